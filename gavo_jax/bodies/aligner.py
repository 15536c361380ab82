"""The camera's motion among bodies that move: several motions are kept, the image is shared out among them, one chosen.

`BodyAware` stands before a search. Where the motion that the search finds explains the image, and nothing was known to
move, that is all.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float64, Integer

from gavo_jax.alignment.judgement import MIN_EXPLAINED_GREY, UNKNOWN
from gavo_jax.alignment.result import with_finding
from gavo_jax.bodies.belief import Belief, suspect
from gavo_jax.bodies.consensus import Opinion
from gavo_jax.bodies.evidence import inverse_depth_of
from gavo_jax.bodies.identity import LEAST, BodyTracks, body_components
from gavo_jax.bodies.motions import find_motions
from gavo_jax.bodies.scene import AwareState, FrameView, MotionSegmenter
from gavo_jax.bodies.surfaces import whole_surfaces
from gavo_jax.datasets.base import Frame
from gavo_jax.odometry.aligners import Aligner, Attempt, FrameSearch, agree, side_by_side
from gavo_jax.odometry.plausibility import depth_alone_disagrees
from gavo_jax.odometry.tracking import Clock, TrackerState, as_exposed
from gavo_jax.rigid_motions import exp, log
from gavo_jax.status import AlignmentStatus, bit
from gavo_jax.trajectory import inverse

DOUBTFUL = 0.1
"""Share of what was at rest that moves, from which on a motion may not be the camera's."""
MAJORITY = 0.5
"""Support from which on a motion is taken for the camera's although its points agree badly."""
ROUNDS = 3
"""Most rounds of searching without what moves by the last round's motion."""
RELUCTANT = 2.0
"""Dissent from a motion, over that from the one which the area asks for, from which on another one is searched for."""
BETTER = 1.2
"""Dissent from a motion, over that from the one found instead, from which on the new one is taken."""
MISTRUSTED, MISTRUSTED_BESIDE_BODIES = 18.0, 12.0
"""Dissents from which on a motion may be a body's, without bodies in view and with some. Where only noise is left the
middle block gains 5.3, the median of chi-squared with six degrees of freedom; real clips have about 9 in the middle
pair and 17 in the worst.
"""
GAIN = 0.01
"""Support that a round has to add for another one to follow."""
LARGE = 0.25
"""Share of the image that bodies cover, from which on the last motion may stand for one that cannot be found."""
MAX_CARRIED = 0.5
"""Seconds for which the last motion may stand for one that cannot be found."""
NEARLY_AS_GOOD = 0.85
"""Support of another motion, over that of the camera's, from which on it may be the camera's as well."""
SUSPICIOUS = 0.02
"""Share of the image with bodies, away from where some were, from which on other motions are asked."""
SUSPECTED = 0.3
"""Suspicion from which on a pixel's points take no part in the search."""
MOST_ASIDE = 0.6
"""Share of the image that may be set aside on suspicion; where more is suspected, only what moves is set aside."""
SAME = (0.01, 0.01)
"""Metres and radians within which two motions are the same."""
GOES_ON = (0.01, 0.01)
"""Least deviation, metres and radians, of a motion that goes on as before; more where the run's velocity changes so."""
SURPRISE = 22.5
"""Squared deviations between what was found and the last motion, gone on with, beyond which it did not go on:
chi-squared with six degrees of freedom is larger once in a thousand times."""
FOUND = (AlignmentStatus.OK, AlignmentStatus.HIGH_ERROR, AlignmentStatus.DEPTH_MISMATCH, AlignmentStatus.AMBIGUOUS)
"""Statuses of a motion that is worth asking about."""
EXCUSED = bit(AlignmentStatus.HIGH_ERROR) | bit(AlignmentStatus.DEPTH_MISMATCH)
"""Findings that a body may cause by hiding what the points saw."""
MOST = 0.9
"""Share of the depth left in view by bodies that has to agree with a motion for `DEPTH_MISMATCH` to be excused."""


class MotionCandidate(NamedTuple):
    """A motion that may be the camera's."""

    attempt: Attempt
    belief: Belief
    """What the motion says of the last frame's pixels."""

    @property
    def rank(self) -> tuple[bool, float]:
        """The larger, the better."""
        return self.attempt.result.status in FOUND, float(self.belief.support)


