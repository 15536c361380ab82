"""Figures of trajectories, their errors, convergence, populations, landscapes of E, basins and drift, as PNG and SVG.

Each `plot_` function draws one figure from arrays and returns it, with a caption that defines what is measured; `save`
writes it.
"""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Collection, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from gavo_jax.errors import write_bytes
from gavo_jax.evaluation import ErrorSeries, quantiles_of
from gavo_jax.output.figure_parts import (
    COLORS,
    add_legend,
    draw_band,
    draw_scale,
    label_ends,
    marks,
    new_figure,
    number_frames,
    panels_of,
    shown_name,
    styles,
    unit_of,
)
from gavo_jax.trajectory import Trajectory, inverse

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from gavo_jax.output.landscape import Landscape

FORMATS = ("png", "svg")
TRUTH_STYLE = {"color": "black", "linewidth": 2.5, "alpha": 0.45, "label": "ground truth"}


def available() -> bool:
    """Whether matplotlib is installed."""
    return importlib.util.find_spec("matplotlib") is not None


SMALLEST_EXCESS = 1e-3
"""Smallest excess drawn, per cent; smaller ones are drawn as this."""
PANEL_WIDTH = 2.5
"""Width of a level's panel, inches."""

CAPTIONS = {
    "trajectory": "Camera positions in the frame of the first camera; the square is the start.",
    "distance_error": "Distance error of each frame: distance between the estimated and the true position of the "
    "camera, both relative to the first pose; the truth is interpolated at the frames' stamps.",
    "drift": "Drift: relative pose error over 1 s, root mean square (TUM evaluate_rpe.py, fixed delta). Blue: this "
    "project's methods; hatched: other libraries.",
    "convergence": "By how many per cent the best error E so far exceeds the last one of its level, over the "
    "iterations of each level, from coarse to fine. What is below "
    f"{SMALLEST_EXCESS:g} % is drawn at {SMALLEST_EXCESS:g} %.",
    "population": "Root of E over the iterations of each level's search of the run's last pair: best and median of the "
    "population, and the range of its middle 80 %. Levels from coarse to fine; their errors are not comparable.",
    "landscape": "Root of E around the motion that was found, along the eigenvectors of its covariance with the "
    "largest and the smallest variance: translation v and rotation w, in the axes of the reference camera.",
    "basin": "Share of frame pairs whose motion is found from a zero guess to within 5 cm and 3 deg, over the median "
    "rotation between the frames of a pair.",
}
"""Caption of each figure by the name of its files."""
WITH_TRUTH = (
    " Ground truth: interpolated at the frames' stamps, laid on the first estimate at its first pose that the "
    "ground truth covers."
)
"""End of the trajectories' caption if there is a ground truth."""
GAPS = " Gaps: too little of the view is left."
"""End of the landscape's caption if there are gaps."""
SEVERAL_RUNS = " Bars: median over the runs; whiskers: smallest and largest."
"""End of the drift's caption if there are several runs."""
MORE_THAN_THE_PAIR = " The motion was found with {}, too: the minimum of this pair alone may lie millimetres away."
"""End of the landscape's caption if more than the pair's images determined the motion."""


def plot_distance_error(errors: Mapping[str, ErrorSeries], ours: Collection[str] = ()) -> Figure:
    """Draw the distance error of each named run over time and frames, as in the paper's figures 5 and 9.

    Args:
        errors: Errors by the run's name.
        ours: Names drawn in colour, the others in grey; if empty, all are in colour.
    """
    figure = new_figure(7.0 if len(errors) == 1 else 8.0, 4.4, CAPTIONS["distance_error"])
    axes = figure.add_subplot()
    stamps = np.unique(np.concatenate([series.timestamps for series in errors.values()])) - min(
        series.timestamps[0] for series in errors.values()
    )
    scale, unit = unit_of(max(float(np.max(series.values)) for series in errors.values()))
    for (name, series), style in zip(errors.items(), styles(errors, ours), strict=True):
        seconds = series.timestamps - series.timestamps[0] + stamps[0]
        axes.plot(
            seconds,
            scale * series.values,
            label=shown_name(name),
            clip_on=False,
            **style,
            markevery=marks(len(series.values)),
        )
    axes.set(xlabel="time (s)", ylabel=f"distance error ({unit})", ylim=(0, None))
    axes.margins(x=0)
    if len(stamps) > 1:
        number_frames(axes, stamps)
    axes.grid(alpha=0.3)
    label_ends(axes)
    return figure


