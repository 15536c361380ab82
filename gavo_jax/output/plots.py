"""Figures as files: trajectories and their errors, convergence, the error's landscape, basins and drift; PNG and SVG.

Every function draws one figure from arrays and returns it, with a caption that defines what is measured; `save` writes
it. Colours are ones that colour-blind people tell apart; line styles, markers and hatches tell the curves and bars
apart without colour. Where some methods are called ours, the others are grey.
"""

from __future__ import annotations

import importlib.util
import textwrap
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from io import BytesIO
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from gavo_jax.errors import printable, write_bytes
from gavo_jax.evaluation import ErrorSeries
from gavo_jax.trajectory import Trajectory, inverse

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from gavo_jax.output.landscape import Landscape

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#882255", "#8C7A1F")
"""Of Okabe and Ito; the last two, of Tol's scheme, take the place of their yellow and black."""
GREYS = (0.3, 0.6)
"""Of other libraries' curves, the darkest and the lightest."""
LINES = ("-", "--", "-.", ":")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">")
FORMATS = ("png", "svg")
TRUTH_STYLE = {"color": "black", "linewidth": 2.5, "alpha": 0.45, "label": "ground truth"}


def available() -> bool:
    """Whether matplotlib is installed."""
    return importlib.util.find_spec("matplotlib") is not None


SMALLEST_EXCESS = 1e-3
"""Per cent; a smaller excess is drawn as this."""
CAPTION_WIDTH, CAPTION_SIZE = 15, 8.5
"""Letters of a caption an inch of the figure, and their size in points: read where a page shows the figure smaller."""
PANEL_WIDTH = 2.5
"""Inches, where each level has a panel."""

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
"""By the name of the figure's files."""
WITH_TRUTH = (
    " Ground truth: interpolated at the frames' stamps, laid on the first estimate at its first pose that the "
    "ground truth covers."
)
"""Of the trajectories' caption."""
GAPS = " Gaps: too little of the view is left."
"""Of the landscape's caption, where there are any."""
SEVERAL_RUNS = " Bars: median over the runs; whiskers: smallest and largest."
"""Of the drift's caption."""
MORE_THAN_THE_PAIR = " The motion was found with {}, too: the minimum of this pair alone may lie millimetres away."
"""Of the landscape's caption."""
SMALL = 0.1
"""Metres: what is smaller is drawn in millimetres."""


def plot_distance_error(errors: Mapping[str, ErrorSeries], ours: Collection[str] = ()) -> Figure:
    """Draw the distance error of each named run over time and frames, as the paper's figures 5 and 9.

    Args:
        errors: of each run.
        ours: runs in colour; the others are grey. All of them where none is named.
    """
    figure = _figure(7.0 if len(errors) == 1 else 8.0, 4.4, "distance_error")
    axes = figure.add_subplot()
    stamps = np.unique(np.concatenate([series.timestamps for series in errors.values()])) - min(
        series.timestamps[0] for series in errors.values()
    )
    scale, unit = _unit(max(float(np.max(series.values)) for series in errors.values()))
    for (name, series), style in zip(errors.items(), _styles(errors, ours), strict=True):
        seconds = series.timestamps - series.timestamps[0] + stamps[0]
        axes.plot(
            seconds,
            scale * series.values,
            label=_words(name),
            clip_on=False,
            **style,
            markevery=_marks(len(series.values)),
        )
    axes.set(xlabel="time (s)", ylabel=f"distance error ({unit})", ylim=(0, None))
    axes.margins(x=0)
    if len(stamps) > 1:
        _number_frames(axes, stamps)
    axes.grid(alpha=0.3)
    _label_ends(axes)
    return figure


