"""Executors of batches: this process on its own device, or a Ray cluster."""

import importlib
import platform
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache, partial
from pathlib import Path
from typing import Any, Protocol

import jax

from gavo_jax.camera import Camera
from gavo_jax.compilation.cache import cache_folder, enable_compilation_cache
from gavo_jax.compilation.waits import Stopwatch
from gavo_jax.datasets.base import Sequence as FrameSequence
from gavo_jax.errors import GavoError, line_of
from gavo_jax.experiments.plan import Batch, RayOptions, Run, configuration, frames_of
from gavo_jax.experiments.together import track_stacked, track_together
from gavo_jax.interrupts import interruptible
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.metrics import Metrics, compute_metrics
from gavo_jax.odometry.run import run_odometry, trajectory_of
from gavo_jax.output.files import environment
from gavo_jax.peers.comparison import peer_odometry
from gavo_jax.peers.registry import make_peer
from gavo_jax.settings import Settings

Row = dict[str, Any]


@dataclass(frozen=True)
class Outcome:
    """The outcome of a batch: its rows, or a one-line reason why there are none."""

    batch: Batch
    rows: tuple[Row, ...]
    fault: str | None = None


class Executor(Protocol):
    """Runs batches, in any order."""

    def slots(self) -> int:
        """Return the number of batches that can run at the same time."""
        ...

    def run(self, experiment: str, batches: Sequence[Batch], on_pairs: Callable[[int], None]) -> Iterator[Outcome]:
        """Yield each batch's outcome as soon as it is known, and call `on_pairs` with the number of pairs just done."""
        ...


class LocalExecutor:
    """Runs one batch after another in this process; the runs of a batch share the device."""

    def slots(self) -> int:
        """Return one."""
        return 1

    def run(self, experiment: str, batches: Sequence[Batch], on_pairs: Callable[[int], None]) -> Iterator[Outcome]:
        """Run the batches in the given order."""
        for batch in batches:
            yield interruptible(partial(run_batch, experiment, batch, on_pairs))


