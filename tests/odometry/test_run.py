"""A run over a sequence: what it is given is checked, the seed decides its bits, a real clip is followed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small
from driving import Altered, errors, known, run
from small import Rendered

from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.run import OdometryRun, run_odometry
from gavo_jax.status import AlignmentStatus


def test_what_is_no_sequence_is_refused_by_name():
    frames = list(SyntheticSequence(frames=2, camera=small.CAMERA))
    for wrong in (frames, "fr1_xyz"):
        with pytest.raises(GavoError, match="a Sequence is needed, not (list|str)"):
            run_odometry(wrong)  # pyright: ignore[reportArgumentType]
    with pytest.raises(GavoError, match="Camera is needed"):
        Odometry("fr1")  # pyright: ignore[reportArgumentType]
    odometry = Odometry(small.CAMERA, small.NEWTON)
    dark = frames[0].grey / np.float32(255.0)
    with pytest.raises(GavoError, match="multiply by 255"):
        odometry.register(replace(frames[0], grey=dark), 0.0)
    odometry.register(frames[0], 0.0)
    step = odometry.register(replace(frames[1], grey=dark), 1 / 30)  # a covered lens is no reason to end a run
    assert step is not None and step.alignment.status is not AlignmentStatus.OK


def test_follows_the_camera(sequence: SyntheticSequence, plain_run: OdometryRun) -> None:
    trajectory = plain_run.trajectory
    np.testing.assert_array_equal(trajectory.timestamps, sequence.timestamps)
    np.testing.assert_array_equal(trajectory.world_T_camera[0], np.eye(4))
    truth = sequence.ground_truth.world_T_camera[:, :3, 3]
    travelled = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    assert errors(plain_run, sequence)[-1] < 0.1 * travelled
    assert not any(step.lost for step in plain_run.steps)


def test_same_seed_same_bits() -> None:
    part = Rendered(frames=4)
    poses = [run_odometry(part, seed=seed).trajectory.world_T_camera for seed in (0, 0, 1)]
    np.testing.assert_array_equal(poses[0], poses[1])
    assert np.any(poses[0] != poses[2])
    np.testing.assert_allclose(poses[0], poses[2], atol=0.01)


def test_an_odometry_needs_two_frames(sequence: SyntheticSequence) -> None:
    for count in (0, 1):
        with pytest.raises(GavoError, match="two frames"):
            run(sequence[:count])


def test_a_sequence_is_checked_before_the_run(sequence: SyntheticSequence) -> None:
    class Refused(Altered):
        def check(self) -> None:
            raise GavoError("rgb.txt: nonsense")

    refused = Refused(sequence, lambda _, frame: frame)
    with pytest.raises(GavoError, match="nonsense"):
        run(refused)
    assert refused.read == []


def test_real_frames(data_dir: Path) -> None:
    result = run_odometry(TumSequence(data_dir / "fr1_xyz")[:40])
    assert result.metrics["lost_pairs"] == 0
    assert known(result.metrics["rpe_translation_rmse_m_per_s"]) < 0.03
    assert known(result.metrics["rpe_rotation_rmse_deg_per_s"]) < 2.0
    assert known(result.metrics["ate_translation_rmse_m"]) < 0.02
