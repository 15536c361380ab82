"""The thin driver: frames in, a trajectory out.

For every new frame one compiled program builds its pyramid, aligns it with the last frame and the keyframe at once,
and makes it the next reference; the images stay on the device, and a thread decodes the next frame meanwhile.
"""

import gc
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, PRNGKeyArray

from gavo_jax.alignment import (
    Alignment,
    AlignmentOptions,
    AlignmentStatus,
    Exchanged,
    Population,
    align_views,
    on_host,
    prepare_reference,
    prepare_target,
)
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame, FrameError, Sequence
from gavo_jax.errors import GavoError
from gavo_jax.evaluation import absolute_trajectory_error, distance_error, relative_pose_error
from gavo_jax.frame_checks import Finding, History, Use, check_frame
from gavo_jax.objective import Reference, most_points, move_reference, settle_reference
from gavo_jax.presets import OdometryOptions, Preset, get_preset
from gavo_jax.program_cache import CachedProgram
from gavo_jax.pyramid import LEVELS, Pyramid, PyramidLevel, atlas_layout, build_pyramid, halve_inverse_depth
from gavo_jax.se3 import exp, rigid
from gavo_jax.trajectory import Trajectory, inverse
from gavo_jax.warp import Points, Target, level_sizes, synchronise_depth, warp


class TrackerState(NamedTuple):
    """What stays on the device from frame to frame."""

    previous: Reference
    keyframe: Reference
    """Points of earlier frames in the previous frame's camera; see `renew_keyframe`."""
    previous_image: Target
    """The previous frame, packed for sampling: what the symmetric error needs of it."""
    motion: Float[Array, " 6"]
    """Twist of the last motion, from the frame before the previous one to the previous one."""
    seconds: Float[Array, ""]
    """Time that motion took."""


class Clock(NamedTuple):
    """When a new frame was taken, as numbers of the program."""

    elapsed: Any
    """Since the reference's colour image, seconds."""
    depth_delay: Any
    """From the new colour image to the new depth image, seconds."""
    frame: Any
    """Index in the sequence; with the run's key it makes the frame's random numbers."""


@partial(jax.jit, static_argnames="finest")
def _synchronised(pyramid: Pyramid, camera: Camera, twist: Float[Array, " 6"], finest: int) -> Pyramid:
    """The pyramid with depth moved along a twist (colour moment to depth moment), from level `finest` upwards."""
    levels = list(pyramid)
    moved = synchronise_depth(pyramid[finest].inverse_depth, camera.level(finest), exp(twist))
    for level in range(finest, len(levels)):
        levels[level] = PyramidLevel(levels[level].grey, moved)
        if level + 1 < len(levels):
            moved = halve_inverse_depth(moved)
    return tuple(levels)


KEYFRAME_SHARES = 16
"""Shares of a keyframe's points that are renewed independently,"""
KEYFRAME_SPREAD = 0.2
"""each at its own overlap, evenly spread over a range of this width."""


def renew_keyframe(keyframe: Reference, newest: Reference, camera: Camera, overlap: Any) -> Reference:
    """A keyframe with the points that are going out of view replaced by the newest frame's.

    A keyframe that is given up whole makes all that follows hang on which frame happens to be the first below a
    threshold. Here the points are dealt into shares, each with its own threshold, so that the shares are soon of
    different frames.

    Args:
        keyframe: Points of earlier frames in the newest frame's camera, [L, N].
        newest: The newest frame's points, alike.
        camera: Of the last, finest level.
        overlap: Part of a share that is in view when it is given up, on average over the shares.
    """
    places = np.arange(keyframe.grey.shape[-1])
    share = np.floor(KEYFRAME_SHARES * (places * (np.sqrt(1.25) - 0.5) % 1.0)).astype(int)  # each all over the image
    dealt = jax.nn.one_hot(share, KEYFRAME_SHARES)
    finest = jax.tree.map(lambda leaf: leaf[-1], keyframe.points)
    inside = warp(finest, jnp.eye(4), camera).inside
    in_view = (inside @ dealt) / jnp.maximum((finest.q > 0).astype(jnp.float32) @ dealt, 1.0)
    thresholds = overlap + KEYFRAME_SPREAD * np.linspace(-0.5, 0.5, KEYFRAME_SHARES)
    renewed = (in_view < thresholds)[share]
    return jax.tree.map(lambda new, old: jnp.where(renewed, new, old), newest, keyframe)


