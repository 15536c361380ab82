"""Why a trajectory may disagree with another as a whole: the order of its quaternions, inverse poses, or its size."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from gavo_jax.errors import GavoError
from gavo_jax.evaluation import align_rigidly, relative_pose_error
from gavo_jax.trajectory import Trajectory, inverse, quaternion_from_rotation, rotation_from_quaternion

REORDERED, LARGE = 0.25, 2.0
"""Quaternions are taken to be w-first if that order leaves less than this share of the median rotation error over one
second, and that error exceeds this many degrees."""

FAR = 0.02
"""Metres: the same for translations, where poses are taken to be inverted."""

OTHER_SIZE = 1.15
"""Ratio of two sizes above which they differ."""

UNITS_OF_LENGTH = {"millimetres": 1000.0, "centimetres": 100.0}
"""Units that positions may be in instead of metres, by the number of them in a metre."""

FEWEST_POSES = 10
"""Fewest poses that show a size."""

SIMILAR, MUCH_BETTER = 0.25, 0.33
"""Two trajectories differ in size only if a similarity leaves at most this share of the true path, and of what a rigid
motion leaves."""


def is_w_first(trajectory: Trajectory, other: Trajectory) -> bool:
    """Whether a file has its quaternions as w x y z instead of x y z w, judged by another trajectory.

    The file alone does not show it: the wrong order leaves motions as large and as smooth. But two trajectories that
    disagree, and agree once this one is reordered, do. Misread quaternions are the inverse rotations between two fixed
    ones, so inverse poses of a camera that turns about one axis look alike; those are not reported.
    """

    def error(quaternions: Float[np.ndarray, "n 4"]) -> float:
        poses = trajectory.world_T_camera.copy()
        poses[:, :3, :3] = rotation_from_quaternion(quaternions)
        return relative_pose_error(other, replace(trajectory, world_T_camera=poses)).rotation.median

    quaternions = quaternion_from_rotation(trajectory.world_T_camera[:, :3, :3])
    try:
        least = min(error(quaternions), error(quaternions * [-1, -1, -1, 1]))
        return least > LARGE and error(quaternions[:, [1, 2, 3, 0]]) < REORDERED * least
    except GavoError:
        return False


def is_inverse(trajectory: Trajectory, other: Trajectory) -> bool:
    """Whether a file has its poses from world to camera, judged by another trajectory.

    Their motions disagree, and agree once this one's poses are inverted; their rotations then agree no worse.
    """

    def errors(poses: Float[np.ndarray, "n 4 4"]) -> np.ndarray:
        relative = relative_pose_error(other, replace(trajectory, world_T_camera=poses))
        return np.array([relative.translation.median, relative.rotation.median])

    try:
        as_written = errors(trajectory.world_T_camera)
        if not as_written[0] > FAR:
            return False
        inverted = errors(inverse(trajectory.world_T_camera))
    except GavoError:
        return False
    return bool(inverted[0] < REORDERED * as_written[0] and inverted[1] < max(as_written[1], LARGE))


def unit_of_length(size: float) -> str | None:
    """The unit that positions are in if they are `size` times too large; None if that is no unit's."""
    return next((name for name, count in UNITS_OF_LENGTH.items() if 1 / OTHER_SIZE < size / count < OTHER_SIZE), None)


def relative_size(estimate: Trajectory, truth: Trajectory) -> float | None:
    """Size of an estimate over that of the truth if the two differ in nothing else; None if they do not.

    Depth in a wrong unit scales all motions alike, so that nothing within the run shows it. The longest segment is
    aligned rigidly, and then scaled about its centre (Umeyama 1991); its errors are those of positions.
    """
    try:
        true, covered = truth.interpolate(estimate.timestamps)
    except GavoError:
        return None
    known = covered & np.isfinite(estimate.world_T_camera).all(axis=(1, 2)) & np.isfinite(true).all(axis=(1, 2))
    if not known.any():
        return None
    numbers, sizes = np.unique(estimate.segments[known], return_counts=True)
    chosen = known & (estimate.segments == numbers[sizes.argmax()])
    points, targets = estimate.world_T_camera[chosen, :3, 3], true[chosen, :3, 3]
    if len(points) < FEWEST_POSES:
        return None
    rotation, _ = align_rigidly(points, targets)
    turned, centered = (points - points.mean(axis=0)) @ rotation.T, targets - targets.mean(axis=0)
    scale = float(np.sum(turned * centered) / max(np.sum(turned**2), np.finfo(float).tiny))
    if scale <= 0 or 1 / OTHER_SIZE < scale < OTHER_SIZE:
        return None
    similar, rigid = (float(np.linalg.norm(some - centered)) for some in (scale * turned, turned))
    return 1 / scale if similar < min(SIMILAR * float(np.linalg.norm(centered)), MUCH_BETTER * rigid) else None