def plot_trajectories(
    estimates: Mapping[str, Trajectory], truth: Trajectory | None, ours: Collection[str] = ()
) -> Figure:
    """Draw each named trajectory from above and upright, all seen from their first camera (x right, z forward).

    The upright panel looks along z or, where the paths are longer along z than along x, along x. Both panels have one
    scale. The truth, where there is any, is taken at the stamps of the first estimate that it covers; its first such
    pose is laid on that estimate's.

    Args:
        estimates: the trajectories.
        truth: what they are compared with.
        ours: estimates in colour; the others are grey. All of them where none is named.
    """
    true_path = None if truth is None else _true_path(next(iter(estimates.values())), truth)
    paths = {name: _path(estimate) for name, estimate in estimates.items()}
    shown = np.concatenate([*paths.values(), *([] if true_path is None else [true_path])]) * UPWARDS
    low, high = np.nanmin(shown, axis=0), np.nanmax(shown, axis=0)
    scale, unit = _unit(float(np.max(high - low)))
    across = 0 if high[0] - low[0] >= high[2] - low[2] else 2
    views = ((0, 2), (across, 1))
    half = _half_widths(high - low, views)
    figure = _figure(8.5, 3.5 * half[1] / half[0] + 1.7, "trajectory", "" if true_path is None else WITH_TRUTH)
    titles = ("From above", "From behind" if across == 0 else "From the right")
    for axes, (i, j), title in zip(figure.subplots(1, 2), views, titles, strict=True):
        if true_path is not None:
            axes.plot(*(scale * UPWARDS * true_path).T[[i, j]], **TRUTH_STYLE)
        for (name, path), style in zip(paths.items(), _styles(paths, ours), strict=True):
            axes.plot(*(scale * UPWARDS * path).T[[i, j]], label=_words(name), **style, markevery=_marks(len(path)))
        axes.scatter([0], [0], marker="s", color="black", s=30, zorder=3)
        axes.annotate("start", (0, 0), (0, -14), bbox=HALO, textcoords="offset points", ha="center", fontsize="small")
        middle = scale * (low + high)[[i, j]] / 2
        axes.set(xlabel=f"{AXES[i]} ({unit})", ylabel=f"{AXES[j]} ({unit})", title=title, aspect="equal")
        axes.set(xlim=middle[0] + scale * half[0] * SIDES, ylim=middle[1] + scale * half[1] * SIDES)
        axes.locator_params(nbins=5)
        axes.grid(alpha=0.3)
        if unit == "mm":
            _draw_scale(axes, unit)
    _legend(figure)
    return figure


UPWARDS = np.array([1.0, -1.0, 1.0])
"""Camera axes, y downwards, into what is drawn."""
AXES = ("x, right", "−y, up", "z, forward")
SIDES = np.array([-1.0, 1.0])
HALO = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5}
MARGIN = 1.3
"""Of a panel's sides over those of what it holds: the start at an edge leaves room for its name."""


def _half_widths(extent: Float[np.ndarray, " 3"], views: Sequence[tuple[int, int]]) -> Float[np.ndarray, " 2"]:
    """Half the sides of panels of one scale that hold each view; not very much wider than high, nor the reverse."""
    wide, high = (max(float(extent[view[k]]) for view in views) for k in (0, 1))
    wide = max(wide, 0.7 * high, 1e-3)
    return 0.5 * MARGIN * np.array([wide, max(high, 0.5 * wide)])


def _path(trajectory: Trajectory) -> Float[np.ndarray, "m 3"]:
    """Positions seen from the first camera, with a row of not-a-number between two segments: the line breaks there."""
    positions = (inverse(trajectory.world_T_camera[0]) @ trajectory.world_T_camera)[:, :3, 3]
    return np.insert(positions, np.flatnonzero(np.diff(trajectory.segments)) + 1, np.nan, axis=0)


