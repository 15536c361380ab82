"""Equations (3) to (8) and the sampling of packed images, against SciPy and plain formulas."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from gavo_jax.camera import Camera
from gavo_jax.datasets.sensor_noise import NONE
from gavo_jax.datasets.synthetic import SyntheticSequence
from gavo_jax.image.levels import Levels, image_plane
from gavo_jax.image.pyramid import PyramidLevel, build_pyramid, make_atlas
from gavo_jax.image.sampling import (
    INVERSE_DEPTH_STEP,
    SLOPE_STEP,
    DepthSample,
    GreySample,
    Target,
    Words,
    inverse_depth_slopes,
    look_up,
    pack_grey,
    pack_target,
    sample_depth,
    sample_grey,
)
from gavo_jax.image.shutter import Shutter, delay, delayed_slopes, row_time
from gavo_jax.image.synchronisation import synchronise_depth
from gavo_jax.image.warp import Points, Slopes, Warped, warp
from gavo_jax.se3 import GENERATORS, adjoint, exp, log, right_jacobian

CAMERA = Camera(60.0, 58.0, 31.2, 24.1, 64, 48)


def twists(reach: float) -> st.SearchStrategy[np.ndarray]:
    """ξ of [6] with entries within ± reach, the identity and its neighbourhood included."""
    value = (
        st.floats(-reach, reach, allow_subnormal=False) | st.floats(-1e-6, 1e-6, allow_subnormal=False) | st.just(0.0)
    )
    return npst.arrays(np.float64, 6, elements=value).map(lambda xi: xi.astype(np.float32))


def hat(xi: np.ndarray) -> np.ndarray:
    """ξ̂ of ξ = (v, w), equation (3): rotation's cross-product matrix, translation in the last column."""
    x, y, z = xi[3:]
    return np.array([[0, -z, y, xi[0]], [z, 0, -x, xi[1]], [-y, x, 0, xi[2]], [0, 0, 0, 0]], np.float64)


jit_exp, jit_log, jit_jacobian = jax.jit(exp), jax.jit(log), jax.jit(right_jacobian)
jit_warp, jit_delay = jax.jit(warp), jax.jit(delay)


@partial(jax.jit, static_argnums=(2, 3))
def words_of(target: Target, warped: Warped, height: int, width: int) -> Words:
    return look_up(target, warped, image_plane(Camera(1.0, 1.0, 0.0, 0.0, width, height)))


@jax.jit
def packed(grey: jax.Array, inverse_depth: jax.Array) -> Target:
    return pack_target(make_atlas([PyramidLevel(grey, inverse_depth)]))


@jax.jit
def pack_and_sample(image: jax.Array, warped: Warped) -> GreySample:
    return sample_grey(words_of(packed(image, jnp.zeros_like(image)), warped, *image.shape), warped)


@jax.jit
def pack_and_sample_depth(inverse_depth: jax.Array, warped: Warped) -> DepthSample:
    target = packed(jnp.zeros_like(inverse_depth), inverse_depth)
    return sample_depth(words_of(target, warped, *inverse_depth.shape), warped)


@given(twists(1.7))
def test_exp_is_the_matrix_exponential_translation_first(xi: np.ndarray) -> None:
    np.testing.assert_allclose(jit_exp(xi), scipy.linalg.expm(hat(xi)), atol=3e-6)


@given(twists(1.7))
def test_log_undoes_exp(xi: np.ndarray) -> None:
    np.testing.assert_allclose(jit_log(jit_exp(xi)), xi, atol=2e-5)


def test_exp_of_a_batch_is_exp_of_each() -> None:
    xi = np.random.default_rng(0).normal(0, 0.3, (2, 3, 6)).astype(np.float32)
    batch = np.asarray(exp(jnp.asarray(xi)))
    assert batch.shape == (2, 3, 4, 4)
    np.testing.assert_allclose(batch[1, 2], scipy.linalg.expm(hat(xi[1, 2])), atol=1e-6)


def test_generators_are_the_twists_matrix() -> None:
    xi = np.array([1.0, 2, 3, 4, 5, 6])
    np.testing.assert_allclose(GENERATORS @ xi, hat(xi))


@given(twists(0.3), twists(1.0))
def test_right_jacobian_to_second_order(xi: np.ndarray, direction: np.ndarray) -> None:
    h = 1e-5
    moved = [scipy.linalg.expm(hat(xi.astype(float) + sign * h * direction)) for sign in (1, -1)]
    base = scipy.linalg.expm(hat(xi))
    tangent = np.linalg.inv(base) @ (moved[0] - moved[1]) / (2 * h)
    third_order = np.linalg.norm(xi) ** 3 * np.linalg.norm(direction)
    assert np.abs(tangent - hat(np.asarray(jit_jacobian(xi)) @ direction)).max() <= 0.1 * third_order + 1e-5


