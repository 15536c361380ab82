"""A sequence through a driver under the eyes of a user, who may stop it with Ctrl-C."""

import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from gavo_jax import plots
from gavo_jax.alignment import visited_levels
from gavo_jax.cli.screen import pair_progress
from gavo_jax.datasets.base import Frame, FrameError, Sequence
from gavo_jax.errors import GavoError
from gavo_jax.evaluation import distance_error
from gavo_jax.landscape import error_landscape
from gavo_jax.odometry.driver import Odometry, Step, track
from gavo_jax.odometry.run import compute_metrics, trajectory_of
from gavo_jax.report import Picture
from gavo_jax.trajectory import Trajectory
from gavo_jax.viewer import NO_VIEWER, Viewer

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
    label: str,
    sequence: Sequence,
    odometry: Odometry,
    on_step: Callable[[Step], None] | None = None,
    viewer: Viewer = NO_VIEWER,
) -> Tracked:
    """Compile, then track every frame, from where the driver stands, under a progress bar and before a viewer's eyes.

    Raises:
        KeyboardInterrupt: the user stopped it before the first pair was done.
    """
    pairs, done = len(sequence) - 1, max(odometry.progress.last_index, 0)
    steps: list[Step] = []
    interrupted = False

    def watch(frame: Frame | None, step: Step | None) -> None:
        viewer.watch(frame, step, odometry.candidates)

    with pair_progress(label, pairs, done) as bar:
        compile_seconds = odometry.warm_up()
        start = time.perf_counter()
        try:
            for step in track(sequence, odometry=odometry, watch=watch):
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


def draw(folder: Path, estimates: Mapping[str, Trajectory], truth: Trajectory | None) -> list[Picture]:
    """Write the figures of named trajectories, where matplotlib is installed; errors where there is a truth.

    Raises:
        GavoError: a figure cannot be written.
    """
    if not plots.available():
        return []
    pictures = [save_figure(plots.plot_trajectories(estimates, truth), folder, "trajectory")]
    if truth is None:
        return pictures
    try:
        errors = {name: distance_error(estimate, truth) for name, estimate in estimates.items()}
    except GavoError:
        return pictures
    return [*pictures, save_figure(plots.plot_distance_error(errors), folder, "distance_error")]


def draw_search(folder: Path, sequence: Sequence, odometry: Odometry, steps: list[Step]) -> None:
    """Write the figures of the search, where matplotlib is installed: convergence, landscape, last population.

    Raises:
        GavoError: a figure cannot be written.
    """
    good = [step for step in steps if not step.lost]
    if not plots.available() or not good:
        return
    settings = odometry.settings
    solver = settings.solver
    visits = visited_levels(solver.levels, settings.alignment)
    widths = [solver.iterations[level] for level in visits]
    whole = [step.alignment.history for step in good if len(step.alignment.history) == sum(widths)]
    if whole:
        parts = np.split(np.stack(whole), np.cumsum(widths)[:-1], axis=1)
        histories = dict(zip(visits, parts, strict=True))
        save_figure(plots.plot_convergence(histories), folder, "convergence")
    if odometry.candidates:
        trimmed = [population.trimmed() for population in odometry.candidates]
        errors = {int(population.level): np.asarray(population.error) for population in trimmed}
        save_figure(plots.plot_population(errors), folder, "population")
    landscape = _landscape_of(sequence, odometry, good[len(good) // 2])
    if landscape is not None:
        save_figure(plots.plot_landscape(landscape), folder, "landscape")


def _landscape_of(sequence: Sequence, odometry: Odometry, step: Step) -> plots.Landscape | None:
    """Return E around the motion of a step at the coarsest and the finest level; None where a frame is unreadable."""
    reference = int(np.searchsorted(sequence.timestamps, step.reference_timestamp))
    settings = odometry.settings
    levels = dict.fromkeys((settings.solver.levels[0], settings.solver.levels[-1]))
    try:
        frames = sequence[reference], sequence[step.index]
    except FrameError:
        return None
    return error_landscape(*frames, odometry.camera, step.alignment, settings.alignment, tuple(levels))


def save_figure(figure: "Figure", folder: Path, name: str) -> Picture:
    """Write a figure as NAME.png and NAME.svg, and return it as a report takes it.

    Raises:
        GavoError: a file cannot be written.
    """
    _, vector = plots.save(figure, folder, name)
    return Picture(plots.CAPTIONS[name], vector)