@partial(CachedProgram, static=("record",), returns=(TrackerState, Reference, Points, Target, Alignment, Population))
def _track(
    state: TrackerState,
    grey: Array,
    depth: Array,
    clock: Clock,
    key: PRNGKeyArray,
    camera: Camera,
    solver: Any,
    alignment: AlignmentOptions,
    options: OdometryOptions,
    *,
    record: bool,
) -> tuple[TrackerState, Alignment, Population | None]:
    """One frame: pyramid, alignment with the references, and the state for the next frame; `key` is the run's.

    Before the first frame the state holds no reading: that frame becomes both references, and nothing is known of the
    motion, so that its points are still where their rows' moments left them. The same program serves, as another one
    would have to be compiled too.
    """
    is_first = ~jnp.any(state.previous.points.q > 0)
    raw = build_pyramid(grey, depth, camera.depth_scale, LEVELS)
    predicted = state.motion * (clock.elapsed / state.seconds)
    finest = min(solver.levels)
    delay = clock.depth_delay / clock.elapsed
    target = _synchronised(raw, camera, delay * predicted, finest) if options.synchronise else raw
    readout = camera.readout / clock.elapsed if options.rolling_shutter else None
    views = (state.previous,)
    if options.reference == "keyframe":
        views += (state.keyframe,)
    guesses = jnp.eye(4)[None]
    if options.prior:
        guesses = jnp.concatenate([exp(predicted)[None], guesses])
    packed = prepare_target(target, solver.levels)
    exchanged = None
    if alignment.symmetric:
        exchanged = Exchanged(prepare_reference(target, camera, solver.levels, alignment), state.previous_image)
    key = jax.random.fold_in(key, clock.frame)
    result, populations = align_views(
        views, packed, camera, solver, alignment, key, guesses, record, exchanged, readout
    )
    motion = jnp.where(is_first, 0.0, result.xi)
    if options.synchronise:
        target = _synchronised(raw, camera, delay * motion, finest)
    newest, keyframe = prepare_reference(target, camera, solver.levels, alignment), state.keyframe
    if readout is not None:
        unsettled = newest.row_time
        newest, keyframe = (settle_reference(frame, motion * readout) for frame in (newest, keyframe))
        newest = newest._replace(row_time=jnp.where(is_first, unsettled, newest.row_time))
    keyframe = move_reference(keyframe, jnp.where(is_first, jnp.eye(4), result.target_T_reference))
    keyframe = renew_keyframe(keyframe, newest, camera.level(finest), options.keyframe_overlap)
    return TrackerState(newest, keyframe, packed, motion, clock.elapsed), result, populations


@jax.jit
def first_state(grey: Array, depth: Array, camera: Camera, solver: Any, alignment: AlignmentOptions) -> TrackerState:
    """State after the first frame, by a program of its own."""
    pyramid = build_pyramid(grey, depth, camera.depth_scale, LEVELS)
    reference = prepare_reference(pyramid, camera, solver.levels, alignment)
    packed = prepare_target(pyramid, solver.levels)
    return TrackerState(reference, reference, packed, jnp.zeros(6), jnp.float32(1.0))


@dataclass(frozen=True)
class Step:
    """What the driver says of one new frame."""

    index: int
    """Of the frame in the sequence; the first frame, 0, makes no step."""
    reference_timestamp: float
    """Colour stamp of the reference, the last frame that was not lost, seconds."""
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


def no_alignment(status: AlignmentStatus) -> Alignment:
    """The result of a pair that could not be aligned at all: no motion, nothing known."""
    nothing: dict[str, Any] = {
        "target_T_reference": np.eye(4),
        "xi": np.zeros(6, np.float32),
        "error": np.float32(np.nan),
        "overlap": np.float32(0.0),
        "covariance": np.full((6, 6), np.nan, np.float32),
        "history": np.zeros(0, np.float32),
    }
    return Alignment(**nothing, status=status)


MAX_HELD = 3
"""Frames without a new reference after which the newest usable one becomes it: the old one is out of reach."""


