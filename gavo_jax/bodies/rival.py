"""A second motion kept beside the first until it is clear which one is the camera's.

Where a body covers much of the image from the start, a search ends with the body's motion, or with one that explains
both to the eye: a turn makes up for a step. One pair of frames can't tell. So what stands before other surfaces is set
aside, the rest is tracked on its own, and the two motions are compared, frame after frame. What the far part shows on
its own is the camera's motion if it is well determined and contradicts the other one: a body hides the scene, and not
the other way round.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Float64

from gavo_jax.alignment.judgement import UNKNOWN
from gavo_jax.alignment.result import Alignment
from gavo_jax.bodies.aligner import BodyAware, deviation, mistrusted
from gavo_jax.bodies.evidence import View, inverse_depth_of
from gavo_jax.bodies.identity import BodyTracks
from gavo_jax.bodies.scene import AwareState
from gavo_jax.bodies.surfaces import nearer_part
from gavo_jax.bodies.votes import vote
from gavo_jax.datasets.base import Frame
from gavo_jax.odometry.aligners import Attempt
from gavo_jax.odometry.plausibility import Usual
from gavo_jax.odometry.tracking import Clock, TrackerState
from gavo_jax.rigid_motions import length_and_angle, log, transport_covariance
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import inverse

TOGETHER = (0.008, np.radians(0.5))
"""Metres and radians within which the two motions are the same."""
APART = (0.025, np.radians(1.0))
"""Metres and radians between the two motions from which on it matters which one is taken."""
AGREED_AFTER, DROPPED_AFTER = 0.15, 0.42
"""Seconds after which a rival is dropped if it is the same motion; if nothing is decided. A body takes time to move
away, however many frames are taken meanwhile."""
DROPPED_EARLY, LEAST_DOUBT = 0.15, 20.0
"""Seconds after which it is dropped where the squared Mahalanobis distance of the two motions is less than that."""
FORGOTTEN = 1.0
"""Seconds after which it counts as clear whose motion the first one's is."""
LARGEST = 100.0
"""Squared Mahalanobis distance of the two motions since the anchor that leaves no doubt that they differ."""
CONTRADICTED = 30.0
"""The same distance from which on the far part contradicts the first motion."""
CLEAR, DOUBTFUL = 0.75, 0.5
"""Certainty (that distance over `LARGEST`, at most 1, plus the far part's margin) above which the rival is taken, and
above which the first search's motion may be a body's."""
MAJORITY, FAR_MAJORITY, FRAMES = 0.2, 0.6, 2
"""Margins in the whole image and in its far part that decide for the rival, and frames for which they have to hold."""
LANDSLIDE = 0.6
"""Margin in the whole image that decides for the rival at once."""
EXACT, EXACTER, VAGUE = 0.012, 0.008, 0.02
"""Metres: deviation of the rival's translation up to which votes can have it taken, up to which the contradiction can,
and from which on it tells nothing."""


class Span(NamedTuple):
    """How long something has been so."""

    frames: Any
    """Number of frames; -1 where it is not so."""
    seconds: Any

    @property
    def lasts(self) -> bool:
        """Whether it is so."""
        return int(self.frames) >= 0

    def later(self, elapsed: float) -> "Span":
        """The same a frame later."""
        return Span(np.int32(int(self.frames) + 1), np.float32(float(self.seconds) + elapsed))


BEGUN, OVER = (Span(np.int32(frames), np.float32(0.0)) for frames in (0, -1))


class Rival(NamedTuple):
    """Another motion that may be the camera's, since some frame, its anchor."""

    state: AwareState
    """State of the rival's own search."""
    anchor: View
    near: Bool[np.ndarray, "h w"]
    """What the anchor shows of surfaces that are taken for bodies."""
    stands_before: Any
    """Whether these stand before the rest: only then it says something that both searches agree."""
    first_T_anchor: Float[np.ndarray, "4 4"]
    """Motion since the anchor by the first search."""
    rival_T_anchor: Float[np.ndarray, "4 4"]
    """Motion since the anchor by the rival's search."""
    covariance: Float[np.ndarray, "6 6"]
    """That of the rival's motion since the anchor, by a step on the target's side: errors of its frames add up."""
    age: Span
    """Time since the anchor."""
    ahead: Any
    """Frames for which the margins have held."""

    @property
    def is_there(self) -> bool:
        """Whether there is one."""
        return self.age.lasts


class RivalledState(NamedTuple):
    """State of the first search, and of its rival."""

    first: AwareState
    rival: Rival
    open_for: Span
    """As long as it has been open whether the first one's motion is the camera's."""

    @property
    def tracker(self) -> TrackerState:
        """State of the first search."""
        return self.first.tracker


