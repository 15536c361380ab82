"""The figures of a run, and their names in every JSON file and table."""

from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final, TypedDict

import jax
import numpy as np

from gavo_jax.errors import GavoError
from gavo_jax.evaluation import absolute_trajectory_error, distance_error, relative_pose_error
from gavo_jax.odometry.driver import Step
from gavo_jax.trajectory import Trajectory


class Metrics(TypedDict):
    """The figures of a run by their names; None where there is no, or too little, ground truth."""

    device: str
    frames: int
    pairs: int
    lost_pairs: int
    guessed_pairs: int
    """Pairs that are not lost and whose motion the images do not tell: the last one, gone on with behind a body."""
    statuses: dict[str, int]
    """Pairs of each status."""
    segments: int
    """Stretches of the trajectory between which the motion is unknown; every error is computed within them."""
    unknown_motions: int
    """Places where one ends and another begins, or goes on."""
    rpe_translation_rmse_m_per_s: float | None
    """Drift, as by TUM's tool: relative pose error over 1 s."""
    rpe_rotation_rmse_deg_per_s: float | None
    rpe_translation_rmse_m_per_frame: float | None
    ate_translation_rmse_m: float | None
    """After alignment."""
    distance_error_final_m: float | None
    """At the end, from the first pose on; None where the motion between is unknown somewhere."""
    compile_seconds: float
    milliseconds_per_pair_median: float | None
    frames_per_second: float | None
    """From files to poses, after compilation, decoding included."""


class RunMetrics(Metrics):
    """The same, and what was run, as in metrics.json."""

    sequence: str
    method: str | None
    """None for a solver of one's own that has no name; see `register`."""
    preset: str | None
    """None for settings that are no preset's."""
    seed: int
    complete: bool
    """Whether every frame was tracked: not where `on_lost` ended the run."""


DRIFT: Final = "rpe_translation_rmse_m_per_s"
ROTATION_DRIFT: Final = "rpe_rotation_rmse_deg_per_s"
DRIFT_PER_FRAME: Final = "rpe_translation_rmse_m_per_frame"
ABSOLUTE_ERROR: Final = "ate_translation_rmse_m"
FINAL_DISTANCE: Final = "distance_error_final_m"
COMPILE_SECONDS: Final = "compile_seconds"
MILLISECONDS: Final = "milliseconds_per_pair_median"
FRAMES_PER_SECOND: Final = "frames_per_second"


ERRORS: Final = (DRIFT, ROTATION_DRIFT, DRIFT_PER_FRAME, ABSOLUTE_ERROR, FINAL_DISTANCE)


def run_identity(sequence: str, method: str | None, preset: str | None, seed: int | None) -> dict[str, Any]:
    """Name the run that metrics are of: what they begin with."""
    return {"sequence": sequence, "method": method, "preset": preset, "seed": seed}


def errors_before(causal: Mapping[str, Any]) -> dict[str, Any]:
    """The errors of a trajectory that loops have corrected since, under names of their own."""
    return {f"odometry_{name}": causal[name] for name in ERRORS}


def compute_metrics(
    trajectory: Trajectory,
    ground_truth: Trajectory | None,
    steps: list[Step],
    seconds: float,
    compile_seconds: float,
) -> Metrics:
    """The figures of `metrics.json` that follow from a run; None where there is no, or too little, ground truth.

    Args:
        trajectory: The estimate.
        ground_truth: The truth, or None.
        steps: The run's steps.
        seconds: Wall time of the run after compilation, decoding included.
        compile_seconds: Time of the compilation.
    """

    def figure(compute: Callable[[Trajectory], float]) -> float | None:
        if ground_truth is None:
            return None
        try:
            return float(compute(ground_truth))
        except GavoError:
            return None

    per_second = partial(relative_pose_error, trajectory, delta=1.0, unit="s")
    per_frame = partial(relative_pose_error, trajectory, delta=1, unit="frames")
    return {
        "device": jax.devices()[0].device_kind,
        "frames": len(steps) + 1,
        "pairs": len(steps),
        "lost_pairs": sum(step.lost for step in steps),
        "guessed_pairs": sum(step.origin == "guessed" and not step.lost for step in steps),
        "statuses": dict(Counter(str(step.alignment.status) for step in steps)),
        "segments": len(np.unique(trajectory.segments)),
        "unknown_motions": int(np.count_nonzero(np.diff(trajectory.segments))),
        DRIFT: figure(lambda truth: per_second(truth).translation.rmse),
        ROTATION_DRIFT: figure(lambda truth: per_second(truth).rotation.rmse),
        DRIFT_PER_FRAME: figure(lambda truth: per_frame(truth).translation.rmse),
        ABSOLUTE_ERROR: figure(lambda truth: absolute_trajectory_error(trajectory, truth).rmse),
        FINAL_DISTANCE: figure(lambda truth: distance_error(_unbroken(trajectory), truth).final),
        COMPILE_SECONDS: compile_seconds,
        MILLISECONDS: float(np.median([step.milliseconds for step in steps])) if steps else None,
        FRAMES_PER_SECOND: (len(steps) + 1) / seconds if seconds > 0 else None,
    }


def _unbroken(trajectory: Trajectory) -> Trajectory:
    """The trajectory; raises GavoError where the way from its first pose to its last is not known."""
    if trajectory.segments[0] != trajectory.segments[-1]:
        raise GavoError("the first pose and the last are of different segments")
    return trajectory
