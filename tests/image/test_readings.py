"""What is no reading in depth that comes as an array."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from small import CAMERA, NEWTON, Rendered

from gavo_jax.alignment.pairs import align
from gavo_jax.datasets.rectified import rectified
from gavo_jax.number_types import as_depth

FRAMES = [Rendered(4, camera=CAMERA)[i] for i in (0, 3)]
MARKED = [replace(frame, depth=np.where(np.arange(160) < 60, 65535, frame.depth)) for frame in FRAMES]
BARE = [replace(frame, depth=np.where(np.arange(160) < 60, 0, frame.depth)) for frame in FRAMES]


def test_the_largest_number_of_16_bits_is_no_reading() -> None:
    """As in files: 7-Scenes has it so. Taken for 13 metres it put a run eleven times as far off, its pairs `ok`."""
    assert MARKED[0].depth.dtype == np.uint16
    np.testing.assert_array_equal(rectified(MARKED[0], CAMERA).depth, BARE[0].depth)
    swapped = MARKED[0].depth.astype(">u2")
    np.testing.assert_array_equal(as_depth(swapped), BARE[0].depth)


@pytest.mark.parametrize("kind", [np.float32, np.int32])
def test_the_same_number_of_other_types_is_one(kind: type) -> None:
    depth = np.full((2, 2), 65535, kind)
    np.testing.assert_array_equal(as_depth(depth), depth)


@pytest.mark.parametrize("place", [np.asarray, jnp.asarray])
def test_a_pair_of_arrays_is_aligned_as_without_them(place) -> None:
    def pair(frames):
        (one, other) = ((place(frame.grey), place(frame.depth)) for frame in frames)
        return align(one, other, CAMERA, NEWTON)

    marked, bare = pair(MARKED), pair(BARE)
    np.testing.assert_array_equal(marked.target_T_reference, bare.target_T_reference)
    assert marked.statuses == bare.statuses
