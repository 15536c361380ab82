"""Writes the figures of a run if matplotlib is installed."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gavo_jax.alignment.visits import visited_levels
from gavo_jax.datasets.base import FrameError, Sequence, index_at
from gavo_jax.errors import GavoError
from gavo_jax.evaluation import distance_error
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.output import plots
from gavo_jax.output.landscape import Landscape, error_landscape
from gavo_jax.output.report import Picture
from gavo_jax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw(
    folder: Path, estimates: Mapping[str, Trajectory], truth: Trajectory | None, ours: Collection[str] = ()
) -> list[Picture]:
    """Write figures of named trajectories and, with a ground truth, of their errors, if matplotlib is installed.

    Args:
        folder: Folder for the files.
        estimates: The trajectories.
        truth: The true trajectory, or None.
        ours: Names drawn in colour, the others in grey; if empty, all are in colour.

    Raises:
        GavoError: A figure cannot be written.
    """
    if not plots.available():
        return []
    pictures = [save_figure(plots.plot_trajectories(estimates, truth, ours), folder, "trajectory")]
    if truth is None:
        return pictures
    try:
        errors = {name: distance_error(estimate, truth) for name, estimate in estimates.items()}
    except GavoError:
        return pictures
    return [*pictures, save_figure(plots.plot_distance_error(errors, ours), folder, "distance_error")]


def draw_search(folder: Path, sequence: Sequence, odometry: Odometry, steps: list[Step]) -> None:
    """Write the figures of the search if matplotlib is installed: convergence, last population, landscape.

    Raises:
        GavoError: A figure cannot be written.
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
    middle = good[len(good) // 2]
    landscape = _landscape_of(sequence, odometry, middle)
    if landscape is not None:
        pair = f"frames {_reference_of(sequence, middle)} and {middle.index}, the middle pair of the run"
        save_figure(plots.plot_landscape(landscape, pair, _beside_the_pair(odometry)), folder, "landscape")


def _beside_the_pair(odometry: Odometry) -> list[str]:
    """Name what a run's motions depend on besides the two images of a pair."""
    options = odometry.settings.odometry
    keyframe = ["a keyframe"] if options.reference == "keyframe" else []
    shutter = ["the shutter's readout"] if options.rolling_shutter and odometry.camera.readout else []
    return keyframe + shutter


def _reference_of(sequence: Sequence, step: Step) -> int:
    """The index of the frame that a step's frame was aligned with."""
    return index_at(sequence.timestamps, step.reference_timestamp)


def _landscape_of(sequence: Sequence, odometry: Odometry, step: Step) -> Landscape | None:
    """Return E around the motion of a step at the coarsest and the finest level; None if a frame is unreadable."""
    settings = odometry.settings
    levels = dict.fromkeys((settings.solver.levels[0], settings.solver.levels[-1]))
    try:
        frames = sequence[_reference_of(sequence, step)].copied(), sequence[step.index]
    except FrameError:
        return None
    return error_landscape(*frames, odometry.camera, step.alignment, settings.alignment, tuple(levels))


def save_figure(figure: Figure, folder: Path, name: str) -> Picture:
    """Write a figure as NAME.png and NAME.svg, and return the latter for a report.

    Raises:
        GavoError: A file cannot be written.
    """
    _, vector = plots.save(figure, folder, name)
    return Picture(" ".join(figure.get_supxlabel().split()), vector)