@given(twists(1.0), twists(1.0))
def test_adjoint_takes_a_step_to_the_other_side(xi: np.ndarray, step: np.ndarray) -> None:
    motion = scipy.linalg.expm(hat(xi))
    moved = hat(np.asarray(jax.jit(adjoint)(jnp.asarray(motion, jnp.float32))) @ step) @ motion
    np.testing.assert_allclose(moved, motion @ hat(step), atol=1e-5)


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


def random_samples(seed: int, count: int = 500) -> tuple[np.ndarray, np.ndarray, Warped]:
    rng = np.random.default_rng(seed)
    u = np.concatenate([rng.uniform(0, 62.999, count), [0, 62, 0, 62, 62.99]]).astype(np.float32)
    v = np.concatenate([rng.uniform(0, 46.999, count), [0, 0, 46, 46, 46.99]]).astype(np.float32)
    one = jnp.ones(u.shape)
    return u, v, Warped(jnp.asarray(u), jnp.asarray(v), one, one)


def bilinear(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    column, row = np.floor(u).astype(int), np.floor(v).astype(int)
    a, b = u - column, v - row
    top = (1 - a) * image[row, column] + a * image[row, column + 1]
    low = (1 - a) * image[row + 1, column] + a * image[row + 1, column + 1]
    return (1 - b) * top + b * low


@pytest.mark.parametrize("seed", range(3))
def test_packed_sampling_is_bilinear(seed: int) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (48, 64)).astype(np.float32)
    u, v, warped = random_samples(seed)
    sample = pack_and_sample(image, warped)
    exact = bilinear(image.astype(float), u.astype(float), v.astype(float))
    np.testing.assert_allclose(sample.value, exact, atol=1e-3)
    column, row = np.floor(u).astype(int), np.floor(v).astype(int)
    # within a cell the interpolation is linear along either axis, so its derivative is a difference across the cell
    np.testing.assert_allclose(
        sample.along_u, bilinear(image, column + 1 - 1e-9, v) - bilinear(image, column, v), atol=1e-3
    )
    np.testing.assert_allclose(sample.along_v, bilinear(image, u, row + 1 - 1e-9) - bilinear(image, u, row), atol=1e-3)


def test_packing_rounds_to_the_nearest_grey_level_and_saturates() -> None:
    image = jnp.array([[-3.0, 0.4], [254.6, 300.0]], jnp.float32)
    word = int(pack_grey(image)[0, 0])
    assert [word >> shift & 255 for shift in (0, 8, 16, 24)] == [0, 0, 255, 255]


def test_a_point_outside_samples_something_finite() -> None:
    far = jnp.array([-1e9, 1e9, 1e30, -5.0], jnp.float32)
    warped = Warped(far, far, jnp.ones(4), jnp.zeros(4))
    assert pack_and_sample(jnp.full((48, 64), 9.0), warped).value.shape == (4,)
    words = words_of(packed(jnp.full((48, 64), 9.0), jnp.full((48, 64), 0.5)), warped, 48, 64)
    assert np.unique(words.grey).size == 1 and np.unique(words.depth).size == 1


def plane(a: float, b: float, c: float) -> np.ndarray:
    """Inverse depth a + b u + c v of a plane, [48, 64]."""
    v, u = np.mgrid[:48, :64]
    return (a + b * u + c * v).astype(np.float32)


def slopes_of(inverse_depth: np.ndarray) -> tuple[np.ndarray, ...]:
    """Slopes of an image beyond whose border there is no reading."""
    return tuple(np.asarray(slope) for slope in inverse_depth_slopes(jnp.pad(jnp.asarray(inverse_depth), 1)))


@given(st.floats(0.3, 1.0), st.floats(-2e-3, 2e-3), st.floats(-2e-3, 2e-3))
def test_slopes_of_a_plane(a: float, b: float, c: float) -> None:
    along_u, along_v = slopes_of(plane(a, b, c))
    np.testing.assert_allclose(along_u, b, atol=2e-6)
    np.testing.assert_allclose(along_v, c, atol=2e-6)


def test_slopes_do_not_cross_edges_or_gaps() -> None:
    inverse_depth = plane(0.5, 1e-3, -1e-3)
    inverse_depth[:, 30:] += 0.5
    inverse_depth[20, 10:20] = 0
    along_u, along_v = slopes_of(inverse_depth)
    seen = inverse_depth > 0
    np.testing.assert_allclose(along_u[seen], 1e-3, atol=2e-6)
    np.testing.assert_allclose(along_v[seen], -1e-3, atol=2e-6)


def test_a_lonely_reading_has_no_slope() -> None:
    inverse_depth = np.zeros((48, 64), np.float32)
    inverse_depth[10, 10] = 0.7
    along_u, along_v = slopes_of(inverse_depth)
    assert float(along_u[10, 10]) == float(along_v[10, 10]) == 0.0


