"""The odometry of a whole sequence: its trajectory, its steps and its figures."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from gavo_jax.alignment.result import Alignment
from gavo_jax.compilation.precision import in_32_bits
from gavo_jax.compilation.waits import Stopwatch
from gavo_jax.datasets.base import RUN, Sequence, require_parts, require_sequence
from gavo_jax.datasets.rectified import without_distortion
from gavo_jax.errors import GavoError
from gavo_jax.mapping.background import BackgroundMapper, mapper_of
from gavo_jax.mapping.correction import Doubts, correct, loop_figures
from gavo_jax.mapping.mapper import Loops
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.hindsight import revised
from gavo_jax.odometry.metrics import RunMetrics, compute_metrics, errors_before, run_identity
from gavo_jax.odometry.stream import track, unwatched
from gavo_jax.presets import names_of
from gavo_jax.settings import AlignmentOptions, OdometryOptions, Settings, as_settings
from gavo_jax.settings_check import as_seed
from gavo_jax.solvers.base import Solver
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import Trajectory

if TYPE_CHECKING:
    from gavo_jax.scene_map import SceneMap


@dataclass(frozen=True, eq=False)
class OdometryRun:
    """A whole run: `trajectory` (camera to world, first camera = world), a step per pair, and the run's figures."""

    trajectory: Trajectory
    steps: list[Step]
    metrics: RunMetrics
    sequence: Sequence | None = field(default=None, repr=False)
    """The frames of the run; None where they are not kept."""
    odometry: Trajectory | None = None
    """The trajectory before its correction by loops; None without loops."""
    loops: Loops | None = None
    """The map of keyframes; None without loops."""

    @property
    def alignments(self) -> list[Alignment]:
        """The alignment of every pair."""
        return [step.alignment for step in self.steps]

    def map(self, shape: Literal["cloud", "mesh"] = "cloud", voxel: float = 0.01) -> "SceneMap":
        """The scene that was seen, as a cloud or a mesh in the run's world; the frames are read once more.

        With `gavo.Reading(color=True)` it has colours, else it is grey. Needs the extra `[map]`.

        Args:
            shape: cloud or mesh.
            voxel: Side of a voxel, metres.

        Raises:
            GavoError: Open3D cannot be imported, the shape is unknown, the voxel is absurd, or the run does not hold
                its sequence.
        """
        from gavo_jax.map_fusion import build_map

        if self.sequence is None:
            raise GavoError("the run does not contain the sequence that it was run over, so no map can be made")
        return build_map(self.sequence, self.steps, shape, voxel, trajectory=self.trajectory)


@in_32_bits
def run_odometry(
    sequence: Sequence,
    settings: Settings | Solver | None = None,
    *,
    seed: int = 0,
    on_step: Callable[[Step], None] | None = None,
    solver: Solver | None = None,
    alignment: AlignmentOptions | None = None,
    options: OdometryOptions | None = None,
) -> OdometryRun:
    """Run the odometry over a sequence.

    Args:
        sequence: At least two frames.
        settings: Settings of the solver, the objective and the odometry; `presets.preset` has named ones. A solver
            stands for the default settings with that solver.
        seed: The same seed, machine and version give the same trajectory, bit for bit.
        on_step: Called with every step as it is done.
        solver: Replaces the settings' solver.
        alignment: Deprecated: a part of the settings.
        options: Deprecated: a part of the settings.

    Raises:
        GavoError: The input is no sequence, has fewer than two frames, or its own check refuses it.
    """
    require_sequence(sequence, RUN)
    if len(sequence) < 2:
        raise GavoError(f"{sequence.name}: odometry needs at least two frames, got {len(sequence)}")
    sequence.check()
    require_parts(sequence)
    sequence = without_distortion(sequence)
    settings = as_settings(settings, solver, alignment=alignment, odometry=options)
    seed = as_seed(seed)
    mapper = mapper_of(sequence.camera, settings.odometry)
    odometry = Odometry(sequence.camera, settings, seed=seed, relocaliser=mapper)
    compile_seconds = odometry.warm_up() + (mapper.warm_up() if mapper else 0.0)
    steps: list[Step] = []
    stopwatch = Stopwatch()
    for step in track(sequence, odometry=odometry, watch=mapper.watch if mapper else unwatched):
        steps.append(step)
        if on_step is not None:
            on_step(replace(step, world_T_camera=step.world_T_camera.copy()))  # the run's own must not change
    seconds, compile_seconds = stopwatch.seconds, compile_seconds + stopwatch.waited
    outcome = finish_run(float(sequence.timestamps[0]), steps, sequence.ground_truth, mapper, seconds, compile_seconds)
    method, preset = names_of(settings)
    metrics: Any = {
        **run_identity(sequence.name, method, preset, seed),
        "complete": len(steps) == len(sequence) - 1,
        **outcome.figures,
    }
    return OdometryRun(outcome.trajectory, outcome.steps, metrics, sequence, outcome.odometry, outcome.loops)


