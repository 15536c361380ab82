"""Figures as files: trajectories and their errors, convergence, the error's landscape, basins and drift; PNG and SVG.

Every function draws one figure from arrays and returns it, with a caption that defines what is measured; `save` writes
it. Colours are those of Okabe and Ito, which colour-blind people tell apart; line styles, markers and hatches tell the
curves and bars apart without colour.
"""

from __future__ import annotations

import importlib.util
import textwrap
import warnings
from collections.abc import Iterator, Mapping, Sequence
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

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
LINES = ("-", "--", "-.", ":")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">")
FORMATS = ("png", "svg")
TRUTH_STYLE = {"color": "black", "linewidth": 2.5, "alpha": 0.45, "label": "ground truth"}


def available() -> bool:
    """Whether matplotlib is installed."""
    return importlib.util.find_spec("matplotlib") is not None


SMALLEST_EXCESS = 1e-3
"""Per cent; a smaller excess is drawn as this."""
CAPTION_WIDTH = 18
"""Letters of a caption an inch of the figure."""

CAPTIONS = {
    "trajectory": "Estimated camera positions, all seen from their first camera; a square marks the start.",
    "distance_error": "Distance error of each frame: distance between the estimated and the true position of the "
    "camera, both relative to the first pose; the truth is interpolated at the frames' stamps.",
    "drift": "Drift: relative pose error over 1 s, root mean square (TUM evaluate_rpe.py, fixed delta); translation "
    "in m/s, rotation in deg/s. Bars: median over the runs; whiskers, where they are given: smallest and largest.",
    "convergence": "By how much the best error E so far exceeds the last one of the same level, over the iterations of "
    "its search: median over the pairs of the run, and the range of their middle 80 %. Levels from coarse to fine. An "
    f"excess below {SMALLEST_EXCESS:g} % is drawn as that.",
    "population": "Root of E over the iterations of each level's search of one pair: best and median of the "
    "population, and the range of its middle 80 %. Levels from coarse to fine; their errors are not comparable.",
    "landscape": "Root of E around the motion that was found, along the eigenvectors of its covariance with the "
    "largest and the smallest variance; a step of 1 is 1 mm and 1 mrad. Gaps: too little of the view is left. The "
    "motion was found with a keyframe and the shutter's readout, too: the minimum of this pair alone may lie "
    "millimetres away.",
    "basin": "Share of frame pairs whose motion is found from a zero guess to within 5 cm and 3 deg, over the median "
    "rotation between the frames of a pair.",
}
"""By the name of the figure's files."""
WITH_TRUTH = (
    " The truth is interpolated at the frames' stamps and laid on the first estimate's first pose that it covers."
)
"""Of the trajectories' caption."""
SMALL = 0.1
"""Metres: what is smaller is drawn in millimetres."""