def test_packed_depth_samples_a_plane_between_its_pixels() -> None:
    inverse_depth = plane(0.5, 4 * SLOPE_STEP, -7 * SLOPE_STEP)
    u, v, warped = random_samples(3)
    sample = pack_and_sample_depth(jnp.asarray(inverse_depth), warped)
    exact = 0.5 + 4 * SLOPE_STEP * u - 7 * SLOPE_STEP * v
    np.testing.assert_allclose(sample.value, exact, atol=0.6 * INVERSE_DEPTH_STEP)
    np.testing.assert_allclose(sample.along_u, 4 * SLOPE_STEP)
    np.testing.assert_allclose(sample.along_v, -7 * SLOPE_STEP)
    assert np.all(sample.valid == 1)


def test_packed_depth_knows_missing_readings() -> None:
    inverse_depth = plane(0.5, 0, 0)
    inverse_depth[:, 20:40] = 0
    u, _, warped = random_samples(4)
    valid = pack_and_sample_depth(jnp.asarray(inverse_depth), warped).valid
    column = np.floor(u)
    # a block that touches a reading knows one
    np.testing.assert_array_equal(np.asarray(valid) == 0, (column >= 20) & (column < 39))


@settings(max_examples=30)
@given(twists(0.04), st.sampled_from([0.7, -0.7]), st.integers(0, 99))
def test_delayed_points_are_where_the_camera_sees_them_when_it_reads_their_row(
    xi: np.ndarray, readout: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    x, y, q, seen = rng.uniform(-0.4, 0.4, (4, 50)).astype(np.float32)
    q += 0.7
    ahead = np.stack([x / q, y / q, 1 / q, np.ones_like(q)])
    points = Points(*map(jnp.asarray, (x, y, q)))
    shutter = Shutter(jnp.float32(readout), jnp.asarray(seen))
    found = jit_delay(points, jit_warp(points, jit_exp(xi), CAMERA), shutter, CAMERA)
    v, point = np.full(50, CAMERA.cy), ahead
    for _ in range(30):  # when each point is on the row that is being read
        share = 1 + readout * (row_time(v, CAMERA) - seen)
        point = np.einsum("nij,jn->in", scipy.linalg.expm(share[:, None, None] * hat(xi)), ahead)
        v = CAMERA.fy * point[1] / point[2] + CAMERA.cy
    exact = np.stack([CAMERA.fx * point[0] / point[2] + CAMERA.cx, v, 1 / point[2]])
    at_once = np.stack(jit_warp(points, jit_exp(xi), CAMERA)[:3])
    # what is left is of second order in the motion and in the share of it that passes
    error = np.abs(np.stack(found[:3]) - exact)
    assert np.all(error <= 0.35 * np.abs(exact - at_once).max(axis=0) + 2e-3)


def test_slopes_of_delayed_points_are_their_derivatives() -> None:
    rng = np.random.default_rng(1)
    points = Points(*(jnp.asarray(rng.uniform(0.2, 0.8, 20), jnp.float32) for _ in range(3)))
    warped = warp(points, exp(jnp.asarray(rng.normal(0, 0.05, 6), jnp.float32)), CAMERA)
    shutter = Shutter(jnp.float32(0.6), jnp.asarray(rng.uniform(-0.5, 0.5, 20), jnp.float32))
    slopes = Slopes(*(jnp.asarray(rng.normal(size=20), jnp.float32) for _ in range(3)))

    def sampled(u: jax.Array, v: jax.Array, inverse_depth: jax.Array) -> jax.Array:
        moved = delay(points, Warped(u, v, inverse_depth, warped.inside), shutter, CAMERA)
        return sum((jnp.sum(slope * leaf) for slope, leaf in zip(slopes, moved, strict=False)), jnp.float32(0))

    expected = jax.grad(sampled, (0, 1, 2))(*warped[:3])
    found = delayed_slopes(slopes, points, warped, shutter, CAMERA)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)


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


def test_levels_are_sampled_out_of_one_atlas() -> None:
    camera, rng = Camera(40.0, 41.0, 23.1, 17.2, 45, 35), np.random.default_rng(5)
    grey, depth = rng.uniform(0, 255, (35, 45)), rng.choice([0.0, 1.0, 1.02, 1.7], (35, 45))
    levels = (3, 2, 0)
    pyramid = jax.jit(build_pyramid, static_argnums=3)(jnp.asarray(grey), jnp.asarray(depth), 1.0, 4)
    target = jax.jit(lambda some: pack_target(make_atlas(some)))([pyramid[level] for level in levels])
    planes = Levels.of(camera, levels).planes(camera)
    for i, level in enumerate(levels):
        plane = jax.tree.map(lambda leaf, i=i: leaf[i], planes)
        alone, view = packed(*pyramid[level]), camera.level(level)
        assert (plane.height, plane.width) == (view.height, view.width) == pyramid[level].grey.shape
        np.testing.assert_allclose([plane.fx, plane.fy, plane.cx, plane.cy], [view.fx, view.fy, view.cx, view.cy])
        v, u = (axis.ravel().astype(np.float32) for axis in np.mgrid[: view.height - 1, : view.width - 1])
        warped = Warped(u, v, np.ones_like(u), np.ones_like(u))
        expected = words_of(alone, warped, view.height, view.width)
        jax.tree.map(np.testing.assert_array_equal, jax.jit(look_up)(target, warped, plane), expected)