def plot_convergence(histories: Mapping[int, Float[np.ndarray, "pairs iterations"]]) -> Figure:
    """Draw how the best error falls within each level, over the pairs of a run.

    Args:
        histories: best E so far after every iteration, by level in the order of the search; NaN where a search had
            ended: its last error is carried on.
    """
    figure = _figure(PANEL_WIDTH * len(histories), 3.8, "convergence")
    panels = _panels(figure, len(histories), one_scale=True)
    for axes, (level, history) in zip(panels, histories.items(), strict=True):
        error = _carry_on(history)
        end = np.where(np.isfinite(error[:, -1:]), error[:, -1:], np.nan)  # infinite where a search sees nothing
        excess = 100.0 * (error[:, :-1] / np.maximum(end, 1e-12) - 1.0)
        iterations = np.arange(1, excess.shape[1] + 1)
        _draw_band(
            axes, iterations, np.maximum(excess, SMALLEST_EXCESS), "median of the pairs", "middle 80 % of the pairs"
        )
        axes.set(title=f"level {level}", xlabel="iteration", yscale="log")
        axes.minorticks_off()
        axes.yaxis.set_major_formatter(_excess)
    figure.axes[0].set_ylabel("excess of E (%)")
    _legend(figure)
    return figure


def _excess(value: float, _: int) -> str:
    """The label of a tick; the smallest one says that what lies below is drawn there."""
    return f"≤ {value:g}" if value <= SMALLEST_EXCESS else f"{value:g}"


def plot_population(errors: Mapping[int, Float[np.ndarray, "iterations p"]]) -> Figure:
    """Draw how the errors of a population fall within each level of one pair's search.

    Args:
        errors: E of every candidate after every iteration, by level in the order of the search; NaN rows where the
            search had ended, +inf where a candidate is worthless.
    """
    figure = _figure(PANEL_WIDTH * len(errors), 3.8, "population")
    for axes, (level, error) in zip(_panels(figure, len(errors)), errors.items(), strict=True):
        error = error[~np.isnan(error).all(axis=1)]
        rmse = np.sqrt(np.where(np.isfinite(error), error, np.nan))
        iterations = np.arange(1, len(rmse) + 1)
        _draw_band(axes, iterations, rmse.T, "median", "middle 80 %")
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
    _legend(figure)
    return figure


def plot_landscape(landscape: Landscape, pair: str = "", more: Sequence[str] = ()) -> Figure:
    """Draw the error around the optimum along the worst- and the best-conditioned direction, level by level.

    Args:
        landscape: the errors.
        pair: which frames it is of, for the title.
        more: what the motion was found with beside the two frames, for the caption.
    """
    has_gaps = not all(np.isfinite(errors).all() for errors in landscape.errors.values())
    found_with = MORE_THAN_THE_PAIR.format(" and ".join(more)) if more else ""
    figure = _figure(8.0, 4.8, "landscape", GAPS * has_gaps + found_with)
    figure.suptitle(pair, fontsize="medium")
    titles = ("worst-conditioned direction", "best-conditioned direction")
    for i, (axes, title) in enumerate(zip(_panels(figure, 2), titles, strict=True)):
        axes.axvline(0, color="black", linewidth=0.8, linestyle=":", label="motion found")
        for (level, errors), style in zip(landscape.errors.items(), _styles(landscape.errors), strict=True):
            style |= {"linewidth": 1.5}
            rmse = np.sqrt(np.where(np.isfinite(errors[i]), errors[i], np.nan))
            axes.plot(landscape.steps * 1e3, rmse, label=f"level {level}", **style, markevery=_marks(len(rmse)))
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
    """Draw how often each method still finds a motion, over the motion's size.

    Args:
        motion: median rotation of the pairs, degrees, in any order.
        success: share of the pairs found, by method; NaN where it was not tried.
        title: what the pairs are of.
        ours: methods in colour; the others are grey. All of them where none is named.
    """
    figure = _figure(9.0, 4.6, "basin")
    axes = figure.add_subplot()
    order = np.argsort(motion)
    for (name, rates), style in zip(success.items(), _styles(success, ours), strict=True):
        tried = [i for i in order if np.isfinite(rates[i])]
        axes.plot(motion[tried], rates[tried], label=_words(name), **style)
    axes.set(xlabel="median rotation of the pairs (deg)", ylabel="share of pairs found", title=title)
    axes.set(ylim=(-0.03, 1.03), xlim=(0, 1.02 * float(np.max(motion))))
    axes.grid(alpha=0.3)
    _label_ends(axes)
    return figure


