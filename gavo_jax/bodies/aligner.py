"""The camera's motion among moving bodies: several motions are kept, the image is shared out among them, one is chosen.

`BodyAware` wraps a search. Where the search's motion explains the image, and nothing was known to move, it is kept.
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
from gavo_jax.bodies.identity import MIN_BODY_SHARE, BodyTracks, body_components
from gavo_jax.bodies.motions import find_motions
from gavo_jax.bodies.pixel_evidence import inverse_depth_of
from gavo_jax.bodies.scene import AwareState, FrameView, MotionSegmenter
from gavo_jax.bodies.surfaces import whole_surfaces
from gavo_jax.datasets.base import Frame
from gavo_jax.frame_checks import MAX_INTERVAL_RATIO
from gavo_jax.odometry.aligners import (
    Aligner,
    Attempt,
    FrameSearch,
    agree,
    checked_for_periods,
    is_motion_known,
    side_by_side,
)
from gavo_jax.odometry.plausibility import depth_alone_disagrees, is_abrupt
from gavo_jax.odometry.tracking import Clock, TrackerState, as_exposed
from gavo_jax.rigid_motions import exp, log
from gavo_jax.status import AlignmentStatus, bit
from gavo_jax.trajectory import inverse

DOUBTFUL = 0.1
"""Contradicted share, or lead of the prediction in support, above which the motion found may not be the camera's."""
MAJORITY = 0.5
"""Support above which a motion is accepted as the camera's although its points fit badly."""
ROUNDS = 3
"""Maximum number of repeated searches, each without what moves according to the one before."""
MAX_DISSENT_RATIO = 2.0
"""Ratio of a motion's dissent to the least dissent from any motion, above which another one is searched for."""
MIN_REPLACEMENT_RATIO = 1.2
"""Ratio of a motion's dissent to that from its replacement, from which on the replacement is taken."""
MISTRUSTED, MISTRUSTED_STRICTLY = 18.0, 12.0
"""Dissents above which a motion may be a body's; the second one applies beside bodies, and where the velocity changes
abruptly. With pure noise the median block gains 5.3, the median of chi-squared with six degrees of freedom. Real clips
have about 9 in the median pair and 17 in the worst.
"""
GAIN = 0.01
"""Gain in support that a round needs for another one to follow."""
LARGE = 0.25
"""Share of the image covered by bodies above which the last motion may stand in for one that is not found."""
MAX_SECONDS_EXTRAPOLATED = 0.5
"""Longest time, in seconds, for which the last motion may stand in for one that is not found."""
NEARLY_AS_GOOD = 0.85
"""Support of another motion, relative to the best one's, above which it may be the camera's as well."""
SUSPICIOUS = 0.02
"""Share of the image with bodies, away from the last frame's bodies, above which other motions are tried."""
SUSPECTED = 0.3
"""Suspicion above which a pixel's points are left out of the search."""
MOST_ASIDE = 0.6
"""Largest share of the image that is set aside on suspicion; where more is suspected, only what moves is set aside."""
SAME = (0.01, 0.01)
"""Metres and radians within which two motions are the same."""
MIN_VELOCITY_DEVIATIONS = (0.01, 0.01)
"""Least standard deviations, metres and radians, of the prior of constant velocity; larger where the run's velocity
usually changes more.
"""
MAX_FUSION_DISTANCE = 22.5
"""Squared Mahalanobis distance between the motion found and the prediction above which the two are not fused.
Chi-squared with six degrees of freedom exceeds it once in a thousand times.
"""
ACCEPTABLE = (AlignmentStatus.OK, AlignmentStatus.HIGH_ERROR, AlignmentStatus.DEPTH_MISMATCH, AlignmentStatus.AMBIGUOUS)
"""Statuses of a motion that may be considered as the camera's."""
EXCUSED = bit(AlignmentStatus.HIGH_ERROR) | bit(AlignmentStatus.DEPTH_MISMATCH)
"""Findings that a body may cause by occluding points."""
MIN_DEPTH_AGREEMENT = 0.9
"""Part of what neither moves nor is hidden whose depth has to agree for `DEPTH_MISMATCH` to be excused."""


