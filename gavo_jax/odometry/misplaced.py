"""References whose image turns out to be of another moment than their timestamp.

A timestamp may be off, so a motion that is too long for its time may pass (`plausibility`). So may the motion to a
frame that was swapped with the next one. But then the next motion goes back as no camera does, and past both of them
the camera goes on as before.
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
    """A motion to the reference that no camera makes, unless the timestamp is off."""

    target_T_reference: Float64[np.ndarray, "4 4"]
    expected: Float64[np.ndarray, "4 4"]
    """The motion expected if the camera had kept its velocity."""
    seconds: float
    """Seconds from the last reference to this one."""
    suspect: bool = False
    """Whether a motion from this reference was implausible, too."""


def arrival_of(aligner: Aligner, state: object, clock: Clock, attempt: Attempt) -> Arrival | None:
    """What to remember of the motion to a new reference.

    This is None where a camera can have made the motion in its time, or where the motion before is unknown.

    Args:
        aligner: The aligner.
        state: Its state before the frame.
        clock: When the frame was taken.
        attempt: Its attempt at the frame.
    """
    seconds = float(clock.elapsed)
    expected = aligner.predict(state, seconds)
    motion = np.asarray(attempt.result.target_T_reference, np.float64)
    if not attempt.usable or np.array_equal(expected, np.eye(4)) or _is_possible(motion, expected, seconds):
        return None
    return Arrival(motion, expected, seconds)


def doubt_reference(came: Arrival | None, clock: Clock, attempt: Attempt) -> tuple[Attempt, Arrival | None]:
    """Flag an attempt whose reference turns out to be misplaced.

    Returns:
        The attempt, and what to remember of the reference if it stays.
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
        seconds: Time that this motion took, seconds.
    """
    whole = came.seconds + seconds
    past, expected = onward @ came.target_T_reference, exp(log(came.expected) * (whole / came.seconds))
    nearer = _off(past, expected) < 0.5 * _off(came.target_T_reference, came.expected)
    return nearer and _is_possible(past, expected, whole)


def _is_possible(motion: np.ndarray, expected: np.ndarray, seconds: float) -> bool:
    """Whether a camera can deviate that far from the expected motion in the time."""
    off = np.array(length_and_angle(motion @ inverse(expected)))
    return bool(np.all(off <= possible_change(seconds, seconds) + np.array(TOLERANCE)))


def _off(motion: np.ndarray, expected: np.ndarray) -> float:
    """Return about how far a motion moves the image away from where it was expected, radians."""
    return float(image_shift(*length_and_angle(motion @ inverse(expected))))
