"""The thin driver: frames in, a trajectory out.

For every new frame one compiled program builds its pyramid, aligns it with the last frame and the keyframe at once,
and makes it the next reference; the images stay on the device, and a thread decodes the next frame meanwhile.
"""

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, PRNGKeyArray

from gavo_jax.alignment import (
    Alignment,
    AlignmentOptions,
    AlignmentStatus,
    Population,
    View,
    align_views,
    on_host,
    prepare_reference,
    prepare_target,
)
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame, FrameError, Sequence
from gavo_jax.errors import GavoError
from gavo_jax.evaluation import absolute_trajectory_error, distance_error, relative_pose_error
from gavo_jax.objective import Reference, share_in_view
from gavo_jax.presets import OdometryOptions, Preset, get_preset
from gavo_jax.pyramid import LEVELS, Pyramid, PyramidLevel, build_pyramid, halve_inverse_depth
from gavo_jax.trajectory import Trajectory, inverse
from gavo_jax.warp import exp, synchronise_depth


class TrackerState(NamedTuple):
    """What stays on the device from frame to frame."""

    previous: Reference
    keyframe: Reference
    previous_T_keyframe: Float[Array, "4 4"]
    motion: Float[Array, " 6"]
    """Twist of the last motion, from the frame before the previous one to the previous one."""
    seconds: Float[Array, ""]
    """Time that motion took."""


class Clock(NamedTuple):
    """Times of a new frame, seconds."""

    elapsed: Float[Array, ""]
    """Since the reference's colour image."""
    depth_delay: Float[Array, ""]
    """From the new colour image to the new depth image."""


def _synchronised(pyramid: Pyramid, camera: Camera, twist: Float[Array, " 6"], finest: int) -> Pyramid:
    """The pyramid with depth moved along a twist (colour moment to depth moment), from level `finest` upwards."""
    levels = list(pyramid)
    moved = synchronise_depth(pyramid[finest].inverse_depth, camera.level(finest), exp(twist))
    for level in range(finest, len(levels)):
        levels[level] = PyramidLevel(levels[level].grey, moved)
        if level + 1 < len(levels):
            moved = halve_inverse_depth(moved)
    return tuple(levels)


@partial(jax.jit, static_argnames=("options", "record"))
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
    record: bool,
) -> tuple[TrackerState, Alignment, Population | None]:
    """One frame: pyramid, alignment with the references, and the state for the next frame."""
    raw = build_pyramid(grey, depth, camera.depth_scale, LEVELS)
    predicted = state.motion * (clock.elapsed / state.seconds)
    finest = min(solver.levels)
    delay = clock.depth_delay / clock.elapsed
    target = _synchronised(raw, camera, delay * predicted, finest) if options.synchronise else raw
    views = (View(state.previous, jnp.eye(4)),)
    if options.reference == "keyframe":
        views += (View(state.keyframe, state.previous_T_keyframe),)
    guesses = jnp.eye(4)[None]
    if options.prior:
        guesses = jnp.concatenate([exp(predicted)[None], guesses])
    packed = prepare_target(target, solver.levels)
    result, populations = align_views(views, packed, camera, solver, alignment, key, guesses, record)
    if options.synchronise:
        target = _synchronised(raw, camera, delay * result.xi, finest)
    newest = prepare_reference(target, camera, solver.levels, alignment)
    target_T_keyframe = result.target_T_reference @ state.previous_T_keyframe
    coarsest = jax.tree.map(lambda leaf: leaf[0], state.keyframe)
    share = share_in_view(coarsest, target_T_keyframe, camera.level(max(solver.levels)))
    renew = share < options.keyframe_overlap
    keyframe, target_T_keyframe = jax.tree.map(
        lambda new, old: jnp.where(renew, new, old), (newest, jnp.eye(4)), (state.keyframe, target_T_keyframe)
    )
    return TrackerState(newest, keyframe, target_T_keyframe, result.xi, clock.elapsed), result, populations


@jax.jit
def _first_state(grey: Array, depth: Array, camera: Camera, solver: Any, alignment: AlignmentOptions) -> TrackerState:
    """State after the first frame: it is both references, and nothing is known of the motion."""
    pyramid = build_pyramid(grey, depth, camera.depth_scale, LEVELS)
    reference = prepare_reference(pyramid, camera, solver.levels, alignment)
    return TrackerState(reference, reference, jnp.eye(4), jnp.zeros(6), jnp.float32(1.0))


