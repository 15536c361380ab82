"""Parts of figures: captions, panels, styles and labels of curves, scale bars.

The colours are safe for colour-blind readers; line styles, markers and hatches distinguish curves and bars without
colour.
"""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Iterator
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from gavo_jax.errors import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#882255", "#8C7A1F")
"""Okabe and Ito's colours, with Tol's wine and an olive in place of their yellow and black."""
GREYS = (0.3, 0.6)
"""Darkest and lightest grey of other libraries' curves."""
LINES = ("-", "--", "-.", ":")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">")
CAPTION_WIDTH, CAPTION_SIZE = 15, 8.5
"""Characters of a caption per inch of figure width, and their size in points: legible in a figure scaled down."""
SMALL = 0.1
"""Extent, metres, below which figures use millimetres."""


def shown_name(name: str) -> str:
    """Escape a user-given name for matplotlib, which would read `$` as a formula and hide names that start with `_`."""
    shown = printable(name).replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown


def new_figure(width: float, height: float, caption: str) -> Figure:
    """Return an empty figure of a size in inches with a caption, tied to no window or global state."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    figure.supxlabel(textwrap.fill(caption, int(CAPTION_WIDTH * width)), fontsize=CAPTION_SIZE, x=0.01, ha="left")
    return figure


def add_legend(figure: Figure) -> None:
    """Add the first panel's legend above all panels, where it covers no curves."""
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=6, fontsize="small")


def number_frames(axes: Any, stamps: Float[np.ndarray, " n"]) -> None:
    """Add a top axis that numbers the frames at these times."""
    # extended beyond both ends: `interp` clamps, which would put larger numbers at the last frame
    span = max(float(stamps[-1] - stamps[0]), 1e-6)
    stamps = np.array([stamps[0] - span, *stamps, stamps[-1] + span])
    numbers = np.array([2 - len(stamps), *range(len(stamps) - 2), 2 * len(stamps)])

    def frame_at(time: Any) -> Any:
        return np.interp(time, stamps, numbers)

    def time_of(frame: Any) -> Any:
        return np.interp(frame, numbers, stamps)

    axes.secondary_xaxis("top", functions=(frame_at, time_of)).set_xlabel("frame")


LABEL_HEIGHT = 0.05
"""Smallest distance between the labels of two curves, as a share of the panel's height."""


def label_ends(axes: Any) -> None:
    """Write each curve's name beside the panel at the height of its last point, in its colour.

    Names that would overlap are moved apart, and a line leads from each to its curve's end. If any curves end at the
    same point, a sample of each curve stands before its name instead.
    """
    low, high = axes.get_ylim()
    ends = {line: (float(line.get_xdata()[-1]), float(line.get_ydata()[-1])) for line in axes.lines if _drawn(line)}
    curves = sorted(ends, key=lambda line: (-ends[line][1], -ends[line][0]))
    if not curves:
        return
    wanted = np.array([(ends[line][1] - low) / (high - low) for line in curves])
    places = dict(zip(curves, apart(wanted, LABEL_HEIGHT, (0.0, 1.0)).tolist(), strict=True))
    shared = len(set(ends.values())) < len(ends)
    for line, place in places.items():
        axes.annotate(
            line.get_label(),
            (1.0, place),
            (1.12 if shared else 1.06, place),
            xycoords="axes fraction",
            textcoords="axes fraction",
            annotation_clip=False,
            va="center",
            color=line.get_color(),
            fontsize="small",
        )
        if shared:
            _draw_sample(axes, line, place)
        else:
            _draw_leader(axes, ends[line], place)


def _drawn(line: Any) -> bool:
    """Whether a line is a named curve."""
    return len(line.get_xdata()) > 0 and not str(line.get_label()).startswith("_")


def _draw_leader(axes: Any, end: tuple[float, float], place: float) -> None:
    """Draw a thin line from the end of a curve to its name beside the panel.

    It is dotted if the curve ends well inside the panel, so that it is not taken for a curve.
    """
    style = {"arrowstyle": "-", "color": "0.6", "linewidth": 0.6, "shrinkA": 0, "shrinkB": 0}
    across = {"linestyle": ":", "linewidth": 0.8} if end[0] < axes.get_xlim()[0] + 0.9 * np.ptp(axes.get_xlim()) else {}
    axes.annotate("", end, (1.03, place), textcoords="axes fraction", annotation_clip=False, arrowprops=style | across)


def _draw_sample(axes: Any, line: Any, place: float) -> None:
    """Draw a sample of a curve before its name beside the panel."""
    names = ("color", "linestyle", "linewidth", "marker", "markersize")
    style = {name: getattr(line, f"get_{name}")() for name in names}
    axes.plot([1.03, 1.065, 1.1], [place] * 3, transform=axes.transAxes, clip_on=False, markevery=[1], **style)


def apart(places: Float[np.ndarray, " n"], distance: float, limits: tuple[float, float]) -> Float[np.ndarray, " n"]:
    """Move descending places as little as needed to keep a minimum distance and, if there is room, the limits."""
    steps = -distance * np.arange(len(places))
    flat = places - steps  # does not rise where the distance is kept
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


def panels_of(figure: Figure, count: int, one_scale: bool = False) -> list[Any]:
    """Return panels side by side, each with its own vertical scale or all with the same one."""
    panels = list(figure.subplots(1, count, squeeze=False, sharey=one_scale)[0])
    for axes in panels:
        axes.grid(alpha=0.3)
        axes.locator_params(axis="x", integer=True)
    return panels


def draw_band(axes: Any, x: Any, samples: Float[np.ndarray, "samples n"], middle: str, range_: str) -> None:
    """Draw the median of samples and the range of their middle 80 %; nothing if no sample is finite."""
    if not np.isfinite(samples).any():
        return
    low, median, high = np.nanquantile(samples, [0.1, 0.5, 0.9], axis=0)
    axes.plot(x, median, color=COLORS[0], marker="o", markersize=3, label=middle)
    axes.fill_between(x, low, high, facecolor=COLORS[5], alpha=0.35, edgecolor=COLORS[0], linewidth=0.5, label=range_)


def draw_scale(axes: Any, unit: str) -> None:
    """Draw a scale bar in the lower corner farther from the start; its round length is a fifth to half of the panel."""
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    power = 10.0 ** np.floor(np.log10(right - left))
    length = max(digit * power for digit in (0.1, 0.2, 0.5, 1.0, 2.0) if digit * power <= 0.5 * (right - left))
    free = 0.88 * (right - left) - length if left + right > 0 else 0.0
    start, up = left + 0.06 * (right - left) + free, low + 0.06 * (high - low)
    axes.plot([start, start + length], [up, up], color="black", linewidth=2, solid_capstyle="butt")
    axes.annotate(
        f"{length:g} {unit}", (start + length / 2, up), (0, 3), textcoords="offset points", ha="center", fontsize=7
    )


def unit_of(extent: float) -> tuple[float, str]:
    """Return the factor from metres to the unit in which to draw an extent in metres, and that unit."""
    return (1e3, "mm") if extent < SMALL else (1.0, "m")


def styles(names: Collection[Any], ours: Collection[str] = ()) -> Iterator[dict[str, Any]]:
    """Yield a colour, line style and marker for each curve; neighbours differ in all three.

    Curves that are not ours are thin and grey. Of the others, earlier ones are wider, so that they show behind later
    ones that coincide with them.
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


def marks(count: int) -> int:
    """Return the spacing of about ten markers along a curve."""
    return max(1, count // 10)
