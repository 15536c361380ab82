"""Packed images are sampled between their pixels, in one atlas or alone."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from seen import plane

from gavo_jax.camera import Camera
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
from gavo_jax.image.warp import Warped


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
