"""`gavo evaluate`: errors of one trajectory file against another."""

import json

from gavo_jax.cli.options import Evaluate
from gavo_jax.errors import GavoError
from gavo_jax.evaluation import ErrorSeries, absolute_trajectory_error, distance_error, relative_pose_error
from gavo_jax.output import plots
from gavo_jax.output.drawing import draw
from gavo_jax.output.files import prepare_folder
from gavo_jax.output.screen import number, print_table, say, waiting
from gavo_jax.trajectory import Trajectory


def evaluate(options: Evaluate) -> int:
    """Print relative pose error, absolute trajectory error and distance error with their definitions, or as JSON."""
    if options.plot is not None and not plots.available():
        raise GavoError("--plot: matplotlib is not installed: pip install 'gavo-jax[plot]'")
    estimate, truth = Trajectory.read_tum(options.estimate), Trajectory.read_tum(options.groundtruth)
    try:
        relative = relative_pose_error(estimate, truth, options.delta, options.unit)
        absolute = absolute_trajectory_error(estimate, truth)
        distance = distance_error(estimate, truth)
    except GavoError as error:
        hint = _hint(estimate, truth, options)
        raise GavoError(f"{options.estimate} against {options.groundtruth}: {error}{hint}") from None
    series = {
        "rpe_translation": relative.translation,
        "rpe_rotation": relative.rotation,
        "ate": absolute,
        "distance_error": distance,
    }
    if options.json:
        span = {"delta": options.delta, "delta_unit": options.unit}
        print(json.dumps({**span, **{name: errors.summary() for name, errors in series.items()}}, indent=2))
    else:
        _print(options, series)
    if options.plot is not None:
        folder = prepare_folder(options.plot)
        with waiting("drawing figures …"):
            draw(folder, {options.estimate.stem: estimate}, truth)
        if not options.json:
            say(f"figures in {folder}")
    return 0


def _hint(estimate: Trajectory, truth: Trajectory, options: Evaluate) -> str:
    """Why the stamps may lead to no error, and what would help."""
    stamps = estimate.timestamps, truth.timestamps
    if min(map(len, stamps)) == 0:
        return ""
    (first, last), (start, end) = ((some.min(), some.max()) for some in stamps)
    if first > end or last < start:
        return f": the estimate goes from {first:.3f} to {last:.3f} s, the truth from {start:.3f} to {end:.3f} s"
    if options.unit == "s" and last - first <= options.delta:
        return f": the estimate lasts {last - first:.2f} s: set --delta, or --unit frames"
    return ""


def _print(options: Evaluate, series: dict[str, ErrorSeries]) -> None:
    """Print a row for each kind of error, and below what each is."""
    span = _span(options.delta, options.unit)
    names = (f"RPE translation, m/{span}", f"RPE rotation, deg/{span}", "ATE, m", "distance error, m")
    rows = [
        (name, *(number(value, 6) for value in (e.rmse, e.mean, e.median, e.max)), len(e.values))
        for name, e in zip(names, series.values(), strict=True)
    ]
    print_table(
        f"{options.estimate} against {options.groundtruth}", ("", "RMSE", "mean", "median", "max", "count"), rows
    )
    for name, errors in zip(names, series.values(), strict=True):
        say(f"{name}: {errors.definition}.")


def _span(delta: float, unit: str) -> str:
    """Return what one value of the relative pose error spans: `s`, `0.5 s`, `frame`, `10 frames`."""
    one = {"s": "s", "frames": "frame"}[unit]
    return one if delta == 1 else f"{delta:g} {unit}"