def plot_trajectories(
    estimates: Mapping[str, Trajectory], truth: Trajectory | None, ours: Collection[str] = ()
) -> Figure:
    """Draw each named trajectory from above and from the side, in the frame of its first camera (x right, z forward).

    The side view looks along z or, if the paths extend further along z than along x, along x. Both panels have the
    same scale. The truth is interpolated at those timestamps of the first estimate that it covers; its first such pose
    is aligned to that estimate's.

    Args:
        estimates: The trajectories.
        truth: The true trajectory, or None.
        ours: Names drawn in colour, the others in grey; if empty, all are in colour.
    """
    true_path = None if truth is None else _true_path(next(iter(estimates.values())), truth)
    paths = {name: _path(estimate) for name, estimate in estimates.items()}
    shown = np.concatenate([*paths.values(), *([] if true_path is None else [true_path])]) * UPWARDS
    low, high = np.nanmin(shown, axis=0), np.nanmax(shown, axis=0)
    scale, unit = unit_of(float(np.max(high - low)))
    across = 0 if high[0] - low[0] >= high[2] - low[2] else 2
    views = ((0, 2), (across, 1))
    half = _half_widths(high - low, views)
    figure = new_figure(
        8.5, 3.5 * half[1] / half[0] + 1.7, CAPTIONS["trajectory"] + ("" if true_path is None else WITH_TRUTH)
    )
    titles = ("From above", "From behind" if across == 0 else "From the right")
    for axes, (i, j), title in zip(figure.subplots(1, 2), views, titles, strict=True):
        if true_path is not None:
            axes.plot(*(scale * UPWARDS * true_path).T[[i, j]], **TRUTH_STYLE)
        for (name, path), style in zip(paths.items(), styles(paths, ours), strict=True):
            axes.plot(*(scale * UPWARDS * path).T[[i, j]], label=shown_name(name), **style, markevery=marks(len(path)))
        axes.scatter([0], [0], marker="s", color="black", s=30, zorder=3)
        axes.annotate("start", (0, 0), (0, -14), bbox=HALO, textcoords="offset points", ha="center", fontsize="small")
        middle = scale * (low + high)[[i, j]] / 2
        axes.set(xlabel=f"{AXES[i]} ({unit})", ylabel=f"{AXES[j]} ({unit})", title=title, aspect="equal")
        axes.set(xlim=middle[0] + scale * half[0] * SIDES, ylim=middle[1] + scale * half[1] * SIDES)
        axes.locator_params(nbins=5)
        axes.grid(alpha=0.3)
        if unit == "mm":
            draw_scale(axes, unit)
    add_legend(figure)
    return figure


UPWARDS = np.array([1.0, -1.0, 1.0])
"""Factors from camera axes, y downwards, to those drawn, y upwards."""
AXES = ("x, right", "−y, up", "z, forward")
SIDES = np.array([-1.0, 1.0])
HALO = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5}
MARGIN = 1.3
"""Sides of a panel over those of its content; a start at an edge has room for its label."""


def _half_widths(extent: Float[np.ndarray, " 3"], views: Sequence[tuple[int, int]]) -> Float[np.ndarray, " 2"]:
    """Half the width and height of panels of one scale that hold each view; width over height is 0.7 to 2."""
    wide, high = (max(float(extent[view[k]]) for view in views) for k in (0, 1))
    wide = max(wide, 0.7 * high, 1e-3)
    return 0.5 * MARGIN * np.array([wide, max(high, 0.5 * wide)])


def _path(trajectory: Trajectory) -> Float[np.ndarray, "m 3"]:
    """Positions in the first camera's frame, with a row of NaN between two segments, where the line breaks."""
    positions = (inverse(trajectory.world_T_camera[0]) @ trajectory.world_T_camera)[:, :3, 3]
    return np.insert(positions, np.flatnonzero(np.diff(trajectory.segments)) + 1, np.nan, axis=0)


def plot_convergence(histories: Mapping[int, Float[np.ndarray, "pairs iterations"]]) -> Figure:
    """Draw how the best error falls within each level, over the pairs of a run.

    Args:
        histories: Best E so far after every iteration, by level in the order of the search. NaN after a search has
            ended; its last error is used there.
    """
    figure = new_figure(PANEL_WIDTH * len(histories), 3.8, CAPTIONS["convergence"])
    panels = panels_of(figure, len(histories), one_scale=True)
    for axes, (level, history) in zip(panels, histories.items(), strict=True):
        error = _carry_on(history)
        end = np.where(np.isfinite(error[:, -1:]), error[:, -1:], np.nan)  # infinite if a search found nothing valid
        excess = 100.0 * (error[:, :-1] / np.maximum(end, 1e-12) - 1.0)
        iterations = np.arange(1, excess.shape[1] + 1)
        draw_band(
            axes, iterations, np.maximum(excess, SMALLEST_EXCESS), "median of the pairs", "middle 80 % of the pairs"
        )
        axes.set(title=f"level {level}", xlabel="iteration", yscale="log")
        axes.minorticks_off()
        axes.yaxis.set_major_formatter(_excess)
    figure.axes[0].set_ylabel("excess of E (%)")
    add_legend(figure)
    return figure