@dataclass(frozen=True)
class BodyAware:
    """An aligner that asks what of the image its motion explains.

    Attributes:
        first: Makes the first attempt at a frame.
        search: What that is; it makes all others.
        is_eager: Whether it learns what moves from a motion that may be a body's, too, and asks for no other one.
    """

    first: Aligner
    search: FrameSearch
    is_eager: bool = False

    @cached_property
    def segmenter(self) -> MotionSegmenter:
        """What sees bodies."""
        settings = self.search.settings
        return MotionSegmenter(as_exposed(self.search.camera, settings.odometry), settings)

    @property
    def search_of_bodies(self) -> Aligner | None:
        """What finds each body's own motion; None where it is not looked for."""
        return self.search.plain if self.search.settings.odometry.bodies == "track" else None

    def warm_up(self) -> float:
        """Compile what every frame needs, side by side: the search, and the look at what it explains."""
        state = self.blank_state()

        def look() -> None:
            jax.block_until_ready(self.segmenter.look(state.scene, state.tracker, np.eye(4)))

        return side_by_side(self.first.warm_up, look)

    def warm_up_second(self) -> None:
        """Compile what is asked where what moves is shared out among motions."""
        state = self.blank_state()
        self.segmenter.look_back(state.scene, state.tracker, np.eye(4))

    def blank_state(self) -> AwareState:
        """The state before the first frame, in the shapes and types of every state."""
        tracker = self.search.blank_state()
        return AwareState(tracker, self.segmenter.blank(), tracker.previous)

    def start(self, frame: Frame) -> AwareState:
        """A scene in which nothing is known to move."""
        tracker = self.first.start(frame)
        return AwareState(tracker, self.segmenter.first(tracker), tracker.previous)

    def predict(self, state: AwareState, elapsed: float) -> Float64[np.ndarray, "4 4"]:
        """Predict by the search."""
        return self.search.predict(state.tracker, elapsed)

    def align(self, state: AwareState, frame: Frame, clock: Clock) -> Attempt:
        """Align, and look what moves."""
        before = np.asarray(state.scene.tracks.labels) > 0
        first = self.first.align(state.tracker, frame, clock)
        seen, look = self._agreed(state, frame, clock, first)
        depth_disagrees = AlignmentStatus.DEPTH_MISMATCH in seen.result.statuses
        found = _bodies(look.belief, before, depth_disagrees)
        attempt, carried = seen, 0.0
        if not self.is_eager and self._asks(first, seen, found, before):
            attempt, carried = self._asked(state, frame, clock, seen)
        is_vague = attempt.usable and not carried and deviation(attempt) > GOES_ON[0]
        if not self.is_eager and is_vague and np.any(before):
            attempt = self._fused_with_prediction(state, clock, attempt)
        if attempt is not seen:
            look = self._look(state, attempt)
            found = _bodies(look.belief, before, depth_disagrees)
        return self._remember(state, frame, clock, attempt, look, found, carried)

    def _asks(
        self, first: Attempt, seen: Attempt, found: Integer[np.ndarray, "h w"], before: Bool[np.ndarray, "h w"]
    ) -> bool:
        """Whether other motions are asked: where bodies appear away from those before, or beside bodies none was found.

        Args:
            first: The first attempt.
            seen: What stands for it, where most of the image's area asked for another motion.
            found: Bodies by that.
            before: Where bodies were in the frame before.
        """
        has_arisen = np.mean((found > 0) & ~_near(before)) > SUSPICIOUS and seen is first
        is_lost = not seen.usable and (np.any(before) or np.any(found))
        is_depth_wrong = np.mean(before) < LARGE and depth_alone_disagrees(first.result.explained)
        return bool(has_arisen or is_lost) and not is_depth_wrong

    def _asked(self, state: AwareState, frame: Frame, clock: Clock, seen: Attempt) -> tuple[Attempt, float]:
        """What other motions come to, and the seconds for which the last one has stood for those that were not found:
        0 where one was.
        """
        attempt, before = self._share_out(state, frame, clock, seen), state.scene.carried
        if attempt.usable or not before < MAX_CARRIED:
            return attempt, 0.0
        covered = float(np.mean(np.asarray(state.scene.tracks.labels) > 0))
        helped = self._helped_by_prediction(state, clock, attempt, covered)
        return helped, 0.0 if helped is attempt else float(before + clock.elapsed)

    def _remember(
        self,
        state: AwareState,
        frame: Frame,
        clock: Clock,
        attempt: Attempt,
        look: FrameView,
        found: Integer[np.ndarray, "h w"],
        carried: float,
    ) -> Attempt:
        """An attempt with its bodies and all that is known after it; from a motion in doubt nothing is learnt."""
        scene, segmenter = state.scene, self.segmenter
        dissent = 0.0 if look.opinion is None else float(look.opinion.dissent)
        if dissent > MISTRUSTED:
            attempt = mistrusted(attempt)
        limit = MISTRUSTED_BESIDE_BODIES if np.any(found) else MISTRUSTED
        is_doubted = dissent > limit or AlignmentStatus.MOVING_BODY in attempt.result.statuses
        tracks, bodies, seen = BodyTracks(*map(np.asarray, scene.tracks)), found, ()
        if np.any(found) or np.any(tracks.numbers):
            inverse_depth = inverse_depth_of(segmenter.view(attempt.state))
            bodies = whole_surfaces(found, np.asarray(look.belief.suspected) > SUSPECTED, inverse_depth)
            tracks, seen = find_motions(
                self.search_of_bodies, segmenter, state, frame, clock, bodies, look.belief, inverse_depth
            )
        tracker: TrackerState = attempt.state
        whole, elapsed = tracker.previous, float(clock.elapsed)
        suspected = suspect(look.belief, bodies > 0, elapsed, trusted=not is_doubted)
        after = segmenter.renewed(scene, look, elapsed)._replace(
            tracks=tracks, carried=np.asarray(carried, np.float32), suspected=suspected
        )
        if carried or (is_doubted and not self.is_eager):  # by a wrong motion the scene seems to move
            after = after._replace(known=look.belief.carried)
        elif np.any(bodies != found):
            known = np.asarray(after.known)
            after = after._replace(known=np.where(bodies != found, np.maximum(known, 0.0), known))
        aside = suspected > SUSPECTED  # without what was just found, where the motion is in doubt
        if np.any(aside):
            tracker = segmenter.without(tracker, aside if np.mean(aside) < MOST_ASIDE else bodies > 0)
        return attempt._replace(state=AwareState(tracker, after, whole, np.asarray(is_doubted)), bodies=seen)

    def _agreed(self, state: AwareState, frame: Frame, clock: Clock, attempt: Attempt) -> tuple[Attempt, FrameView]:
        """The attempt, or a search without what dissents where most of the image's area asks for another motion; and
        what is seen by its motion.
        """
        look = self._look(state, attempt)
        for _ in range(ROUNDS):
            opinion = look.opinion
            if opinion is None or not float(opinion.dissent) > RELUCTANT * float(opinion.least):
                break
            again = self.search.align(self._without(state.tracker, opinion, clock), frame, clock)
            if not again.usable:
                break
            other = self._look(state, again)
            if other.opinion is None or BETTER * float(other.opinion.dissent) > float(opinion.dissent):
                break
            attempt, look = again, other
        return attempt, look

    def _look(self, state: AwareState, attempt: Attempt) -> FrameView:
        return self.segmenter.look(state.scene, attempt.state, attempt.result.target_T_reference)

    def _without(self, tracker: TrackerState, opinion: Opinion, clock: Clock) -> TrackerState:
        """A tracker without the points that dissent, whose search begins from the motion that the others ask for."""
        motion = np.asarray(opinion.target_T_reference, np.float64)
        guess = np.float32(log(motion) * (float(tracker.seconds) / float(clock.elapsed)))
        return self.segmenter.without(tracker, opinion.dissenting)._replace(guess=guess)

    def _share_out(self, state: AwareState, frame: Frame, clock: Clock, first: Attempt) -> Attempt:
        """The motion that most of what was at rest agrees with.

        Those that may be the camera's are the one that was found, that of what it leaves unexplained, and that of what
        the last motion, gone on with, explains; where nothing was known to move, what was found may be a wrong one, and
        the search that begins from rest is another. The best is searched for again without what moves by it.
        """
        scene, tracker, segmenter = state.scene, state.tracker, self.segmenter
        known = bool(np.any(np.asarray(scene.tracks.labels)))

        def candidate(attempt: Attempt) -> MotionCandidate:
            return MotionCandidate(
                attempt, segmenter.look_back(scene, attempt.state, attempt.result.target_T_reference)
            )

        def search_from(tracker: TrackerState) -> MotionCandidate:
            return candidate(self.search.align(tracker, frame, clock))

        def search_without(mask: Any) -> MotionCandidate:
            return search_from(segmenter.without(tracker, mask))

        found = candidate(first)
        predicted = segmenter.look_back(scene, first.state, self.predict(state, float(clock.elapsed)))
        tried = [found]
        if found.belief.contradicted > DOUBTFUL or predicted.support > found.belief.support + DOUBTFUL:
            tried += [search_without(found.belief.moving < 0), search_without(predicted.moving > 0)]
        if not first.usable and not known:
            at_rest = tracker._replace(previous=state.whole, keyframe=state.whole, guess=np.zeros(6, np.float32))
            tried += [search_from(at_rest)]
        best = max(tried, key=lambda candidate: candidate.rank)
        for _ in range(ROUNDS):
            again = search_without((best.belief.moving > 0) | best.belief.hidden)
            gain = float(again.belief.support) - float(best.belief.support)
            if gain < -GAIN or again.rank[0] < best.rank[0]:
                break
            best = again
            if gain < GAIN:
                break
        return _judged(best, tried, known)

    def _helped_by_prediction(self, state: AwareState, clock: Clock, attempt: Attempt, covered: float) -> Attempt:
        """An attempt with the help of the last motion, where what bodies leave in view does not tell the whole motion
        or, of an image that is covered for the most part, nothing; else the attempt as it is.
        """
        result = attempt.result
        if int(result.findings) == bit(AlignmentStatus.LOW_TEXTURE) and np.all(np.isfinite(result.covariance)):
            return self._fused_with_prediction(state, clock, attempt)
        return self._extrapolated(state, clock, attempt) if covered > LARGE else attempt

    def _fused_with_prediction(self, state: AwareState, clock: Clock, attempt: Attempt) -> Attempt:
        """The attempt with what its images do not tell of the motion filled in as the last one goes on: the mean of
        both, weighted by their covariances. As it is where the two disagree: the camera did not go on as before.
        """
        found = np.asarray(attempt.result.target_T_reference)
        onward = log(inverse(found) @ self.predict(state, float(clock.elapsed)))
        changed = np.square(float(clock.elapsed)) * np.asarray(state.tracker.velocity_change.changes, np.float64)
        prior = np.diag(np.repeat(np.maximum(changed, np.square(GOES_ON)), 3))
        covariance = np.float64(attempt.result.covariance)
        certainty = np.linalg.inv(covariance + prior)
        if onward @ certainty @ onward > SURPRISE:
            return attempt
        share = covariance @ certainty
        motion = found @ exp(share @ onward)
        return _moved(state, attempt, motion, share @ prior)

    def _extrapolated(self, state: AwareState, clock: Clock, attempt: Attempt) -> Attempt:
        """The attempt with the motion that the camera has if it goes on as before."""
        motion = self.predict(state, float(clock.elapsed))
        attempt = _moved(state, attempt, motion, UNKNOWN)
        findings = bit(AlignmentStatus.MOVING_BODY)
        result = attempt.result._replace(status=AlignmentStatus.MOVING_BODY, findings=findings)
        return attempt._replace(result=result, unknown=1)