class RayExecutor:
    """Runs batches as tasks on a Ray cluster: the one RAY_ADDRESS names, or else one started here.

    Ray retries a task whose process or node dies. Rows are sent back to the driver, which alone writes the table. The
    nodes only need to read the frames, under the same paths.
    """

    RETRIES = 5

    def __init__(self, options: RayOptions) -> None:
        """Join the cluster.

        Raises:
            GavoError: Ray is missing, no cluster answers, Ray refuses the amounts, or no node has enough processors and
                GPUs for a batch, which then would wait for ever.
        """
        try:
            ray = importlib.import_module("ray")
        except ImportError:
            raise GavoError("--executor ray needs Ray: pip install 'gavo-jax[ray]'") from None
        self._ray = ray
        self._started = not ray.is_initialized()
        if self._started:
            try:
                ray.init(log_to_driver=False, configure_logging=False, include_dashboard=False)
            except (ConnectionError, RuntimeError, ValueError) as error:
                raise GavoError(f"--executor ray: no cluster: {line_of(error)}") from None
        self._wanted = self._fitting(options)
        folder = cache_folder()  # on each node, it holds the programs compiled for that kind of processor
        try:
            self._task = ray.remote(_run_cached).options(
                num_cpus=self._wanted["CPU"],
                num_gpus=self._wanted["GPU"],
                max_retries=self.RETRIES,
                runtime_env={"env_vars": {} if folder is None else {"GAVO_CACHE_DIR": str(folder)}},
            )
        except ValueError as error:
            raise GavoError(f"--executor ray: {line_of(error)}") from None

    def slots(self) -> int:
        """Return how many batches the nodes' processors and GPUs can run at the same time."""
        wanted = {name: amount for name, amount in self._wanted.items() if amount}
        each = [min((node.get(name, 0.0) // n for name, n in wanted.items()), default=1) for node in self._nodes()]
        return max(1, int(sum(each)))

    def run(self, experiment: str, batches: Sequence[Batch], on_pairs: Callable[[int], None]) -> Iterator[Outcome]:
        """Submit all batches to the cluster and yield their outcomes in order of completion."""
        ray = self._ray
        waiting = {self._task.remote(experiment, batch): batch for batch in batches}
        try:
            while waiting:
                ready, _ = ray.wait(list(waiting), num_returns=1, timeout=1.0)
                for reference in ready:
                    batch = waiting.pop(reference)
                    try:
                        outcome = ray.get(reference)
                    except ray.exceptions.RayError as error:
                        outcome = Outcome(batch, (), line_of(error))
                    on_pairs(sum(run.pairs for run in batch.runs))
                    yield outcome
        finally:
            for reference in waiting:
                ray.cancel(reference, force=True)

    def close(self) -> None:
        """Shut the cluster down if it was started here."""
        if self._started:
            self._ray.shutdown()

    def _nodes(self) -> list[dict[str, float]]:
        """Return what each node has in all: a batch runs on one of them."""
        return [node["Resources"] for node in self._ray.nodes() if node["Alive"]]

    def _fitting(self, options: RayOptions) -> dict[str, float]:
        """Return what a batch takes: of processors at most those of one node; too few GPUs are a fault."""
        nodes = [(node.get("CPU", 0.0), node.get("GPU", 0.0)) for node in self._nodes()]
        most = max((gpus for _, gpus in nodes), default=0.0)
        wanted = options.gpus if options.gpus is not None else min(1.0, most)
        if wanted > most:
            raise GavoError(
                f"--executor ray: a batch takes {wanted:g} GPU, but no node of the cluster has more than {most:g}"
            )
        processors = min(options.cpus, max((cpus for cpus, gpus in nodes if gpus >= wanted), default=0.0))
        if not processors and options.cpus:
            raise GavoError(f"--executor ray: a batch takes {options.cpus:g} CPU, the nodes that it fits have none")
        return {"CPU": processors, "GPU": wanted}


def _run_cached(experiment: str, batch: Batch) -> Outcome:
    """Call `run_batch` in a worker process, with the compilation cache for its kind of processor."""
    enable_compilation_cache()
    return run_batch(experiment, batch)


def run_batch(experiment: str, batch: Batch, on_pairs: Callable[[int], None] | None = None) -> Outcome:
    """Run a batch on this process's device.

    Args:
        experiment: Name of the experiment, written to the rows.
        batch: Runs of one program over the same frames.
        on_pairs: Called with the number of pairs just done.

    Returns:
        One row of the results table per run, or the fault if the input is bad.
    """
    try:
        sequence = batch.part.open()
        settings = batch.runs[0].settings
        if settings is not None and settings.odometry.loops:
            return Outcome(batch, (_mapped(experiment, batch, sequence, settings, on_pairs),))
        tracker = _Tracker(batch, sequence)
        compile_seconds = tracker.warm_up()
        stopwatch = Stopwatch()
        steps = tracker.track(on_pairs)
        seconds, compile_seconds = stopwatch.seconds / len(batch.runs), compile_seconds + stopwatch.waited
        first = float(sequence.timestamps[0])
        rows, frames = [], frames_of(batch.part.name, sequence)
        for run, own in zip(batch.runs, steps, strict=True):
            truth = sequence.ground_truth
            metrics = compute_metrics(trajectory_of(first, own), truth, own, seconds, compile_seconds)
            rows.append(_row(experiment, batch, run, frames, metrics))
    except GavoError as error:
        return Outcome(batch, (), str(error))
    return Outcome(batch, tuple(rows))


def _mapped(
    experiment: str, batch: Batch, sequence: FrameSequence, settings: Settings, on_pairs: Callable[[int], None] | None
) -> Row:
    """The row of a run with a map, the only one in its batch: its metrics are those of the corrected trajectory."""
    (run,) = batch.runs

    def on_step(_: Step) -> None:
        if on_pairs is not None:
            on_pairs(1)

    metrics = run_odometry(sequence, settings, seed=run.seed or 0, on_step=on_step).metrics
    own: Any = {name: metrics[name] for name in Metrics.__annotations__}
    return _row(experiment, batch, run, frames_of(run.part.name, sequence), own)


class _Tracker:
    """Tracks a batch's frames by all its runs: on an accelerator, stacked into one call per frame."""

    def __init__(self, batch: Batch, sequence: FrameSequence) -> None:
        self._sequence, self._runs = sequence, batch.runs
        self._stacked = jax.default_backend() != "cpu" and batch.runs[0].settings is not None

    def warm_up(self) -> float:
        """Compile the program and return the seconds this took."""
        if not self._stacked:
            return _odometry(self._runs[0], self._sequence).warm_up()
        start = time.perf_counter()
        self._track(self._sequence[:2], None)
        return time.perf_counter() - start

    def track(self, on_pairs: Callable[[int], None] | None) -> list[list[Step]]:
        """Track all frames and return the steps of each run."""
        frames = iter(range(len(self._sequence)))

        def on_frame() -> None:
            if on_pairs is not None and next(frames) > 0:
                on_pairs(len(self._runs))

        return self._track(self._sequence, on_frame)

    def _track(self, sequence: FrameSequence, on_frame: Callable[[], None] | None) -> list[list[Step]]:
        settings = [run.settings for run in self._runs if run.settings is not None]
        if self._stacked:
            return track_stacked(sequence, settings, [run.seed or 0 for run in self._runs], on_frame)
        return track_together(sequence, [_odometry(run, sequence) for run in self._runs], on_frame)


def _odometry(run: Run, sequence: FrameSequence) -> Odometry:
    if run.settings is None:
        return peer_odometry(run.method, sequence.camera)
    return Odometry(sequence.camera, run.settings, seed=run.seed or 0)


def _row(experiment: str, batch: Batch, run: Run, frames: Mapping[str, Any], metrics: Metrics) -> Row:
    commit, modified = git_state()
    return {
        "run": run.id,
        "experiment": experiment,
        "sequence": run.part.name,
        "method": run.method,
        "preset": run.preset,
        "variant": run.variant,
        "label": run.label,
        "seed": run.seed,
        **metrics,
        "runs_together": len(batch.runs),
        "pixels": run.pixels,
        "configuration": configuration(run, frames),
        "versions": environment() | _peer_versions(run, frames["camera"]),
        "git_commit": commit,
        "git_modified": modified,
        "host": platform.node(),
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _peer_versions(run: Run, camera: Camera) -> dict[str, str]:
    return dict(make_peer(run.method, camera).versions) if run.settings is None else {}


@cache
def git_state() -> tuple[str | None, bool | None]:
    """Commit of the checkout this package is imported from, and whether it has changes; None outside a checkout."""
    folder = Path(__file__).parent

    def git(*arguments: str) -> str | None:
        try:
            done = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, timeout=20)
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    if git("ls-files", "--error-unmatch", "__init__.py") is None:
        return None, None
    commit, changes = git("rev-parse", "HEAD"), git("status", "--porcelain", "--untracked-files=no")
    return commit, None if changes is None else bool(changes)
