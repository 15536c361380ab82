"""The warp, equations (4) to (8), against plain formulas."""

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from seen import CAMERA, jit_warp
from twists import hat, twists

from gavo_jax.camera import Camera
from gavo_jax.image.warp import Points, warp


def grid_points(camera: Camera, inverse_depth: np.ndarray) -> Points:
    v, u = np.mgrid[: camera.height, : camera.width]
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return Points(*(jnp.asarray(a.reshape(-1), jnp.float32) for a in (x, y, inverse_depth)))


@given(twists(0.2), st.integers(0, 5))
@settings(max_examples=30)
def test_warp_is_back_project_transform_project(xi: np.ndarray, seed: int) -> None:
    depth = np.random.default_rng(seed).uniform(0.5, 6.0, (48, 64))
    target_T_reference = scipy.linalg.expm(hat(xi))
    v, u = np.mgrid[:48, :64]
    points = CAMERA.back_project(np.stack([u, v], -1).astype(float), depth)
    moved = points @ target_T_reference[:3, :3].T + target_T_reference[:3, 3]
    moved[moved[..., 2] < 0.05] = np.nan
    pixels = np.asarray(CAMERA.project(moved)).reshape(-1, 2)
    warped = jit_warp(grid_points(CAMERA, 1 / depth), target_T_reference.astype(np.float32), CAMERA)
    distance = np.max([-pixels[:, 0], pixels[:, 0] - 63, -pixels[:, 1], pixels[:, 1] - 47], axis=0)
    inside = np.asarray(warped.inside) > 0
    near = np.isnan(distance)
    np.testing.assert_array_equal(
        inside[~near & (np.abs(distance) > 1e-3)], (distance < 0)[~near & (np.abs(distance) > 1e-3)]
    )
    seen = inside & ~near
    np.testing.assert_allclose(np.stack([warped.u, warped.v], -1)[seen], pixels[seen], atol=2e-3)
    np.testing.assert_allclose(warped.inverse_depth[seen], 1 / moved[..., 2].reshape(-1)[seen], rtol=1e-4)


def test_points_without_reading_or_behind_the_camera_are_not_inside() -> None:
    inverse_depth = np.full((48, 64), 0.5)
    inverse_depth[:, :32] = 0
    inside = np.asarray(jit_warp(grid_points(CAMERA, inverse_depth), jnp.eye(4), CAMERA).inside).reshape(48, 64)
    assert not inside[:, :32].any() and inside[:-1, 32:-1].all()
    backwards = np.eye(4, dtype=np.float32)
    backwards[2, 3] = -3.0
    assert not np.any(jit_warp(grid_points(CAMERA, inverse_depth), backwards, CAMERA).inside)


def test_inside_is_where_four_neighbours_are() -> None:
    pixels = [(0, 0, 1), (62.99, 46.99, 1), (63, 10, 0), (10, 47, 0), (-0.01, 10, 0), (10, -0.01, 0), (70, 10, 0)]
    u, v, expected = np.array(pixels).T
    points = Points(*(jnp.asarray(a, jnp.float32) for a in ((u - 31.2) / 60, (v - 24.1) / 58, np.ones(7))))
    np.testing.assert_array_equal(warp(points, jnp.eye(4), CAMERA).inside[1:], expected[1:])