def plot_drift(clips: Mapping[str, Mapping[str, Float[np.ndarray, "runs 2"]]], ours: Collection[str]) -> Figure:
    """Draw the drift of every method on every clip as bars, other libraries' hatched.

    Args:
        clips: translation (m/s) and rotation (deg/s) of every run, by clip and method.
        ours: which of the methods are the project's own.
    """
    rows = max(len(methods) for methods in clips.values())
    several = any(len(runs) > 1 for methods in clips.values() for runs in methods.values())
    figure = _figure(9.0, (0.9 + 0.2 * rows) * len(clips) + 0.6, "drift", SEVERAL_RUNS if several else "")
    panels = figure.subplots(len(clips), 2, squeeze=False)
    for (clip, methods), pair in zip(clips.items(), panels, strict=True):
        for column, (axes, label) in enumerate(zip(pair, ("translation (m/s)", "rotation (deg/s)"), strict=True)):
            decimals = _decimals(np.concatenate([runs[:, column] for runs in methods.values()]), (4, 2)[column])
            for place, (name, runs) in enumerate(methods.items()):
                values = runs[:, column]
                middle = float(np.median(values))
                mine = {"color": COLORS[0], "edgecolor": "black"}
                style = mine if name in ours else {"color": "#E4E4E4", "edgecolor": "#808080", "hatch": "//"}
                spread = [[middle - values.min()], [values.max() - middle]] if len(values) > 1 else None
                axes.barh(place, middle, xerr=spread, linewidth=0.5, capsize=2, **style)
                axes.annotate(f" {middle:.{decimals}f}", (values.max(), place), va="center", fontsize=7)
            names = [_words(name) for name in methods] if column == 0 else [""] * len(methods)
            axes.set_yticks(range(len(methods)), names, fontsize="small")
            axes.invert_yaxis()
            axes.margins(x=0.15)
            axes.set(xlabel=label, title=_words(clip))
            axes.grid(alpha=0.3, axis="x")
            axes.locator_params(axis="x", nbins=6)
            axes.set_axisbelow(True)
    return figure


def _decimals(values: Float[np.ndarray, " n"], least: int) -> int:
    """How many decimals give the smallest of some values two digits, and at least so many."""
    smallest = float(np.min(values[values > 0], initial=1.0))
    return max(least, 1 - int(np.floor(np.log10(smallest))))


def save(figure: Figure, folder: str | Path, name: str) -> list[Path]:
    """Write a figure as NAME.png and NAME.svg (`FORMATS`), each whole, into a folder and return their paths.

    Raises:
        GavoError: a file cannot be written.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    def draw_png(data: BytesIO) -> None:
        FigureCanvasAgg(figure).print_png(data, pil_kwargs={"optimize": True})

    def draw_svg(data: BytesIO) -> None:
        with rc_context({"svg.hashsalt": name}):  # else its names are random
            FigureCanvasSVG(figure).print_svg(data, metadata={"Date": None})

    # not by `savefig`, which draws twice for each file and lays out anew: that takes the most time
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


def _words(name: str) -> str:
    """A name of other people's as a figure shows it: no formula, and no command."""
    return printable(name).replace("$", r"\$")