class Progress(NamedTuple):
    """Where a driver stands between two frames: all that decides what it makes of the next ones."""

    tracker: TrackerState | None = None
    """On the device; None while no usable frame was seen."""
    last_index: int = -1
    """Of the last frame."""
    reference_timestamp: float = 0.0
    world_T_reference: Float64[np.ndarray, "4 4"] = np.eye(4)
    world_T_camera: Float64[np.ndarray, "4 4"] = np.eye(4)
    """As recorded last."""
    held: int = 0
    """Frames since the reference was renewed."""
    history: History = History()


class Odometry:
    """Frame-by-frame tracking with the state kept on the device.

    Args:
        camera: Camera of the frames, without distortion.
        solver: Any solver with an entry a level; the `default` preset's genetic algorithm if left out.
        alignment: What is minimised.
        options: How the driver uses it.
        seed: Every random number follows from it.
        record: Whether every frame's candidates are kept until the next frame, for people to look at.

    Attributes:
        progress: Where it stands; a driver of the same settings that is given it goes on from there.
        key: Every random number follows from it and the frames' indices.
    """

    def __init__(
        self,
        camera: Camera,
        solver: Any = None,
        alignment: AlignmentOptions | None = None,
        options: OdometryOptions | None = None,
        seed: int = 0,
        record: bool = False,
    ):
        preset = get_preset()
        self.camera = camera
        self.solver = preset.solver if solver is None else solver
        self.alignment = preset.alignment if alignment is None else alignment
        self.options = preset.odometry if options is None else options
        self.record = record
        self.populations: tuple[Population, ...] = ()
        """Candidates of the last frame's search, an entry a level, coarsest first; empty unless they are recorded."""
        self.progress = Progress()
        self.key = jax.random.key(seed)

    def warm_up(self) -> float:
        """Compile the program for a frame (or load it from the cache); returns the seconds this took."""
        start, collects = time.perf_counter(), gc.isenabled()
        gc.disable()  # tracing makes objects by the hundred thousand that all stay; looking through them takes a fifth
        try:
            self._start(self._blank())
        finally:
            if collects:
                gc.enable()
        return time.perf_counter() - start

    def blank_state(self) -> TrackerState:
        """The state before the first frame: nothing, in the shapes and types of every state of this driver."""
        levels = self.solver.levels
        row: Any = np.zeros((len(levels), most_points(self.camera, levels, self.alignment.points)), np.float32)
        layout = atlas_layout(level_sizes(self.camera, levels))
        words: Any = np.zeros((layout.height, layout.width), np.uint32)
        reference = Reference(Points(row, row, row), row, row, row, row, row, row, row)
        still: Any = np.zeros(6, np.float32), np.float32(1.0)
        return TrackerState(reference, reference, Target(words, words), *still)

    def register(self, frame: Frame | FrameError | None, timestamp: float) -> Step | None:
        """Track one more frame.

        A frame that is not fit for it (`frame_checks`) is flagged and never becomes a reference.

        Args:
            frame: The next frame; for one that could not be read the error, or None: it is lost, and the run goes on.
            timestamp: Its colour stamp, seconds; later than the last one's, or the frame is lost.

        Returns:
            The step, or None for the first frame, which is the world's origin.

        Raises:
            FrameError: There is no first frame to start from.
        """
        self.populations = ()
        if self.progress.last_index < 0 and not isinstance(frame, Frame):
            raise frame or FrameError("the first frame could not be read")
        start = time.perf_counter()
        finding, history = check_frame(frame, timestamp, self.camera, self.progress.history)
        before = self.progress._replace(last_index=self.progress.last_index + 1, history=history)
        usable = frame if isinstance(frame, Frame) and finding.use is not Use.NOTHING else None
        if before.tracker is None:
            fit = usable if finding.use is Use.ALL else None
            after = before if fit is None else self._restart(before, fit)
            result, lost = no_alignment(AlignmentStatus.NO_REFERENCE if fit else finding.status), True
        elif usable is None:
            after, result, lost = self._lose(before, None, timestamp), no_alignment(finding.status), True
        else:
            after, result, lost = self._advance(before, usable, finding)
        self.progress = after
        if before.last_index == 0:
            return None
        milliseconds = (time.perf_counter() - start) * 1e3
        return Step(
            before.last_index,
            before.reference_timestamp,
            timestamp,
            result,
            after.world_T_camera.copy(),
            milliseconds,
            lost,
            self.options.on_lost if lost else "",
        )

    def _blank(self) -> Frame:
        size = (self.camera.height, self.camera.width)
        return Frame(np.zeros(size, np.uint8), np.zeros(size, np.uint16), timestamp=0.0)

    def _start(self, frame: Frame) -> TrackerState:
        """The state after a first frame; its search, which has nothing to find, leaves no candidates."""
        populations = self.populations
        state, _ = self._run(self.blank_state(), frame, Clock(np.float32(1.0), np.float32(0.0), np.uint32(0)))
        self.populations = populations
        return state

    def _restart(self, before: Progress, frame: Frame) -> Progress:
        """Make a frame the only reference, standing where the camera is recorded to be."""
        return before._replace(
            tracker=self._start(frame),
            reference_timestamp=frame.timestamp,
            world_T_reference=before.world_T_camera,
            held=0,
        )

    def _advance(self, before: Progress, frame: Frame, finding: Finding) -> tuple[Progress, Alignment, bool]:
        """Align a usable frame; where that succeeds and it is fit for it, it becomes the reference.

        Returns:
            Where the driver stands now, the result, and whether the pair is lost.
        """
        state, result, usable = self._align(before, frame)
        if not usable:
            fit = frame if finding.use is Use.ALL else None
            return self._lose(before, fit, frame.timestamp), result, True
        if result.status == AlignmentStatus.OK:
            result = result._replace(status=finding.status)
        world_T_camera = before.world_T_reference @ inverse(np.asarray(result.target_T_reference))
        after = before._replace(world_T_camera=world_T_camera, held=before.held + 1)
        overdue = finding.status is AlignmentStatus.PARTIAL_DEPTH and after.held >= MAX_HELD
        if finding.use is Use.ALL or overdue:
            after = after._replace(
                tracker=state, reference_timestamp=frame.timestamp, world_T_reference=world_T_camera, held=0
            )
        return after, result, False

    def _lose(self, before: Progress, frame: Frame | None, timestamp: float) -> Progress:
        """Record a lost pair by the policy, and give the old reference up once it is out of reach.

        Args:
            before: Where the driver stood.
            frame: The new frame if it is fit to be a reference.
            timestamp: Its stamp.
        """
        after = before._replace(held=before.held + 1)
        if self.options.on_lost == "predict" and timestamp > before.reference_timestamp:
            assert before.tracker is not None
            elapsed = (timestamp - before.reference_timestamp) / float(before.tracker.seconds)
            motion = rigid(exp(before.tracker.motion * elapsed))
            after = after._replace(world_T_camera=before.world_T_reference @ inverse(motion))
        return after if frame is None or after.held < MAX_HELD else self._restart(after, frame)

    def clock(self, before: Progress, frame: Frame) -> Clock:
        """When a frame was taken, for a driver that counts it as its last one already."""
        assert before.tracker is not None
        elapsed = frame.timestamp - before.reference_timestamp
        if elapsed <= 0:
            elapsed = float(before.tracker.seconds)
        delay = 0.0 if frame.depth_timestamp is None else frame.depth_timestamp - frame.timestamp
        return Clock(np.float32(max(elapsed, 1e-3)), np.float32(delay), np.uint32(before.last_index))

    def _align(self, before: Progress, frame: Frame) -> tuple[TrackerState, Alignment, bool]:
        """Align with the references; a result that is not ok is tried again by the wide search.

        Returns:
            The state afterwards, the result, and whether its motion can be used: it is ok, or its high error is all
            that speaks against it and the wide search ends at the same motion (blur, or something that moves).
        """
        assert before.tracker is not None
        clock = self.clock(before, frame)
        state_after, result = self._run(before.tracker, frame, clock)
        usable = result.status == AlignmentStatus.OK
        if usable or not self.options.recover:
            return state_after, result, usable
        populations = self.populations
        wide = self._wide()
        state_wide, second = self._run(
            before.tracker, frame, clock, wide.solver, wide.alignment, replace(self.options, reference="previous")
        )
        if second.status == AlignmentStatus.OK:
            return state_wide, second, True
        self.populations = populations
        confirmed = result.status == second.status == AlignmentStatus.HIGH_ERROR and _agree(result, second)
        return state_after, result, confirmed

    def _wide(self) -> Preset:
        """The wide search on the points that the references hold."""
        wide = get_preset("ga", "wide")
        iterations = tuple(n if k in self.solver.levels else 0 for k, n in enumerate(wide.solver.iterations))
        return replace(
            wide,
            solver=replace(wide.solver, iterations=iterations),
            alignment=replace(wide.alignment, points=self.alignment.points),
        )

    def _run(
        self,
        state: TrackerState,
        frame: Frame,
        clock: Clock,
        solver: Any = None,
        alignment: AlignmentOptions | None = None,
        options: OdometryOptions | None = None,
    ) -> tuple[TrackerState, Alignment]:
        solver, alignment = solver or self.solver, alignment or self.alignment
        options = options or self.options
        images, settings = (frame.grey, frame.depth), (self.camera, solver, alignment, _traced(options))
        state, result, populations = _track(state, *images, clock, self.key, *settings, record=self.record)
        result = on_host(result)
        if populations is not None:
            host = jax.device_get(populations)
            visits = range(len(host.level))
            self.populations = tuple(jax.tree.map(lambda leaf, k=k: leaf[k], host) for k in visits)
        return state, result


