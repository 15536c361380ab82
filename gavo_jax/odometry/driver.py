"""The thin driver: frames in, chained poses out.

It checks each frame, has an aligner find its motion, decides what becomes of it, and chains the poses.
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
from gavo_jax.bodies.records import Body, covered, in_world
from gavo_jax.camera import Camera, require_camera
from gavo_jax.compilation.precision import in_32_bits
from gavo_jax.compilation.waits import Stopwatch
from gavo_jax.datasets.base import (
    Frame,
    FrameError,
    as_seconds,
    require_begin_in_seconds,
    require_grey_levels,
)
from gavo_jax.datasets.rectified import rectified
from gavo_jax.errors import GavoWarning
from gavo_jax.frame_checks import Finding, Use, check_frame, doubts_last_stamp
from gavo_jax.odometry.aligners import Aligner, Attempt
from gavo_jax.odometry.beginnings import begun, followed, revised_by
from gavo_jax.odometry.composition import make_aligner, warm_up_wholly
from gavo_jax.odometry.depth_watch import judge_by_depth, watch_from
from gavo_jax.odometry.leaps import align_leaping
from gavo_jax.odometry.misplaced import arrival_of, doubt_reference
from gavo_jax.odometry.progress import Progress
from gavo_jax.odometry.second_thoughts import without_depth
from gavo_jax.odometry.way import Way
from gavo_jax.settings import Settings, as_settings
from gavo_jax.settings_check import as_seed
from gavo_jax.solvers.base import Solver
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import inverse


@dataclass(frozen=True)
class Step:
    """What the driver says of one new frame."""

    index: int
    """Index of the frame in the sequence; the first frame, 0, makes no step."""
    reference_timestamp: float
    """Colour stamp of the frame that this one was aligned with, seconds."""
    timestamp: float
    alignment: Alignment
    """On the host; of a lost pair its `target_T_reference` is what was found, not what was recorded. Its status may be
    a warning about the frame (a gap before it, depth in part missing) that had a usable motion all the same."""
    world_T_camera: Float64[np.ndarray, "4 4"]
    """Recorded; the world is the first camera."""
    milliseconds: float
    """From the decoded images to the result on the host."""
    lost: bool
    """Whether there is no usable motion."""
    policy: Literal["", "hold", "predict", "stop"] = ""
    """What was recorded for a lost pair; see `OdometryOptions.on_lost`."""
    segment: int = 0
    """Stretch of the trajectory that the frame belongs to; between two stretches the motion is unknown."""
    origin: Literal["tracked", "relocalised", "guessed"] = "tracked"
    """Where the pose comes from: the reference, a keyframe of the map (then that is the pair's reference), or nothing
    (a lost pair, or a motion that is taken to have gone on behind a body)."""
    bodies: tuple[Body, ...] = ()
    """What moves on its own, where the settings ask for that; see docs/bodies.md."""
    revises: int = 0
    """So many of the pairs before are wrong, as is seen now: they followed a body, or led to an image that is
    not of its stamp's moment; see `odometry.hindsight`."""

    @property
    def depth_is_trusted(self) -> bool:
        """Whether nothing speaks against the frame's own depth: maps are made of such frames."""
        return DOUBTED_DEPTH.isdisjoint(self.alignment.statuses)

    @property
    def moving(self) -> Bool[np.ndarray, "height width"] | None:
        """Pixels of the image, without distortion, that move on their own; None where nothing is known to."""
        return covered(self.bodies)


class Found(NamedTuple):
    """Where a frame was found in a map."""

    alignment: Alignment
    """With a keyframe as the reference."""
    timestamp: float
    """Colour stamp of the keyframe, seconds."""
    world_T_camera: Float64[np.ndarray, "4 4"]
    """Pose of the frame, in the world of the odometry's segment that the keyframe belongs to."""
    segment: int


class Relocaliser(Protocol):
    """Finds frames in a map of the run so far."""

    def find(self, frame: Frame, segment: int) -> Found | None:
        """Return where a frame was taken, seen from another segment than its own; None where the map does not say."""
        ...


MAX_HELD = 3
"""Frames without a new reference after which the newest usable one becomes it: the old one is out of reach."""
MAX_DOUBTED = 15
"""The same where depth alone keeps frames from becoming it; then it may be the reference's depth that is wrong."""
POOR = frozenset({AlignmentStatus.PARTIAL_DEPTH, AlignmentStatus.HIGH_ERROR})
"""Statuses of frames that have a motion, but become the reference only where the old one is out of reach."""
DEPTHLESS = frozenset({AlignmentStatus.NO_DEPTH, AlignmentStatus.FROZEN})
"""Statuses of frames that have a motion, but never become the reference."""
DOUBTED_DEPTH = DEPTHLESS | {AlignmentStatus.DEPTH_MISMATCH}
"""Statuses of frames that have a motion, but no depth of their own that could be trusted."""
SOUGHT_AT_ONCE, SOUGHT_EVERY = 10, 10
"""Frames of a segment that is adrift of which each is looked for in the map; after them, every so many."""

Moving = Callable[[Step], Bool[np.ndarray, "height width"] | None]
"""Says which pixels move in a step's frame: `Step.moving`, or the masks of the run's folder."""


def seen_moving(step: Step) -> Bool[np.ndarray, "height width"] | None:
    """`Step.moving`."""
    return step.moving


class FrameOutcome(NamedTuple):
    """What became of a frame, before a map is asked."""

    after: Progress
    result: Alignment
    lost: bool
    candidates: tuple[Population, ...] = ()
    bodies: tuple[Body, ...] = ()
    revises: int = 0
    """See `Step`."""


class Odometry:
    """Frame-by-frame tracking: it holds an aligner, and between two frames all it knows is its `progress`.

    Args:
        camera: Camera of the frames; where it has lens distortion, that is taken out of every frame.
        settings: What searches, what is minimised, how it is used; the `default` preset's if left out.
        seed: Every random number follows from it and the frames' indices.
        record: Whether every frame's candidates are kept until the next frame, for people to look at.
        solver: Takes the place of the settings' solver.
        aligner: Takes the place of the search that the settings describe.
        relocaliser: Is asked where a frame is that nothing ties to the frames before.

    Attributes:
        camera: Without distortion: that of the frames as they are aligned.
        progress: Where it stands; a driver of the same settings that is given it goes on from there.
        candidates: Of the last frame's search, an entry per level, coarsest first; empty unless they are recorded.
        frame: The last frame as it was tracked: without what is drawn into the images. None where it could not be read.

    Raises:
        GavoError: The camera's images are too small, or the seed is none.
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
        """Compile the program for a frame (or load it from the cache); returns the seconds this took.

        Args:
            wholly: Also what only a doubtful pair needs: a camera would not wait while that is compiled.
        """
        return warm_up_wholly(self.aligner) if wholly else self.aligner.warm_up()

    @in_32_bits
    def register(self, frame: Frame | FrameError | None, timestamp: float) -> Step | None:
        """Track one more frame.

        A frame that is not fit for it (`frame_checks`) is flagged and never becomes a reference.

        Args:
            frame: The next frame; for one that could not be read the error, or None: it is lost, and the run goes on.
            timestamp: Its colour stamp, seconds; later than the last one's, or the frame is lost. The frame's own
                stamp gives way to it.

        Returns:
            The step, or None for the first frame, which is the world's origin.

        Raises:
            FrameError: There is no first frame to start from.
            GavoError: What is given is no frame, its images are not of the camera's size or no grey and depth, or a
                stamp is no number, or the first one is not in seconds.
        """
        timestamp = as_seconds("timestamp", timestamp)
        frame = self._accepted(frame, timestamp)
        stopwatch = Stopwatch()
        drawn, self.frame = self.progress.drawn, None
        if isinstance(frame, Frame):
            drawn = drawn.after(frame.grey)
            self.frame = frame = drawn.without(frame)
        finding, history = check_frame(frame, timestamp, self.camera, self.progress.history)
        before = self.progress._replace(last_index=self.progress.last_index + 1, history=history, drawn=drawn)
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
        origin = "guessed" if lost or after.unknown else "tracked"
        found = self._seek(after, usable if finding.use is Use.ALL else None)
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
            # what a lost search took for a body did not fit a motion that was wrong
            bodies = () if lost else tuple(body.moved(new_T_old) for body in bodies)
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
        """What is given, if it may be: a frame without distortion and at its stamp, or why there is none."""
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
        """Pass over a frame of which nothing can be used."""
        revises = int(before.held == 0 and doubts_last_stamp(timestamp, before.history))
        after = self._lose(before, None, timestamp)
        return FrameOutcome(after, no_alignment(finding.status), lost=True, revises=revises)

    def _begin(self, before: Progress, frame: Frame | None, finding: Finding) -> FrameOutcome:
        """Begin with a frame before which nothing could be a reference: it is the first one if it is fit for that."""
        if frame is None or finding.use is not Use.ALL:
            return FrameOutcome(before, no_alignment(finding.status), lost=True)
        return FrameOutcome(self._restart(before, frame), no_alignment(AlignmentStatus.NO_REFERENCE), lost=True)

    def _align(self, before: Progress, frame: Frame, finding: Finding) -> FrameOutcome:
        """Align a frame and judge what comes of it."""
        clock = before.clock(frame)
        state = before.tracker_at(frame.timestamp)
        attempt, leap = align_leaping(self.aligner, state, frame, clock, before.leap)
        renewed = arrival_of(self.aligner, state, clock, attempt)
        attempt, kept = doubt_reference(before.arrival, clock, attempt)
        after, result, lost = self._advance(before, frame, finding, attempt)
        after = after._replace(leap=leap if after.held else None, arrival=kept if after.held else renewed)
        size = (self.camera.height, self.camera.width)
        since = None if lost else before.world_T_reference
        bodies = tuple(in_world(seen, after.world_T_camera, since, size) for seen in attempt.bodies)
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
                revises = max(revises, watch.pairs_covered(before.last_index))
        return FrameOutcome(after, result, lost, attempt.candidates, bodies, revises)

    def _seek(self, after: Progress, frame: Frame | None) -> Found | None:
        """Look for a frame in the map, where it is the reference of a segment that is adrift."""
        if self.relocaliser is None or frame is None or not after.adrift or after.held:
            return None
        if after.adrift > SOUGHT_AT_ONCE and after.adrift % SOUGHT_EVERY:
            return None
        return self.relocaliser.find(frame, after.segment)

    def _restart(self, before: Progress, frame: Frame) -> Progress:
        """Make a frame the only reference, standing where the camera is recorded to be; after others it starts a new
        segment.
        """
        here = before if before.last_index == 0 else before.in_new_segment()
        return here._replace(
            tracker=self.aligner.start(frame),
            reference_timestamp=frame.timestamp,
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
        """What becomes of an attempt: where its motion is usable and the frame fit for it, that is the new reference.

        Returns:
            Where the driver stands now, the result, and whether the pair is lost.
        """
        result = attempt.result
        doubted = AlignmentStatus.DEPTH_MISMATCH in result.statuses
        if not attempt.usable:
            # of another scene, image and depth are unlike: only depth that was wrong before, or alone is, is in doubt
            doubted &= before.doubted or result.status is AlignmentStatus.DEPTH_MISMATCH
            fit = frame if finding.use is Use.ALL and not (doubted and before.held + 1 < MAX_DOUBTED) else None
            after = self._lose(before._replace(doubted=doubted), fit, frame.timestamp)
            return after, with_finding(result, finding.status), True
        result = with_finding(result, finding.status)
        world_T_camera = before.world_T_reference @ inverse(np.asarray(result.target_T_reference))
        after = before._replace(world_T_camera=world_T_camera, held=before.held + 1, doubted=doubted)
        if attempt.unknown:
            after = after._replace(unknown=before.unknown + attempt.unknown)
        elif before.unknown:
            after = after._replace(unknown=0)
            if before.unknown >= MAX_HELD:  # too many to go on in the same world
                after = after.in_new_segment()
        may_be = not POOR.isdisjoint(result.statuses) and DEPTHLESS.isdisjoint(result.statuses)
        overdue = after.held >= MAX_HELD and may_be and (attempt.fit or not doubted)
        if overdue or (attempt.fit and finding.use is Use.ALL):
            after = after._replace(
                tracker=attempt.state,
                reference_timestamp=frame.timestamp,
                world_T_reference=world_T_camera,
                held=0,
                way=Way(),
            )
        elif not attempt.unknown and AlignmentStatus.HIGH_ERROR not in result.statuses:  # whose place is a rough one
            since = frame.timestamp - before.reference_timestamp
            after = after._replace(way=before.way.after(since, np.asarray(result.xi, np.float64)))
        return after, result, False

    def _lose(self, before: Progress, frame: Frame | None, timestamp: float) -> Progress:
        """Record a lost pair by the policy, and give the old reference up once it is out of reach.

        Args:
            before: Where the driver stood.
            frame: The new frame if it is fit to be a reference.
            timestamp: Its stamp.
        """
        after = before._replace(held=before.held + 1)
        if self.settings.odometry.on_lost == "predict" and timestamp > before.reference_timestamp:
            motion = self.aligner.predict(before.tracker_at(timestamp), timestamp - before.reference_timestamp)
            after = after._replace(world_T_camera=before.world_T_reference @ inverse(motion))
        return after if frame is None or after.held < MAX_HELD else self._restart(after, frame)