def _figure(width: float, height: float, name: str, more: str = "") -> Figure:
    """Return a figure (inches) with a caption and nothing else, that belongs to no window and to no global state."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    figure.supxlabel(
        textwrap.fill(CAPTIONS[name] + more, int(CAPTION_WIDTH * width)), fontsize=CAPTION_SIZE, x=0.01, ha="left"
    )
    return figure


def _legend(figure: Figure) -> None:
    """Name what the first panel shows, above all panels: within one it would cover curves."""
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=6, fontsize="small")


def _number_frames(axes: Any, stamps: Float[np.ndarray, " n"]) -> None:
    """Add an axis on top that counts the frames at these times."""
    # beyond the last frame the axis goes on, so that no number above it is written at its place
    span = max(float(stamps[-1] - stamps[0]), 1e-6)
    stamps = np.array([stamps[0] - span, *stamps, stamps[-1] + span])
    numbers = np.array([2 - len(stamps), *range(len(stamps) - 2), 2 * len(stamps)])

    def frame_at(time: Any) -> Any:
        return np.interp(time, stamps, numbers)

    def time_of(frame: Any) -> Any:
        return np.interp(frame, numbers, stamps)

    axes.secondary_xaxis("top", functions=(frame_at, time_of)).set_xlabel("frame")


LABEL_HEIGHT = 0.05
"""Of the panel's height, between the labels of two curves at least."""


def _label_ends(axes: Any) -> None:
    """Write each curve's name beside the panel at the height of its last point, in its colour.

    Names of curves that end together make room. Those that end at one point share a line to it.
    """
    low, high = axes.get_ylim()
    ends = {line: (float(line.get_xdata()[-1]), float(line.get_ydata()[-1])) for line in axes.lines if _drawn(line)}
    curves = sorted(ends, key=lambda line: (-ends[line][1], -ends[line][0]))
    if not curves:
        return
    wanted = np.array([(ends[line][1] - low) / (high - low) for line in curves])
    places = dict(zip(curves, _apart(wanted, LABEL_HEIGHT, (0.0, 1.0)).tolist(), strict=True))
    for line, place in places.items():
        axes.annotate(
            line.get_label(),
            (1.0, place),
            (1.06, place),
            xycoords="axes fraction",
            textcoords="axes fraction",
            annotation_clip=False,
            va="center",
            color=line.get_color(),
            fontsize="small",
        )
    for end in dict.fromkeys(ends.values()):
        group = [places[line] for line in curves if ends[line] == end]
        _draw_leader(axes, end, min(group), max(group))


def _drawn(line: Any) -> bool:
    """Whether a line is a curve with a name."""
    return len(line.get_xdata()) > 0 and not str(line.get_label()).startswith("_")


def _draw_leader(axes: Any, end: tuple[float, float], lowest: float, highest: float) -> None:
    """Draw a thin line from the end of a curve, or of several, to the name or names beside the panel.

    It is dotted where it crosses the panel: it is no curve.
    """
    style = {"arrowstyle": "-", "color": "0.6", "linewidth": 0.6, "shrinkA": 0, "shrinkB": 0}
    beside = 1.03 if highest == lowest else 1.045
    across = {"linestyle": ":", "linewidth": 0.8} if end[0] < axes.get_xlim()[0] + 0.9 * np.ptp(axes.get_xlim()) else {}
    axes.annotate(
        "",
        end,
        (beside, (lowest + highest) / 2),
        textcoords="axes fraction",
        annotation_clip=False,
        arrowprops=style | across,
    )
    if highest > lowest:
        axes.plot([beside] * 2, [lowest, highest], transform=axes.transAxes, clip_on=False, color="0.6", linewidth=0.6)


def _apart(places: Float[np.ndarray, " n"], distance: float, limits: tuple[float, float]) -> Float[np.ndarray, " n"]:
    """Places in falling order, moved as little as it takes to keep a distance and, if there is room, the limits."""
    steps = -distance * np.arange(len(places))
    flat = places - steps  # falling by at least the distance where this does not rise
    level, blocks = [], []
    for value in flat.tolist():  # pool adjacent violators
        level.append(value)
        blocks.append(1)
        while len(level) > 1 and level[-1] > level[-2]:
            count = blocks[-1] + blocks[-2]
            level[-2:] = [(level[-1] * blocks[-1] + level[-2] * blocks[-2]) / count]
            blocks[-2:] = [count]
    lowest, highest = limits
    spread = np.repeat(level, blocks) + steps
    return np.maximum(np.minimum(spread, highest + steps), lowest + steps - steps[-1:])


