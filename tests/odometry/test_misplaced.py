"""References whose image is of another moment than their stamp says."""

from pathlib import Path

import numpy as np
import pytest

from gavo_jax.odometry.hindsight import revised
from gavo_jax.odometry.misplaced import Arrival, is_misplaced
from gavo_jax.rigid_motions import exp
from gavo_jax.status import AlignmentStatus as Status
from tests.odometry.test_leaps import real

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


def test_neighbours_that_changed_places(data_dir: Path) -> None:
    steps, off = real(data_dir, "fr1_rpy", [*range(15, 30), 31, 30, *range(32, 36)], moments=[*range(15, 36)])
    wrong = [step.index for step in steps if off(step)[1] > 3.0 or off(step)[0] > 0.05]
    flagged = {step.index for step in revised(steps) if step.alignment.status is not Status.OK}
    # the last, against a frame that is two intervals off, is wrong by 3.2 degrees and implausible by as little
    assert {15, 17} <= set(wrong) <= flagged | {18} <= {15, 16, 17, 18}
