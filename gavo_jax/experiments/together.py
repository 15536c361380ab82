"""Many runs over one sequence together: each frame is decoded once, for all of them.

On a CPU, which one run's program already fills, the runs of a frame are calls of that one program: their numbers are
those of `track`, bit for bit. An accelerator gets all runs of a frame as one call, `vmap` over their states, keys,
solvers and options, the runs laid out over all local devices; a rate that differs from run to run compiles nothing.
"""

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Float64

from gavo_jax.alignment.result import Alignment, on_host
from gavo_jax.camera import Camera
from gavo_jax.compilation.precision import in_32_bits
from gavo_jax.compilation.waits import Stopwatch
from gavo_jax.datasets.base import Frame, FrameError
from gavo_jax.datasets.base import Sequence as FrameSequence
from gavo_jax.datasets.rectified import rectified
from gavo_jax.odometry.aligners import Attempt, Search, traced_part
from gavo_jax.odometry.composition import with_recovery
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.hindsight import revised
from gavo_jax.odometry.progress import Progress
from gavo_jax.odometry.stream import decoded
from gavo_jax.odometry.tracking import Clock, TrackerState, first_state, track_frame
from gavo_jax.settings import Settings

Register = Callable[[Frame | FrameError, float], list[Step | None]]


def track_together(
    sequence: FrameSequence,
    odometries: Sequence[Odometry],
    on_frame: Callable[[], None] | None = None,
) -> list[list[Step]]:
    """Track one sequence by several drivers, frame by frame.

    Args:
        sequence: Its frames are decoded once, in a thread, while the one before is aligned.
        odometries: The drivers, fresh ones, of the sequence's camera.
        on_frame: Called after each frame with all runs done.

    Returns:
        The steps of each driver; those of a driver whose policy is to stop end with its first lost frame.

    Raises:
        FrameError: the first frame cannot be read.
    """
    workers = min(len(odometries), os.cpu_count() or 1)
    with ThreadPoolExecutor(workers) as pool:

        def register(frame: Frame | FrameError, timestamp: float) -> list[Step | None]:
            return list(pool.map(lambda odometry: odometry.register(frame, timestamp), odometries))

        return _drive(sequence, odometries, register, on_frame)


@in_32_bits
def track_stacked(
    sequence: FrameSequence,
    settings: Sequence[Settings],
    seeds: Sequence[int],
    on_frame: Callable[[], None] | None = None,
) -> list[list[Step]]:
    """Track one sequence by R runs of one program, all runs of a frame in one call on the device.

    Results agree with `track` to rounding, which a random search may enlarge.

    Args:
        sequence: As in `track_together`.
        settings: Of each run, of one structure: what differs are rates (see `program_of`).
        seeds: Seed of each run.
        on_frame: As in `track_together`.

    Returns:
        The steps of each run.

    Raises:
        FrameError: the first frame cannot be read.
    """
    stack = _Stack(sequence.camera, settings, seeds)
    return _drive(sequence, stack.lanes, stack.register, on_frame)


def program_of(settings: Settings) -> Any:
    """What decides, beside the camera, the compiled program of a run: runs of equal (hashable) answers share one."""
    return jax.tree.structure(_of_program(settings))


def _drive(
    sequence: FrameSequence,
    odometries: Sequence[Odometry],
    register: Register,
    on_frame: Callable[[], None] | None,
) -> list[list[Step]]:
    steps: list[list[Step]] = [[] for _ in odometries]
    stopped = [False] * len(odometries)
    for index, frame in enumerate(decoded(sequence)):
        for i, step in enumerate(register(frame, float(sequence.timestamps[index]))):
            if step is not None and not stopped[i]:
                steps[i].append(step)
                stopped[i] = step.lost and odometries[i].settings.odometry.on_lost == "stop"
        if on_frame is not None:
            on_frame()
        if all(stopped):
            break
    return [revised(of_one) for of_one in steps]


def _of_program(settings: Settings) -> Settings:
    """What the program for a frame takes of a run's settings."""
    return replace(settings, odometry=traced_part(settings.odometry))


@jax.jit
def _track_stack(
    states: TrackerState,
    grey: Any,
    depth: Any,
    clocks: Clock,
    keys: Any,
    camera: Camera,
    settings: Settings,
) -> tuple[TrackerState, Alignment]:
    """One frame of R runs: everything but the images and the camera has a leading axis R."""

    def one(state: TrackerState, clock: Clock, key: Any, settings: Settings) -> Any:
        parts = (settings.solver, settings.alignment, settings.odometry)
        return track_frame(state, grey, depth, clock, key, camera, *parts, record=False)[:2]

    return jax.vmap(one)(states, clocks, keys, settings)


