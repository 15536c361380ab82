"""Many runs over one sequence together: each frame is decoded once, for all of them.

On a CPU, which one run's program already fills, the runs of a frame are calls of that one program: their numbers are
those of `track`, bit for bit. An accelerator gets all runs of a frame as one call, `vmap` over their states, keys,
solvers and options, the runs laid out over all local devices; a rate that differs from run to run compiles nothing.
"""

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from gavo_jax.alignment import Alignment, AlignmentOptions, on_host
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame, FrameError
from gavo_jax.datasets.base import Sequence as FrameSequence
from gavo_jax.odometry import Clock, Odometry, Progress, Step, TrackerState, _traced, _track, decoded, first_state
from gavo_jax.presets import OdometryOptions, Preset

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


def track_stacked(
    sequence: FrameSequence,
    presets: Sequence[Preset],
    seeds: Sequence[int],
    on_frame: Callable[[], None] | None = None,
) -> list[list[Step]]:
    """Track one sequence by R runs of one program, all runs of a frame in one call on the device.

    Results agree with `track` to rounding, which a random search may enlarge.

    Args:
        sequence: As in `track_together`.
        presets: Settings of each run, of one structure: what differs are rates (see `program_of`).
        seeds: Seed of each run.
        on_frame: As in `track_together`.

    Returns:
        The steps of each run.

    Raises:
        FrameError: the first frame cannot be read.
    """
    stack = _Stack(sequence.camera, presets, seeds)
    return _drive(sequence, stack.lanes, stack.register, on_frame)


def program_of(preset: Preset) -> Any:
    """What decides, beside the camera, the compiled program of a run: runs of equal (hashable) answers share one."""
    return jax.tree.structure(_settings_of(preset))


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
                stopped[i] = step.lost and odometries[i].options.on_lost == "stop"
        if on_frame is not None:
            on_frame()
        if all(stopped):
            break
    return steps


Settings = tuple[Any, AlignmentOptions, OdometryOptions]
"""A run's solver, what it minimises and how the driver uses it, as the program takes them."""


def _settings_of(preset: Preset) -> Settings:
    return preset.solver, preset.alignment, _traced(preset.odometry)


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
        return _track(state, grey, depth, clock, key, camera, *settings, record=False)[:2]

    return jax.vmap(one)(states, clocks, keys, settings)


NEW_ROW: Any = object()
"""Stands for a lane's state after its first attempt at a frame: a row of the new stack."""


class _Lane(Odometry):
    """One run of a stack: its first attempt at a frame was made with the others', whatever follows is its own."""

    first_attempt: Alignment | None = None

    def _run(
        self,
        state: TrackerState,
        frame: Frame,
        clock: Clock,
        solver: Any = None,
        alignment: AlignmentOptions | None = None,
        options: OdometryOptions | None = None,
    ) -> tuple[TrackerState, Alignment]:
        if solver is None and self.first_attempt is not None:
            return NEW_ROW, self.first_attempt
        return super()._run(state, frame, clock, solver, alignment, options)

    def _start(self, frame: Frame) -> TrackerState:
        """As of a single run, whose program the stack has no other use for."""
        return first_state(frame.grey, frame.depth, self.camera, self.solver, self.alignment)


class _Stack:
    """R lanes whose states are rows of one stack on the device."""

    def __init__(self, camera: Camera, presets: Sequence[Preset], seeds: Sequence[int]) -> None:
        self.lanes = [
            _Lane(camera, preset.solver, preset.alignment, preset.odometry, seed)
            for preset, seed in zip(presets, seeds, strict=True)
        ]
        self._camera = camera
        self._sharding = _over_devices(len(presets))
        self._settings = self._rows([_settings_of(preset) for preset in presets])

    def register(self, frame: Frame | FrameError, timestamp: float) -> list[Step | None]:
        """Track one more frame by all lanes; each decides by itself what becomes of it."""
        before = [lane.progress for lane in self.lanes]
        after = None
        if isinstance(frame, Frame) and all(progress.tracker is not None for progress in before):
            after = self._attempt(frame, before)
        steps = [lane.register(frame, timestamp) for lane in self.lanes]
        for i, lane in enumerate(self.lanes):
            if lane.progress.tracker is NEW_ROW:
                lane.progress = lane.progress._replace(tracker=_row(after, i))
            lane.first_attempt = None
        return steps

    def _attempt(self, frame: Frame, before: Sequence[Progress]) -> TrackerState:
        """Align a frame by all lanes in one call; each lane keeps its own result, the stack of states is returned."""
        numbered = [progress._replace(last_index=progress.last_index + 1) for progress in before]
        clocks = self._rows([lane.clock(progress, frame) for lane, progress in zip(self.lanes, numbered, strict=True)])
        keys = jnp.stack([lane.key for lane in self.lanes])
        states = self._rows([progress.tracker for progress in before])
        images = jnp.asarray(frame.grey), jnp.asarray(frame.depth)
        after, results = _track_stack(states, *images, clocks, keys, self._camera, self._settings)
        host = jax.device_get(results)
        for i, lane in enumerate(self.lanes):
            lane.first_attempt = on_host(jax.tree.map(lambda leaf, i=i: leaf[i], host))
        return after

    def _rows(self, values: Sequence[Any]) -> Any:
        """Stack R pytrees of numbers, laid out over the devices."""
        stacked = jax.tree.map(lambda *leaves: jnp.stack([_as_array(leaf) for leaf in leaves]), *values)
        return jax.device_put(stacked, self._sharding)


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
