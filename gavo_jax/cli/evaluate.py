"""`gavo evaluate`: errors of one trajectory file against another."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from gavo_jax.cli.options import Evaluate
from gavo_jax.cli.run_table import covered_in_part
from gavo_jax.datasets.clocks import INTERVALS
from gavo_jax.datasets.truth import counted_in
from gavo_jax.errors import GavoError, print_message
from gavo_jax.evaluation import (
    MAX_DIFFERENCE,
    ErrorSeries,
    absolute_trajectory_error,
    distance_error,
    relative_pose_error,
)
from gavo_jax.output import plots
from gavo_jax.output.drawing import draw
from gavo_jax.output.files import COMPARISON, FRAMES, prepare_folder, refuse_foreign
from gavo_jax.output.screen import number, print_table, say, waiting
from gavo_jax.trajectory import MAX_GAP, Trajectory, associate
from gavo_jax.trajectory_doubts import is_inverse, is_w_first, other_axes, relative_size, unit_of_length

UNITS = {1e-3: "milliseconds", 1e-6: "microseconds", 1e-9: "nanoseconds"}
"""Units, in seconds, that timestamps may have instead of seconds."""

DURATION_TOLERANCE = 0.1
"""Relative difference in duration below which two trajectories are taken to be of one recording."""


def evaluate(options: Evaluate) -> int:
    """Print relative pose error, absolute trajectory error and distance error with their definitions, or as JSON."""
    _check(options)
    paths = options.estimate, options.groundtruth
    (estimate, *_), (truth, *_) = read = _read(*paths)
    series, missing = _errors(estimate, truth, options)
    if options.json:
        span = {"delta": options.delta, "delta_unit": options.unit}
        figures = {name: None for name in NAMES} | {name: errors.summary() for name, errors in series.items()}
        print(json.dumps({**span, **figures}, indent=2))
    else:
        _print(options, series)
    note = print_message if options.json else say  # beside the JSON, not in it
    for words in (*missing, *_remarks(paths, read)):
        note(words)
    if options.plot is not None:
        folder = prepare_folder(options.plot)
        with waiting("drawing figures …"):
            draw(folder, {options.estimate.stem: estimate}, truth)
        if not options.json:
            say(f"figures in {folder}")
    return 0


def _check(options: Evaluate) -> None:
    """Raise GavoError for an invalid span, or for figures that cannot be drawn."""
    if not 0 < options.delta < np.inf:
        raise GavoError(f"--delta: must be a positive number, not {options.delta:g}")
    if options.unit == "frames" and options.delta != int(options.delta):
        raise GavoError(f"--delta: must be a whole number of frames, not {options.delta:g}")
    if options.plot is None:
        return
    if not plots.available():
        raise GavoError("--plot: matplotlib is not installed: pip install 'gavo-jax[plot]'")
    refuse_foreign(options.plot, FRAMES, COMPARISON)


def _remarks(paths: tuple[Path, Path], read: list[tuple[Trajectory, float]]) -> Iterator[str]:
    """Yield a remark for each file that was not read literally, or disagrees as a whole, and for a truth in part."""
    are_comparable = True
    for path, (one, unit), (other, _) in zip(paths, read, reversed(read), strict=True):
        if unit in UNITS:
            yield f"{path}: its stamps are taken as {UNITS[unit]}"
        if is_w_first(one, other):
            yield f"{path}: its rotations agree only if its quaternions are read as w x y z; write them as x y z w"
        elif is_inverse(one, other):
            yield f"{path}: it agrees only if its poses are inverted; write them from camera to world"
            are_comparable = False
    if are_comparable and (axes := other_axes(read[0][0], read[1][0])):
        yield f"{paths[0]}: it agrees with {paths[1]} only if {axes}; the relative errors do not allow for that"
    if are_comparable and (size := relative_size(read[0][0], read[1][0])):
        cause = "the errors do not allow for that"
        for path, times in zip(paths, (size, 1 / size), strict=True):
            if name := unit_of_length(times):
                cause = f"{path} seems to be in {name}"
        yield f"{paths[0]}: it has {size:.3g} times the size of {paths[1]}, and {cause}"
    (estimate, _), (truth, _) = read
    is_dense = len(truth) > 1 and np.median(np.diff(truth.timestamps)) <= MAX_GAP
    if is_dense and (part := covered_in_part(estimate, truth)):
        yield part


NAMES = ("rpe_translation", "rpe_rotation", "ate", "distance_error")
"""Names of the errors, in the order they are printed."""


def _errors(estimate: Trajectory, truth: Trajectory, options: Evaluate) -> tuple[dict[str, ErrorSeries], list[str]]:
    """Return the errors by name, and why any errors of the whole trajectory are missing.

    Raises:
        GavoError: no two poses are as far apart as the relative error needs, or the timestamps' units differ.
    """
    try:
        _check_units(estimate.timestamps, truth.timestamps)
        relative = relative_pose_error(estimate, truth, options.delta, options.unit)
    except GavoError as error:
        hint = _hint(estimate, truth, options)
        raise GavoError(f"{options.estimate} against {options.groundtruth}: {error}{hint}") from None
    series, missing = {"rpe_translation": relative.translation, "rpe_rotation": relative.rotation}, []
    for name, compute in (("ate", absolute_trajectory_error), ("distance_error", distance_error)):
        try:
            series[name] = compute(estimate, truth)
        except GavoError as error:
            missing.append(str(error))
    return series, missing


def _read(*paths: Path) -> list[tuple[Trajectory, float]]:
    """Read two trajectories; return each with timestamps in seconds, and the unit in its file, in seconds.

    If most timestamps of the two files match as written, both are taken to be in seconds.
    """
    written = [Trajectory.read_tum(path) for path in paths]
    units = [counted_in(one) for one in written]
    first, second = (one.timestamps for one in written)
    alike = len(associate(first, second, MAX_DIFFERENCE)[0])
    if units[0] != units[1] and 2 * alike > min(len(first), len(second)):
        units = [1.0, 1.0]
    return [(replace(one, timestamps=unit * one.timestamps), unit) for one, unit in zip(written, units, strict=True)]


def _check_units(estimate: np.ndarray, truth: np.ndarray) -> None:
    """Raise GavoError if the two trajectories' timestamps seem to be in different units; files don't state the unit."""
    for whose, stamps, others in (("estimate", estimate, truth), ("truth", truth, estimate)):
        if min(len(stamps), len(others)) < 2:
            return
        for unit, name in UNITS.items():
            is_alike = abs(unit * np.ptp(stamps) / np.ptp(others) - 1) < DURATION_TOLERANCE or not _meet(stamps, others)
            if is_alike and _meet(unit * stamps, others) and unit * np.median(np.diff(stamps)) > INTERVALS[0]:
                raise GavoError(
                    f"the stamps of the {whose} look like {name}, the others like seconds; write both in seconds"
                )


def _meet(stamps: np.ndarray, others: np.ndarray) -> bool:
    return bool(stamps.min() <= others.max() and others.min() <= stamps.max())


def _hint(estimate: Trajectory, truth: Trajectory, options: Evaluate) -> str:
    """Explain why the timestamps may yield no error, and what would help."""
    stamps = estimate.timestamps, truth.timestamps
    if min(map(len, stamps)) < 2 or not 0 < options.delta < np.inf:
        return ""
    (first, last), (start, end) = ((some.min(), some.max()) for some in stamps)
    if first > end or last < start:
        return f"; the estimate covers {first:.3f} to {last:.3f} s, the truth {start:.3f} to {end:.3f} s"
    if options.unit == "s" and last - first <= options.delta:
        return f"; the estimate lasts {last - first:.2f} s: set --delta, or --unit frames"
    if options.unit == "s" and np.median(np.diff(np.sort(stamps[0]))) > options.delta:
        return "; set --delta, or --unit frames"
    return ""


def _print(options: Evaluate, series: dict[str, ErrorSeries]) -> None:
    """Print a row for each kind of error, and the definitions below."""
    span = _span(options.delta, options.unit)
    heads = (f"RPE translation, m/{span}", f"RPE rotation, deg/{span}", "ATE, m", "distance error, m")
    names: dict[str, str] = dict(zip(NAMES, heads, strict=True))
    rows = [
        (names[name], *(number(value, 6) for value in (e.rmse, e.mean, e.median, e.max)), len(e.values))
        for name, e in series.items()
    ]
    print_table(
        f"{options.estimate} against {options.groundtruth}", ("", "RMSE", "mean", "median", "max", "count"), rows
    )
    for name, errors in series.items():
        say(f"{names[name]}: {errors.definition}.")


def _span(delta: float, unit: str) -> str:
    """Return the span of the relative pose error as text: `s`, `0.5 s`, `frame`, `10 frames`."""
    one = {"s": "s", "frames": "frame"}[unit]
    return one if delta == 1 else f"{delta:g} {unit}"
