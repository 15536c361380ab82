"""A second motion kept beside the first until it is clear which one is the camera's.

Where a body covers much of the image from the start, a search may find the body's motion. It may also find a compromise
that seems to explain both, as a rotation looks like a translation. One pair of frames can't tell. So surfaces in front
of others are set aside, the rest is tracked on its own, and the two motions are compared frame after frame. The far
part's motion is the camera's if it is well determined and contradicts the other one: a body occludes the scene, not the
other way round.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float64

from gavo_jax.alignment.judgement import UNKNOWN
from gavo_jax.alignment.result import Alignment
from gavo_jax.bodies.aligner import SUSPECTED, BodyAware, mistrusted
from gavo_jax.bodies.duel import AGREED_AFTER, BEGUN, DROPPED_AFTER, EXACT, OVER, Duel, Motions, Span, leads
from gavo_jax.bodies.identity import BodyTracks
from gavo_jax.bodies.pixel_evidence import View, inverse_depth_of
from gavo_jax.bodies.scene import AwareState
from gavo_jax.bodies.surfaces import nearer_part
from gavo_jax.bodies.votes import vote
from gavo_jax.datasets.base import Frame
from gavo_jax.odometry.aligners import Attempt
from gavo_jax.odometry.plausibility import Usual
from gavo_jax.odometry.tracking import Clock, TrackerState
from gavo_jax.rigid_motions import log
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import inverse

FORGOTTEN = 1.0
"""Seconds after which the first motion is no longer in question."""


class Rival(NamedTuple):
    """Another motion since some frame, its anchor, that may be the camera's."""

    state: AwareState
    """State of the rival's own search."""
    anchor: View
    near: Bool[np.ndarray, "h w"]
    """Pixels of the anchor on surfaces that are taken for bodies."""
    stands_before: Any
    """Whether these surfaces are in front of the rest: only then does agreement of both searches mean anything."""
    motions: Motions
    """Motions since the anchor, by the first search and by the rival's."""
    age: Span
    """Time since the anchor."""
    ahead: Any
    """Consecutive frames for which the margins have been large enough."""

    @property
    def is_there(self) -> bool:
        """Whether there is a rival."""
        return self.age.lasts


