"""Which frames of a recording a camera is estimated from."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from small import CAMERA

from gavo_jax.calibration.motion import LEAST_FRAMES, stretches_of_motion
from gavo_jax.datasets.base import Frame
from gavo_jax.errors import GavoError


class Stamped:
    """Images at any timestamps."""

    name, camera, ground_truth = "stamped", CAMERA, None

    def __init__(self, timestamps: np.ndarray) -> None:
        self.timestamps = timestamps

    def __len__(self) -> int:
        return len(self.timestamps)

    def __getitem__(self, index: Any) -> Any:
        grey = np.random.default_rng(index).integers(0, 255, (CAMERA.height, CAMERA.width)).astype(np.uint8)
        return Frame(grey, np.full(grey.shape, 5000, np.uint16), float(self.timestamps[index]))

    def __iter__(self) -> Any:
        return (self[i] for i in range(len(self)))

    def check(self) -> None:
        """Nothing to check."""


def test_no_speed_is_computed_across_stamps_that_cannot_be_right() -> None:
    """A frame stamped late, with the next right behind it, made a readout of 2 ms of one of 29, and seemed sure."""
    stamps = np.arange(40) / 30
    stamps[15] += 0.03
    (run,) = stretches_of_motion(Stamped(stamps))
    assert [frame.timestamp for frame in run] == pytest.approx(stamps[16:])


def test_too_few_credible_frames_are_refused() -> None:
    stamps = np.arange(4 * LEAST_FRAMES) / 30
    stamps[:: LEAST_FRAMES - 2] += 0.03
    with pytest.raises(GavoError, match="too soon after the last"):
        stretches_of_motion(Stamped(stamps))


def test_a_sequence_may_decode_into_the_same_arrays() -> None:
    """The frames that are kept were all the last one."""
    same = np.empty((CAMERA.height, CAMERA.width), np.uint8)

    class Reusing(Stamped):
        def __getitem__(self, index: Any) -> Any:
            np.copyto(same, (frame := super().__getitem__(index)).grey)
            return replace(frame, grey=same)

    stamps = np.arange(20) / 30
    (run,) = stretches_of_motion(Reusing(stamps))
    for frame, right in zip(run, Stamped(stamps), strict=True):
        np.testing.assert_array_equal(frame.grey, right.grey)
