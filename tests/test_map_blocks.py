"""Which blocks of voxels a frame touches."""

from dataclasses import replace

import numpy as np
import pytest
from small import CAMERA

from gavo_jax.map_blocks import BLOCK, SAMPLING_STRIDE, image_for_blocks, with_samples_filled


@pytest.mark.parametrize("stray", [0.0, 0.5, 3.0])
def test_open3d_finds_a_reading_where_it_looks(stray: float) -> None:
    """A sensor leaves out every fourth row; one stray reading there does not do for all others."""
    metres = np.full((40, 60), 2.0, np.float32)
    metres[::4] = 0.0
    metres[0, 0] = stray
    filled = with_samples_filled(metres)
    assert np.all(filled[::4, ::4] > 0) and filled[0, 0] == (stray or 2.0)
    np.testing.assert_array_equal(filled[1], metres[1])


def test_only_what_lies_between_its_neighbours_fills_a_sample() -> None:
    """Catches a surface that grows by a sample on every side, and with it the map."""
    for place, reached in (((3, 3), {(0, 0), (0, 4), (4, 0), (4, 4)}), ((4, 4), {(4, 4)})):
        metres = np.zeros((20, 20), np.float32)
        metres[place] = 1.0
        found = with_samples_filled(metres)[::SAMPLING_STRIDE, ::SAMPLING_STRIDE]
        assert {(int(i) * SAMPLING_STRIDE, int(j) * SAMPLING_STRIDE) for i, j in np.argwhere(found)} == reached


@pytest.mark.parametrize("voxel", [0.01, 0.002])
def test_no_block_lies_between_the_pixels_that_are_looked_at(voxel: float) -> None:
    metres = np.full((CAMERA.height, CAMERA.width), 0.5, np.float32)
    metres[10:20], metres[20:30] = 2.0, 0.0  # the farthest counts
    seen, matrix = image_for_blocks(metres, CAMERA, voxel)
    assert SAMPLING_STRIDE * 2.0 / matrix[0, 0] <= BLOCK * voxel
    ahead = np.array([0.3, -0.2, 1.0])
    (u, v), (column, row) = ((camera @ ahead)[:2] for camera in (CAMERA.matrix, matrix))
    times = seen.shape[1] / CAMERA.width  # the same place of the image, its pixels' middles at whole numbers
    np.testing.assert_allclose([(column + 0.5) / times, (row + 0.5) / times], [u + 0.5, v + 0.5])


def test_an_image_that_is_fine_enough_stays() -> None:
    metres = np.random.default_rng(0).uniform(1.0, 2.0, (CAMERA.height, CAMERA.width)).astype(np.float32)
    seen, matrix = image_for_blocks(metres, replace(CAMERA, depth_scale=1000.0), 0.1)
    np.testing.assert_array_equal(seen, metres)
    np.testing.assert_allclose(matrix, CAMERA.matrix)


def test_a_frame_without_a_reading_stays_an_image() -> None:
    """Catches an image of no pixels, which Open3D refuses."""
    seen, _ = image_for_blocks(np.zeros((CAMERA.height, CAMERA.width), np.float32), CAMERA, 0.01)
    assert seen.shape == (CAMERA.height, CAMERA.width) and not seen.any()
