"""Why a trajectory may disagree with another as a whole: the order of its quaternions, inverse poses, axes, or size."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from gavo_jax.errors import GavoError
from gavo_jax.evaluation import align_rigidly, relative_pose_error, rotation_angle
from gavo_jax.trajectory import Trajectory, inverse, quaternion_from_rotation, rotation_from_quaternion

REORDERED, LARGE = 0.25, 2.0
"""Quaternions are taken to be w-first if that order leaves less than this share of the median rotation error over one
second, and that error exceeds this many degrees."""

FAR = 0.02
"""Metres: the same for translations, where poses are taken to be inverted."""

TURNED = 0.2
"""Radians by which a camera's axes are turned at least, where they are taken to be other ones."""

ALONG = 0.97
"""Cosine above which an axis is taken to lie along another one."""

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
    disagree, and agree once this one is reordered, do; their translations then agree no worse. Misread quaternions are
    the inverse rotations between two fixed ones, so inverse poses of a camera that turns about one axis look alike;
    those are not reported.
    """

    def errors(quaternions: Float[np.ndarray, "n 4"]) -> tuple[float, float]:
        poses = trajectory.world_T_camera.copy()
        poses[:, :3, :3] = rotation_from_quaternion(quaternions)
        return _errors(other, trajectory, poses)

    quaternions = quaternion_from_rotation(trajectory.world_T_camera[:, :3, :3])
    try:
        moved, turned = errors(quaternions)
        least = min(turned, errors(quaternions * [-1, -1, -1, 1])[1])
        reordered = errors(quaternions[:, [1, 2, 3, 0]])
    except GavoError:
        return False
    return least > LARGE and reordered[1] < REORDERED * least and reordered[0] < max(moved, FAR)


def is_inverse(trajectory: Trajectory, other: Trajectory) -> bool:
    """Whether a file has its poses from world to camera, judged by another trajectory.

    Their motions disagree, and agree once this one's poses are inverted; their rotations then agree no worse.
    """
    try:
        as_written = _errors(other, trajectory, trajectory.world_T_camera)
        if not as_written[0] > FAR:
            return False
        inverted = _errors(other, trajectory, inverse(trajectory.world_T_camera))
    except GavoError:
        return False
    return inverted[0] < REORDERED * as_written[0] and inverted[1] < max(as_written[1], LARGE)


def other_axes(trajectory: Trajectory, other: Trajectory) -> str | None:
    """Say how a trajectory's camera axes lie in the other's if the two differ in nothing else; None if they do not.

    The absolute error does not show it, as it compares positions. But a motion is given in the camera's axes, so that
    the same motion is another one in other axes: both its translation and its rotation are turned.
    """
    try:
        as_written = _errors(other, trajectory, trajectory.world_T_camera)
        own, others = _twists(trajectory, other)
        if len(own) < FEWEST_POSES or not (as_written[0] > FAR or as_written[1] > LARGE):
            return None
        # a motion and its inverse: their centre is zero, so that a turn alone is left
        rotation, _ = align_rigidly(np.concatenate([own, -own]), np.concatenate([others, -others]))
        poses = trajectory.world_T_camera.copy()
        poses[:, :3, :3] = poses[:, :3, :3] @ rotation.T
        turned = _errors(other, trajectory, poses)
    except GavoError:
        return None
    limits = zip(turned, as_written, (FAR, LARGE), strict=True)
    is_told = all(after < (REORDERED * before if before > least else least) for after, before, least in limits)
    angle = float(rotation_angle(rotation))
    return _axes(rotation, angle) if is_told and angle > TURNED else None


def _axes(rotation: Float[np.ndarray, "3 3"], angle: float) -> str:
    """Words for the axes of a camera, the columns of a rotation; other ones than the other camera's are named."""
    largest = np.abs(rotation).argmax(axis=0)
    signs = np.sign(rotation[largest, range(3)])
    if np.abs(rotation).max(axis=0).min() < ALONG:
        return f"its camera is turned by {np.degrees(angle):.0f}° against the other's"
    names = ", ".join(f"{'-' if sign < 0 else ''}{'xyz'[axis]}" for sign, axis in zip(signs, largest, strict=True))
    return f"its camera's x, y, z axes are the other's {names}"


def _errors(estimate: Trajectory, truth: Trajectory, poses: Float[np.ndarray, "n 4 4"]) -> tuple[float, float]:
    """Median relative errors over one second, metres and degrees, if the truth had other poses."""
    relative = relative_pose_error(estimate, replace(truth, world_T_camera=poses))
    return relative.translation.median, relative.rotation.median


def _twists(trajectory: Trajectory, other: Trajectory) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
    """Translations and turns of both over one second from where either has poses; turns in units of translations."""
    starts = trajectory.timestamps
    ends = [[one.interpolate(starts + later) for later in (0.0, 1.0)] for one in (trajectory, other)]
    known = np.all([valid & np.isfinite(pose).all(axis=(1, 2)) for own in ends for pose, valid in own], axis=0)
    motions = [inverse(start[known]) @ end[known] for (start, _), (end, _) in ends]
    moved = [motion[:, :3, 3] for motion in motions]
    rotations = [motion[:, :3, :3] for motion in motions]
    skew = [rotation - rotation.swapaxes(1, 2) for rotation in rotations]
    turned = [one[:, [2, 0, 1], [1, 2, 0]] / 2 for one in skew]  # axis times sine
    weight = np.linalg.norm(moved[1]) / max(float(np.linalg.norm(turned[1])), np.finfo(float).tiny)
    own, others = (np.concatenate([one, weight * turn]) for one, turn in zip(moved, turned, strict=True))
    return own, others


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