@dataclass(frozen=True)
class WithRival:
    """An aligner that keeps another motion beside its own as long as either may be the camera's.

    Attributes:
        first: Finds the motion of a frame and its bodies.
    """

    first: BodyAware

    @cached_property
    def second(self) -> BodyAware:
        """Follows the rival, which has to learn as it goes."""
        return BodyAware(self.first.search, self.first.search, is_eager=True)

    def warm_up(self) -> float:
        """That of the first one; votes are compiled, or loaded, when they are needed: few runs do."""
        return self.first.warm_up()

    def blank_state(self) -> RivalledState:
        """The state before the first frame, in the shapes and types of every state."""
        return self._alone(self.first.blank_state(), OVER)

    def start(self, frame: Frame) -> RivalledState:
        """A scene in which nothing is known to move, and a rival if something stands before the rest. It is open whose
        motion is found, too, where nothing does: a body may fill the image.
        """
        state = self.first.start(frame)
        rival = self._rival_of(state)
        return RivalledState(state, rival, BEGUN)

    def predict(self, state: RivalledState, elapsed: float) -> Float64[np.ndarray, "4 4"]:
        """Predict by the first one."""
        return self.first.predict(state.first, elapsed)

    def align(self, state: RivalledState, frame: Frame, clock: Clock) -> Attempt:
        """The first one's attempt, or the rival's once that is clearly the camera's motion."""
        attempt = self.first.align(state.first, frame, clock)
        own: AwareState = attempt.state
        rival, open_for, elapsed = state.rival, state.open_for, float(clock.elapsed)
        if not rival.is_there and attempt.usable and (own.is_doubted or open_for.lasts):
            rival = self._rival_of(state.first, standing_before=not own.is_doubted)
            open_for = BEGUN if rival.is_there and not open_for.lasts else open_for
        open_for = open_for.later(elapsed) if open_for.lasts and float(open_for.seconds) < FORGOTTEN else OVER
        other = self.second.align(rival.state, frame, clock) if rival.is_there else None
        if other is not None and other.usable:
            aged = rival._replace(age=rival.age.later(elapsed))
            if attempt.usable:
                return self._decide(attempt, other, aged, open_for)
            depth_is_doubted = AlignmentStatus.DEPTH_MISMATCH in attempt.result.statuses
            if deviation(other) < EXACT and not depth_is_doubted:  # that motion has ended; whose it was stays open
                return self._taken(other, aged, open_for, open_for, clearly=True)
        if not attempt.usable:  # should it be used all the same, a rival would have missed a frame
            rival = self._nobody
        elif other is not None:
            rival = self._rival_of(own) if float(open_for.seconds) < DROPPED_AFTER else self._nobody
        return _open(attempt, open_for)._replace(state=RivalledState(own, rival, open_for))

    def _decide(self, attempt: Attempt, other: Attempt, rival: Rival, open_for: Span) -> Attempt:
        """Which of two attempts at a frame stands for it, and whether the rival, of the age it has then, is kept."""
        before = np.asarray(rival.first_T_anchor, np.float64)
        first = np.asarray(attempt.result.target_T_reference) @ before
        onward = np.asarray(other.result.target_T_reference, np.float64)
        second = onward @ np.asarray(rival.rival_T_anchor, np.float64)
        age = float(rival.age.seconds)
        earlier = transport_covariance(onward, np.asarray(rival.covariance, np.float64))
        covariance = earlier + _in_target(other.result)
        contradiction = _distance(first, second, _in_target(attempt.result) + covariance)
        apart, uncertainty = _between(first, second), deviation(other)
        if not uncertainty < VAGUE:
            return attempt._replace(state=self._alone(attempt.state, open_for))
        open_after = OVER if rival.stands_before else open_for
        confirmed = attempt._replace(state=self._alone(attempt.state, open_after))
        if age >= AGREED_AFTER and not _exceeds(apart, TOGETHER):
            return confirmed
        far, ahead, is_asked = 0.0, 0, _exceeds(apart, APART)
        if is_asked:
            motions = np.stack([first, second]).astype(np.float32)
            margin = vote(rival.anchor, _view(attempt.state), motions, rival.near, self.first.segmenter.camera)
            whole, far = float(margin.whole), float(margin.far)
            ahead = int(rival.ahead) + 1 if whole > MAJORITY and far > FAR_MAJORITY else 0
            if uncertainty < EXACT and far > 0.0 and (ahead >= FRAMES or whole > LANDSLIDE):
                return self._taken(other, rival, open_for, open_after)
        contradicts = contradiction > CONTRADICTED and (far > 0.0 if is_asked else bool(rival.stands_before))
        contradicts &= _exceeds(apart, TOGETHER)
        certainty = min(contradiction / LARGEST, 1.0) + far
        if contradicts and uncertainty < EXACTER and certainty > CLEAR:
            return self._taken(other, rival, open_for, open_after)
        if int(rival.age.frames) >= FRAMES and contradicts and certainty > DOUBTFUL:
            attempt = mistrusted(attempt)
        if age >= DROPPED_EARLY and contradiction < LEAST_DOUBT:
            return confirmed
        if age > DROPPED_AFTER:
            return attempt._replace(state=self._alone(attempt.state, open_for))
        after = rival._replace(
            state=other.state,
            first_T_anchor=first.astype(np.float32),
            rival_T_anchor=second.astype(np.float32),
            covariance=np.asarray(covariance, np.float32),
            ahead=np.int32(ahead),
        )
        return attempt._replace(state=RivalledState(attempt.state, after, open_for))

    def _taken(
        self, other: Attempt, rival: Rival, open_for: Span, open_after: Span, *, clearly: bool = False
    ) -> Attempt:
        """The rival's attempt in place of the first one's, by the way from where its camera was believed to be.

        Args:
            other: The rival's.
            rival: Before it, of the age it has then.
            open_for: How long it was open whose motion the first one's is.
            open_after: How long it is from now on.
            clearly: Whether motions that differ by no more than the rival's errors are the same: nothing speaks for
                the rival but that it goes on.
        """
        before = np.asarray(rival.first_T_anchor, np.float64), np.asarray(rival.rival_T_anchor, np.float64)
        second = np.asarray(other.result.target_T_reference) @ before[1]
        result = _returned(other.result, second @ inverse(before[0]))
        taken = other._replace(state=self._alone(other.state, open_after), result=result)
        earlier = int(rival.age.frames) - 1
        parted = _exceeds(_between(*before), TOGETHER)
        if parted and clearly:
            parted = _distance(*before, np.asarray(rival.covariance, np.float64)) > LEAST_DOUBT
        if parted or earlier == 0:  # else the motions before were the same by both
            unknown = max(int(open_for.frames) - earlier - 1, 0)
            taken = taken._replace(unknown=unknown, revises=unknown + earlier)
        return mistrusted(taken)

    @cached_property
    def _nobody(self) -> Rival:
        """No rival, in the shapes and types of every one."""
        blank, still = self.first.blank_state(), np.eye(4, dtype=np.float32)
        nothing = np.zeros(self.first.segmenter.size, bool)
        exact = np.zeros((6, 6), np.float32)
        return Rival(blank, _view(blank), nothing, np.bool_(False), still, still, exact, OVER, np.int32(0))

    def _alone(self, state: AwareState, open_for: Span) -> RivalledState:
        """A state without a rival."""
        return RivalledState(state, self._nobody, open_for)

    def _rival_of(self, state: AwareState, standing_before: bool = False) -> Rival:
        """The motion of what the last frame shows behind all that stands before other surfaces, from here on; nobody if
        only such surfaces are asked for, and there are none.
        """
        segmenter, anchor = self.first.segmenter, _view(state)
        near, stands_before = nearer_part(inverse_depth_of(anchor))
        if not np.any(near) or (standing_before and not stands_before):
            return self._nobody
        number = np.int32(state.scene.tracks.last + 1)
        tracks = BodyTracks.empty(segmenter.size)._replace(labels=number * near.astype(np.int32), last=number)  # pyright: ignore[reportArgumentType]
        tracks.numbers[0] = number
        scene = state.scene._replace(
            known=np.asarray(near, np.float32),  # pyright: ignore[reportArgumentType]
            suspected=np.asarray(near, np.float32),
            tracks=tracks,
            carried=np.zeros((), np.float32),
        )
        tracker = state.tracker._replace(keyframe=state.tracker.previous, usual=Usual.unknown())
        seen = state._replace(tracker=segmenter.without(tracker, near), scene=scene)
        return self._nobody._replace(
            state=seen, anchor=anchor, near=near, stands_before=np.bool_(stands_before), age=BEGUN
        )


