"""The driver: frames in, chained poses out.

It checks each frame, has an aligner find its motion, decides what becomes of the frame, and chains the poses.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import jax
import numpy as np
from jaxtyping import Bool, Float64

from gavo_jax.alignment.result import Alignment, no_alignment, with_finding
from gavo_jax.alignment.search import Population
from gavo_jax.alignment.stacking import require_untraced
from gavo_jax.bodies.records import Body, covered, in_world
from gavo_jax.camera import Camera
from gavo_jax.camera_check import require_camera
from gavo_jax.compilation.precision import in_32_bits
from gavo_jax.compilation.waits import Stopwatch
from gavo_jax.datasets.base import Frame, FrameError, as_seconds, require_begin_in_seconds, require_grey_levels
from gavo_jax.datasets.rectified import rectified
from gavo_jax.errors import GavoWarning
from gavo_jax.frame_checks import Finding, Use, doubt_unit_of_time, seconds_late
from gavo_jax.odometry.aligners import Aligner, Attempt
from gavo_jax.odometry.beginnings import begun, followed, revised_by
from gavo_jax.odometry.composition import make_aligner, warm_up_wholly
from gavo_jax.odometry.depth_watch import judge_by_depth, watch_from
from gavo_jax.odometry.leaps import align_leaping
from gavo_jax.odometry.misplaced import arrival_of, doubt_reference
from gavo_jax.odometry.overlays import Sight
from gavo_jax.odometry.progress import Progress
from gavo_jax.odometry.second_thoughts import without_depth
from gavo_jax.odometry.way import Way
from gavo_jax.settings import Settings, as_settings
from gavo_jax.settings_check import as_seed
from gavo_jax.solvers.base import Solver
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import inverse


@dataclass(frozen=True, eq=False)
class Step:
    """The driver's record of one new frame."""

    index: int
    """Index of the frame in the sequence; the first frame, 0, has no step."""
    reference_timestamp: float
    """Colour timestamp of the frame that this one was aligned with, seconds."""
    timestamp: float
    alignment: Alignment
    """The alignment, on the host. For a lost pair its `target_T_reference` is what was found, not what was recorded.
    Its status may be a warning about the frame (a gap before it, partly missing depth) although the motion is usable.
    """
    world_T_camera: Float64[np.ndarray, "4 4"]
    """Recorded pose; the world is the first camera."""
    milliseconds: float
    """Time from the decoded images to the result on the host, milliseconds."""
    lost: bool
    """Whether there is no usable motion."""
    policy: Literal["", "hold", "predict", "stop"] = ""
    """What was recorded for a lost pair; see `OdometryOptions.on_lost`."""
    segment: int = 0
    """Segment of the trajectory that the frame belongs to; between two segments the motion is unknown."""
    origin: Literal["tracked", "relocalised", "guessed"] = "tracked"
    """Where the pose comes from: the reference, a keyframe of the map (then that is the pair's reference), or a guess.
    Guessed are lost pairs, and motions that are taken to have gone on behind a body.
    """
    bodies: tuple[Body, ...] = ()
    """Bodies that move on their own, where the settings ask for them; see docs/bodies.md."""
    revises: int = 0
    """Number of pairs before this one that turn out to be wrong. They followed a body, had wrong depth, or led to an
    image of another moment than its timestamp; see `odometry.hindsight`.
    """

    @property
    def depth_is_trusted(self) -> bool:
        """Whether nothing speaks against the frame's own depth; maps are made of such frames only."""
        return DOUBTED_DEPTH.isdisjoint(self.alignment.statuses)

    @property
    def moving(self) -> Bool[np.ndarray, "height width"] | None:
        """Pixels of the undistorted image that move on their own; None where none are known to."""
        return covered(self.bodies)


class Found(NamedTuple):
    """Where a frame was found in a map."""

    alignment: Alignment
    """Alignment with a keyframe as the reference."""
    timestamp: float
    """Colour timestamp of the keyframe, seconds."""
    world_T_camera: Float64[np.ndarray, "4 4"]
    """Pose of the frame, in the world of the odometry's segment that the keyframe belongs to."""
    segment: int


class Relocaliser(Protocol):
    """Finds frames in a map of the run so far."""

    def find(self, frame: Frame, segment: int) -> Found | None:
        """Return where a frame was taken, relative to another segment than its own; None where the map does not say."""
        ...