class RivalledState(NamedTuple):
    """State of the first search and of its rival."""

    first: AwareState
    rival: Rival
    open_for: Span
    """How long it has been open whether the first motion is the camera's."""

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
        """The aligner that tracks the rival; it is eager, as it has to learn as it goes."""
        return BodyAware(self.first.search, self.first.search, is_eager=True)

    def warm_up(self) -> float:
        """Warm up the first one only; votes are compiled, or loaded, when needed, as few runs need them."""
        return self.first.warm_up()

    def warm_up_second(self) -> None:
        """Compile the votes."""
        nobody, nowhere = self._nobody, np.stack([np.eye(4, dtype=np.float32)] * 2)
        vote(nobody.anchor, nobody.anchor, nowhere, nobody.near, self.first.segmenter.camera)

    def blank_state(self) -> RivalledState:
        """The state before the first frame, in the shapes and types of every state."""
        return self._alone(self.first.blank_state(), OVER)

    def start(self, frame: Frame) -> RivalledState:
        """Start with a scene in which nothing is known to move, and a rival where part of the image is nearer.

        Even without a rival it is open whose motion will be found: a body may fill the image.
        """
        state = self.first.start(frame)
        rival = self._rival_of(state)
        return RivalledState(state, rival, BEGUN)

    def predict(self, state: RivalledState, elapsed: float) -> Float64[np.ndarray, "4 4"]:
        """Predict with the first search."""
        return self.first.predict(state.first, elapsed)

    def align(self, state: RivalledState, frame: Frame, clock: Clock) -> Attempt:
        """The first one's attempt, or the rival's once that is clearly the camera's motion."""
        attempt = self.first.align(state.first, frame, clock)
        rival, open_for = self._called(state, attempt)
        elapsed = float(clock.elapsed)
        open_for = open_for.later(elapsed) if open_for.lasts and float(open_for.seconds) < FORGOTTEN else OVER
        other = self.second.align(rival.state, frame, clock) if rival.is_there else None
        if other is not None and other.usable:
            aged = rival._replace(age=rival.age.later(elapsed))
            if attempt.usable:
                return self._decide(attempt, other, aged, open_for, frame)
            depth_is_doubted = AlignmentStatus.DEPTH_MISMATCH in attempt.result.statuses
            if other.deviation < EXACT and not depth_is_doubted:  # that motion is lost; whose it was stays open
                return self._taken(other, aged, open_for, open_for, clearly=True)
        if not attempt.usable:  # if it is used all the same, a rival would have missed a frame
            rival = self._nobody
        elif other is not None:
            rival = self._rival_of(attempt.state) if float(open_for.seconds) < DROPPED_AFTER else self._nobody
        return self._begun_anew(attempt._replace(state=RivalledState(attempt.state, rival, open_for)), open_for, frame)

    def _begun_anew(self, attempt: Attempt, open_for: Span, frame: Frame) -> Attempt:
        """The attempt, with a new beginning where it may follow a body and it is open whether the ones before did.

        All these motions are unknown then. What was learnt with them is kept only if bodies were told from the scene.
        """
        is_doubted = attempt.usable and AlignmentStatus.MOVING_BODY in attempt.result.statuses
        if not (is_doubted and open_for.lasts):
            return attempt
        earlier = int(open_for.frames) - 1
        state: RivalledState = attempt.state
        tells = state.rival.is_there and state.rival.stands_before
        tells = tells or np.any(np.asarray(state.first.scene.suspected) > SUSPECTED)
        after = state._replace(open_for=BEGUN) if tells else self.start(frame)
        return attempt._replace(unknown=earlier + 1, revises=earlier, state=after)

    def _called(self, state: RivalledState, attempt: Attempt) -> tuple[Rival, Span]:
        """The rival, and how long the first motion has been in question.

        A new rival is made where there is none and the first motion is in doubt. It is also made where a surface comes
        to be in front of the rest while the question is open.
        """
        rival, open_for, is_doubted = state.rival, state.open_for, bool(attempt.state.is_doubted)
        if rival.is_there or not attempt.usable or not (is_doubted or open_for.lasts):
            return rival, open_for
        rival = self._rival_of(state.first, standing_before=not is_doubted)
        return rival, BEGUN if rival.is_there and not open_for.lasts else open_for

    def _decide(self, attempt: Attempt, other: Attempt, rival: Rival, open_for: Span, frame: Frame) -> Attempt:
        """Decide which of two attempts stands for a frame, and whether the rival, of its age then, is kept."""
        duel = self._duel(attempt, other, rival)
        open_after = OVER if rival.stands_before else open_for
        if duel.is_won:
            return self._taken(other, rival, open_for, open_after)
        if duel.casts_doubt:
            attempt = mistrusted(attempt)
        if duel.is_rival_unsupported:
            state = self._alone(attempt.state, open_after)
        elif duel.is_given_up:
            state = self._alone(attempt.state, open_for)
        else:
            kept = rival._replace(state=other.state, motions=duel.motions.stored(), ahead=np.int32(duel.ahead))
            state = RivalledState(attempt.state, kept, open_for)
        return self._begun_anew(attempt._replace(state=state), open_for, frame)

    def _duel(self, attempt: Attempt, other: Attempt, rival: Rival) -> Duel:
        """Compare the two motions; the anchor's pixels vote only where the choice matters."""
        motions = rival.motions.after(attempt.result, other.result)
        duel = Duel.of(motions, attempt.result, other.deviation, rival.age, stands_before=bool(rival.stands_before))
        if not duel.asks_for_votes:
            return duel
        both = np.stack([motions.first_T_anchor, motions.rival_T_anchor]).astype(np.float32)
        margin = vote(rival.anchor, _view(attempt.state), both, rival.near, self.first.segmenter.camera)
        return replace(duel, margin=margin, ahead=int(rival.ahead) + 1 if leads(margin) else 0)

    def _taken(
        self, other: Attempt, rival: Rival, open_for: Span, open_after: Span, *, clearly: bool = False
    ) -> Attempt:
        """The rival's attempt in place of the first one's, moving from where the first camera was believed to be.

        Args:
            other: The rival's attempt.
            rival: The rival before the attempt, but with its age after it.
            open_for: How long the first motion has been in question.
            open_after: How long it is from this frame on.
            clearly: Whether motions that differ by no more than the rival's errors count as the same: all that speaks
                for the rival is that it was not lost.
        """
        first_T_anchor, rival_T_anchor, _ = rival.motions.exact()
        onward = np.asarray(other.result.target_T_reference) @ rival_T_anchor
        result = _returned(other.result, onward @ inverse(first_T_anchor))
        taken = other._replace(state=self._alone(other.state, open_after), result=result)
        earlier = int(rival.age.frames) - 1
        have_parted = rival.motions.have_parted(clearly=clearly)
        is_brief = open_for.lasts and not clearly and float(rival.age.seconds) < AGREED_AFTER
        if have_parted or is_brief or earlier == 0:  # else both agreed on the earlier motions
            unknown = max(int(open_for.frames) - earlier - 1, 0)
            taken = taken._replace(unknown=unknown, revises=unknown + earlier)
        return mistrusted(taken)

    @cached_property
    def _nobody(self) -> Rival:
        """No rival, in the shapes and types of every one."""
        blank, nothing = self.first.blank_state(), np.zeros(self.first.segmenter.size, bool)
        return Rival(blank, _view(blank), nothing, np.bool_(False), Motions.none(), OVER, np.int32(0))

    def _alone(self, state: AwareState, open_for: Span) -> RivalledState:
        """A state without a rival."""
        return RivalledState(state, self._nobody, open_for)

    def _rival_of(self, state: AwareState, standing_before: bool = False) -> Rival:
        """A new rival from the last frame on: the motion of all that lies behind the nearer surfaces.

        There is none if nothing is nearer than the rest, or if `standing_before` and no surface is in front of others.
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
            seconds_extrapolated=np.zeros((), np.float32),
        )
        tracker = state.tracker._replace(keyframe=state.tracker.previous, usual=Usual.unknown())
        seen = state._replace(tracker=segmenter.without(tracker, near), scene=scene)
        return self._nobody._replace(
            state=seen, anchor=anchor, near=near, stands_before=np.bool_(stands_before), age=BEGUN
        )


def _view(state: AwareState) -> View:
    """Return the last frame's view on the host: slicing an array on the device would compile a program."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[0], state.scene.views)


def _returned(result: Alignment, motion: Float64[np.ndarray, "4 4"]) -> Alignment:
    """The rival's result with its motion starting where the first camera was believed to be, which is poorly known."""
    return result._replace(
        target_T_reference=motion,
        xi=log(motion).astype(np.float32),
        covariance=UNKNOWN,
    )