def _traced(options: OdometryOptions) -> OdometryOptions:
    """The options that shape the program; the others are reset, so that they cause no second compilation."""
    return replace(options, recover=True, on_lost="hold")


AGREEMENT = (0.02, 0.02)
"""Metres and radians within which two searches ended at the same motion."""


def _agree(first: Alignment, second: Alignment) -> bool:
    between = inverse(np.asarray(first.target_T_reference)) @ second.target_T_reference
    angle = np.arccos(np.clip((np.trace(between[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
    return bool(np.linalg.norm(between[:3, 3]) < AGREEMENT[0] and angle < AGREEMENT[1])


def _unwatched(frame: Frame | None, step: Step | None) -> None:
    """Nobody looks."""


def track(
    sequence: Sequence,
    solver: Any = None,
    alignment: AlignmentOptions | None = None,
    options: OdometryOptions | None = None,
    seed: int = 0,
    odometry: Odometry | None = None,
    watch: Callable[[Frame | None, Step | None], None] = _unwatched,
) -> Iterator[Step]:
    """Stream a sequence: a step for every frame after the first, as it is done.

    The next frame is decoded in a thread while one is aligned; memory does not grow with the sequence. A frame that
    cannot be read makes a lost step. With `on_lost="stop"` the stream ends after the first lost one. An odometry that
    has seen frames already goes on with the next one. `watch` is shown every frame (None: it could not be read) with
    its step (None: it is the first).

    Raises:
        FrameError: The first frame cannot be read.
    """
    if odometry is None:
        odometry = Odometry(sequence.camera, solver, alignment, options, seed)

    first = odometry.progress.last_index + 1
    for index, frame in enumerate(decoded(sequence, first), start=first):
        step = odometry.register(frame, float(sequence.timestamps[index]))
        watch(frame if isinstance(frame, Frame) else None, step)
        if step is not None:
            yield step
            if step.lost and odometry.options.on_lost == "stop":
                return


def decoded(sequence: Sequence, first: int = 0) -> Iterator[Frame | FrameError]:
    """Frame after frame, or why it cannot be read; the next one is decoded in a thread meanwhile."""

    def read(index: int) -> Frame | FrameError:
        try:
            return sequence[index]
        except FrameError as error:
            return error

    if first >= len(sequence):
        return
    with ThreadPoolExecutor(max_workers=1) as decoder:
        coming = decoder.submit(read, first)
        for index in range(first, len(sequence)):
            frame = coming.result()
            if index + 1 < len(sequence):
                coming = decoder.submit(read, index + 1)
            yield frame


@dataclass(frozen=True)
class OdometryRun:
    """A whole run: `trajectory` (camera to world, first camera = world), a step a pair, and the run's figures."""

    trajectory: Trajectory
    steps: list[Step]
    metrics: dict[str, Any]

    @property
    def alignments(self) -> list[Alignment]:
        """The alignment of every pair."""
        return [step.alignment for step in self.steps]


def run_odometry(
    sequence: Sequence,
    solver: Any = None,
    seed: int = 0,
    alignment: AlignmentOptions | None = None,
    options: OdometryOptions | None = None,
    on_step: Callable[[Step], None] | None = None,
) -> OdometryRun:
    """Run the odometry over a sequence.

    Args:
        sequence: At least two frames.
        solver: Any solver with an entry a level; the `default` preset's genetic algorithm if left out.
        seed: The same seed, machine and version give the same trajectory, bit for bit.
        alignment: What is minimised; see `AlignmentOptions`.
        options: How the driver uses it; see `OdometryOptions`.
        on_step: Called with every step as it is done.

    Raises:
        GavoError: Fewer than two frames, or the sequence's own check refuses it.
    """
    if len(sequence) < 2:
        raise GavoError(f"{sequence.name}: an odometry needs at least two frames, not {len(sequence)}")
    sequence.check()
    odometry = Odometry(sequence.camera, solver, alignment, options, seed)
    compile_seconds = odometry.warm_up()
    steps: list[Step] = []
    start = time.perf_counter()
    for step in track(sequence, odometry=odometry):
        steps.append(step)
        if on_step is not None:
            on_step(step)
    seconds = time.perf_counter() - start
    trajectory = trajectory_of(float(sequence.timestamps[0]), steps)
    metrics = compute_metrics(trajectory, sequence.ground_truth, steps, seconds, compile_seconds)
    return OdometryRun(trajectory, steps, {"sequence": sequence.name, "seed": seed, **metrics})


def trajectory_of(first_timestamp: float, steps: list[Step]) -> Trajectory:
    """Trajectory of a run: the first camera at the origin, then a pose a step; none where the stamp is in doubt."""
    steps = [step for step in steps if step.alignment.status != AlignmentStatus.BAD_TIMESTAMP]
    stamps = np.array([first_timestamp] + [step.timestamp for step in steps])
    return Trajectory(stamps, np.stack([np.eye(4)] + [step.world_T_camera for step in steps]))


def compute_metrics(
    trajectory: Trajectory,
    ground_truth: Trajectory | None,
    steps: list[Step],
    seconds: float,
    compile_seconds: float,
) -> dict[str, Any]:
    """The figures of `metrics.json` that follow from a run; None where there is no, or too little, ground truth.

    Args:
        trajectory: The estimate.
        ground_truth: The truth, or None.
        steps: The run's steps.
        seconds: Wall time of the run after compilation, decoding included.
        compile_seconds: Time of the compilation.
    """

    def figure(compute: Callable[[Trajectory], float]) -> float | None:
        if ground_truth is None:
            return None
        try:
            return float(compute(ground_truth))
        except GavoError:
            return None

    per_second = partial(relative_pose_error, trajectory, delta=1.0, unit="s")
    per_frame = partial(relative_pose_error, trajectory, delta=1, unit="frames")
    return {
        "device": jax.devices()[0].device_kind,
        "frames": len(steps) + 1,
        "pairs": len(steps),
        "lost_pairs": sum(step.lost for step in steps),
        "statuses": dict(Counter(step.alignment.status.name.lower() for step in steps)),
        "rpe_translation_rmse_m_per_s": figure(lambda truth: per_second(truth).translation.rmse),
        "rpe_rotation_rmse_deg_per_s": figure(lambda truth: per_second(truth).rotation.rmse),
        "rpe_translation_rmse_m_per_frame": figure(lambda truth: per_frame(truth).translation.rmse),
        "ate_translation_rmse_m": figure(lambda truth: absolute_trajectory_error(trajectory, truth).rmse),
        "distance_error_final_m": figure(lambda truth: distance_error(trajectory, truth).final),
        "compile_seconds": compile_seconds,
        "milliseconds_per_pair_median": float(np.median([step.milliseconds for step in steps])) if steps else None,
        "frames_per_second": (len(steps) + 1) / seconds if seconds > 0 else None,
    }