def _excess(value: float, _: int) -> str:
    """Return a tick's label; the smallest has a ≤, as smaller values are drawn there."""
    return f"≤ {value:g}" if value <= SMALLEST_EXCESS else f"{value:g}"


def plot_population(errors: Mapping[int, Float[np.ndarray, "iterations p"]]) -> Figure:
    """Draw how the errors of a population fall within each level of one pair's search.

    Args:
        errors: E of every candidate after every iteration, by level in the order of the search. Rows are NaN after
            the search has ended; invalid candidates are +inf.
    """
    figure = new_figure(PANEL_WIDTH * len(errors), 3.8, CAPTIONS["population"])
    for axes, (level, error) in zip(panels_of(figure, len(errors)), errors.items(), strict=True):
        error = error[~np.isnan(error).all(axis=1)]
        rmse = np.sqrt(np.where(np.isfinite(error), error, np.nan))
        iterations = np.arange(1, len(rmse) + 1)
        draw_band(axes, iterations, rmse.T, "median", "middle 80 %")
        best = np.min(np.where(np.isnan(rmse), np.inf, rmse), axis=1)
        axes.plot(
            iterations,
            np.where(np.isfinite(best), best, np.nan),
            color=COLORS[1],
            linestyle="--",
            marker="s",
            label="best",
        )
        axes.set_title(f"level {level}, {error.shape[1]} candidates", fontsize="medium")
        axes.set(xlabel="iteration")
    figure.axes[0].set_ylabel("√E (grey levels)")
    add_legend(figure)
    return figure


def plot_landscape(landscape: Landscape, pair: str = "", more: Sequence[str] = ()) -> Figure:
    """Draw the error around the optimum along the worst- and the best-conditioned direction, level by level.

    Args:
        landscape: The errors.
        pair: Names of the two frames, for the title.
        more: What else the motion was found with, for the caption.
    """
    has_gaps = not all(np.isfinite(errors).all() for errors in landscape.errors.values())
    found_with = MORE_THAN_THE_PAIR.format(" and ".join(more)) if more else ""
    figure = new_figure(8.0, 4.8, CAPTIONS["landscape"] + GAPS * has_gaps + found_with)
    figure.suptitle(pair, fontsize="medium")
    titles = ("worst-conditioned direction", "best-conditioned direction")
    for i, (axes, title) in enumerate(zip(panels_of(figure, 2), titles, strict=True)):
        axes.axvline(0, color="black", linewidth=0.8, linestyle=":", label="motion found")
        for (level, errors), style in zip(landscape.errors.items(), styles(landscape.errors), strict=True):
            style |= {"linewidth": 1.5}
            rmse = np.sqrt(np.where(np.isfinite(errors[i]), errors[i], np.nan))
            axes.plot(landscape.steps * 1e3, rmse, label=f"level {level}", **style, markevery=marks(len(rmse)))
        v, w = (", ".join(f"{value:.2f}" for value in half) for half in np.split(landscape.directions[i], 2))
        step = f"step s, with v = s ({v}) mm\nand w = s ({w}) mrad".replace("-", "−")
        axes.set(title=title, xlabel=step, ylim=(0, None))
    figure.axes[0].set_ylabel("√E (grey levels)")
    figure.axes[0].legend(fontsize="small")
    return figure


def plot_basin(
    motion: Float[np.ndarray, " n"],
    success: Mapping[str, Float[np.ndarray, " n"]],
    title: str,
    ours: Collection[str] = (),
) -> Figure:
    """Draw how often each method finds a motion over the size of the motion.

    Args:
        motion: Median rotation of the pairs, degrees, in any order.
        success: Share of the pairs found, by method; NaN where a method was not tried.
        title: Origin of the pairs.
        ours: Names drawn in colour, the others in grey; if empty, all are in colour.
    """
    figure = new_figure(9.0, 4.6, CAPTIONS["basin"])
    axes = figure.add_subplot()
    order = np.argsort(motion)
    for (name, rates), style in zip(success.items(), styles(success, ours), strict=True):
        tried = [i for i in order if np.isfinite(rates[i])]
        axes.plot(motion[tried], rates[tried], label=shown_name(name), **style)
    axes.set(xlabel="median rotation of the pairs (deg)", ylabel="share of pairs found", title=title)
    axes.set(ylim=(-0.03, 1.03), xlim=(0, 1.02 * float(np.max(motion))))
    axes.grid(alpha=0.3)
    label_ends(axes)
    return figure


