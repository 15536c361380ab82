"""Depth at the colour image's moment."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from hypothesis import given
from seen import CAMERA, plane
from twists import hat, twists

from gavo_jax.camera import Camera
from gavo_jax.datasets.rendered.sensor_noise import NONE
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.image.pyramid import build_pyramid
from gavo_jax.image.synchronisation import synchronise_depth

synchronise = jax.jit(synchronise_depth)


@given(twists(0.03))
def test_synchronised_depth_of_a_plane(xi: np.ndarray) -> None:
    depth_T_colour = scipy.linalg.expm(hat(xi))
    normal, offset = np.array([0.1, -0.2, 1.0]), 2.0  # points P of the depth camera with normal . P = offset
    v, u = np.mgrid[:48, :64]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], -1)
    read = rays @ normal / offset
    # the same plane seen from the colour image's place
    exact = rays @ (depth_T_colour[:3, :3].T @ normal) / (offset - normal @ depth_T_colour[:3, 3])
    moved = np.asarray(synchronise(read.astype(np.float32), CAMERA, depth_T_colour.astype(np.float32)))
    inner = moved[4:-4, 4:-4]
    assert np.all(inner > 0)
    # nearest-pixel lookup: wrong by the plane's slope over half a pixel a side, and a little more
    assert np.abs(inner - exact[4:-4, 4:-4]).max() < 0.75 * (np.abs(normal[:2]) / offset / 58).sum()


def test_synchronising_with_no_motion_changes_nothing() -> None:
    read = plane(0.5, 1e-3, 2e-3)
    read[10:20, 5:9] = 0
    np.testing.assert_allclose(synchronise(read, CAMERA, jnp.eye(4)), read, rtol=1e-6)


def test_synchronising_with_a_motion_out_of_view_leaves_no_reading() -> None:
    around = np.diag([-1.0, 1.0, -1.0, 1.0]).astype(np.float32)
    np.testing.assert_array_equal(synchronise(plane(0.5, 0, 0), CAMERA, around), 0)


def test_synchronised_depth_of_the_room() -> None:
    sequence = SyntheticSequence(frames=4, noise=NONE, camera=Camera(131.0, 131.0, 79.5, 59.5, 160, 120))
    world_T_camera = sequence.ground_truth.world_T_camera
    depth_T_colour = np.linalg.inv(world_T_camera[3]) @ world_T_camera[0]

    def inverse_depth(i: int) -> np.ndarray:
        frame = sequence[i]
        return np.asarray(
            build_pyramid(jnp.asarray(frame.grey), jnp.asarray(frame.depth), 5000.0, levels=1)[0].inverse_depth
        )

    exact, late = inverse_depth(0), inverse_depth(3)
    moved = np.asarray(synchronise(late, sequence.camera, depth_T_colour.astype(np.float32)))
    seen = moved > 0
    assert seen.mean() > 0.9
    before = np.abs(late - exact)[seen]
    after = np.abs(moved - exact)[seen]
    assert np.median(after) < 0.2 * np.median(before)
    assert np.mean(after) < 0.5 * np.mean(before)