MAX_HELD = 3
"""Frames without a new reference after which the newest usable one becomes it, as the old one is out of reach."""
MAX_DOUBTED = 15
"""Frames without a new reference, for doubts about depth alone, after which a frame becomes it all the same: the
reference's own depth may be wrong.
"""
POOR = frozenset({AlignmentStatus.PARTIAL_DEPTH, AlignmentStatus.HIGH_ERROR})
"""Statuses of frames that have a motion, but become the reference only when the old one is out of reach."""
DEPTHLESS = frozenset({AlignmentStatus.NO_DEPTH, AlignmentStatus.FROZEN})
"""Statuses of frames that have a motion, but never become the reference."""
UNFIT_FOR_WAY = {AlignmentStatus.HIGH_ERROR, AlignmentStatus.AMBIGUOUS}
"""Statuses of motions that tell nothing of the next one: their poses are rough, or may be off by a period."""
DOUBTED_DEPTH = DEPTHLESS | {AlignmentStatus.DEPTH_MISMATCH}
"""Statuses of frames that have a motion, but no trustworthy depth of their own."""
SOUGHT_AT_ONCE, SOUGHT_EVERY = 10, 10
"""Frames at the start of a segment adrift that are all looked for in the map, and the interval of later ones."""

Moving = Callable[[Step], Bool[np.ndarray, "height width"] | None]
"""Function that gives the pixels that move in a step's frame: `Step.moving`, or the masks of the run's folder."""


def seen_moving(step: Step) -> Bool[np.ndarray, "height width"] | None:
    """Return `Step.moving`."""
    return step.moving


class FrameOutcome(NamedTuple):
    """What became of a frame, before the map is asked."""

    after: Progress
    result: Alignment
    lost: bool
    candidates: tuple[Population, ...] = ()
    bodies: tuple[Body, ...] = ()
    revises: int = 0
    """See `Step.revises`."""
    is_guess: bool = False
    """Whether the motion is a guess, though the pair is not lost."""


