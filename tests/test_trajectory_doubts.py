"""What is said of trajectories that disagree as a whole: the order of their quaternions, their size."""

from dataclasses import replace

import numpy as np
import pytest
from paths import CLIPS, perturbed, real_pair, smooth_truth, transform

from gavo_jax.trajectory import Trajectory, inverse, quaternion_from_rotation, rotation_from_quaternion
from gavo_jax.trajectory_doubts import is_inverse, is_w_first, other_axes, relative_size, unit_of_length


def w_first(trajectory: Trajectory) -> Trajectory:
    """As read from a file that has w x y z."""
    poses = trajectory.world_T_camera.copy()
    poses[:, :3, :3] = rotation_from_quaternion(quaternion_from_rotation(poses[:, :3, :3])[:, [3, 0, 1, 2]])
    return Trajectory(trajectory.timestamps, poses)


@pytest.mark.parametrize("clip", CLIPS)
def test_quaternions_of_the_other_order_are_told(data_dir, clip):
    noisy, truth = real_pair(data_dir / clip)
    estimate = perturbed(truth, noisy.timestamps, 0, 0.3)
    inverted = Trajectory(truth.timestamps, inverse(truth.world_T_camera))
    for one, other in ((estimate, truth), (truth, estimate)):
        assert is_w_first(w_first(one), other)
        assert not is_w_first(one, other) and not is_w_first(one, w_first(other))
    for one, other in ((noisy, truth), (truth, noisy), (estimate, inverted), (inverted, estimate)):
        assert not is_w_first(one, other)


@pytest.mark.parametrize("clip", CLIPS)
def test_poses_from_world_to_camera_are_told(data_dir, clip):
    """The errors were ten times as large, and nothing said why."""
    noisy, truth = real_pair(data_dir / clip)
    estimate = perturbed(truth, noisy.timestamps, 0, 0.3)
    inverted = Trajectory(truth.timestamps, inverse(truth.world_T_camera))
    assert is_inverse(inverted, estimate)
    for one, other in ((estimate, truth), (noisy, truth), (w_first(truth), estimate), (scaled(truth, 1e3), estimate)):
        assert not is_inverse(one, other)


@pytest.mark.parametrize(
    ("size", "unit"), [(950.0, "millimetres"), (102.0, "centimetres"), (5.0, None), (1.0, None), (0.001, None)]
)
def test_positions_in_another_unit_are_told(size, unit):
    """Of a truth in millimetres a run said that depth had 5 units per metre, and refused that."""
    assert unit_of_length(size) == unit


@pytest.mark.parametrize("axis", np.eye(3))
def test_inverse_poses_of_a_turn_about_one_axis_are_not_taken_for_the_other_order(axis):
    stamps = np.arange(100) / 30
    turn, back = (
        Trajectory(stamps, np.array([transform(axis * sign * 0.4 * t, np.zeros(3)) for t in stamps]))
        for sign in (1, -1)
    )
    assert not is_w_first(turn, turn) and not is_w_first(back, turn)


def scaled(trajectory: Trajectory, factor: float) -> Trajectory:
    poses = trajectory.world_T_camera.copy()
    poses[:, :3, 3] *= factor
    return replace(trajectory, world_T_camera=poses)


@pytest.mark.parametrize("clip", CLIPS)
@pytest.mark.parametrize("factor", [0.001, 0.2, 0.8, 1.3, 5.0, 1000.0])
def test_a_trajectory_of_another_size_is_told(data_dir, clip, factor):
    noisy, truth = real_pair(data_dir / clip)
    estimate = perturbed(truth, noisy.timestamps, 0, 0.1)
    assert relative_size(scaled(estimate, factor), truth) == pytest.approx(factor, rel=0.05)
    assert relative_size(estimate, scaled(truth, factor)) == pytest.approx(1 / factor, rel=0.05)


@pytest.mark.parametrize(("factor", "is_told"), [(0.8, True), (0.9, False), (1.0, False), (1.1, False), (1.25, True)])
def test_a_size_that_a_depth_sensor_may_be_off_by_is_not_another_one(factor, is_told):
    """Catches a word about the unit of depth where the scale is off by a tenth, as that of many a sensor."""
    truth = smooth_truth()
    assert (relative_size(scaled(truth, factor), truth) is not None) == is_told


