"""Sequences of one's own whose camera has lens distortion."""

import copy
from dataclasses import replace
from typing import Any

import numpy as np
from small import CAMERA, NEWTON

from gavo_jax.datasets.rectified import rectified, without_distortion
from gavo_jax.datasets.rendered.sensor_noise import NONE
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.odometry.run import run_odometry
from gavo_jax.odometry.stream import track

PLAIN = SyntheticSequence(4, noise=NONE, camera=CAMERA, color=True)
LENS = replace(CAMERA, distortion=(0.1, -0.1, 0.0, 0.0, 0.0))


class Raw:
    """Frames as a camera with a lens records them, as far as a program can tell."""

    bodies_truth = ("of the source",)

    def __init__(self, frames: Any = PLAIN) -> None:
        self.frames, self.camera, self.name = frames, LENS, "raw"
        self.ground_truth, self.timestamps = frames.ground_truth, frames.timestamps

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: Any) -> Any:
        return Raw(self.frames[index]) if isinstance(index, slice) else self.frames[index]

    def check(self) -> None:
        pass


def test_frames_come_without_distortion_whoever_takes_them() -> None:
    sequence: Any = without_distortion(Raw())  # pyright: ignore[reportArgumentType]
    assert not sequence.camera.is_distorted and sequence.name == "raw" and sequence.bodies_truth == Raw.bodies_truth
    expected = rectified(PLAIN[2], LENS)
    for frame in (sequence[2], sequence[1:][1], list(sequence)[2]):
        assert frame.color is not None and expected.color is not None
        np.testing.assert_array_equal(frame.grey, expected.grey)
        np.testing.assert_array_equal(frame.depth, expected.depth)
        np.testing.assert_array_equal(frame.color, expected.color)
    assert without_distortion(PLAIN) is PLAIN
    assert copy.copy(sequence).name == "raw"


def test_a_run_holds_the_sequence_as_it_was_tracked() -> None:
    """Its map was made of the frames as they were recorded, as if by a pinhole."""
    run = run_odometry(Raw(), NEWTON)  # pyright: ignore[reportArgumentType]
    assert run.sequence is not None and not run.sequence.camera.is_distorted
    steps = list(track(Raw(), NEWTON))  # pyright: ignore[reportArgumentType]
    np.testing.assert_array_equal(run.trajectory.world_T_camera[-1], steps[-1].world_T_camera)


def test_depth_that_is_no_finite_number_is_no_reading() -> None:
    """Infinity is written for "farther than I see"; some of what looks at depth took it for a distance."""
    depth = PLAIN[0].depth.astype(np.float32)
    depth[:10], depth[10:20] = np.inf, np.nan
    plain = rectified(replace(PLAIN[0], depth=depth), CAMERA)  # pyright: ignore[reportArgumentType]
    assert plain.depth.dtype == np.float32 and not plain.depth[:20].any()
    np.testing.assert_array_equal(plain.depth[20:], depth[20:])
