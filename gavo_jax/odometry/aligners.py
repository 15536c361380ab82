"""Aligners find the motion of a new frame: the search, and what wraps or replaces it.

An aligner is a value that the driver holds: it starts from a frame and then makes an `Attempt` at each new one. What it
knows of earlier frames is a state that the driver keeps and hands back, so a failed attempt leaves no trace.
"""

import gc
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64, PRNGKeyArray

from gavo_jax.alignment.judgement import is_unknown
from gavo_jax.alignment.repetition import another_period_fits_expected, another_period_is_in_reach
from gavo_jax.alignment.result import Alignment, on_host, with_finding
from gavo_jax.alignment.search import Population
from gavo_jax.bodies.records import Seen
from gavo_jax.camera import Camera
from gavo_jax.compilation.precision import in_32_bits
from gavo_jax.datasets.base import Frame
from gavo_jax.evaluation import rotation_angle
from gavo_jax.odometry.plausibility import UNKNOWN_SECONDS
from gavo_jax.odometry.tracking import Clock, TrackerState, blank_state, track_frame
from gavo_jax.rigid_motions import exp
from gavo_jax.settings import OdometryOptions, Settings
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import inverse


class Attempt(NamedTuple):
    """An aligner's attempt at a frame."""

    state: Any
    """The aligner's state if the frame becomes the reference."""
    result: Alignment
    """The motion and what is known of it, on the host."""
    usable: bool
    """Whether the motion can be used."""
    fit: bool = True
    """Whether the frame may become the reference, provided that its motion is usable."""
    candidates: tuple[Population, ...] = ()
    """Candidates of the search, one entry per level, coarsest first; empty unless they are recorded."""
    bodies: tuple[Seen, ...] = ()
    """Bodies that move on their own, as far as they were looked for."""
    unknown: int = 0
    """Number of the last motions, this one included, that are guesses."""
    revises: int = 0
    """Number of motions before this one that turn out to be wrong; see `Step.revises`."""

    @property
    def is_found(self) -> bool:
        """Whether the motion is usable and comes from the images: a guess fits any depth and any time."""
        return self.usable and not is_unknown(self.result)

    @property
    def deviation(self) -> float:
        """Standard deviation of the motion's translation, metres."""
        return float(np.sqrt(np.trace(self.result.covariance[:3, :3])))


class Aligner(Protocol):
    """Finds the motion of a new frame."""

    def warm_up(self) -> float:
        """Compile, or load, what is needed; return the seconds this took."""
        ...

    def start(self, frame: Frame) -> Any:
        """The state with a frame as the only reference."""
        ...

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        """Align a frame with the references; the state stays as it is."""
        ...

    def predict(self, state: Any, elapsed: float) -> Float64[np.ndarray, "4 4"]:
        """target_T_reference if the camera keeps its velocity for `elapsed` seconds."""
        ...


class FrameSearch(Aligner, Protocol):
    """An aligner that finds motions itself, from references that a `TrackerState` holds."""

    @property
    def camera(self) -> Camera:
        """Camera of the frames, without distortion."""
        ...

    @property
    def settings(self) -> Settings:
        """Settings of the search."""
        ...

    @property
    def plain(self) -> "FrameSearch":
        """The search without second thoughts."""
        ...

    def blank_state(self) -> TrackerState:
        """The state before the first frame."""
        ...


BEGINNING = Clock(np.float32(1.0), np.float32(0.0), np.uint32(0))
"""Clock of a first frame."""


@dataclass(frozen=True)
class Search:
    """Our own search: the compiled program of `tracking.track_frame`.

    Attributes:
        camera: Camera of the frames, without distortion.
        settings: Settings of the search.
        key: The run's key; every random number follows from it and the frame's index.
        record: Whether the candidates are kept.
    """

    camera: Camera
    settings: Settings
    key: PRNGKeyArray
    record: bool = False

    def warm_up(self) -> float:
        """Compile the program for a frame, or load it from the cache."""
        start, collects = time.perf_counter(), gc.isenabled()
        gc.disable()  # tracing makes 100,000s of objects that stay; the collector would take a fifth of the time
        try:
            self.start(self._blank_frame())
        finally:
            if collects:
                gc.enable()
        return time.perf_counter() - start

    @property
    def plain(self) -> "Search":
        """The search itself, as it has no second thoughts."""
        return self

    def blank_state(self) -> TrackerState:
        """The state before the first frame."""
        return blank_state(self.camera, self.settings.solver, self.settings.alignment)

    def start(self, frame: Frame) -> TrackerState:
        """The state after a first frame, by the program that serves every frame; there is no motion to find yet."""
        return self.align(self.blank_state(), frame, BEGINNING).state

    def _blank_frame(self) -> Frame:
        size = (self.camera.height, self.camera.width)
        return Frame(np.zeros(size, np.uint8), np.zeros(size, np.uint16), timestamp=0.0)

    def _inputs(self, state: TrackerState, frame: Frame, clock: Clock) -> tuple[Any, ...]:
        """Return the inputs of the program."""
        settings, odometry = self.settings, traced_part(self.settings.odometry)
        images = (frame.grey, frame.depth)
        return state, *images, clock, self.key, self.camera, settings.solver, settings.alignment, odometry

    def is_kept(self) -> bool:
        """Whether the program was compiled before, so that `warm_up` only loads it."""
        inputs = self._inputs(self.blank_state(), self._blank_frame(), BEGINNING)
        return track_frame.is_kept(*inputs, record=self.record)

    def align(self, state: TrackerState, frame: Frame, clock: Clock) -> Attempt:
        """Align with the previous frame and the keyframe; the motion is usable if it is `OK`."""
        after, result, populations = track_frame(*self._inputs(state, frame, clock), record=self.record)
        attempt = self.judged(state, after, on_host(result), frame, clock)
        return attempt._replace(candidates=_by_level(populations))

    def judged(
        self, state: TrackerState, after: TrackerState, result: Alignment, frame: Frame, clock: Clock
    ) -> Attempt:
        """The attempt that a result makes, checked for being off by a period where the image repeats itself.

        Args:
            state: State before the frame.
            after: State with the frame as the reference.
            result: The search's result, on the host.
            frame: The new frame.
            clock: When it was taken.
        """
        attempt = Attempt(after, result, result.status == AlignmentStatus.OK)
        return checked_for_periods(self, state, attempt, frame, clock)

    def predict(self, state: TrackerState, elapsed: float) -> Float64[np.ndarray, "4 4"]:
        """Predict by the twist of the last motion."""
        return exp(np.asarray(state.motion, np.float64) * (elapsed / float(state.seconds)))