def _moved(
    state: AwareState, attempt: Attempt, motion: Float64[np.ndarray, "4 4"], covariance: Float64[np.ndarray, "6 6"]
) -> Attempt:
    """An attempt of another motion than the one that was found, which can be used."""
    xi: Any = log(motion).astype(np.float32)
    result = attempt.result._replace(target_T_reference=motion, xi=xi, covariance=covariance.astype(np.float32))
    tracker: TrackerState = attempt.state
    before = state.tracker  # what the search made of the wrong motion is of no use
    tracker = tracker._replace(
        keyframe=tracker.previous,
        motion=xi,
        guess=xi,
        instant_motion=xi,
        velocity_change=before.velocity_change,
        usual=before.usual,
    )
    return attempt._replace(state=tracker, result=result, usable=True)


def _judged(best: MotionCandidate, tried: list[MotionCandidate], known: bool) -> Attempt:
    """The best candidate's attempt with what the image as a whole says of it.

    What all of the image at rest speaks for is not wrong because a body hides what its points saw; but the image has to
    agree with it where its points still see. And where another motion has nearly as much support, or more of the image
    speaks against this one than for it, it may be a body's.
    """
    attempt, result, belief = best.attempt, best.attempt.result, best.belief
    seen = known or float(belief.contradicted) > LEAST
    in_view = 1.0 - np.mean((belief.moving > 0) | belief.hidden)
    excused = EXCUSED if float(result.explained.depth) > MOST * in_view else bit(AlignmentStatus.HIGH_ERROR)
    matches = float(result.explained.grey) > MIN_EXPLAINED_GREY
    if seen and matches and float(belief.support) > MAJORITY and not int(result.findings) & ~excused:
        result = result._replace(status=AlignmentStatus.OK, findings=0)
        attempt = attempt._replace(result=result, usable=True)
    rivals = [other for other in tried if other.rank[0] and not agree(other.attempt.result, attempt.result, SAME)]
    stronger = any(float(other.belief.support) > NEARLY_AS_GOOD * float(belief.support) for other in rivals)
    if stronger or float(belief.contradicted) > float(belief.support):
        attempt = mistrusted(attempt)
    return attempt


def mistrusted(attempt: Attempt) -> Attempt:
    """The attempt with the word that its motion may be a body's."""
    return attempt._replace(result=with_finding(attempt.result, AlignmentStatus.MOVING_BODY))


def deviation(attempt: Attempt) -> float:
    """Standard deviation of an attempt's translation, metres."""
    return float(np.sqrt(np.trace(attempt.result.covariance[:3, :3])))


def _bodies(belief: Belief, before: Bool[np.ndarray, "h w"], depth_disagrees: bool) -> Integer[np.ndarray, "h w"]:
    moving, known = jax.device_get((belief.moving, belief.known))
    return body_components(moving, known, before, depth_disagrees)


def _near(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """A mask with a border as wide as a body moves from frame to frame."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
