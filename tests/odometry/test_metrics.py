"""The figures of a run, by their names, and which of them need the truth."""

import time
from typing import Any

import numpy as np
import pytest
from driving import FRAMES, Altered, errors, known, run

from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.mapping.mapper import Loops
from gavo_jax.mapping.pose_graph import Solution
from gavo_jax.odometry.driver import Step
from gavo_jax.odometry.metrics import compute_metrics
from gavo_jax.odometry.run import OdometryRun, finish_run
from gavo_jax.trajectory import Trajectory

METRICS = {
    "device",
    "frames",
    "pairs",
    "lost_pairs",
    "guessed_pairs",
    "rpe_translation_rmse_m_per_s",
    "rpe_rotation_rmse_deg_per_s",
    "rpe_translation_rmse_m_per_frame",
    "ate_translation_rmse_m",
    "distance_error_final_m",
    "compile_seconds",
    "milliseconds_per_pair_median",
    "frames_per_second",
}


def test_metrics(plain_run: OdometryRun, sequence: SyntheticSequence) -> None:
    metrics = plain_run.metrics
    assert METRICS <= set(metrics)
    assert (metrics["frames"], metrics["pairs"], metrics["lost_pairs"]) == (FRAMES, FRAMES - 1, 0)
    assert metrics["sequence"] == "synthetic" and metrics["seed"] == 0
    assert metrics["method"] == "gauss-newton" and metrics["preset"] is None and metrics["complete"]
    assert metrics["distance_error_final_m"] == pytest.approx(errors(plain_run, sequence)[-1], abs=1e-6)
    assert 0 < known(metrics["rpe_translation_rmse_m_per_frame"]) < 0.01
    assert metrics["rpe_translation_rmse_m_per_s"] is None, "the sequence is shorter than a second"
    for key in ("compile_seconds", "milliseconds_per_pair_median", "frames_per_second"):
        assert known(metrics[key]) > 0


class SlowlyMapped:
    """A map without keyframes that takes its time in the end."""

    def finish(self, steps: list[Step]) -> Loops:
        time.sleep(0.3)
        return Loops([], [], Solution(np.zeros((0, 4, 4)), np.zeros(0), np.zeros((0, 6)), 1.0))


def test_a_resumed_run_is_as_fast_as_what_was_tracked_of_it(plain_run: OdometryRun) -> None:
    """What comes at the end once was counted as often as pairs had been tracked before."""

    def speed(seconds: float, pairs: int, mapper: Any = None) -> float | None:
        outcome = finish_run(0.0, plain_run.steps, None, mapper, seconds, 0.0, pairs)
        return outcome.figures["frames_per_second"]

    pairs = len(plain_run.steps)
    assert speed(20.0, pairs) == pytest.approx((pairs + 1) / 20.0, rel=0.01)
    assert speed(20.0 / pairs, 1) == pytest.approx((pairs + 1) / 20.0, rel=0.01)
    assert known(speed(20.0 / pairs, 1, SlowlyMapped())) == pytest.approx((pairs + 1) / 20.3, rel=0.02)
    assert speed(1e-4, 0) is None, "nothing was tracked: nothing is known"


def test_without_ground_truth_there_are_no_errors(sequence: SyntheticSequence) -> None:
    blind = Altered(sequence[:4], lambda _, frame: frame, ground_truth=False)
    metrics = run(blind).metrics
    about_truth = {key for key in METRICS if key.startswith(("rpe", "ate", "distance"))}
    assert {key for key in METRICS if metrics[key] is None} == about_truth


def test_there_is_no_distance_at_the_end_where_the_way_there_is_unknown() -> None:
    stamps = np.arange(4) / 30
    poses = np.stack([np.eye(4)] * 4)
    poses[:, 0, 3] = np.arange(4)
    truth = Trajectory(stamps, poses)
    shrunk = np.array(poses)
    shrunk[:, 0, 3] *= 0.5
    ends = [
        compute_metrics(Trajectory(stamps, shrunk, np.array(segments)), truth, [], 1.0, 0.0)["distance_error_final_m"]
        for segments in ([0, 0, 0, 0], [0, 0, 0, 1], [0, 1, 1, 0])
    ]
    assert ends == [pytest.approx(1.5), None, pytest.approx(1.5)]
