"""References whose image is of another moment than their stamp says."""

from pathlib import Path

import numpy as np
import pytest

from gavo_jax.odometry.hindsight import revised
from gavo_jax.odometry.misplaced import Arrival, arrival_of, doubt_reference, is_misplaced
from gavo_jax.rigid_motions import exp
from gavo_jax.status import AlignmentStatus as Status
from gavo_jax.trajectory import inverse
from tests.odometry.test_leaps import CLOCK, Searching, found, real

DT = 1 / 30
STEP = np.array([0.0, 0.0, 0.0, 0.0, 0.06, 0.0])
"""Of a fast turn: radians from frame to frame."""


@pytest.mark.parametrize(
    ("arrived", "onward", "intervals", "misplaced"),
    [
        (2, -1, 1, False),  # the motion to its neighbour, which lies behind: nothing is known yet
        (2, 1, 2, True),  # and to the frame after both
        (-1, 3, 1, True),  # an older image, and the next frame
        (2, 2, 1, False),  # a turn that became faster
        (2, 9, 1, False),  # then something else
    ],
)
def test_past_a_misplaced_reference_the_camera_went_on(
    arrived: float, onward: float, intervals: int, misplaced: bool
) -> None:
    came = Arrival(exp(arrived * STEP), exp(STEP), DT)
    assert is_misplaced(came, exp(onward * STEP), intervals * DT) == misplaced


VELOCITY = np.array([0.5, 0.2, -0.3, 0.3, 1.8, -0.5])
EXPECTED = exp(VELOCITY * DT)
ODD = exp(np.array([0.0, 0.0, 0.0, 0.0, 0.12, 0.0])) @ EXPECTED
"""A motion that no camera makes within a frame: it turns by 7 degrees more than expected."""
AT = CLOCK._replace(elapsed=np.float32(DT))


def test_only_a_motion_that_no_camera_makes_is_remembered() -> None:
    """Not one of a failed search, and none where no velocity was known that it could disagree with."""
    came = arrival_of(Searching(found(ODD), VELOCITY), None, AT, found(ODD))
    assert came is not None and came.seconds == pytest.approx(DT) and not came.suspect
    np.testing.assert_allclose(came.target_T_reference, ODD)
    np.testing.assert_allclose(came.expected, EXPECTED, atol=1e-7)
    assert arrival_of(Searching(found(ODD), VELOCITY), None, AT, found(ODD, usable=False)) is None
    assert arrival_of(Searching(found(ODD), 0 * VELOCITY), None, AT, found(ODD)) is None
    assert arrival_of(Searching(found(EXPECTED), VELOCITY), None, AT, found(EXPECTED)) is None
    aside = exp(np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.0])) @ EXPECTED  # by its translation alone
    assert arrival_of(Searching(found(aside), VELOCITY), None, AT, found(aside)) is not None


def test_a_reference_is_misplaced_once_the_camera_is_seen_past_it() -> None:
    """From there one motion back has to be implausible, and a later one, perhaps, has to be where it was going."""
    came = Arrival(ODD, EXPECTED, DT)
    back = exp(VELOCITY * 2 * DT) @ inverse(ODD)
    attempt, left = doubt_reference(came, AT, found(back))
    assert (attempt.revises, left) == (0, came), "nothing was implausible"
    attempt, left = doubt_reference(came, AT, found(back, Status.IMPLAUSIBLE_MOTION))
    assert (attempt.revises, left) == (1, None) and attempt.result.statuses == (Status.IMPLAUSIBLE_MOTION,)
    elsewhere = exp(np.array([0.0, 0.0, 0.0, 0.0, -0.4, 0.0])) @ back
    attempt, left = doubt_reference(came, AT, found(elsewhere, Status.IMPLAUSIBLE_MOTION))
    assert attempt.revises == 0 and left == came._replace(suspect=True)
    further = exp(VELOCITY * 3 * DT) @ inverse(ODD)
    attempt, left = doubt_reference(left, CLOCK, found(further))
    assert (attempt.revises, left) == (1, None) and attempt.result.statuses == (Status.IMPLAUSIBLE_MOTION,)
    doubted = found(back, Status.IMPLAUSIBLE_MOTION)._replace(revises=3)
    assert doubt_reference(came, AT, doubted)[0].revises == 3, "more is wrong already"
    same = found(back, Status.IMPLAUSIBLE_MOTION)
    assert doubt_reference(None, AT, same)[0] is same


def test_neighbours_that_changed_places(data_dir: Path) -> None:
    steps, off = real(data_dir, "fr1_rpy", [*range(15, 30), 31, 30, *range(32, 36)], moments=[*range(15, 36)])
    wrong = [step.index for step in steps if off(step)[1] > 3.0 or off(step)[0] > 0.05]
    flagged = {step.index for step in revised(steps) if step.alignment.status is not Status.OK}
    # the last, against a frame that is two intervals off, is wrong by 3.2 degrees and implausible by as little
    assert {15, 17} <= set(wrong) <= flagged | {18} <= {15, 16, 17, 18}
