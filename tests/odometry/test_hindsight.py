"""Pairs that turn out to have followed a body."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from gavo_jax.alignment.judgement import UNKNOWN
from gavo_jax.alignment.result import no_alignment, with_finding
from gavo_jax.odometry.driver import Step
from gavo_jax.odometry.hindsight import revised
from gavo_jax.output.frames import read_run
from gavo_jax.output.run_folder import RunFolder
from gavo_jax.rigid_motions import exp
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import inverse


def ran(*statuses: AlignmentStatus) -> list[Step]:
    """A run with a pair of each status."""
    exact = 1e-6 * np.eye(6, dtype=np.float32)
    return [
        Step(i, i - 1.0, float(i), no_alignment(status)._replace(covariance=exact), np.eye(4), 1.0, False)
        for i, status in enumerate(statuses, start=1)
    ]


def test_pairs_that_followed_a_body_say_so_once_it_is_seen() -> None:
    ok, high_error, body = AlignmentStatus.OK, AlignmentStatus.HIGH_ERROR, AlignmentStatus.MOVING_BODY
    steps = ran(ok, ok, high_error, ok, body, ok)
    steps[3] = replace(steps[3], lost=True)
    steps[4] = replace(steps[4], revises=2, reference_timestamp=3.0)
    after = revised(steps)
    assert [step.alignment.statuses for step in after] == [(ok,), (body,), (high_error, body), (ok,), (body,), (ok,)]
    assert [np.array_equal(step.alignment.covariance, UNKNOWN) for step in after] == [False, True, True] + [False] * 3
    assert [step.alignment.status for step in steps] == [ok, ok, high_error, ok, body, ok], (
        "the steps stay as they were"
    )
    for once, twice in zip(after, revised(after), strict=True):
        assert once.alignment.statuses == twice.alignment.statuses


def test_no_more_pairs_are_revised_than_there_are() -> None:
    steps = ran(AlignmentStatus.OK, AlignmentStatus.OK)
    steps[1] = replace(steps[1], revises=9)
    assert [step.alignment.status for step in revised(steps)] == [AlignmentStatus.MOVING_BODY, AlignmentStatus.OK]


def test_a_stamp_out_of_order_speaks_of_the_one_before() -> None:
    ok, early, implausible = AlignmentStatus.OK, AlignmentStatus.BAD_TIMESTAMP, AlignmentStatus.IMPLAUSIBLE_MOTION
    steps = ran(ok, ok, early, ok, ok)
    steps[2] = replace(steps[2], revises=1, lost=True)
    steps[3] = replace(steps[3], reference_timestamp=steps[2].reference_timestamp)
    assert [step.alignment.status for step in revised(steps)] == [ok, implausible, early, implausible, ok]


def test_what_a_step_says_of_others_stays_when_it_is_revised_itself() -> None:
    """A run folder is read and revised again whenever somebody looks at it."""
    ok, body, implausible = AlignmentStatus.OK, AlignmentStatus.MOVING_BODY, AlignmentStatus.IMPLAUSIBLE_MOTION
    steps = ran(ok, ok, implausible, body)
    steps[2], steps[3] = replace(steps[2], revises=1), replace(steps[3], revises=1)
    after = revised(steps)
    assert [step.alignment.statuses for step in after] == [(ok,), (implausible,), (implausible, body), (body,)]
    for once, twice in zip(after, revised(after), strict=True):
        assert once.alignment.statuses == twice.alignment.statuses


def test_a_doubted_reference_is_no_body_where_a_part_of_the_next_image_stood_still() -> None:
    ok, body, implausible = AlignmentStatus.OK, AlignmentStatus.MOVING_BODY, AlignmentStatus.IMPLAUSIBLE_MOTION
    steps = ran(ok, ok, implausible)
    steps[2] = replace(steps[2], revises=1, alignment=with_finding(steps[2].alignment, body))
    assert revised(steps)[1].alignment.status is implausible


def test_a_correction_of_the_path_says_nothing_of_images() -> None:
    """Loops move the poses after a run; what its motions were stays as it is."""
    steps = turning([0, 1, 2, 3, 5, 4, 6, 7])
    wrong = {step.index for step in revised(steps) if step.alignment.status is not AlignmentStatus.OK}
    moved = [replace(step, world_T_camera=np.eye(4)) for step in steps]
    assert {step.index for step in revised(moved) if step.alignment.status is not AlignmentStatus.OK} == wrong


def turning(moments: Sequence[float]) -> list[Step]:
    """A run of pairs that are ok, over images of a turn by 2 degrees per moment."""
    poses = [exp(np.array([0.0, 0.0, 0.0, 0.0, moment * 0.035, 0.0])) for moment in moments]
    ok = no_alignment(AlignmentStatus.OK)._replace(covariance=np.eye(6, dtype=np.float32) * 1e-6)
    return [
        Step(i, (i - 1) / 15, i / 15, ok._replace(target_T_reference=inverse(new) @ old), new, 1.0, False)
        for i, (old, new) in enumerate(pairwise(poses), start=1)
    ]


def test_lost_frames_are_no_part_of_a_path() -> None:
    """Of two frames that changed places around a third, that one was lost and the others were `ok`."""
    steps = turning([0, 1, 2, 3, 6, 4, 7, 8, 9])
    stamps = [0, 1, 2, 3, 4, 6, 7, 8, 9]
    steps = [
        replace(step, reference_timestamp=a / 15, timestamp=b / 15)
        for step, (a, b) in zip(steps, pairwise(stamps), strict=True)
    ]
    lost = replace(steps[4], timestamp=5 / 15, lost=True)
    after = revised([*steps[:4], lost, *steps[4:]])
    flagged = [place for place, step in enumerate(after) if step.alignment.status is not AlignmentStatus.OK]
    assert flagged == [3, 5, 6]


@pytest.mark.parametrize(
    ("moments", "wrong"),
    [
        ([0, 1, 2, 3, 5, 4, 6, 7], {4, 5, 6}),  # neighbours that changed places
        ([0, 1, 2, 5, 4, 3, 6, 7], {3, 4, 5, 6}),  # those on either side of one
        ([0, 1, 2, 3, 2, 5, 6, 7], {4, 5}),  # an older image
        ([0, 1, 2, 3, 7, 5, 6, 7], {4, 5}),  # a younger one
        ([0, 1, 2, 3, 2, 1, 0, -1], set()),  # a camera that turns round,
        ([0, 1, 0, 1, 0, 1, 0, 1], set()),  # or shakes,
        ([0, 1, 3, 6, 6, 5, 3, 0], set()),  # or swings
    ],
)
def test_images_that_break_a_smooth_path(moments: list[float], wrong: set[int]) -> None:
    steps = turning(moments)
    flagged = {step.index for step in revised(steps) if step.alignment.status is AlignmentStatus.IMPLAUSIBLE_MOTION}
    assert flagged == wrong


def test_a_step_that_is_revised_for_another_reason_says_the_same_of_others() -> None:
    """Revised a second time, the first pair was of another moment, too."""
    ok, body, implausible = AlignmentStatus.OK, AlignmentStatus.MOVING_BODY, AlignmentStatus.IMPLAUSIBLE_MOTION
    steps = ran(ok, ok, implausible)
    steps[1], steps[2] = replace(steps[1], revises=1), replace(steps[2], revises=1)
    for after in (revised(steps), revised(revised(steps))):
        assert [step.alignment.statuses for step in after] == [(body,), (implausible,), (implausible,)]


@pytest.mark.parametrize("rate", [15, 30, 29.97])
def test_a_run_that_is_read_back_is_revised_as_it_was(rate: float, tmp_path: Path) -> None:
    """The reference's stamp came back in microseconds, the frame's in full: no pair seemed to follow another."""
    steps = [
        replace(step, reference_timestamp=(step.index - 1) / rate, timestamp=step.index / rate)
        for step in turning(range(13))
    ]
    steps[-1] = replace(steps[-1], revises=1)
    with RunFolder(tmp_path / "run") as folder:
        folder.start({}, 0.0)
        for step in steps:
            folder.add(step)
    (tmp_path / "run" / "config.json").write_text("{}")
    read = read_run(tmp_path / "run").steps
    wrong = [step.index for step in read if step.alignment.status is not AlignmentStatus.OK]
    assert wrong == [step.index for step in revised(steps) if step.alignment.status is not AlignmentStatus.OK] == [11]
