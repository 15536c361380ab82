"""Figures of trajectories and their errors, as files: PNG and SVG.

Every function draws one figure from arrays and returns it; `save` writes it. Colours are those of Okabe and Ito, which
colour-blind people tell apart; line styles and markers tell the curves apart without colour.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from gavo_jax.errors import GavoError
from gavo_jax.evaluation import ErrorSeries
from gavo_jax.trajectory import Trajectory, inverse

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
LINES = ("-", "--", "-.", ":")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">")
FORMATS = ("png", "svg")
TRUTH_STYLE = {"color": "black", "linewidth": 2.5, "alpha": 0.45, "label": "ground truth"}


def available() -> bool:
    """Whether matplotlib is installed."""
    return importlib.util.find_spec("matplotlib") is not None


def plot_distance_error(errors: Mapping[str, ErrorSeries]) -> Figure:
    """Draw the distance error (17) of each named run over the frames' time, as the paper's figure 5."""
    figure = _figure(7.0, 4.0)
    axes = figure.add_subplot()
    start = min(series.timestamps[0] for series in errors.values())
    for (name, series), style in zip(errors.items(), _styles(), strict=False):
        axes.plot(series.timestamps - start, series.values, label=name, **style, markevery=_marks(len(series.values)))
    axes.set(xlabel="time (s)", ylabel="distance error (m)", title="Distance from the true position", ylim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def plot_trajectories(estimates: Mapping[str, Trajectory], truth: Trajectory | None) -> Figure:
    """Draw each named trajectory from above and in space, all seen from their first camera (x right, z forward).

    The truth, where there is any, is taken at the stamps of the first estimate that it covers; its first such pose is
    laid on that estimate's.
    """
    figure = _figure(10.0, 4.8)
    above, space = figure.add_subplot(1, 2, 1), figure.add_subplot(1, 2, 2, projection="3d")
    paths = {name: (inverse(t.world_T_camera[0]) @ t.world_T_camera)[:, :3, 3] for name, t in estimates.items()}
    styles = dict(zip(paths, _styles(), strict=False))
    true_path = None if truth is None else _true_path(next(iter(estimates.values())), truth)
    if true_path is not None:
        above.plot(true_path[:, 0], true_path[:, 2], **TRUTH_STYLE)
        space.plot(true_path[:, 0], true_path[:, 2], -true_path[:, 1], **TRUTH_STYLE)
    for name, path in paths.items():
        style = {**styles[name], "markevery": _marks(len(path))}
        above.plot(path[:, 0], path[:, 2], label=name, **style)
        space.plot(path[:, 0], path[:, 2], -path[:, 1], label=name, **style)
    above.set(xlabel="x, right (m)", ylabel="z, forward (m)", title="From above", aspect="equal")
    above.set_adjustable("datalim")
    above.grid(alpha=0.3)
    above.legend()
    space.set(xlabel="x, right (m)", ylabel="z, forward (m)", zlabel="−y, up (m)", title="In space")
    _limit_to_cube(space, [*paths.values(), *([] if true_path is None else [true_path])])
    return figure


def save(figure: Figure, folder: str | Path, name: str) -> list[Path]:
    """Write a figure as NAME.png and NAME.svg (`FORMATS`) into a folder and return their paths.

    Raises:
        GavoError: a file cannot be written.
    """
    paths = [Path(folder) / f"{name}.{suffix}" for suffix in FORMATS]
    for path in paths:
        metadata = {"Date": None} if path.suffix == ".svg" else None
        try:
            figure.savefig(path, dpi=150, metadata=metadata)
        except OSError as error:
            raise GavoError(f"{path}: cannot be written: {error.strerror or error}") from None
    return paths


def _figure(width: float, height: float) -> Figure:
    """Return an empty figure (inches) that belongs to no window and to no global state."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _limit_to_cube(space: Any, paths: Sequence[Float[np.ndarray, "n 3"]]) -> None:
    """Give the three axes of a drawing in space the same scale and a few ticks each."""
    points = np.concatenate(paths)[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    low, high = points.min(axis=0), points.max(axis=0)
    half = max(0.55 * float(np.max(high - low)), 1e-3)
    for axis, middle in zip("xyz", (low + high) / 2, strict=True):
        getattr(space, f"set_{axis}lim")(middle - half, middle + half)
        space.locator_params(axis=axis, nbins=4)
    space.set_box_aspect((1, 1, 1), zoom=0.85)


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