def plot_distance_error(errors: Mapping[str, ErrorSeries]) -> Figure:
    """Draw the distance error of each named run over time and frames, as the paper's figures 5 and 9."""
    figure = _figure(7.0, 4.4, "distance_error")
    axes = figure.add_subplot()
    stamps = np.unique(np.concatenate([series.timestamps for series in errors.values()])) - min(
        series.timestamps[0] for series in errors.values()
    )
    scale, unit = _unit(max(float(np.max(series.values)) for series in errors.values()))
    for (name, series), style in zip(errors.items(), _styles(), strict=False):
        seconds = series.timestamps - series.timestamps[0] + stamps[0]
        axes.plot(seconds, scale * series.values, label=name, **style, markevery=_marks(len(series.values)))
    axes.set(xlabel="time (s)", ylabel=f"distance error ({unit})", ylim=(0, None))
    axes.margins(x=0)
    if len(stamps) > 1:
        _number_frames(axes, stamps)
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def plot_trajectories(estimates: Mapping[str, Trajectory], truth: Trajectory | None) -> Figure:
    """Draw each named trajectory from above and in space, all seen from their first camera (x right, z forward).

    The truth, where there is any, is taken at the stamps of the first estimate that it covers; its first such pose is
    laid on that estimate's.
    """
    true_path = None if truth is None else _true_path(next(iter(estimates.values())), truth)
    figure = _figure(10.0, 5.2, "trajectory", "" if true_path is None else WITH_TRUTH)
    above, space = figure.add_subplot(1, 2, 1), figure.add_subplot(1, 2, 2, projection="3d")
    paths = {name: _path(estimate) for name, estimate in estimates.items()}
    shown = [*paths.values(), *([] if true_path is None else [true_path])]
    scale, unit = _unit(
        float(np.max(np.ptp(np.concatenate([path[np.isfinite(path[:, 0])] for path in shown]), axis=0)))
    )
    if true_path is not None:
        x, y, z = scale * true_path.T
        above.plot(x, z, **TRUTH_STYLE)
        space.plot(x, z, -y, **TRUTH_STYLE)
    for i, ((name, path), style) in enumerate(zip(paths.items(), _styles(), strict=False)):
        # those below show beside those above where methods coincide
        style |= {"linewidth": 1.2 + 2.0 * (1 - i / max(len(paths) - 1, 1)) * (len(paths) > 1)}
        x, y, z = scale * path.T
        above.plot(x, z, label=name, **style, markevery=_marks(len(path)))
        space.plot(x, z, -y, label=name, **style, markevery=_marks(len(path)))
    above.scatter([0], [0], marker="s", color="black", s=30, zorder=3)
    space.scatter([0], [0], zs=0, marker="s", color="black", s=20)
    above.set(xlabel=f"x, right ({unit})", ylabel=f"z, forward ({unit})", title="From above", aspect="equal")
    above.grid(alpha=0.3)
    above.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0), fontsize="small")
    space.set(xlabel=f"x, right ({unit})", ylabel=f"z, forward ({unit})", zlabel=f"−y, up ({unit})", title="In space")
    _fit_above(above, [scale * path for path in shown])
    if unit == "mm":
        _draw_scale(above, unit)
    _fit_in_space(space, [scale * path for path in shown])
    return figure


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
    figure = _figure(3.0 * len(histories), 3.6, "convergence")
    panels = _panels(figure, len(histories), one_scale=True)
    for axes, (level, history) in zip(panels, histories.items(), strict=True):
        error = _carry_on(history)
        excess = 100.0 * (error[:, :-1] / np.maximum(error[:, -1:], 1e-12) - 1.0)
        iterations = np.arange(1, excess.shape[1] + 1)
        _draw_band(axes, iterations, np.maximum(excess, SMALLEST_EXCESS), "median of the pairs", "middle 80 % of them")
        axes.set(title=f"level {level}", xlabel="iteration", yscale="log")
        axes.minorticks_off()
    figure.axes[0].set_ylabel("excess of E (%)")
    figure.axes[0].legend(fontsize="small")
    return figure


def plot_population(errors: Mapping[int, Float[np.ndarray, "iterations p"]]) -> Figure:
    """Draw how the errors of a population fall within each level of one pair's search.

    Args:
        errors: E of every candidate after every iteration, by level in the order of the search; NaN rows where the
            search had ended, +inf where a candidate is worthless.
    """
    figure = _figure(3.0 * len(errors), 3.6, "population")
    for axes, (level, error) in zip(_panels(figure, len(errors)), errors.items(), strict=True):
        error = error[~np.isnan(error).all(axis=1)]
        rmse = np.sqrt(np.where(np.isfinite(error), error, np.nan))
        iterations = np.arange(1, len(rmse) + 1)
        _draw_band(axes, iterations, rmse.T, "median", "middle 80 %")
        axes.plot(iterations, np.nanmin(rmse, axis=1), color=COLORS[1], linestyle="--", marker="s", label="best")
        axes.set(title=f"level {level}, {error.shape[1]} candidates", xlabel="iteration")
    figure.axes[0].set_ylabel("√E (grey levels)")
    figure.axes[0].legend(fontsize="small")
    return figure


def plot_landscape(landscape: Landscape, pair: str = "") -> Figure:
    """Draw the error around the optimum along the worst- and the best-conditioned direction, level by level.

    Args:
        landscape: the errors.
        pair: which frames it is of, for the title.
    """
    figure = _figure(8.0, 4.8, "landscape")
    figure.suptitle(pair, fontsize="medium")
    titles = ("worst-conditioned direction", "best-conditioned direction")
    for i, (axes, title) in enumerate(zip(_panels(figure, 2), titles, strict=True)):
        for (level, errors), style in zip(landscape.errors.items(), _styles(), strict=False):
            rmse = np.sqrt(np.where(np.isfinite(errors[i]), errors[i], np.nan))
            axes.plot(landscape.steps * 1e3, rmse, label=f"level {level}", **style, markevery=_marks(len(rmse)))
        numbers = ", ".join(f"{value:.2f}" for value in landscape.directions[i])
        axes.set(title=title, xlabel=f"step (mm, mrad) along\n(v, w) = ({numbers})", ylim=(0, None))
    figure.axes[0].set_ylabel("√E (grey levels)")
    figure.axes[0].legend(fontsize="small")
    return figure


