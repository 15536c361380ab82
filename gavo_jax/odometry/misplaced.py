"""References whose image turns out to be of another moment than their stamp says.

A stamp may be off, so a motion that is longer than a camera can make it in the time passes (`plausibility`). So does
the motion to a frame that has changed places with the next one. But then the next motion goes back as no camera does,
and past both of them the camera went on as it did before.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from gavo_jax.alignment.result import with_finding
from gavo_jax.odometry.aligners import Aligner, Attempt
from gavo_jax.odometry.plausibility import TOLERANCE, image_shift, possible_change
from gavo_jax.odometry.tracking import Clock
from gavo_jax.rigid_motions import exp, length_and_angle, log
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import inverse


class Arrival(NamedTuple):
    """A motion to the reference that no camera makes, save that its stamp may be off."""

    target_T_reference: Float64[np.ndarray, "4 4"]
    expected: Float64[np.ndarray, "4 4"]
    """The same, had the camera gone on as before."""
    seconds: float
    """From the reference before to this one."""
    suspect: bool = False
    """Whether a motion from this reference was implausible, too."""


def arrival_of(aligner: Aligner, state: object, clock: Clock, attempt: Attempt) -> Arrival | None:
    """What to remember of the motion to a new reference: nothing where a camera can have made it in the time, or
    where nothing is known of the motion before.

    Args:
        aligner: Who aligned.
        state: What it knew before.
        clock: When the frame was taken.
        attempt: What it made of the frame.
    """
    seconds = float(clock.elapsed)
    expected = aligner.predict(state, seconds)
    motion = np.asarray(attempt.result.target_T_reference, np.float64)
    if not attempt.usable or np.array_equal(expected, np.eye(4)) or _is_possible(motion, expected, seconds):
        return None
    return Arrival(motion, expected, seconds)


def doubt_reference(came: Arrival | None, clock: Clock, attempt: Attempt) -> tuple[Attempt, Arrival | None]:
    """An attempt that says so where its reference turns out to be misplaced, and what to remember of the reference,
    should it stay.
    """
    if came is None:
        return attempt, None
    result = attempt.result
    suspect = came.suspect or AlignmentStatus.IMPLAUSIBLE_MOTION in result.statuses
    onward = np.asarray(result.target_T_reference, np.float64)
    if suspect and attempt.revises == 0 and is_misplaced(came, onward, float(clock.elapsed)):
        result = with_finding(result, AlignmentStatus.IMPLAUSIBLE_MOTION)
        return attempt._replace(result=result, revises=1), None
    return attempt, came._replace(suspect=suspect)


def is_misplaced(came: Arrival, onward: Float64[np.ndarray, "4 4"], seconds: float) -> bool:
    """Whether the camera, seen past a reference, went on as before it was reached.

    Args:
        came: How the reference was reached.
        onward: target_T_reference from there to the new frame.
        seconds: The time that this took.
    """
    whole = came.seconds + seconds
    past, expected = onward @ came.target_T_reference, exp(log(came.expected) * (whole / came.seconds))
    nearer = _off(past, expected) < 0.5 * _off(came.target_T_reference, came.expected)
    return nearer and _is_possible(past, expected, whole)


def _is_possible(motion: np.ndarray, expected: np.ndarray, seconds: float) -> bool:
    """Whether a camera can have left its way that far by then."""
    off = np.array(length_and_angle(motion @ inverse(expected)))
    return bool(np.all(off <= possible_change(seconds, seconds) + np.array(TOLERANCE)))


def _off(motion: np.ndarray, expected: np.ndarray) -> float:
    """Return by how much a motion moves the image otherwise than expected, about, in radians."""
    return float(image_shift(*length_and_angle(motion @ inverse(expected))))
