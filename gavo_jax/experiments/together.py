"""Tracks one sequence by many runs together, decoding each frame once for all of them.

On a CPU, which a single run's program already keeps busy, each run calls that program: results equal those of `track`
bit for bit. On accelerators, all runs of a frame are one call, a `vmap` over their states, keys, solvers and options,
sharded over the local devices. Rates that differ between runs don't trigger another compilation.
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
from gavo_jax.compilation.waits import Stopwatch, counted_map
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
        sequence: Sequence to track; each frame is decoded once, in a thread, while the previous one is aligned.
        odometries: Fresh drivers for the sequence's camera.
        on_frame: Called once all runs are done with a frame.

    Returns:
        The steps of each driver; if its policy is to stop when lost, they end with its first lost frame.

    Raises:
        FrameError: the first frame cannot be read.
    """
    workers = min(len(odometries), os.cpu_count() or 1)
    with ThreadPoolExecutor(workers) as pool:

        def register(frame: Frame | FrameError, timestamp: float) -> list[Step | None]:
            return counted_map(pool, lambda odometry: odometry.register(frame, timestamp), odometries)

        return _drive(sequence, odometries, register, on_frame)


@in_32_bits
def track_stacked(
    sequence: FrameSequence,
    settings: Sequence[Settings],
    seeds: Sequence[int],
    on_frame: Callable[[], None] | None = None,
) -> list[list[Step]]:
    """Track one sequence by R runs of one program, with one call on the device per frame.

    Results agree with `track` up to rounding, which a random search may amplify.

    Args:
        sequence: As in `track_together`.
        settings: Settings of each run; they may differ only in what doesn't change the program (see `program_of`).
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
    """A hashable key of a run's compiled program: runs with equal keys and cameras share one."""
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
    """The settings of a run that its compiled program depends on or takes as inputs."""
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
    """Track one frame by R runs: all arguments except the images and the camera have a leading axis R."""

    def one(state: TrackerState, clock: Clock, key: Any, settings: Settings) -> Any:
        parts = (settings.solver, settings.alignment, settings.odometry)
        return track_frame(state, grey, depth, clock, key, camera, *parts, record=False)[:2]

    return jax.vmap(one)(states, clocks, keys, settings)


class _Made(NamedTuple):
    """One run's attempt at a frame, from the call for all runs."""

    state: TrackerState
    """The run's state before the frame."""
    frame: Frame
    """The frame that was aligned."""
    clock: Clock
    """Timing of the frame."""
    result: Alignment
    after: Callable[[], TrackerState]
    """Returns the run's state after the frame, a row of the new stack."""

    def answers(self, state: TrackerState, frame: Frame, clock: Clock) -> bool:
        """Whether the attempt was made from exactly these inputs.

        The driver may have changed them since, by removing depth or correcting the elapsed time.
        """
        is_same_frame = frame.grey is self.frame.grey and frame.depth is self.frame.depth
        return state is self.state and is_same_frame and clock == self.clock


@dataclass
class _Stacked:
    """The search of one run of a stack: the first attempt at each frame comes from the call for all runs."""

    search: Search
    made: _Made | None = None
    """The attempt from that call; None if there is none, so that the run searches by itself."""

    def warm_up(self) -> float:
        """Return 0: the stack's program is compiled at its first aligned frame."""
        return 0.0

    def start(self, frame: Frame) -> TrackerState:
        """Start without the program of a single run, which the stack doesn't otherwise need."""
        settings = self.search.settings
        return first_state(frame.grey, frame.depth, self.search.camera, settings.solver, settings.alignment)

    def align(self, state: TrackerState, frame: Frame, clock: Clock) -> Attempt:
        """Return the stack's attempt if it was made from the same inputs; otherwise search."""
        if self.made is None or not self.made.answers(state, frame, clock):
            return self.search.align(state, frame, clock)
        return self.search.judged(state, self.made.after(), self.made.result, frame, clock)

    def predict(self, state: TrackerState, elapsed: float) -> Float64[np.ndarray, "4 4"]:
        """Predict as a single run does."""
        return self.search.predict(state, elapsed)


class _Stack:
    """R runs, or lanes, whose states are rows of one stack on the device."""

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
        """Track the next frame by all lanes; each decides for itself whether to accept the result."""
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
        # Every lane waited for the whole stack.
        return [step and replace(step, milliseconds=step.milliseconds + milliseconds) for step in steps]

    def _attempt(self, frame: Frame, before: Sequence[Progress]) -> None:
        """Align a frame by all lanes in one call; each lane keeps its result and a function that returns its state."""
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
        """Stack R pytrees of numbers and shard them over the devices."""
        stacked = jax.tree.map(lambda *leaves: jnp.stack([_as_array(leaf) for leaf in leaves]), *values)
        return jax.device_put(stacked, self._sharding)


def _tracker_of(state: Any) -> TrackerState:
    """The tracker's part of a lane's state, which may also hold bodies."""
    return state if isinstance(state, TrackerState) else state.tracker


def _as_array(leaf: Any) -> jax.Array:
    return jnp.asarray(leaf, jnp.float32) if isinstance(leaf, float | int) else jnp.asarray(leaf)


@jax.jit
def _row(stack: Any, i: int) -> TrackerState:
    return jax.tree.map(lambda leaf: leaf[i], stack)


def _over_devices(rows: int) -> NamedSharding:
    """Sharding of a leading axis over gcd(rows, number of devices) of the local devices.

    Each device gets the same number of rows, so 4 runs on 3 devices use one of them: choose the size of batches as a
    multiple of the number of devices.
    """
    devices = jax.local_devices()
    count = math.gcd(rows, len(devices))
    return NamedSharding(Mesh(np.array(devices[:count]), ("runs",)), PartitionSpec("runs"))