def _open(attempt: Attempt, open_for: Span) -> Attempt:
    """The attempt; its motion is unknown where it may be a body's, as the ones before may have been."""
    doubted = open_for.lasts and AlignmentStatus.MOVING_BODY in attempt.result.statuses
    return attempt._replace(unknown=1) if doubted else attempt


def _view(state: AwareState) -> View:
    """Return the last frame's view, on the host: to slice a device's array takes a program."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[0], state.scene.views)


def _in_target(result: Alignment) -> Float64[np.ndarray, "6 6"]:
    """Covariance of a motion by a step on the target's side: results have it by one on the reference's."""
    return transport_covariance(
        np.asarray(result.target_T_reference, np.float64), np.asarray(result.covariance, np.float64)
    )


def _distance(
    first: Float64[np.ndarray, "4 4"], second: Float64[np.ndarray, "4 4"], covariance: Float64[np.ndarray, "6 6"]
) -> float:
    """Squared Mahalanobis distance of two motions since the anchor, by a step on the target's side."""
    step = log(first @ inverse(second))
    return float(step @ np.linalg.solve(covariance, step))


def _between(first: Float64[np.ndarray, "4 4"], second: Float64[np.ndarray, "4 4"]) -> tuple[float, float]:
    length, angle = length_and_angle(inverse(first) @ second)
    return float(length), float(angle)


def _exceeds(apart: tuple[float, float], limits: tuple[float, float]) -> bool:
    return apart[0] > limits[0] or apart[1] > limits[1]


def _returned(result: Alignment, motion: Float64[np.ndarray, "4 4"]) -> Alignment:
    """The rival's result with the way from where the first one's camera was believed to be: that is not known well."""
    return result._replace(
        target_T_reference=motion,
        xi=log(motion).astype(np.float32),
        covariance=UNKNOWN,
    )