@pytest.mark.parametrize("clip", CLIPS)
def test_a_trajectory_that_drifts_or_is_of_another_camera_has_no_other_size(data_dir, clip):
    noisy, truth = real_pair(data_dir / clip)
    assert relative_size(noisy, truth) is None
    for degree in (0.3, 1.0, 3.0):
        assert relative_size(perturbed(truth, noisy.timestamps, 1, degree), truth) is None
    others = (truth.timestamps, inverse(truth.world_T_camera)), (truth.timestamps, truth.world_T_camera[::-1])
    for stamps, poses in others:
        assert relative_size(Trajectory(stamps, poses), truth) is None


def test_a_size_needs_motion_and_enough_poses_of_one_segment():
    truth = smooth_truth()
    still = replace(truth, world_T_camera=np.tile(np.eye(4), (len(truth), 1, 1)))
    noise = np.random.default_rng(0).normal(0, 0.002, (len(truth), 3))
    trembling = still.world_T_camera.copy()
    trembling[:, :3, 3] = noise
    for one in (still, replace(still, world_T_camera=trembling)):
        assert relative_size(one, truth) is None and relative_size(truth, one) is None
    half = scaled(truth, 0.5)
    assert relative_size(half, truth) == pytest.approx(0.5)
    assert relative_size(half[:9], truth) is None
    assert relative_size(replace(half, timestamps=half.timestamps + 1000), truth) is None
    segments = np.arange(len(truth)) // 9
    assert relative_size(replace(half, segments=segments), truth) is None
    poses = half.world_T_camera.copy()
    poses[200:] = transform([0.0, 0.0, 1.0], [3.0, 0.0, 0.0]) @ poses[200:]
    apart = replace(half, world_T_camera=poses, segments=(np.arange(len(truth)) >= 200).astype(int))
    assert relative_size(apart, truth) == pytest.approx(0.5)
    lost = half.world_T_camera.copy()
    lost[5, 0, 3] = np.nan
    assert relative_size(replace(half, world_T_camera=lost), truth) == pytest.approx(0.5)


AXES = {
    "z, -x, -y": [[0, -1, 0], [0, 0, -1], [1, 0, 0]],  # x forward, y left, z up, as ROS has them
    "x, -y, -z": np.diag([1, -1, -1]),  # as OpenGL has them
    "y, x, -z": [[0, 1, 0], [1, 0, 0], [0, 0, -1]],
}
"""Axes of a camera, the columns, in those of another one."""


@pytest.mark.parametrize("clip", CLIPS)
@pytest.mark.parametrize(("names", "rotation"), AXES.items())
def test_other_axes_of_the_camera_are_told(data_dir, clip, names, rotation):
    """Of poses with other axes the drift was tenfold, the absolute error small, and the truth's quaternions blamed."""
    noisy, truth = real_pair(data_dir / clip)
    estimate = perturbed(truth, noisy.timestamps, 0, 0.3)
    for one, other in ((estimate, truth), (truth, estimate)):
        assert other_axes(one, other) is None
        turned = with_axes(one, np.array(rotation, float))
        assert other_axes(turned, other) == f"its camera's x, y, z axes are the other's {names}"
        assert not is_w_first(turned, other) and not is_w_first(other, turned)


def test_a_camera_that_is_turned_against_the_other_is_told(data_dir):
    noisy, truth = real_pair(data_dir / "fr1_desk")
    estimate = perturbed(truth, noisy.timestamps, 0, 0.3)
    turned = with_axes(truth, transform([0.3, 0.6, -0.2], np.zeros(3))[:3, :3])
    assert other_axes(turned, estimate) == "its camera is turned by 40° against the other's"


@pytest.mark.parametrize("clip", CLIPS)
def test_a_noisy_trajectory_has_the_same_axes(data_dir, clip):
    noisy, truth = real_pair(data_dir / clip)
    for one, other in ((noisy, truth), (truth, noisy), (w_first(truth), noisy)):
        assert other_axes(one, other) is None


def with_axes(trajectory: Trajectory, rotation: np.ndarray) -> Trajectory:
    poses = trajectory.world_T_camera.copy()
    poses[:, :3, :3] = poses[:, :3, :3] @ rotation
    return replace(trajectory, world_T_camera=poses)