def plot_basin(
    motion: Float[np.ndarray, " n"],
    success: Mapping[str, Float[np.ndarray, " n"]],
    title: str,
    ours: Sequence[str] = (),
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
    greys = iter(np.linspace(0.35, 0.75, max(len(success) - len(ours), 1)))
    colored = _styles()
    for name, rates in success.items():
        tried = [i for i in order if np.isfinite(rates[i])]
        style = next(colored)
        if ours and name not in ours:
            style |= {"color": str(next(greys)), "linewidth": 1.0, "markersize": 3}
        axes.plot(motion[tried], rates[tried], label=name, **style)
    axes.set(xlabel="median rotation of the pairs (deg)", ylabel="share of pairs found", title=title)
    axes.set(ylim=(-0.03, 1.03), xlim=(0, 1.02 * float(np.max(motion))))
    axes.grid(alpha=0.3)
    _label_ends(axes)
    return figure


def plot_drift(clips: Mapping[str, Mapping[str, Float[np.ndarray, "runs 2"]]], ours: Sequence[str]) -> Figure:
    """Draw the drift of every method on every clip as bars, other libraries' hatched.

    Args:
        clips: translation (m/s) and rotation (deg/s) of every run, by clip and method.
        ours: which of the methods are the project's own.
    """
    rows = max(len(methods) for methods in clips.values())
    figure = _figure(9.0, (0.9 + 0.2 * rows) * len(clips) + 0.6, "drift")
    panels = figure.subplots(len(clips), 2, squeeze=False)
    for (clip, methods), pair in zip(clips.items(), panels, strict=True):
        for column, (axes, label) in enumerate(zip(pair, ("translation (m/s)", "rotation (deg/s)"), strict=True)):
            for place, (name, runs) in enumerate(methods.items()):
                values = runs[:, column]
                middle = float(np.median(values))
                style = {"color": COLORS[0]} if name in ours else {"color": "#DDDDDD", "hatch": "//"}
                spread = [[middle - values.min()], [values.max() - middle]] if len(values) > 1 else None
                axes.barh(place, middle, xerr=spread, edgecolor="black", linewidth=0.5, capsize=2, **style)
                axes.annotate(f" {middle:#.3g}", (values.max(), place), va="center", fontsize=7)
            names = [_words(name) for name in methods] if column == 0 else [""] * len(methods)
            axes.set_yticks(range(len(methods)), names, fontsize="small")
            axes.invert_yaxis()
            axes.margins(x=0.15)
            axes.set(xlabel=label, title=_words(clip))
            axes.grid(alpha=0.3, axis="x")
            axes.set_axisbelow(True)
    return figure


def save(figure: Figure, folder: str | Path, name: str) -> list[Path]:
    """Write a figure as NAME.png and NAME.svg (`FORMATS`), each whole, into a folder and return their paths.

    Raises:
        GavoError: a file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    def draw_png(data: BytesIO) -> None:
        FigureCanvasAgg(figure).print_png(data, pil_kwargs={"optimize": True})

    def draw_svg(data: BytesIO) -> None:
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
    figure.supxlabel(textwrap.fill(CAPTIONS[name] + more, int(CAPTION_WIDTH * width)), fontsize=7, x=0.01, ha="left")
    return figure


def _number_frames(axes: Any, stamps: Float[np.ndarray, " n"]) -> None:
    """Add an axis on top that counts the frames at these times."""
    numbers = np.arange(len(stamps))

    def frame_at(time: Any) -> Any:
        return np.interp(time, stamps, numbers)

    def time_of(frame: Any) -> Any:
        return np.interp(frame, numbers, stamps)

    axes.secondary_xaxis("top", functions=(frame_at, time_of)).set_xlabel("frame")


LABEL_HEIGHT = 0.05
"""Of the panel's height, between the labels of two curves at least."""


def _label_ends(axes: Any) -> None:
    """Write each curve's name beside its last point, in its colour; names of curves that end together make room."""
    low, high = axes.get_ylim()
    curves = sorted((line for line in axes.lines if len(line.get_xdata())), key=lambda line: -line.get_ydata()[-1])
    places = np.array([(line.get_ydata()[-1] - low) / (high - low) for line in curves])
    places = _apart(places, LABEL_HEIGHT, (0.0, 1.0))
    for line, place in zip(curves, places.tolist(), strict=True):
        axes.annotate(
            _words(line.get_label()),
            (line.get_xdata()[-1], line.get_ydata()[-1]),
            (1.03, place),
            textcoords="axes fraction",
            annotation_clip=False,
            va="center",
            color=line.get_color(),
            fontsize="small",
            arrowprops={"arrowstyle": "-", "color": line.get_color(), "linewidth": 0.5, "relpos": (0.0, 0.5)},
        )


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
    """Draw the median of samples with the range of their middle 80 %."""
    low, median, high = np.nanquantile(samples, [0.1, 0.5, 0.9], axis=0)
    axes.fill_between(x, low, high, facecolor=COLORS[5], alpha=0.35, edgecolor=COLORS[0], linewidth=0.5, label=range_)
    axes.plot(x, median, color=COLORS[0], marker="o", markersize=3, label=middle)


def _carry_on(history: Float[np.ndarray, "pairs iterations"]) -> Float[np.ndarray, "pairs iterations"]:
    """Return the history with NaN replaced by the last value before it."""
    last = np.maximum.accumulate(np.where(np.isnan(history), 0, np.arange(history.shape[1])), axis=1)
    return np.take_along_axis(history, last, axis=1)


def _fit_above(axes: Any, paths: Sequence[Float[np.ndarray, "n 3"]]) -> None:
    """Have a panel hold the paths seen from above, with one scale, and half as wide as it is high at least."""
    points = np.concatenate(paths)[:, [0, 2]]
    low, high = _limits(points)
    middle, half = (low + high) / 2, 0.55 * np.maximum(high - low, 0.6 * max(float(np.max(high - low)), 1e-3))
    axes.set(xlim=(middle[0] - half[0], middle[0] + half[0]), ylim=(middle[1] - half[1], middle[1] + half[1]))


def _draw_scale(axes: Any, unit: str) -> None:
    """Draw a bar of a round length, a fifth to a half of the panel, into its lower left corner."""
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    power = 10.0 ** np.floor(np.log10(right - left))
    length = max(digit * power for digit in (0.1, 0.2, 0.5, 1.0, 2.0) if digit * power <= 0.5 * (right - left))
    start, up = left + 0.06 * (right - left), low + 0.06 * (high - low)
    axes.plot([start, start + length], [up, up], color="black", linewidth=2, solid_capstyle="butt")
    axes.annotate(
        f"{length:g} {unit}", (start + length / 2, up), (0, 3), textcoords="offset points", ha="center", fontsize=7
    )


def _fit_in_space(space: Any, paths: Sequence[Float[np.ndarray, "n 3"]]) -> None:
    """Give the three axes of a drawing in space the same scale, a few ticks each, and no more room than is needed."""
    points = np.concatenate(paths)[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    low, high = _limits(points)
    half = 0.55 * np.maximum(high - low, 0.35 * max(float(np.max(high - low)), 1e-3))
    for i, (axis, middle) in enumerate(zip("xyz", (low + high) / 2, strict=True)):
        getattr(space, f"set_{axis}lim")(middle - half[i], middle + half[i])
        space.locator_params(axis=axis, nbins=4 if half[i] > 0.7 * np.max(half) else 1)
    space.tick_params(labelsize="x-small")
    for axis in (space.xaxis, space.yaxis, space.zaxis):
        axis.labelpad = 12
    space.set_box_aspect(tuple(half / np.max(half)), zoom=0.85)


def _limits(points: Float[np.ndarray, "n d"]) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    """Smallest and largest coordinates, places without a number left out."""
    return np.nanmin(points, axis=0), np.nanmax(points, axis=0)


def _unit(extent: float) -> tuple[float, str]:
    """Values a metre and their unit, for what is so many metres large."""
    return (1e3, "mm") if extent < SMALL else (1.0, "m")


def _styles() -> Iterator[dict[str, Any]]:
    """Yield a colour, line style and marker for each curve; neighbours differ in all three."""
    for color, line, marker in zip(cycle(COLORS), cycle(LINES), cycle(MARKERS), strict=False):
        yield {"color": color, "linestyle": line, "marker": marker, "markersize": 4, "linewidth": 1.5}


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
