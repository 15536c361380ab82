"""Second thoughts about a frame: the wide search as a fallback, or the image without its depth.

Each is an aligner that wraps another one; `composition` combines them as the settings ask.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from gavo_jax.alignment.judgement import MIN_EXPLAINED_GREY
from gavo_jax.alignment.result import with_finding
from gavo_jax.datasets.base import Frame
from gavo_jax.odometry.aligners import Aligner, Attempt, Search, agree
from gavo_jax.odometry.tracking import Clock, TrackerState
from gavo_jax.status import AlignmentStatus, bit


@dataclass(frozen=True)
class SecondThought:
    """An aligner that wraps another one, and differs from it in how it aligns a frame.

    Attributes:
        first: The aligner that is tried first.
    """

    first: Aligner

    def warm_up(self) -> float:
        """Warm up the first aligner; what else is used serves every frame, or compiles when it is needed."""
        return self.first.warm_up()

    def start(self, frame: Frame) -> Any:
        """Start the first aligner."""
        return self.first.start(frame)

    def predict(self, state: Any, elapsed: float) -> Float64[np.ndarray, "4 4"]:
        """Predict with the first aligner."""
        return self.first.predict(state, elapsed)


@dataclass(frozen=True)
class Recovering(SecondThought):
    """An aligner that retries unusable results with another aligner, from the same state.

    Attributes:
        first: The aligner that is tried first.
        second: The aligner that is tried if the first result is unusable; it compiles when it is needed.
        wide: The search of the second aligner.
        is_loaded: Whether `warm_up` loads the wide search's program if it was compiled before.
    """

    second: Aligner
    wide: Search | None = None
    is_loaded: bool = False

    def warm_up(self) -> float:
        """Warm up the first aligner; the second one is only loaded here, or compiles when it is needed."""
        seconds = self.first.warm_up()
        return seconds + self.wide.warm_up() if self.is_loaded and self.wide and self.wide.is_kept() else seconds

    def warm_up_second(self) -> None:
        """Compile what the second aligner needs."""
        if self.wide is not None:
            self.wide.warm_up()

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        """The first attempt if it is usable, else the second one if that is.

        If neither is, the first motion is used all the same if a high error is the only finding of both and their
        motions agree (blur, or something that moves). Such a frame does not become the reference.
        """
        attempt = self.first.align(state, frame, clock)
        if attempt.usable:
            return attempt
        again = self.second.align(state, frame, clock)
        if again.usable:
            return again
        confirmed = int(attempt.result.findings) == int(again.result.findings) == bit(AlignmentStatus.HIGH_ERROR)
        return attempt._replace(usable=confirmed and agree(attempt.result, again.result), fit=False)


POLISHED = bit(AlignmentStatus.HIGH_ERROR)
"""Findings that a finer search may have about a motion that another one has found."""
SAME_BASIN = (0.05, 0.05)
"""Metres and radians within which a finer search ends in the same minimum."""


@dataclass(frozen=True)
class Polished(SecondThought):
    """A search whose motion is refined by another one, which also uses the keyframe.

    Attributes:
        first: Finds the motion, and tells whether the images match.
        fine: Starts from that motion.
    """

    fine: Search

    def align(self, state: TrackerState, frame: Frame, clock: Clock) -> Attempt:
        """The first attempt, with the finer motion if that ends in the same minimum.

        If too little of the image agrees with the finer motion, `HIGH_ERROR` is added to the findings.
        """
        attempt = self.first.align(state, frame, clock)
        if not attempt.usable:
            return attempt
        guess = attempt.result.xi * (np.float32(state.seconds) / clock.elapsed)
        again = self.fine.align(state._replace(guess=guess), frame, clock)
        if int(again.result.findings) & ~POLISHED or not agree(attempt.result, again.result, SAME_BASIN):
            return attempt
        result = again.result._replace(status=attempt.result.status, findings=attempt.result.findings)
        if result.explained.grey < MIN_EXPLAINED_GREY:
            result = with_finding(result, AlignmentStatus.HIGH_ERROR)
        return attempt._replace(state=again.state, result=result)


@dataclass(frozen=True)
class DoubtingDepth(SecondThought):
    """An aligner that doubts a frame's depth before it doubts the motion.

    Where depth disagrees with the image, the frame is aligned again by its image alone. The motion can then be used,
    but a frame with such depth does not become the reference.

    Attributes:
        first: Aligns with depth.
        alone: Aligns by the image alone.
    """

    alone: Aligner

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        """Align with depth, or without it where it disagrees."""
        attempt = self.first.align(state, frame, clock)
        if AlignmentStatus.DEPTH_MISMATCH not in attempt.result.statuses:
            return attempt
        again = self.alone.align(state, without_depth(frame), clock)
        if not again.is_found:
            return attempt
        result = with_finding(again.result, AlignmentStatus.DEPTH_MISMATCH)
        return again._replace(result=result, fit=False)


def without_depth(frame: Frame) -> Frame:
    """A frame with all of its depth removed."""
    return replace(frame, depth=np.zeros_like(frame.depth))
