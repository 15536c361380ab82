"""Second thoughts about a frame: the wide search behind the first one, an image without its depth.

Each is an aligner around another one; `composition` puts them together as settings ask for it.
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
    """An aligner around another one, which differs in what it makes of a frame.

    Attributes:
        first: What is asked first.
    """

    first: Aligner

    def warm_up(self) -> float:
        """Warm up the first one; what else is asked serves every frame, or compiles when it is needed."""
        return self.first.warm_up()

    def start(self, frame: Frame) -> Any:
        """Start the first one."""
        return self.first.start(frame)

    def predict(self, state: Any, elapsed: float) -> Float64[np.ndarray, "4 4"]:
        """Predict by the first one."""
        return self.first.predict(state, elapsed)


@dataclass(frozen=True)
class Recovering(SecondThought):
    """An aligner whose unusable results are tried again by another one, from the same state.

    Attributes:
        first: What is asked first.
        second: What is asked where that is unusable; it compiles when it is asked.
        wide: What the second one searches with.
        is_loaded: Whether `warm_up` loads the wide search's program where it was compiled before.
    """

    second: Aligner
    wide: Search | None = None
    is_loaded: bool = False

    def warm_up(self) -> float:
        """Warm up the first one; the second compiles when it is needed."""
        seconds = self.first.warm_up()
        return seconds + self.wide.warm_up() if self.is_loaded and self.wide and self.wide.is_kept() else seconds

    def warm_up_second(self) -> None:
        """Compile what the second one needs."""
        if self.wide is not None:
            self.wide.warm_up()

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        """The first attempt if it is usable, else the second one if that is.

        If neither is, the first one's motion can be used all the same where a high error is all that speaks against it
        and the second ends at the same motion (blur, or something that moves). A reference should be better explained.
        """
        attempt = self.first.align(state, frame, clock)
        if attempt.usable:
            return attempt
        again = self.second.align(state, frame, clock)
        if again.usable:
            return again
        confirmed = int(attempt.result.findings) == int(again.result.findings) == bit(AlignmentStatus.HIGH_ERROR)
        return attempt._replace(usable=confirmed and agree(attempt.result, again.result), fit=False)


POLISHED = (AlignmentStatus.OK, AlignmentStatus.HIGH_ERROR)
"""What a finer search may say of a motion that another one has found."""
SAME_BASIN = (0.05, 0.05)
"""Metres and radians within which it ends in the same minimum."""


@dataclass(frozen=True)
class Polished(SecondThought):
    """A search from whose motion another one begins, which sees it more exactly: it has the keyframe as well.

    Attributes:
        first: Finds the motion, and says whether the images match.
        fine: Begins there.
    """

    fine: Search

    def align(self, state: TrackerState, frame: Frame, clock: Clock) -> Attempt:
        """The first one's attempt, with the finer motion if that ends in the same minimum; where the image disagrees
        with that one, it says so.
        """
        attempt = self.first.align(state, frame, clock)
        if not attempt.usable:
            return attempt
        guess = attempt.result.xi * (np.float32(state.seconds) / clock.elapsed)
        again = self.fine.align(state._replace(guess=guess), frame, clock)
        if again.result.status not in POLISHED or not agree(attempt.result, again.result, SAME_BASIN):
            return attempt
        result = again.result._replace(status=attempt.result.status, findings=attempt.result.findings)
        if result.explained.grey < MIN_EXPLAINED_GREY:
            result = with_finding(result, AlignmentStatus.HIGH_ERROR)
        return attempt._replace(state=again.state, result=result)


@dataclass(frozen=True)
class DoubtingDepth(SecondThought):
    """An aligner that doubts a frame's depth before it doubts the motion.

    Where depth does not agree with the image, the frame is aligned once more by its image alone; the motion can be used
    then, but a frame of such depth is no reference.

    Attributes:
        first: What aligns.
        alone: What aligns an image alone.
    """

    alone: Aligner

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        """Align with depth, or without where it does not agree."""
        attempt = self.first.align(state, frame, clock)
        if AlignmentStatus.DEPTH_MISMATCH not in attempt.result.statuses:
            return attempt
        again = self.alone.align(state, without_depth(frame), clock)
        if not again.is_found:
            return attempt
        result = with_finding(again.result, AlignmentStatus.DEPTH_MISMATCH)
        return again._replace(result=result, fit=False)


def without_depth(frame: Frame) -> Frame:
    """A frame of which only the image counts."""
    return replace(frame, depth=np.zeros_like(frame.depth))