class _Made(NamedTuple):
    """One run's attempt at a frame, made with the others'."""

    state: TrackerState
    """The run's state before the frame."""
    frame: Frame
    """The new frame."""
    clock: Clock
    """When the new frame was taken."""
    result: Alignment
    after: Callable[[], TrackerState]
    """Gives the state after it: a row of the new stack."""

    def answers(self, state: TrackerState, frame: Frame, clock: Clock) -> bool:
        """Whether it is what a search would find; since it was made, depth may have been left out, or the motion be
        thought to have taken another time.
        """
        is_same_frame = frame.grey is self.frame.grey and frame.depth is self.frame.depth
        return state is self.state and is_same_frame and clock == self.clock


@dataclass
class _Stacked:
    """The search of one run of a stack: its first attempt at a frame was made with the others'."""

    search: Search
    made: _Made | None = None
    """That attempt; None where there is none, and the run is on its own."""

    def warm_up(self) -> float:
        """The stack's program compiles with its first frame."""
        return 0.0

    def start(self, frame: Frame) -> TrackerState:
        """Start as a single run does, whose program the stack has no other use for."""
        settings = self.search.settings
        return first_state(frame.grey, frame.depth, self.search.camera, settings.solver, settings.alignment)

    def align(self, state: TrackerState, frame: Frame, clock: Clock) -> Attempt:
        """The attempt that was made, if it is the one that is asked for."""
        if self.made is None or not self.made.answers(state, frame, clock):
            return self.search.align(state, frame, clock)
        return self.search.judged(state, self.made.after(), self.made.result, frame, clock)

    def predict(self, state: TrackerState, elapsed: float) -> Float64[np.ndarray, "4 4"]:
        """Predict as a single run does."""
        return self.search.predict(state, elapsed)


class _Stack:
    """R lanes whose states are rows of one stack on the device."""

    def __init__(self, camera: Camera, settings: Sequence[Settings], seeds: Sequence[int]) -> None:
        self._recorded, self._camera = camera, camera.rectified()
        self._searches = [
            _Stacked(Search(self._camera, own, jax.random.key(seed))) for own, seed in zip(settings, seeds, strict=True)
        ]
        self.lanes = [
            Odometry(self._camera, stacked.search.settings, aligner=with_recovery(stacked, stacked.search))
            for stacked in self._searches
        ]
        self._sharding = _over_devices(len(settings))
        self._settings = self._rows([_of_program(own) for own in settings])

    def register(self, frame: Frame | FrameError, timestamp: float) -> list[Step | None]:
        """Track one more frame by all lanes; each decides by itself what becomes of it."""
        milliseconds = 0.0
        if isinstance(frame, Frame):
            frame = rectified(frame, self._recorded)
            before = [lane.progress for lane in self.lanes]
            if all(progress.tracker is not None for progress in before):
                stopwatch = Stopwatch()
                self._attempt(frame, before)
                milliseconds = stopwatch.seconds * 1e3
        steps = [lane.register(frame, timestamp) for lane in self.lanes]
        for stacked in self._searches:
            stacked.made = None
        # every lane has waited for the whole stack
        return [step and replace(step, milliseconds=step.milliseconds + milliseconds) for step in steps]

    def _attempt(self, frame: Frame, before: Sequence[Progress]) -> None:
        """Align a frame by all lanes in one call; each lane keeps its own result and a way to its state."""
        numbered = [progress._replace(last_index=progress.last_index + 1) for progress in before]
        clocks = [progress.clock(frame) for progress in numbered]
        keys = jnp.stack([stacked.search.key for stacked in self._searches])
        states = [_tracker_of(progress.tracker) for progress in before]
        inputs = self._rows(states), jnp.asarray(frame.grey), jnp.asarray(frame.depth), self._rows(clocks), keys
        after, results = _track_stack(*inputs, self._camera, self._settings)
        host = jax.device_get(results)
        for i, stacked in enumerate(self._searches):
            result = on_host(jax.tree.map(lambda leaf, i=i: leaf[i], host))
            stacked.made = _Made(states[i], frame, clocks[i], result, partial(_row, after, i))

    def _rows(self, values: Sequence[Any]) -> Any:
        """Stack R pytrees of numbers, laid out over the devices."""
        stacked = jax.tree.map(lambda *leaves: jnp.stack([_as_array(leaf) for leaf in leaves]), *values)
        return jax.device_put(stacked, self._sharding)


def _tracker_of(state: Any) -> TrackerState:
    """The tracker's part of a lane's state, which may know of bodies too."""
    return state if isinstance(state, TrackerState) else state.tracker


def _as_array(leaf: Any) -> jax.Array:
    return jnp.asarray(leaf, jnp.float32) if isinstance(leaf, float | int) else jnp.asarray(leaf)


@jax.jit
def _row(stack: Any, i: int) -> TrackerState:
    return jax.tree.map(lambda leaf: leaf[i], stack)


def _over_devices(rows: int) -> NamedSharding:
    """The leading axis laid out over as many of the local devices as divide it."""
    devices = jax.local_devices()
    count = math.gcd(rows, len(devices))
    return NamedSharding(Mesh(np.array(devices[:count]), ("runs",)), PartitionSpec("runs"))
