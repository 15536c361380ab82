"""A sequence through a driver under the eyes of a user, who may stop it with Ctrl-C."""

import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from gavo_jax import plots
from gavo_jax.cli.screen import pair_progress
from gavo_jax.datasets.base import Sequence
from gavo_jax.errors import GavoError
from gavo_jax.evaluation import distance_error
from gavo_jax.odometry import Odometry, Step, compute_metrics, track, trajectory_of
from gavo_jax.results import DISTANCE_FIGURE, TRAJECTORY_FIGURE
from gavo_jax.trajectory import Trajectory

INTERRUPTED = 130
"""Exit status after Ctrl-C."""


class Tracked(NamedTuple):
    """What came of a sequence; where the user stopped it, up to there."""

    trajectory: Trajectory
    steps: list[Step]
    metrics: dict[str, Any]
    """`odometry.compute_metrics`."""
    interrupted: bool


def track_visibly(
    label: str, sequence: Sequence, odometry: Odometry, on_step: Callable[[Step], None] | None = None
) -> Tracked:
    """Compile, then track every frame, from where the driver stands, under a progress bar.

    Raises:
        KeyboardInterrupt: the user stopped it before the first pair was done.
    """
    pairs, done = len(sequence) - 1, max(odometry.progress.last_index, 0)
    steps: list[Step] = []
    interrupted = False
    with pair_progress(label, pairs, done) as bar:
        compile_seconds = odometry.warm_up()
        start = time.perf_counter()
        try:
            for step in track(sequence, odometry=odometry):
                if on_step is not None:
                    on_step(step)
                steps.append(step)
                bar.advance()
        except KeyboardInterrupt:
            if not steps:
                raise
            interrupted = True
        seconds = time.perf_counter() - start
    if interrupted:
        print(f"gavo: {label}: interrupted after {done + len(steps)} of {pairs} pairs", file=sys.stderr)
    trajectory = trajectory_of(float(sequence.timestamps[0]), steps)
    metrics = compute_metrics(trajectory, sequence.ground_truth, steps, seconds, compile_seconds)
    return Tracked(trajectory, steps, metrics, interrupted)


def draw(folder: Path, estimates: Mapping[str, Trajectory], truth: Trajectory | None) -> None:
    """Write the figures of named trajectories, where matplotlib is installed; errors where there is a truth.

    Raises:
        GavoError: a figure cannot be written.
    """
    if not plots.available():
        return
    plots.save(plots.plot_trajectories(estimates, truth), folder, TRAJECTORY_FIGURE)
    if truth is None:
        return
    try:
        errors = {name: distance_error(estimate, truth) for name, estimate in estimates.items()}
    except GavoError:
        return
    plots.save(plots.plot_distance_error(errors), folder, DISTANCE_FIGURE)