def expecting(state: Any, xi: Float64[np.ndarray, " 6"], seconds: float) -> Any:
    """A search's state, however it is wrapped, that expects the motion `xi` after `seconds`.

    States of other aligners are returned as they are.
    """
    for name in ("tracker", "first"):
        if name in getattr(state, "_fields", ()):
            return state._replace(**{name: expecting(getattr(state, name), xi, seconds)})
    if not isinstance(state, TrackerState):
        return state
    motion = jnp.asarray(xi * (float(state.seconds) / seconds), jnp.float32)
    return state._replace(motion=motion, guess=motion)


def at_rest(state: TrackerState) -> TrackerState:
    """A state in which nothing is known of the camera's motion, as after a first frame."""
    still = jnp.zeros(6)
    return state._replace(motion=still, guess=still, instant_motion=still, seconds=jnp.float32(UNKNOWN_SECONDS))


def checked_for_periods(
    search: FrameSearch, state: TrackerState, attempt: Attempt, frame: Frame, clock: Clock
) -> Attempt:
    """A usable attempt, checked for being off by a period where the image repeats itself.

    If it may be off and the last motion is known, the attempt is unusable. If the last motion is unknown the result is
    used, but the next frame gets no prediction from it: that would only repeat the error.

    Args:
        search: Knows the camera, and predicts.
        state: State before the frame.
        attempt: The attempt; one that is not usable is returned as it is.
        frame: The new frame.
        clock: When it was taken.
    """
    if not attempt.usable:
        return attempt
    result, seconds = attempt.result, float(clock.elapsed)
    motion, images = np.asarray(result.target_T_reference), (frame.grey, frame.depth, search.camera)
    is_known = is_motion_known(state)
    if is_known:
        is_open = another_period_fits_expected(motion, result.error, search.predict(state, seconds), *images)
    else:
        is_open = another_period_is_in_reach(motion, result.error, seconds, *images)
    if not is_open:
        return attempt
    attempt = attempt._replace(result=with_finding(result, AlignmentStatus.AMBIGUOUS), usable=not is_known)
    return attempt if is_known else attempt._replace(state=at_rest(attempt.state))


def is_motion_known(state: TrackerState) -> bool:
    """Whether a state knows how the camera moves: not after a first frame, or a motion that may be off by a period."""
    return bool(np.any(np.asarray(state.motion)))


def _by_level(populations: Population | None) -> tuple[Population, ...]:
    """The candidates of each visit to a level, on the host."""
    if populations is None:
        return ()
    host = jax.device_get(populations)
    return tuple(jax.tree.map(lambda leaf, k=k: leaf[k], host) for k in range(len(host.level)))


def traced_part(options: OdometryOptions) -> OdometryOptions:
    """The options that shape the program; the others are reset, so that they cause no second compilation."""
    return replace(options, relight=True, recover=True, bodies="off", on_lost="hold", loops=False)


def side_by_side(here: Callable[[], Any], beside: Callable[[], Any]) -> float:
    """Compile with two functions at once, the second one in a thread; return the seconds this took."""
    start = time.perf_counter()
    with ThreadPoolExecutor(max_workers=1) as worker:
        other = worker.submit(in_32_bits(beside))
        here()
        other.result()
    return time.perf_counter() - start


AGREEMENT = (0.02, 0.02)
"""Metres and radians within which two searches have found the same motion."""


def agree(first: Alignment, second: Alignment, within: tuple[float, float] = AGREEMENT) -> bool:
    """Whether two motions are the same within some metres and radians."""
    between = inverse(np.asarray(first.target_T_reference)) @ second.target_T_reference
    return bool(np.linalg.norm(between[:3, 3]) < within[0] and rotation_angle(between[:3, :3]) < within[1])
