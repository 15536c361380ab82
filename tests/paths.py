"""Trajectories for tests: smooth ones, and odometries of them that drift."""

import numpy as np
from scipy.spatial.transform import Rotation

from gavo_jax.trajectory import Trajectory, inverse

CLIPS = ["fr1_xyz", "fr1_desk", "fr1_rpy"]


def transform(rotation_vector, translation) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    matrix[:3, 3] = translation
    return matrix


def smooth_truth(seconds: float = 4.0, rate: float = 100.0, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    stamps = 1000 + np.arange(0, seconds, 1 / rate) + rng.uniform(-0.001, 0.001, int(round(seconds * rate)))
    phase = rng.uniform(0, 6, 6)
    waves = 0.5 * np.sin(stamps[:, None] * [1.0, 1.3, 0.7, 0.9, 1.1, 0.6] + phase)
    return Trajectory(stamps, np.array([transform(row[:3], row[3:]) for row in waves]))


def perturbed(truth: Trajectory, stamps: np.ndarray, seed: int, degree: float = 1.0) -> Trajectory:
    """An odometry of `truth`: first pose the identity, every step off by a few millimetres and tenths of a degree."""
    rng = np.random.default_rng(seed)
    true, valid = truth.interpolate(stamps)
    assert valid.all()
    world_T_camera = [np.eye(4)]
    for before, after in zip(true[:-1], true[1:], strict=True):
        noise = transform(rng.normal(0, 0.005 * degree, 3), rng.normal(0, 0.004 * degree, 3))
        world_T_camera.append(world_T_camera[-1] @ inverse(before) @ after @ noise)
    return Trajectory(stamps, np.array(world_T_camera))


def real_pair(folder, seed=0) -> tuple[Trajectory, Trajectory]:
    truth = Trajectory.read_tum(folder / "groundtruth.txt")
    stamps = np.loadtxt(folder / "rgb.txt", usecols=0)
    return perturbed(truth, stamps, seed), truth