class MotionCandidate(NamedTuple):
    """A motion that may be the camera's."""

    attempt: Attempt
    belief: Belief
    """What the motion implies for the last frame's pixels."""

    @property
    def rank(self) -> tuple[bool, float]:
        """Sort key: the larger, the better."""
        return self.attempt.result.status in ACCEPTABLE, float(self.belief.support)


@dataclass(frozen=True)
class BodyAware:
    """An aligner that checks how much of the image its motion explains.

    Attributes:
        first: Makes the first attempt at a frame.
        search: The search behind `first`; it makes all other attempts.
        is_eager: Whether it learns what moves even from a motion that may be a body's, and tries no other motion.
    """

    first: Aligner
    search: FrameSearch
    is_eager: bool = False

    @cached_property
    def segmenter(self) -> MotionSegmenter:
        """The segmenter of moving bodies."""
        settings = self.search.settings
        return MotionSegmenter(as_exposed(self.search.camera, settings.odometry), settings)

    @property
    def search_of_bodies(self) -> Aligner | None:
        """The search for each body's own motion; None where bodies are not tracked."""
        return self.search.plain if self.search.settings.odometry.bodies == "track" else None

    def warm_up(self) -> float:
        """Compile what every frame needs, in parallel: the search, and the check of what it explains."""
        state = self.blank_state()

        def look() -> None:
            jax.block_until_ready(self.segmenter.look(state.scene, state.tracker, np.eye(4), 0.0))

        return side_by_side(self.first.warm_up, look)

    def warm_up_second(self) -> None:
        """Compile what is needed only where the image is shared out among several motions."""
        state = self.blank_state()
        self.segmenter.look_back(state.scene, state.tracker, np.eye(4))

    def blank_state(self) -> AwareState:
        """The state before the first frame, in the shapes and types of every state."""
        tracker = self.search.blank_state()
        return AwareState(tracker, self.segmenter.blank(), tracker.previous)

    def start(self, frame: Frame) -> AwareState:
        """Start with a scene in which nothing is known to move."""
        tracker = self.first.start(frame)
        return AwareState(tracker, self.segmenter.first(tracker), tracker.previous)

    def predict(self, state: AwareState, elapsed: float) -> Float64[np.ndarray, "4 4"]:
        """Predict with the underlying search."""
        return self.search.predict(state.tracker, elapsed)

    def align(self, state: AwareState, frame: Frame, clock: Clock) -> Attempt:
        """Align a frame, and find what moves in it."""
        before = np.asarray(state.scene.tracks.labels) > 0
        first = self.first.align(state.tracker, frame, clock)
        seen, look = self._agreed(state, frame, clock, first)
        depth_disagrees = AlignmentStatus.DEPTH_MISMATCH in seen.result.statuses
        found = _bodies(look.belief, before, depth_disagrees)
        attempt, seconds_extrapolated = seen, 0.0
        if not self.is_eager and self._asks(first, seen, found, before):
            attempt, seconds_extrapolated = self._asked(state, frame, clock, seen)
        is_vague = attempt.usable and not seconds_extrapolated and attempt.deviation > MIN_VELOCITY_DEVIATIONS[0]
        if not self.is_eager and is_vague and is_motion_known(state.tracker) and np.any(before):
            attempt = self._fused_with_prediction(state, clock, attempt)
        if attempt is not seen:
            look = self._look(state, clock, attempt)
            found = _bodies(look.belief, before, depth_disagrees)
        return self._remember(state, frame, clock, attempt, look, found, seconds_extrapolated)

    def _asks(
        self, first: Attempt, seen: Attempt, found: Integer[np.ndarray, "h w"], before: Bool[np.ndarray, "h w"]
    ) -> bool:
        """Whether to try other motions: where bodies appear away from earlier ones, or a search fails beside bodies.

        Args:
            first: The first attempt.
            seen: The attempt that replaces it if most of the image's area asks for another motion; else the same.
            found: Bodies according to `seen`.
            before: Where bodies were in the last frame.
        """
        has_arisen = np.mean((found > 0) & ~_near(before)) > SUSPICIOUS and seen is first
        is_lost = not seen.usable and (np.any(before) or np.any(found))
        is_depth_wrong = np.mean(before) < LARGE and depth_alone_disagrees(first.result.explained)
        return bool(has_arisen or is_lost) and not is_depth_wrong

    def _asked(self, state: AwareState, frame: Frame, clock: Clock, seen: Attempt) -> tuple[Attempt, float]:
        """The best of several other motions, and how long the last one has stood in for a missing one.

        The time is in seconds; 0 where a motion was found.
        """
        attempt, before = self._share_out(state, frame, clock, seen), state.scene.seconds_extrapolated
        has_missed = float(clock.elapsed) > MAX_INTERVAL_RATIO * float(state.tracker.seconds)
        is_predicted = is_motion_known(state.tracker) and not has_missed and before < MAX_SECONDS_EXTRAPOLATED
        if attempt.usable or not is_predicted:
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
        seconds_extrapolated: float,
    ) -> Attempt:
        """Complete an attempt with its bodies and the state after it; nothing is learnt from a motion in doubt."""
        scene, segmenter = state.scene, self.segmenter
        dissent = 0.0 if look.opinion is None else float(look.opinion.dissent)
        if dissent > MISTRUSTED or (dissent > MISTRUSTED_STRICTLY and self._is_abrupt(state, clock, attempt)):
            attempt = mistrusted(attempt)
        limit = MISTRUSTED_STRICTLY if np.any(found) else MISTRUSTED
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
            tracks=tracks, seconds_extrapolated=np.asarray(seconds_extrapolated, np.float32), suspected=suspected
        )
        # under a wrong motion the static scene seems to move
        if seconds_extrapolated or (is_doubted and not self.is_eager):
            after = after._replace(known=look.belief.carried_belief)
        elif np.any(bodies != found):
            known = np.asarray(after.known)
            after = after._replace(known=np.where(bodies != found, np.maximum(known, 0.0), known))
        aside = suspected > SUSPECTED  # without what was just found, where the motion is in doubt
        if np.any(aside):
            tracker = segmenter.without(tracker, aside if np.mean(aside) < MOST_ASIDE else bodies > 0)
        return attempt._replace(state=AwareState(tracker, after, whole, np.asarray(is_doubted)), bodies=seen)

    def _agreed(self, state: AwareState, frame: Frame, clock: Clock, attempt: Attempt) -> tuple[Attempt, FrameView]:
        """Search again without dissenting blocks while most of the image's area asks for another motion.

        Returns:
            The attempt to keep, and how the frame looks under its motion.
        """
        look = self._look(state, clock, attempt)
        for _ in range(ROUNDS):
            opinion = look.opinion
            if opinion is None or not float(opinion.dissent) > MAX_DISSENT_RATIO * float(opinion.least):
                break
            again = self.search.align(self._without(state.tracker, opinion, clock), frame, clock)
            if not again.usable:
                break
            other = self._look(state, clock, again)
            if other.opinion is None or MIN_REPLACEMENT_RATIO * float(other.opinion.dissent) > float(opinion.dissent):
                break
            attempt, look = again, other
        return attempt, look

    def _is_abrupt(self, state: AwareState, clock: Clock, attempt: Attempt) -> bool:
        """Whether the velocity changes abruptly, as where a search leaves a body for the scene."""
        elapsed, found = float(clock.elapsed), np.asarray(attempt.result.target_T_reference)
        lasted = float(state.tracker.seconds)
        return is_motion_known(state.tracker) and is_abrupt(found, self.predict(state, elapsed), elapsed, lasted)

    def _look(self, state: AwareState, clock: Clock, attempt: Attempt) -> FrameView:
        return self.segmenter.look(state.scene, attempt.state, attempt.result.target_T_reference, float(clock.elapsed))

    def _without(self, tracker: TrackerState, opinion: Opinion, clock: Clock) -> TrackerState:
        """A tracker without the dissenting points, whose search starts from the motion that the others ask for."""
        motion = np.asarray(opinion.target_T_reference, np.float64)
        guess = np.float32(log(motion) * (float(tracker.seconds) / float(clock.elapsed)))
        return self.segmenter.without(tracker, opinion.dissenting)._replace(guess=guess)

    def _share_out(self, state: AwareState, frame: Frame, clock: Clock, first: Attempt) -> Attempt:
        """The motion that most of what was at rest agrees with.

        Candidates are the motion found, that of the pixels it leaves unexplained, and that of the pixels which the
        prediction explains. If the search failed and nothing was known to move, a search from rest is another. The best
        one is searched for again without what moves according to it.
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
        judged = _judged(best, tried, known)
        if best.attempt.usable:
            return judged
        # the search did not check what it refused
        return checked_for_periods(self.search, tracker, judged, frame, clock)

    def _helped_by_prediction(self, state: AwareState, clock: Clock, attempt: Attempt, covered: float) -> Attempt:
        """Help out an attempt that failed beside bodies with the predicted motion.

        The two are fused if the attempt only lacks texture. Otherwise the prediction replaces it if bodies cover more
        than `LARGE` of the image. Else the attempt is returned as it is.
        """
        result = attempt.result
        if int(result.findings) == bit(AlignmentStatus.LOW_TEXTURE) and np.all(np.isfinite(result.covariance)):
            return self._fused_with_prediction(state, clock, attempt)
        return self._extrapolated(state, clock, attempt) if covered > LARGE else attempt

    def _fused_with_prediction(self, state: AwareState, clock: Clock, attempt: Attempt) -> Attempt:
        """Fuse an attempt with the predicted motion: their mean, weighted by their covariances.

        Where the two contradict each other, the velocity has changed, and the attempt is returned as it is.
        """
        found = np.asarray(attempt.result.target_T_reference)
        onward = log(inverse(found) @ self.predict(state, float(clock.elapsed)))
        changed = np.square(float(clock.elapsed)) * np.asarray(state.tracker.velocity_change.changes, np.float64)
        prior = np.diag(np.repeat(np.maximum(changed, np.square(MIN_VELOCITY_DEVIATIONS)), 3))
        covariance = np.float64(attempt.result.covariance)
        certainty = np.linalg.inv(covariance + prior)
        if onward @ certainty @ onward > MAX_FUSION_DISTANCE:
            return attempt
        share = covariance @ certainty
        motion = found @ exp(share @ onward)
        return _moved(state, attempt, motion, share @ prior)

    def _extrapolated(self, state: AwareState, clock: Clock, attempt: Attempt) -> Attempt:
        """The attempt with the predicted motion in place of its own."""
        motion = self.predict(state, float(clock.elapsed))
        attempt = _moved(state, attempt, motion, UNKNOWN)
        findings = bit(AlignmentStatus.MOVING_BODY)
        result = attempt.result._replace(status=AlignmentStatus.MOVING_BODY, findings=findings)
        return attempt._replace(result=result, unknown=1)


def _moved(
    state: AwareState, attempt: Attempt, motion: Float64[np.ndarray, "4 4"], covariance: Float64[np.ndarray, "6 6"]
) -> Attempt:
    """A usable attempt with another motion than the one that was found."""
    xi: Any = log(motion).astype(np.float32)
    result = attempt.result._replace(target_T_reference=motion, xi=xi, covariance=covariance.astype(np.float32))
    tracker: TrackerState = attempt.state
    before = state.tracker  # what the search learnt from the wrong motion is useless
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
    """The best candidate's attempt, judged by the image as a whole.

    A motion that most of the static scene supports is not wrong because a body hides its points. But the points that
    are still visible have to agree with it. It may be a body's where another motion has nearly as much support, or
    where more of the image contradicts it than supports it.
    """
    attempt, result, belief = best.attempt, best.attempt.result, best.belief
    seen = known or float(belief.contradicted) > MIN_BODY_SHARE
    in_view = 1.0 - np.mean((belief.moving > 0) | belief.hidden)
    depth_agrees = float(result.explained.depth) > MIN_DEPTH_AGREEMENT * in_view
    excused = EXCUSED if depth_agrees else bit(AlignmentStatus.HIGH_ERROR)
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
    """The attempt, flagged as possibly following a body."""
    return attempt._replace(result=with_finding(attempt.result, AlignmentStatus.MOVING_BODY))


def _bodies(belief: Belief, before: Bool[np.ndarray, "h w"], depth_disagrees: bool) -> Integer[np.ndarray, "h w"]:
    moving, known = jax.device_get((belief.moving, belief.known))
    return body_components(moving, known, before, depth_disagrees)


def _near(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """A mask dilated by about as much as a body moves from frame to frame."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