def plot_drift(clips: Mapping[str, Mapping[str, Float[np.ndarray, "runs 2"]]], ours: Collection[str]) -> Figure:
    """Draw the drift of every method on every clip as bars, other libraries' hatched.

    Args:
        clips: Drift in translation (m/s) and rotation (deg/s) of every run, by clip and method; +inf for a run without,
            of a camera that was lost.
        ours: Names of the project's own methods.
    """
    rows = max(len(methods) for methods in clips.values())
    several = any(len(runs) > 1 for methods in clips.values() for runs in methods.values())
    figure = new_figure(
        9.0, (0.9 + 0.2 * rows) * len(clips) + 0.6, CAPTIONS["drift"] + (SEVERAL_RUNS if several else "")
    )
    panels = figure.subplots(len(clips), 2, squeeze=False)
    for (clip, methods), pair in zip(clips.items(), panels, strict=True):
        for column, (axes, label) in enumerate(zip(pair, ("translation (m/s)", "rotation (deg/s)"), strict=True)):
            all_values = np.concatenate([runs[:, column] for runs in methods.values()])
            decimals = _decimals(all_values[np.isfinite(all_values)], (4, 2)[column])
            for place, (name, runs) in enumerate(methods.items()):
                values = runs[np.isfinite(runs[:, column]), column]
                lost = len(runs) - len(values)
                (middle,) = quantiles_of(runs[:, column], [0.5])
                if not np.isfinite(middle):
                    axes.annotate(f" no drift in {lost} of {len(runs)}", (0, place), va="center", fontsize=7)
                    continue
                mine = {"color": COLORS[0], "edgecolor": "black"}
                style = mine if name in ours else {"color": "#E4E4E4", "edgecolor": "#808080", "hatch": "//"}
                spread = [[middle - values.min()], [values.max() - middle]] if len(values) > 1 else None
                axes.barh(place, middle, xerr=spread, linewidth=0.5, capsize=2, **style)
                without = f", none in {lost} of {len(runs)}" if lost else ""
                axes.annotate(f" {middle:.{decimals}f}{without}", (values.max(), place), va="center", fontsize=7)
            names = [shown_name(name) for name in methods] if column == 0 else [""] * len(methods)
            axes.set_yticks(range(len(methods)), names, fontsize="small")
            axes.invert_yaxis()
            axes.margins(x=0.15)
            axes.set(xlabel=label, title=shown_name(clip))
            axes.grid(alpha=0.3, axis="x")
            axes.locator_params(axis="x", nbins=6)
            axes.set_axisbelow(True)
    return figure


def _decimals(values: Float[np.ndarray, " n"], least: int) -> int:
    """Number of decimals, at least `least`, that gives the smallest positive value two significant digits."""
    smallest = float(np.min(values[values > 0], initial=1.0))
    return max(least, 1 - int(np.floor(np.log10(smallest))))


def save(figure: Figure, folder: str | Path, name: str) -> list[Path]:
    """Write a figure as NAME.png and NAME.svg (`FORMATS`), each atomically, into a folder and return their paths.

    Raises:
        GavoError: A file cannot be written.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    def draw_png(data: BytesIO) -> None:
        FigureCanvasAgg(figure).print_png(data, pil_kwargs={"optimize": True})

    def draw_svg(data: BytesIO) -> None:
        with rc_context({"svg.hashsalt": name}):  # otherwise its ids are random
            FigureCanvasSVG(figure).print_svg(data, metadata={"Date": None})

    # `savefig` would draw twice for each file and repeat the layout, which takes most of the time
    figure.set_dpi(120)
    paths = []
    for suffix, draw in zip(FORMATS, (draw_png, draw_svg), strict=True):
        path, data = Path(folder) / f"{name}.{suffix}", BytesIO()
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Glyph .* missing")  # a name in a script that the font lacks
            draw(data)
        write_bytes(path, data.getvalue())
        figure.set_layout_engine("none")
        paths.append(path)
    return paths


def _carry_on(history: Float[np.ndarray, "pairs iterations"]) -> Float[np.ndarray, "pairs iterations"]:
    """Return the history with NaN replaced by the last value before it."""
    last = np.maximum.accumulate(np.where(np.isnan(history), 0, np.arange(history.shape[1])), axis=1)
    return np.take_along_axis(history, last, axis=1)


def _true_path(estimate: Trajectory, truth: Trajectory) -> Float[np.ndarray, "n 3"] | None:
    """Return true positions at the estimate's timestamps, in its first camera's frame; None if there are none."""
    world_T_camera, valid = truth.interpolate(estimate.timestamps)
    if not valid.any():
        return None
    true, first = world_T_camera[valid], estimate.world_T_camera[valid][0]
    first_camera_T_start = inverse(estimate.world_T_camera[0]) @ first
    return (first_camera_T_start @ inverse(true[0]) @ true)[:, :3, 3]
