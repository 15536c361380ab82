"""Frames that are missing although the timestamps go on: the camera seems to leap.

A motion that no camera makes between two timestamps has one of two causes. The image may be of another moment: then the
next frame is where the camera was expected. Or frames are missing, and the others were given new timestamps: then the
next frame is one ordinary step further. The next frame tells which it is; until then the leap is remembered.

The effect of a rolling shutter depends on the time that a motion took. So a leap is searched for as if it took as long
as the camera, at its last speed, needs for it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from gavo_jax.alignment.result import with_finding
from gavo_jax.datasets.base import Frame
from gavo_jax.odometry.aligners import Aligner, Attempt
from gavo_jax.odometry.plausibility import SMALLEST_SHIFT, TOLERANCE, image_shift, possible_change
from gavo_jax.odometry.tracking import Clock
from gavo_jax.rigid_motions import length_and_angle
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import inverse

LONGEST = 1.0
"""Longest time that a leap is taken to last, seconds."""


class Leap(NamedTuple):
    """A motion from the reference that no camera makes in the time between the timestamps."""

    target_T_reference: Float64[np.ndarray, "4 4"]
    seconds: float
    """Seconds in which a camera would have made the motion."""
    timestamp: float
    """Timestamp of the frame that the motion leads to, seconds."""


def align_leaping(
    aligner: Aligner, state: object, frame: Frame, clock: Clock, leap: Leap | None
) -> tuple[Attempt, Leap | None]:
    """An attempt at a frame, and the leap that it may be.

    Args:
        aligner: The aligner.
        state: The aligner's state before the frame.
        frame: The new frame.
        clock: When it was taken.
        leap: The leap that the last frame may have been.

    Returns:
        The attempt and the leap. An attempt that confirms the last leap is usable, with the finding
            `IMPLAUSIBLE_MOTION`.
    """
    attempt = aligner.align(state, frame, clock)
    leaps = not attempt.usable and AlignmentStatus.IMPLAUSIBLE_MOTION in attempt.result.statuses
    if leap is not None and (attempt.usable or leaps):
        since = frame.timestamp - leap.timestamp
        again = aligner.align(state, frame, clock._replace(elapsed=np.float32(leap.seconds + since)))
        if again.is_found and _goes_on(aligner, state, clock, leap, since, again):
            return again._replace(result=with_finding(again.result, AlignmentStatus.IMPLAUSIBLE_MOTION)), None
    if not leaps:
        return attempt, None
    seconds = _seconds(aligner, state, clock, attempt)
    again = aligner.align(state, frame, clock._replace(elapsed=np.float32(seconds)))
    if not again.is_found:
        return attempt, None
    return attempt, Leap(np.asarray(again.result.target_T_reference, np.float64), seconds, frame.timestamp)


def _goes_on(aligner: Aligner, state: object, clock: Clock, leap: Leap, since: float, attempt: Attempt) -> bool:
    """Whether a motion is one step further than a leap, rather than where the camera was expected without it."""
    motion = np.asarray(attempt.result.target_T_reference, np.float64)
    onward = length_and_angle(motion @ inverse(leap.target_T_reference) @ inverse(aligner.predict(state, since)))
    if np.any(np.array(onward) > possible_change(since, leap.seconds) + np.array(TOLERANCE)):
        return False
    stayed = length_and_angle(motion @ inverse(aligner.predict(state, float(clock.elapsed))))
    return bool(image_shift(*onward) < image_shift(*stayed))


def _seconds(aligner: Aligner, state: object, clock: Clock, attempt: Attempt) -> float:
    """Seconds in which the camera, at its last speed, would make an attempt's motion."""
    elapsed = float(clock.elapsed)
    found = image_shift(*length_and_angle(np.asarray(attempt.result.target_T_reference, np.float64)))
    expected = image_shift(*length_and_angle(aligner.predict(state, elapsed)))
    return max(elapsed, min(elapsed * float(found) / max(float(expected), SMALLEST_SHIFT), LONGEST))
