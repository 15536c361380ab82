"""`gavo evaluate`: errors of one trajectory file against another."""

from gavo_jax.cli.options import Evaluate
from gavo_jax.errors import GavoError
from gavo_jax.evaluation import absolute_trajectory_error, distance_error, relative_pose_error
from gavo_jax.output.screen import number, print_table, say
from gavo_jax.trajectory import Trajectory


def evaluate(options: Evaluate) -> int:
    """Print relative pose error, absolute trajectory error and distance error with their definitions."""
    estimate, truth = Trajectory.read_tum(options.estimate), Trajectory.read_tum(options.groundtruth)
    try:
        relative = relative_pose_error(estimate, truth, options.delta, options.unit)
        absolute = absolute_trajectory_error(estimate, truth)
        distance = distance_error(estimate, truth)
    except GavoError as error:
        raise GavoError(f"{options.estimate} against {options.groundtruth}: {error}") from None
    span = _span(options.delta, options.unit)
    series = {
        f"RPE translation [m / {span}]": relative.translation,
        f"RPE rotation [deg / {span}]": relative.rotation,
        "ATE [m]": absolute,
        "distance error [m]": distance,
    }
    rows = [
        (name, *(number(value, 6) for value in (e.rmse, e.mean, e.median, e.max)), len(e.values))
        for name, e in series.items()
    ]
    title = f"{options.estimate} against {options.groundtruth}"
    print_table(title, ("", "RMSE", "mean", "median", "max", "count"), rows)
    for name, errors in series.items():
        say(f"{name}: {errors.definition}.")
    return 0


def _span(delta: float, unit: str) -> str:
    """Return what one value of the relative pose error spans: `s`, `0.5 s`, `frame`, `10 frames`."""
    one = {"s": "s", "frames": "frame"}[unit]
    return one if delta == 1 else f"{delta:g} {unit}"