def _panels(figure: Figure, count: int, one_scale: bool = False) -> list[Any]:
    """Return panels side by side, each with a scale of its own upwards, or all with one."""
    panels = list(figure.subplots(1, count, squeeze=False, sharey=one_scale)[0])
    for axes in panels:
        axes.grid(alpha=0.3)
        axes.locator_params(axis="x", integer=True)
    return panels


def _draw_band(axes: Any, x: Any, samples: Float[np.ndarray, "samples n"], middle: str, range_: str) -> None:
    """Draw the median of samples with the range of their middle 80 %, where there is any."""
    if not np.isfinite(samples).any():
        return
    low, median, high = np.nanquantile(samples, [0.1, 0.5, 0.9], axis=0)
    axes.plot(x, median, color=COLORS[0], marker="o", markersize=3, label=middle)
    axes.fill_between(x, low, high, facecolor=COLORS[5], alpha=0.35, edgecolor=COLORS[0], linewidth=0.5, label=range_)


def _carry_on(history: Float[np.ndarray, "pairs iterations"]) -> Float[np.ndarray, "pairs iterations"]:
    """Return the history with NaN replaced by the last value before it."""
    last = np.maximum.accumulate(np.where(np.isnan(history), 0, np.arange(history.shape[1])), axis=1)
    return np.take_along_axis(history, last, axis=1)


def _draw_scale(axes: Any, unit: str) -> None:
    """Draw a bar of a round length, a fifth to a half of the panel, into the lower corner that is farther from the
    start.
    """
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    power = 10.0 ** np.floor(np.log10(right - left))
    length = max(digit * power for digit in (0.1, 0.2, 0.5, 1.0, 2.0) if digit * power <= 0.5 * (right - left))
    free = 0.88 * (right - left) - length if left + right > 0 else 0.0
    start, up = left + 0.06 * (right - left) + free, low + 0.06 * (high - low)
    axes.plot([start, start + length], [up, up], color="black", linewidth=2, solid_capstyle="butt")
    axes.annotate(
        f"{length:g} {unit}", (start + length / 2, up), (0, 3), textcoords="offset points", ha="center", fontsize=7
    )


def _unit(extent: float) -> tuple[float, str]:
    """Values a metre and their unit, for what is so many metres large."""
    return (1e3, "mm") if extent < SMALL else (1.0, "m")


def _styles(names: Collection[Any], ours: Collection[str] = ()) -> Iterator[dict[str, Any]]:
    """Yield a colour, line style and marker for each curve; neighbours differ in all three.

    Those that are not ours are thin and grey. Of the others the first ones are wider, and show beside those drawn over
    them where methods coincide.
    """
    muted = [name for name in names if ours and name not in ours]
    greys = iter(np.linspace(*GREYS, max(len(muted), 2)).tolist())
    widths = iter(np.linspace(2.8, 1.2, len(names) - len(muted)) if len(names) - len(muted) > 1 else [1.5])
    colors = cycle(COLORS)
    for name, line, marker in zip(names, cycle(LINES), cycle(MARKERS), strict=False):
        style = {"linestyle": line, "marker": marker}
        if name in muted:
            yield style | {"color": f"{next(greys):.3g}", "markersize": 3, "linewidth": 1.0}
        else:
            yield style | {"color": next(colors), "markersize": 4, "linewidth": float(next(widths))}


def _marks(count: int) -> int:
    """Return the spacing of about ten markers along a curve."""
    return max(1, count // 10)


def _true_path(estimate: Trajectory, truth: Trajectory) -> Float[np.ndarray, "n 3"] | None:
    """Return true positions at the estimate's stamps in its first camera's frame; None where nothing is covered."""
    world_T_camera, valid = truth.interpolate(estimate.timestamps)
    if not valid.any():
        return None
    true, first = world_T_camera[valid], estimate.world_T_camera[valid][0]
    first_camera_T_start = inverse(estimate.world_T_camera[0]) @ first
    return (first_camera_T_start @ inverse(true[0]) @ true)[:, :3, 3]