@dataclass(frozen=True)
class Step:
    """What the driver says of one new frame."""

    index: int
    """Of the frame in the sequence; the first frame, 0, makes no step."""
    reference_timestamp: float
    """Colour stamp of the reference, the last frame that was not lost, seconds."""
    timestamp: float
    alignment: Alignment
    """On the host; of a lost pair its `target_T_reference` is what was found, not what was recorded."""
    world_T_camera: Float64[np.ndarray, "4 4"]
    """Recorded; the world is the first camera."""
    milliseconds: float
    """From the decoded images to the result on the host."""
    lost: bool


def no_alignment(status: AlignmentStatus) -> Alignment:
    """The result of a pair that could not be aligned at all: no motion, nothing known."""
    nothing = Alignment(
        target_T_reference=jnp.eye(4),
        xi=jnp.zeros(6),
        error=jnp.float32(jnp.nan),
        overlap=jnp.float32(0.0),
        covariance=jnp.full((6, 6), jnp.nan),
        status=status,
        history=jnp.zeros(0),
    )
    return on_host(nothing)


MAX_HELD = 3
"""Lost frames in a row after which the newest readable one becomes the reference: the old one is out of reach."""


class Odometry:
    """Frame-by-frame tracking with the state kept on the device.

    Args:
        camera: Camera of the frames, without distortion.
        solver: Any solver with an entry a level; the `default` preset's genetic algorithm if left out.
        alignment: What is minimised.
        options: How the driver uses it.
        seed: Every random number follows from it.
        record: Whether every frame's candidates are kept until the next frame, for people to look at.
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
        self._key = jax.random.key(seed)
        self._state: TrackerState | None = None
        self._index = -1
        self._reference_timestamp = 0.0
        self._world_T_reference = np.eye(4)
        self._world_T_camera = np.eye(4)
        self._held = 0

    def warm_up(self) -> float:
        """Compile the program for a frame (or load it from the cache); returns the seconds this took."""
        start = time.perf_counter()
        size = (self.camera.height, self.camera.width)
        blank = Frame(np.zeros(size, np.uint8), np.zeros(size, np.uint16), timestamp=0.0)
        self._run(self._start(blank), blank, Clock(jnp.float32(1.0), jnp.float32(0.0)), self._key)
        return time.perf_counter() - start

    def register(self, frame: Frame | None, timestamp: float) -> Step | None:
        """Track one more frame.

        Args:
            frame: The next frame, or None for one that could not be read: it is lost, and the run goes on.
            timestamp: Its colour stamp, seconds; later than the last one's.

        Returns:
            The step, or None for the first frame, which is the world's origin.

        Raises:
            FrameError: There is no first frame to start from.
        """
        self._index += 1
        self.populations = ()
        if self._state is None:
            if frame is None:
                raise FrameError("the first frame could not be read")
            self._restart(frame)
            return None
        start = time.perf_counter()
        state, result = (None, no_alignment(AlignmentStatus.UNREADABLE))
        if frame is not None:
            state, result = self._align(self._state, frame)
        lost = result.status != AlignmentStatus.OK
        reference_timestamp = self._reference_timestamp
        if state is not None and not lost:
            self._state, self._held, self._reference_timestamp = state, 0, timestamp
            self._world_T_reference = self._world_T_reference @ inverse(_rigid(result.target_T_reference))
            self._world_T_camera = self._world_T_reference
        else:
            self._lose(frame, timestamp)
        milliseconds = (time.perf_counter() - start) * 1e3
        return Step(
            self._index, reference_timestamp, timestamp, result, self._world_T_camera.copy(), milliseconds, lost
        )

    def _start(self, frame: Frame) -> TrackerState:
        return _first_state(frame.grey, frame.depth, self.camera, self.solver, self.alignment)

    def _restart(self, frame: Frame) -> None:
        """Make a frame the only reference, standing where the camera is recorded to be."""
        self._state, self._held, self._reference_timestamp = self._start(frame), 0, frame.timestamp
        self._world_T_reference = self._world_T_camera

    def _lose(self, frame: Frame | None, timestamp: float) -> None:
        """Record a lost pair by the policy, and give the old reference up once it is out of reach."""
        assert self._state is not None
        self._held += 1
        if self.options.on_lost == "predict":
            elapsed = (timestamp - self._reference_timestamp) / float(self._state.seconds)
            motion = _rigid(np.asarray(exp(self._state.motion * elapsed)))
            self._world_T_camera = self._world_T_reference @ inverse(motion)
        if frame is not None and self._held >= MAX_HELD:
            self._restart(frame)

    def _clock(self, frame: Frame) -> Clock:
        elapsed = frame.timestamp - self._reference_timestamp
        delay = 0.0 if frame.depth_timestamp is None else frame.depth_timestamp - frame.timestamp
        return Clock(jnp.float32(max(elapsed, 1e-3)), jnp.float32(delay))

    def _align(self, state: TrackerState, frame: Frame) -> tuple[TrackerState, Alignment]:
        """Align with the references; a result that looks wrong is tried again by the wide search."""
        clock, key = self._clock(frame), jax.random.fold_in(self._key, self._index)
        state_after, result = self._run(state, frame, clock, key)
        if result.status == AlignmentStatus.OK or not self.options.recover:
            return state_after, result
        wide = self._wide()
        state_wide, second = self._run(
            state, frame, clock, key, wide.solver, wide.alignment, replace(self.options, reference="previous")
        )
        if second.status == AlignmentStatus.OK:
            return state_wide, second
        return state_after, result

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
        key: PRNGKeyArray,
        solver: Any = None,
        alignment: AlignmentOptions | None = None,
        options: OdometryOptions | None = None,
    ) -> tuple[TrackerState, Alignment]:
        solver, alignment = solver or self.solver, alignment or self.alignment
        options = options or self.options
        state, result, populations = _track(
            state, frame.grey, frame.depth, clock, key, self.camera, solver, alignment, _traced(options), self.record
        )
        if populations is not None:
            levels = range(len(solver.levels))
            self.populations = tuple(jax.tree.map(lambda leaf, k=k: leaf[k], populations) for k in levels)
        return state, on_host(result)


def _traced(options: OdometryOptions) -> OdometryOptions:
    """The options that shape the program; the others are reset, so that they cause no second compilation."""
    return replace(options, recover=True, on_lost="hold")


def _rigid(transform: Float[Array | np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
    """A float32 motion in double precision with its rotation made orthonormal, so that chains stay rigid."""
    result = np.eye(4)
    u, _, v = np.linalg.svd(np.asarray(transform[:3, :3], np.float64))
    result[:3, :3] = u @ v
    result[:3, 3] = transform[:3, 3]
    return result


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
    cannot be read makes a lost step. With `on_lost="stop"` the stream ends after the first lost one. `watch` is shown
    every frame (None: it could not be read) with its step (None: it is the first).

    Raises:
        FrameError: The first frame cannot be read.
    """
    if odometry is None:
        odometry = Odometry(sequence.camera, solver, alignment, options, seed)

    def read(index: int) -> Frame | FrameError:
        try:
            return sequence[index]
        except FrameError as error:
            return error

    with ThreadPoolExecutor(max_workers=1) as decoder:
        coming = decoder.submit(read, 0)
        for index in range(len(sequence)):
            frame = coming.result()
            if index + 1 < len(sequence):
                coming = decoder.submit(read, index + 1)
            if isinstance(frame, FrameError) and index == 0:
                raise frame
            stamp = float(sequence.timestamps[index])
            readable = None if isinstance(frame, FrameError) else frame
            step = odometry.register(readable, stamp)
            watch(readable, step)
            if step is not None:
                yield step
                if step.lost and odometry.options.on_lost == "stop":
                    return


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
    """Trajectory of a run: the first camera at the origin, then a pose a step."""
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
        "rpe_translation_rmse_m_per_s": figure(lambda truth: per_second(truth).translation.rmse),
        "rpe_rotation_rmse_deg_per_s": figure(lambda truth: per_second(truth).rotation.rmse),
        "rpe_translation_rmse_m_per_frame": figure(lambda truth: per_frame(truth).translation.rmse),
        "ate_translation_rmse_m": figure(lambda truth: absolute_trajectory_error(trajectory, truth).rmse),
        "distance_error_final_m": figure(lambda truth: distance_error(trajectory, truth).final),
        "compile_seconds": compile_seconds,
        "milliseconds_per_pair_median": float(np.median([step.milliseconds for step in steps])) if steps else None,
        "frames_per_second": (len(steps) + 1) / seconds if seconds > 0 else None,
    }
