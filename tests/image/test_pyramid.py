"""Pyramids: half-pixel convention, depth that is never mixed across an edge, missing readings that stay missing."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from gavo_jax.camera import Camera
from gavo_jax.image.levels import atlas_layout
from gavo_jax.image.pyramid import (
    LEVELS,
    NO_PIXEL,
    PyramidLevel,
    build_pyramid,
    halve_grey,
    halve_inverse_depth,
    make_atlas,
)

CAMERA = Camera(131.0, 130.0, 78.3, 61.2, 160, 120)

build = jax.jit(build_pyramid, static_argnames="levels")
halve_depth = jax.jit(halve_inverse_depth)


def rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Normalised coordinates (x, y) of every pixel centre, [h, w] each."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy


def ramp_frame() -> tuple[np.ndarray, np.ndarray]:
    """Grey and depth (m) of a plane with a linear ramp painted on the image: both affine in normalised coordinates."""
    x, y = rays(CAMERA)
    return (120 + 70 * x - 40 * y).astype(np.float32), (1 / (0.5 + 0.12 * x - 0.06 * y)).astype(np.float32)


@pytest.mark.parametrize("level", range(LEVELS))
def test_a_level_shows_what_its_camera_sees(level: int) -> None:
    grey, depth = ramp_frame()
    image = build(grey, depth, 1.0)[level]
    camera = CAMERA.level(level)
    x, y = rays(camera)
    inner = np.s_[2:-2, 2:-2]
    assert image.grey.shape == image.inverse_depth.shape == (camera.height, camera.width)
    np.testing.assert_allclose(image.grey[inner], (120 + 70 * x - 40 * y)[inner], rtol=1e-5)
    np.testing.assert_allclose(image.inverse_depth[inner], (0.5 + 0.12 * x - 0.06 * y)[inner], rtol=1e-5)


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_level_0_is_the_image_itself(kind: type) -> None:
    grey = np.arange(48, dtype=kind).reshape(6, 8)
    depth = np.full((6, 8), 10_000, np.uint16)
    image = build(grey, depth, 5000.0, levels=1)[0]
    np.testing.assert_array_equal(image.grey, grey)
    np.testing.assert_array_equal(image.inverse_depth, np.full((6, 8), 0.5, np.float32))
    assert image.grey.dtype == image.inverse_depth.dtype == jnp.float32


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf, -np.inf])
def test_what_is_no_depth_is_no_reading(bad: float) -> None:
    depth = np.full((8, 8), 2.0, np.float32)
    depth[2:4, 4:6] = bad
    depth[6, 6] = bad
    pyramid = build(np.zeros((8, 8), np.uint8), depth, 1.0, levels=2)
    np.testing.assert_array_equal(pyramid[0].inverse_depth == 0, depth != 2.0)
    expected = np.full((4, 4), 0.5)
    expected[1, 2] = 0
    np.testing.assert_allclose(pyramid[1].inverse_depth, expected, rtol=1e-6)


def test_grey_that_is_not_finite_does_not_spread() -> None:
    grey = np.full((8, 8), 50.0, np.float32)
    grey[3, 3] = np.nan
    assert all(np.isfinite(level.grey).all() for level in build(grey, np.ones((8, 8), np.float32), 1.0, levels=3))


def test_odd_sizes_drop_the_last_row_and_column() -> None:
    pyramid = build(np.full((31, 45), 7, np.uint8), np.ones((31, 45), np.float32), 1.0, levels=4)
    assert [level.grey.shape for level in pyramid] == [(31, 45), (15, 22), (7, 11), (3, 5)]
    for level in pyramid:
        np.testing.assert_allclose(level.grey, 7, rtol=1e-6)
        np.testing.assert_allclose(level.inverse_depth, 1, rtol=1e-6)


def test_halving_grey_keeps_the_mean_and_is_symmetric() -> None:
    grey = np.zeros((16, 16), np.float32)
    grey[7:9, 7:9] = 64.0
    half = np.asarray(halve_grey(jnp.asarray(grey)))
    assert half.sum() == pytest.approx(64.0)
    np.testing.assert_allclose(half, half.T)
    np.testing.assert_allclose(half, half[::-1, ::-1])


def test_a_block_across_an_edge_keeps_the_nearer_surface() -> None:
    inverse_depth = jnp.array([[1.0, 0.5, 0.5, 0.0], [0.5, 1.01, 0.0, 0.502]], jnp.float32)
    np.testing.assert_allclose(halve_inverse_depth(inverse_depth), [[1.005, 0.501]], rtol=1e-6)


inverse_depths = npst.arrays(
    np.float32, (6, 8), elements=st.sampled_from([0.0, 0.25, 0.251, 0.5, 0.505, 1.0, 1.5, 4.0])
)


@given(inverse_depths)
def test_halved_depth_lies_on_the_nearest_surface(inverse_depth: np.ndarray) -> None:
    half = np.asarray(halve_depth(inverse_depth))
    blocks = inverse_depth.reshape(3, 2, 4, 2).transpose(0, 2, 1, 3).reshape(3, 4, 4)
    nearest = blocks.max(axis=-1)
    np.testing.assert_array_equal(half == 0, nearest == 0)
    assert np.all(half <= nearest * (1 + 1e-6))
    assert np.all(half >= nearest * 0.95), "a farther surface was mixed in"


def readings(*rows: list[float], width: int = 640) -> np.ndarray:
    """Which of some depths, metres, are kept: each row is a strip of an image of that width, repeated below."""
    kept = []
    for row in rows:
        depth = np.ones((8, width), np.float32)
        depth[:, : len(row)] = row
        image = build(np.zeros(depth.shape, np.uint8), depth, 1.0, levels=1)[0]
        turned = build(np.zeros(depth.T.shape, np.uint8), depth.T, 1.0, levels=1)[0]
        found = np.asarray(image.inverse_depth) > 0
        np.testing.assert_array_equal(np.asarray(turned.inverse_depth).T > 0, found)
        kept.append(found[4, : len(row)])
    return np.array(kept)


def test_readings_between_two_surfaces_are_none() -> None:
    """As a time-of-flight camera has them at boundaries, and whoever interpolates depth."""
    one_pixel, three_pixels, into_a_hole, alone = readings(
        [1, 1, 1, 1.4, 2, 2, 2, 1, 1],
        [1, 1, 1.2, 1.5, 1.8, 2, 2, 2, 2],
        [1, 1, 0.7, 0.2, 0, 0, 0.4, 1, 1],
        [1, 1, 1, 1, 7, 1, 1, 1, 1],
    )
    np.testing.assert_array_equal(np.flatnonzero(~one_pixel), [3])
    np.testing.assert_array_equal(np.flatnonzero(~three_pixels), [2, 3, 4])
    np.testing.assert_array_equal(np.flatnonzero(~into_a_hole), [2, 3, 4, 5, 6])
    np.testing.assert_array_equal(np.flatnonzero(~alone), [4])


def test_readings_beside_an_edge_or_a_hole_are_kept() -> None:
    step, hole = [1, 1, 1, 1, 2, 2, 2, 2, 2], [1, 1, 0, 0, 0, 2, 2, 2, 2]
    slanted, sparse = [1, 1.02, 1.04, 1.06, 1.08, 1.1, 1.12, 1.14, 1.16], [0, 3, 0, 0, 2, 0, 1, 1, 1]
    rows = [step, hole, slanted, sparse]
    np.testing.assert_array_equal(readings(*rows), np.array(rows) > 0)


def test_small_images_may_change_more_from_a_pixel_to_the_next() -> None:
    """The floor, seen in 80 columns."""
    row = [1 / (1 - 0.1 * pixel) for pixel in range(8)]
    assert readings(row, width=80).all() and not readings(row).all()


def test_zeros_stay_zeros_on_every_level() -> None:
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 1.01, (64, 64)).astype(np.float32)
    depth[16:48, 32:] = 0
    pyramid = build(np.zeros((64, 64), np.uint8), depth, 1.0, levels=5)
    for k, level in enumerate(pyramid):
        assert isinstance(level, PyramidLevel)
        seen = (depth > 0).reshape(64 >> k, 1 << k, 64 >> k, 1 << k).any(axis=(1, 3))
        np.testing.assert_array_equal(np.asarray(level.inverse_depth) > 0, seen)


@given(st.integers(16, 700), st.integers(16, 700), st.sets(st.integers(0, LEVELS - 1), min_size=1), st.randoms())
def test_levels_in_an_atlas_keep_a_pixel_between_them(height: int, width: int, some: set[int], order: Any) -> None:
    levels = sorted(some)
    order.shuffle(levels)
    sizes = [(height >> level, width >> level) for level in levels]
    layout = atlas_layout(sizes)
    count = np.zeros((layout.height + 1, layout.width + 1), int)
    for (h, w), (row, column) in zip(sizes, layout.corners, strict=True):
        assert row + h <= layout.height and column + w <= layout.width
        count[row : row + h + 1, column : column + w + 1] += 1  # with a pixel behind and below
        count[row + h, column : column + w + 1] -= 1
        count[row : row + h, column + w] -= 1
        count[row : row + h, column : column + w] += 10
    assert set(np.unique(count)) <= {0, 11}, "two levels touch or overlap"
    assert count[: layout.height, : layout.width].reshape(-1)[layout.gap] == 0


def test_an_atlas_shows_its_levels_and_nothing_else() -> None:
    levels = [
        PyramidLevel(jnp.full(size, value), jnp.full(size, value)) for size, value in (((3, 4), 2.0), ((7, 9), 5.0))
    ]
    atlas = make_atlas(levels)
    assert atlas.grey.shape == (7 + 1 + 3 + 3, 9 + 3)
    for image, empty in ((atlas.grey, NO_PIXEL), (atlas.inverse_depth, 0.0)):
        expected = np.full((14, 12), empty)
        expected[1:8, 1:10], expected[9:12, 1:5] = 5.0, 2.0
        np.testing.assert_array_equal(image, expected)


def test_halving_replicates_the_border() -> None:
    grey = np.random.default_rng(1).uniform(0, 255, (8, 10)).astype(np.float32)
    wide, kernel = np.pad(grey, 1, mode="edge"), np.array([1, 3, 3, 1]) / 8
    blocks = np.lib.stride_tricks.sliding_window_view(wide, (4, 4))[::2, ::2]
    np.testing.assert_allclose(halve_grey(jnp.asarray(grey)), blocks @ kernel @ kernel, rtol=1e-5)
