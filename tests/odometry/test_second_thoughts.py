"""What is asked where the first search is in doubt, and what of the answers counts."""

import numpy as np
import pytest
from driving import CAMERA, SEARCH_ALONE, Told, found
from small import Rendered

from gavo_jax.alignment.result import Alignment, with_finding
from gavo_jax.datasets.rendered.sensor_noise import NONE
from gavo_jax.odometry.aligners import BEGINNING
from gavo_jax.odometry.composition import blank_of
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.second_thoughts import Polished, Recovering
from gavo_jax.status import AlignmentStatus

IMPLAUSIBLE = with_finding(found(AlignmentStatus.HIGH_ERROR, 0.02), AlignmentStatus.IMPLAUSIBLE_MOTION)
"""A high error is the gravest of what speaks against it, and not all."""

POORLY_KNOWN = with_finding(found(AlignmentStatus.HIGH_ERROR, 0.12), AlignmentStatus.LOW_TEXTURE)
"""It may be off by decimetres: pairs of which it was the motion were `ok` with a deviation of 40 cm."""


@pytest.mark.parametrize(
    "first, second, x",
    [
        (found(AlignmentStatus.OK, 0.02), found(AlignmentStatus.OK, 0.1), 0.02),
        (found(AlignmentStatus.AMBIGUOUS, 0.02), found(AlignmentStatus.OK, 0.1), 0.1),
        (found(AlignmentStatus.HIGH_ERROR, 0.02), found(AlignmentStatus.HIGH_ERROR, 0.03), 0.02),
        (found(AlignmentStatus.HIGH_ERROR, 0.02), found(AlignmentStatus.HIGH_ERROR, 0.1), None),
        (found(AlignmentStatus.LOW_OVERLAP, 0.02), found(AlignmentStatus.LOW_OVERLAP, 0.02), None),
        (IMPLAUSIBLE, IMPLAUSIBLE, None),
    ],
)
def test_a_second_aligner_is_asked_where_the_first_is_not_sure(
    first: Alignment, second: Alignment, x: float | None
) -> None:
    sequence = Rendered(frames=2, camera=CAMERA, noise=NONE)
    odometry = Odometry(CAMERA, aligner=Recovering(Told(first), Told(second)))
    odometry.register(sequence[0], 0.0)
    step = odometry.register(sequence[1], sequence[1].timestamp)
    assert step is not None and step.lost is (x is None)
    assert step.world_T_camera[0, 3] == pytest.approx(-(x or 0.0))
    is_explained = AlignmentStatus.OK in (first.status, second.status)
    assert odometry.progress.tracker == sequence[int(is_explained)].timestamp


def test_a_frame_that_is_not_explained_is_no_reference_while_the_old_one_is_in_reach() -> None:
    """The next frame would be compared with what was wrong in it: pairs behind one were off by three times as much."""
    poor = Told(found(AlignmentStatus.HIGH_ERROR, 0.02))
    odometry = Odometry(CAMERA, aligner=Recovering(poor, poor))
    sequence = Rendered(frames=6, camera=CAMERA, noise=NONE)
    steps = [odometry.register(frame, frame.timestamp) for frame in sequence]
    of = [int(np.argmin(np.abs(sequence.timestamps - step.reference_timestamp))) for step in steps if step is not None]
    assert of == [0, 0, 0, 3, 3]
    assert not any(step.lost for step in steps if step is not None)


@pytest.mark.parametrize(
    ("first", "fine", "x"),
    [
        (found(AlignmentStatus.OK, 0.10), found(AlignmentStatus.HIGH_ERROR, 0.12), 0.12),
        (found(AlignmentStatus.OK, 0.10), found(AlignmentStatus.OK, 0.12), 0.12),
        (found(AlignmentStatus.OK, 0.10), found(AlignmentStatus.OK, 0.16), 0.10),
        (found(AlignmentStatus.OK, 0.10), found(AlignmentStatus.LOW_TEXTURE, 0.12), 0.10),
        (found(AlignmentStatus.OK, 0.10), POORLY_KNOWN, 0.10),
        (found(AlignmentStatus.AMBIGUOUS, 0.10), found(AlignmentStatus.OK, 0.12), 0.10),
    ],
)
def test_what_the_wide_search_finds_is_polished(first: Alignment, fine: Alignment, x: float) -> None:
    """By the search that has the keyframe, if it ends in the same minimum; the wide one says what it is worth."""
    state = blank_of(Odometry(CAMERA, SEARCH_ALONE).aligner)
    polished = Polished(Told(first), Told(fine))  # pyright: ignore[reportArgumentType]
    attempt = polished.align(state, Rendered(frames=1, camera=CAMERA, noise=NONE)[0], BEGINNING)
    assert attempt.result.target_T_reference[0, 3] == x
    assert attempt.result.status is first.status and attempt.usable is (first.status is AlignmentStatus.OK)


@pytest.mark.parametrize(("explained", "status"), [(0.5, AlignmentStatus.OK), (0.4, AlignmentStatus.HIGH_ERROR)])
def test_an_image_that_the_finer_motion_does_not_explain_is_told(explained: float, status: AlignmentStatus) -> None:
    """An image whose rows a fault had shifted was 4 degrees off and `ok`, as the wide search found it good enough."""
    fine = found(AlignmentStatus.HIGH_ERROR, 0.12)
    fine = fine._replace(explained=fine.explained._replace(grey=np.float32(explained)))
    state = blank_of(Odometry(CAMERA, SEARCH_ALONE).aligner)
    polished = Polished(Told(found(AlignmentStatus.OK, 0.10)), Told(fine))  # pyright: ignore[reportArgumentType]
    attempt = polished.align(state, Rendered(frames=1, camera=CAMERA, noise=NONE)[0], BEGINNING)
    assert attempt.result.status is status and attempt.usable