class Odometry:
    """Frame-by-frame tracking with an aligner; all that it knows between two frames is its `progress`.

    Args:
        camera: Camera of the frames; lens distortion is removed from every frame.
        settings: Settings of the solver, the objective and the odometry; the `default` preset's if left out.
        seed: Every random number follows from it and the frames' indices.
        record: Whether every frame's candidates are kept until the next frame, for display.
        solver: Replaces the settings' solver.
        aligner: Replaces the search that the settings describe.
        relocaliser: Finds the place of frames that nothing ties to the frames before.

    Attributes:
        camera: Camera of the frames as they are aligned, without distortion.
        progress: Where it stands; a driver of the same settings that is given it goes on from there.
        candidates: Candidates of the last frame's search, one entry per level, coarsest first; empty unless recorded.
        frame: The last frame as it was tracked, without overlays. None where it could not be read.

    Raises:
        GavoError: The camera's images are too small, the seed is invalid, or it is made inside `jax.jit`.
    """

    @in_32_bits
    def __init__(
        self,
        camera: Camera,
        settings: Settings | Solver | None = None,
        *,
        seed: int = 0,
        record: bool = False,
        solver: Solver | None = None,
        aligner: Aligner | None = None,
        relocaliser: Relocaliser | None = None,
    ):
        require_untraced(camera, settings, solver)
        require_camera(camera)
        self.relocaliser = relocaliser
        self.recorded, self.camera, self.settings = camera, camera.rectified(), as_settings(settings, solver)
        if self.settings.odometry.loops and relocaliser is None:
            fault = "a driver that is fed frame by frame keeps no map and closes no loops: run_odometry does"
            warnings.warn(f"odometry.loops: {fault}", GavoWarning, stacklevel=3)
        self.aligner = aligner or make_aligner(self.camera, self.settings, jax.random.key(as_seed(seed)), record)
        self.progress = Progress()
        self.candidates: tuple[Population, ...] = ()
        self.frame: Frame | None = None

    @in_32_bits
    def warm_up(self, wholly: bool = False) -> float:
        """Compile the program for a frame, or load it from the cache; return the seconds this took.

        Args:
            wholly: Whether to compile also what only a doubtful pair needs: a live camera would not wait for that.
        """
        return warm_up_wholly(self.aligner) if wholly else self.aligner.warm_up()

    @in_32_bits
    def register(self, frame: Frame | FrameError | None, timestamp: float) -> Step | None:
        """Track one more frame.

        A frame that is not fit to be tracked (`frame_checks`) is flagged and never becomes a reference.

        Args:
            frame: The next frame; the error or None for one that could not be read: it is lost, and the run goes on.
            timestamp: Its colour timestamp, seconds; it overrides the frame's own. If it is not later than the last
                one, the frame is lost. After three such frames in a row the clock counts as set back to the third.

        Returns:
            The step, or None for the first frame, which is the world's origin.

        Raises:
            FrameError: There is no first frame to start from.
            GavoError: The input is no frame, or its images are not grey and depth of the camera's size. Or a
                timestamp is no number, or the first one is not in seconds.
        """
        timestamp = as_seconds("timestamp", timestamp)
        frame = self._accepted(frame, timestamp)
        stopwatch = Stopwatch()
        sight, here = Sight(self.progress.history, self.progress.overlays), self.progress.world_T_camera
        sight, self.frame, finding = sight.after(frame, timestamp, self.camera, here)
        before = self.progress._replace(last_index=self.progress.last_index + 1, **sight._asdict())
        doubt_unit_of_time(before.last_index, before.history)
        usable = self.frame if finding.use is not Use.NOTHING else None
        if usable is not None and finding.use is Use.GREY:
            usable = without_depth(usable)
        if before.tracker is None:
            outcome = self._begin(before, usable, finding)
        elif usable is None:
            outcome = self._pass_over(before, finding, timestamp)
        else:
            outcome = self._align(before, usable, finding)
        after, result, lost, bodies = outcome.after, outcome.result, outcome.lost, outcome.bodies
        origin = "guessed" if lost or outcome.is_guess else "tracked"
        found = self._seek(after, usable if finding.use is Use.ALL else None, before.held)
        if found is not None:
            after = after._replace(
                world_T_reference=found.world_T_camera,
                world_T_camera=found.world_T_camera,
                segment=found.segment,
                adrift=after.adrift + 1 if found.segment else 0,  # another one may be adrift itself
                unknown=0,
                beginning=None,
            )
            new_T_old = found.world_T_camera @ inverse(outcome.after.world_T_camera)
            bodies = tuple(body.moved(new_T_old) for body in bodies)
            result, lost, origin = with_finding(found.alignment, finding.status), False, "relocalised"
        elif after.adrift:
            after = after._replace(adrift=after.adrift + 1)
        if usable is not None and after.tracker is not before.tracker:
            after = after._replace(depth=watch_from(after.depth, usable, self.camera))
        self.progress, self.candidates = after, outcome.candidates
        if before.last_index == 0:
            return None
        return Step(
            index=before.last_index,
            reference_timestamp=before.reference_timestamp if found is None else found.timestamp,
            timestamp=timestamp,
            alignment=result,
            world_T_camera=after.world_T_camera.copy(),
            milliseconds=stopwatch.seconds * 1e3,
            lost=lost,
            policy=self.settings.odometry.on_lost if lost else "",
            segment=after.segment,
            origin=origin,
            bodies=bodies,
            revises=outcome.revises,
        )

    def _accepted(self, frame: Frame | FrameError | None, timestamp: float) -> Frame | FrameError | None:
        """The input, checked: a frame without distortion and at its timestamp, or the reason why there is none."""
        is_first = self.progress.last_index < 0
        if not (frame is None or isinstance(frame, FrameError)):
            frame = rectified(frame, self.recorded)
            if is_first:  # later a dark image may be a covered lens
                require_grey_levels(frame.grey)
        if is_first:
            require_begin_in_seconds(timestamp)
        if isinstance(frame, Frame):
            return frame.at(timestamp)
        if is_first:
            raise frame or FrameError("the first frame could not be read")
        return frame

    def _pass_over(self, before: Progress, finding: Finding, timestamp: float) -> FrameOutcome:
        """Pass over an unusable frame."""
        late = seconds_late(timestamp, before.history) if before.held == 0 else 0.0
        after = self._lose(before, None, timestamp)._replace(reference_late=late or before.reference_late)
        return FrameOutcome(after, no_alignment(finding.status), lost=True, revises=int(late > 0))

    def _begin(self, before: Progress, frame: Frame | None, finding: Finding) -> FrameOutcome:
        """Begin with a frame where there is no reference yet; it becomes the first one if it is fit for that."""
        if frame is None or finding.use is not Use.ALL:
            return FrameOutcome(before, no_alignment(finding.status), lost=True)
        return FrameOutcome(self._restart(before, frame), no_alignment(AlignmentStatus.NO_REFERENCE), lost=True)

    def _align(self, before: Progress, frame: Frame, finding: Finding) -> FrameOutcome:
        """Align a frame and judge the outcome."""
        clock = before.clock(frame)
        state = before.tracker_at(frame.timestamp)
        attempt, leap = align_leaping(self.aligner, state, frame, clock, before.leap)
        renewed = arrival_of(self.aligner, state, clock, attempt)
        attempt, kept = doubt_reference(before.arrival, clock, attempt)
        after, result, lost = self._advance(before, frame, finding, attempt)
        after = after._replace(leap=leap if after.held else None, arrival=kept if after.held else renewed)
        size = (self.camera.height, self.camera.width)
        since = before.world_T_reference if attempt.is_found else None
        trusted = () if lost else attempt.bodies  # a lost search takes for one what does not fit its wrong motion
        numbered = map(before.numbering.given_to, trusted)
        bodies = tuple(in_world(seen, after.world_T_camera, since, size) for seen in numbered)
        after = after._replace(numbering=before.numbering.after(bodies, lost and after.tracker is not before.tracker))
        revises = attempt.revises
        if not lost:
            shown, is_reference = sum(seen.share for seen in attempt.bodies), after.tracker is not before.tracker
            revises = max(revises, revised_by(before.beginning, shown))
            beginning = followed(before.beginning, frame.timestamp, shown, is_reference=is_reference)
            after = after._replace(beginning=beginning)
        if not lost and before.depth is not None:
            result, watch = judge_by_depth(before.depth, frame, bodies, float(clock.elapsed), result, self.camera)
            after = after._replace(depth=watch)
            if watch.found_wrong and not before.depth.found_wrong:
                result, revises = watch.blamed(result, revises, before.last_index)
        return FrameOutcome(after, result, lost, attempt.candidates, bodies, revises, attempt.unknown > 0)

    def _seek(self, after: Progress, frame: Frame | None, held: int) -> Found | None:
        """Look for a frame in the map if it has become the reference of a segment that is adrift.

        After the first frames that is one in every `SOUGHT_EVERY`, or the next reference; the last one is `held` back.
        """
        if self.relocaliser is None or frame is None or not after.adrift or after.held:
            return None
        is_due = after.adrift // SOUGHT_EVERY > (after.adrift - held - 1) // SOUGHT_EVERY
        if after.adrift > SOUGHT_AT_ONCE and not is_due:
            return None
        return self.relocaliser.find(frame, after.segment)

    def _restart(self, before: Progress, frame: Frame) -> Progress:
        """Make a frame the only reference, at the recorded pose; unless it is the first, this starts a new segment."""
        here = before if before.last_index == 0 else before.in_new_segment()
        if before.tracker is None:  # there is nothing to tie it to
            here = here._replace(adrift=0)
        return here._replace(
            tracker=self.aligner.start(frame),
            reference_timestamp=frame.timestamp,
            reference_late=0.0,
            world_T_reference=before.world_T_camera,
            held=0,
            way=Way(),
            doubted=False,
            unknown=0,
            beginning=begun(before.beginning, frame.timestamp),
        )

    def _advance(
        self, before: Progress, frame: Frame, finding: Finding, attempt: Attempt
    ) -> tuple[Progress, Alignment, bool]:
        """Apply an attempt: if its motion is usable and the frame is fit, the frame becomes the new reference.

        Returns:
            Where the driver stands after it, the result, and whether the pair is lost.
        """
        result = attempt.result
        doubted = AlignmentStatus.DEPTH_MISMATCH in result.statuses
        if not attempt.usable:
            # in another scene both image and depth differ: depth is in doubt only if it was before, or differs alone
            doubted &= before.doubted or result.status is AlignmentStatus.DEPTH_MISMATCH
            fit = frame if finding.use is Use.ALL and not (doubted and before.held + 1 < MAX_DOUBTED) else None
            after = self._lose(before._replace(doubted=doubted), fit, frame.timestamp)
            return after, with_finding(result, finding.status), True
        result = with_finding(result, finding.status)
        world_T_camera = before.world_T_reference @ inverse(np.asarray(result.target_T_reference))
        after = before._replace(world_T_camera=world_T_camera, held=before.held + 1, doubted=doubted)
        if before.unknown and not attempt.unknown:
            after = after._replace(unknown=0)
            if before.unknown >= MAX_HELD:  # too many guesses to go on in the same world
                after = after.in_new_segment()
        may_be = not POOR.isdisjoint(result.statuses) and DEPTHLESS.isdisjoint(result.statuses)
        overdue = after.held >= MAX_HELD and may_be and (attempt.fit or not doubted)
        if overdue or (attempt.fit and finding.use is Use.ALL):
            after = after._replace(
                tracker=attempt.state,
                reference_timestamp=frame.timestamp,
                reference_late=0.0,
                world_T_reference=world_T_camera,
                held=0,
                way=Way(),
                unknown=before.unknown + attempt.unknown if attempt.unknown else 0,
            )
        elif not attempt.unknown and UNFIT_FOR_WAY.isdisjoint(result.statuses):
            since = before.since_reference(frame.timestamp)
            after = after._replace(way=before.way.after(since, np.asarray(result.xi, np.float64)))
        return after, result, False

    def _lose(self, before: Progress, frame: Frame | None, timestamp: float) -> Progress:
        """Record a lost pair by the policy, and give up the old reference once it is out of reach.

        Args:
            before: Where the driver stood.
            frame: The new frame if it is fit to be a reference.
            timestamp: Timestamp of the new frame.
        """
        after = before._replace(held=before.held + 1)
        if self.settings.odometry.on_lost == "predict" and (since := before.since_reference(timestamp)) > 0:
            motion = self.aligner.predict(before.tracker_at(timestamp), since)
            after = after._replace(world_T_camera=before.world_T_reference @ inverse(motion))
        return after if frame is None or after.held < MAX_HELD else self._restart(after, frame)
