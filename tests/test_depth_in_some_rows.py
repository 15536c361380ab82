"""Depth in some of the rows or columns, as of a spinning sensor: which of them they are changes nothing."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.synthetic import DEFAULT_CAMERA, SyntheticSequence
from gavo_jax.frame_checks import Finding, History, Use, check_frame, check_images
from gavo_jax.inspection import inspect_sequence
from gavo_jax.status import AlignmentStatus as Status

CAMERA = DEFAULT_CAMERA.level(1)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return list(SyntheticSequence(frames=4, camera=CAMERA))


def kept(frame: Frame, axis: int, first: int, step: int) -> Frame:
    """A frame with depth in every so many rows (axis 0) or columns alone."""
    is_kept = np.arange(frame.depth.shape[axis]) % step == first
    return replace(frame, depth=np.where(is_kept[:, None] if axis == 0 else is_kept, frame.depth, 0))


def findings_of(frames: list[Frame]) -> list[Finding]:
    findings, history = [], History()
    for frame in frames:
        finding, history = check_frame(frame, frame.timestamp, CAMERA, history)
        findings.append(finding)
    return findings


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("step", "first"), [(2, 1), (4, 0), (4, 1), (4, 2), (8, 3), (16, 15)])
def test_depth_is_seen_whichever_rows_or_columns_have_it(frames: list[Frame], axis: int, step: int, first: int) -> None:
    sparse = [kept(frame, axis, first, step) for frame in frames]
    assert findings_of(sparse) == [Finding(Status.OK, Use.ALL)] * 4
    assert not check_images(sparse[0].grey, sparse[0].depth, CAMERA.depth_scale)


@pytest.mark.parametrize("axis", [0, 1])
def test_rows_that_change_from_frame_to_frame_are_as_many(frames: list[Frame], axis: int) -> None:
    sparse = [kept(frame, axis, i % 4, 4) for i, frame in enumerate(frames)]
    assert findings_of(sparse) == [Finding(Status.OK, Use.ALL)] * 4


@pytest.mark.parametrize("axis", [0, 1])
def test_depth_of_some_rows_that_is_the_last_one_once_more_is_told(frames: list[Frame], axis: int) -> None:
    sparse = [kept(frame, axis, 3, 8) for frame in frames]
    frozen = [replace(frame, depth=sparse[0].depth) for frame in sparse[:3]]
    assert [finding.status for finding in findings_of(frozen)] == [Status.OK, Status.FROZEN, Status.FROZEN]


def test_a_spare_reading_here_and_there_is_no_depth(frames: list[Frame]) -> None:
    sparse = [kept(kept(frame, 0, 3, 8), 1, 3, 8) for frame in frames[:2]]
    assert findings_of(sparse) == [Finding(Status.NO_DEPTH, Use.TARGET)] * 2


class EveryOtherRow:
    """A sequence with depth in the rows of odd numbers alone."""

    name, camera, ground_truth = "every other row", CAMERA, None

    def __init__(self, frames: list[Frame]) -> None:
        self.frames = [kept(frame, 0, 1, 2) for frame in frames]
        self.timestamps = np.array([frame.timestamp for frame in frames])

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: Any) -> Any:
        return self.frames[index]


def test_an_inspection_sees_what_a_run_does(frames: list[Frame]) -> None:
    """65535 was a surface at 13 m, and an image in colour a traceback."""
    sequence: Any = EveryOtherRow(frames)
    sequence.frames = [
        replace(f, depth=np.where(f.depth > 0, f.depth, 65535).astype(np.uint16)) for f in sequence.frames
    ]
    sequence.frames[2] = replace(sequence.frames[2], grey=np.stack([sequence.frames[2].grey] * 3, axis=-1))
    facts = inspect_sequence(sequence)
    assert facts["depth"]["far_m"] < 13 and facts["depth"]["coverage"] < 0.52
    assert facts["frames_not_used"] == {"unreadable": 1} and "grey image" in facts["why_not"][0]


def test_an_inspection_finds_them(frames: list[Frame]) -> None:
    sequence: Any = EveryOtherRow(frames)
    depth = inspect_sequence(sequence)["depth"]
    full = np.mean([np.mean(frame.depth > 0) for frame in frames])
    assert abs(depth["coverage"] - full / 2) < 0.02 and depth["median_m"] is not None