class RunOutcome(NamedTuple):
    """The outcome of a run."""

    trajectory: Trajectory
    steps: list[Step]
    """The steps, revised by what later frames have shown."""
    figures: dict[str, Any]
    """Entries of metrics.json: `Metrics`, and with loops the errors before them and the figures of the map."""
    odometry: Trajectory | None = None
    """The trajectory before its correction by loops; None without loops."""
    loops: Loops | None = None


def finish_run(
    first_timestamp: float,
    steps: list[Step],
    ground_truth: Trajectory | None,
    mapper: BackgroundMapper | None,
    seconds: float,
    compile_seconds: float,
    pairs: int | None = None,
) -> RunOutcome:
    """Finish a run whose last frame was tracked: hindsight, then loops, then figures.

    Args:
        first_timestamp: Timestamp of the first frame, seconds.
        steps: The run's steps, as they were made.
        ground_truth: The true trajectory, or None.
        mapper: The run's map, which is finished here; None without loops.
        seconds: Wall time of the tracking, decoding included, compilation excluded.
        compile_seconds: Time of the compilation.
        pairs: Number of pairs tracked in that time, if not all of them: the run was resumed. If 0, the speed is
            unknown.
    """
    start = time.perf_counter()
    steps = revised(steps)
    causal = trajectory = trajectory_of(first_timestamp, steps)
    loops = mapper.finish(steps) if mapper else None
    if loops is not None:
        trajectory = correct(causal, loops, doubts_of(steps))
    ending = time.perf_counter() - start
    share = 1.0 if pairs is None else pairs / max(len(steps), 1)
    seconds = seconds / share + ending if share else 0.0  # as if all had been tracked at this speed

    def figures(of: Trajectory) -> dict[str, Any]:
        return {**compute_metrics(of, ground_truth, steps, seconds, compile_seconds)}

    if loops is None:
        return RunOutcome(trajectory, steps, figures(trajectory))
    of_loops = {**errors_before(figures(causal)), **loop_figures(loops)}
    return RunOutcome(trajectory, steps, figures(trajectory) | of_loops, causal, loops)


def doubts_of(steps: list[Step]) -> Doubts:
    """Which poses of `trajectory_of` are guesses. A lost frame that others were aligned with is located by these."""
    kept = [step for step in steps if step.alignment.status != AlignmentStatus.BAD_TIMESTAMP]
    references = {step.reference_timestamp for step in kept if not step.lost}
    guessed = [step.origin == "guessed" for step in kept]
    lost = [step.lost and step.timestamp not in references for step in kept]
    return Doubts(np.array([False, *guessed]), np.array([False, *lost]))


def trajectory_of(first_timestamp: float, steps: list[Step]) -> Trajectory:
    """The trajectory of a run: the first camera at the origin, then a pose per step with a trusted timestamp."""
    steps = [step for step in steps if step.alignment.status != AlignmentStatus.BAD_TIMESTAMP]
    stamps = np.array([first_timestamp] + [step.timestamp for step in steps])
    poses = np.stack([np.eye(4)] + [step.world_T_camera for step in steps])
    return Trajectory(stamps, poses, np.array([0] + [step.segment for step in steps]))
