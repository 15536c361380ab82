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
    """The figures of a run, by name; None without ground truth, or with too little of it."""

    device: str
    frames: int
    pairs: int
    lost_pairs: int
    guessed_pairs: int
    """Pairs that are not lost but whose motion is a guess: the last one, continued behind a body."""
    statuses: dict[str, int]
    """Pairs of each status."""
    segments: int
    """Stretches of the trajectory between which the motion is unknown; every error is computed within them."""
    unknown_motions: int
    """Places where the trajectory passes from one segment to another."""
    rpe_translation_rmse_m_per_s: float | None
    """Drift as TUM's tool computes it: relative pose error over 1 s."""
    rpe_rotation_rmse_deg_per_s: float | None
    rpe_translation_rmse_m_per_frame: float | None
    ate_translation_rmse_m: float | None
    """Absolute trajectory error, after alignment."""
    distance_error_final_m: float | None
    """Position error of the last pose that the truth covers, from a common first pose; None where the motion in between
    is unknown."""
    compile_seconds: float
    milliseconds_per_pair_median: float | None
    frames_per_second: float | None
    """Frames per second from files to poses, decoding included, compilation excluded."""


class RunMetrics(Metrics):
    """The metrics of a run, and what was run, as in metrics.json."""

    sequence: str
    method: str | None
    """Name of the method; None for a solver of one's own that has no name, see `register`."""
    preset: str | None
    """Name of the preset; None for settings that are no preset's."""
    seed: int
    complete: bool
    """Whether every frame was tracked: False if `on_lost` ended the run."""


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
    """The entries that identify a run, with which its metrics begin."""
    return {"sequence": sequence, "method": method, "preset": preset, "seed": seed}


def drifts_of(figures: Mapping[str, Any]) -> tuple[float, float]:
    """Drift of a run in translation (m/s) and rotation (deg/s); +inf without any, of a camera that was lost."""
    known = figures[DRIFT] is not None
    return (figures[DRIFT], figures[ROTATION_DRIFT]) if known else (np.inf, np.inf)


def errors_before(causal: Mapping[str, Any]) -> dict[str, Any]:
    """Errors of a trajectory before its correction by loops, under names of their own."""
    return {f"odometry_{name}": causal[name] for name in ERRORS}


def compute_metrics(
    trajectory: Trajectory,
    ground_truth: Trajectory | None,
    steps: list[Step],
    seconds: float,
    compile_seconds: float,
) -> Metrics:
    """The figures of `metrics.json` that follow from a run; None without ground truth, or with too little of it.

    Args:
        trajectory: The estimated trajectory.
        ground_truth: The true trajectory, or None.
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
    """The trajectory; raises GavoError where the motion from its first pose to its last is unknown."""
    if trajectory.segments[0] != trajectory.segments[-1]:
        raise GavoError("the first pose and the last belong to different segments")
    return trajectory
