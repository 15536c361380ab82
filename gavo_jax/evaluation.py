"""Errors of a trajectory against the truth: relative pose error (15)(16), absolute error, distance error (17)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from gavo_jax.errors import GavoError, as_number
from gavo_jax.trajectory import (
    MAX_GAP,
    ROUNDED,
    Trajectory,
    associate,
    inverse,
    require_trajectory,
)

MAX_DIFFERENCE = 0.02
"""Stamps of estimate and truth at least this far apart, in seconds, are not associated."""
SPARSE = 0.04
"""Seconds between true poses above which those within `MAX_DIFFERENCE` count, not those within two intervals as in
TUM's script: most of the drift would be the way to the nearest one.
"""


@dataclass(frozen=True, eq=False)
class ErrorSeries:
    """One kind of error, value by value.

    Attributes:
        values: one error per pair of poses, or per pose.
        timestamps: stamps of the estimate's poses (of each pair's first pose), seconds.
        unit: unit of the values: "m" or "deg".
        definition: what each value is, in a sentence.
    """

    values: Float[np.ndarray, " n"]
    timestamps: Float[np.ndarray, " n"]
    unit: str
    definition: str

    @property
    def rmse(self) -> float:
        """Root mean square; for the translational RPE over 1 s it is the drift in m/s. Equation (16)."""
        return float(np.sqrt(np.mean(np.square(self.values))))

    @property
    def mean(self) -> float:
        """Arithmetic mean."""
        return float(np.mean(self.values))

    @property
    def median(self) -> float:
        """Median."""
        return float(np.median(self.values))

    @property
    def max(self) -> float:
        """Largest value."""
        return float(np.max(self.values))

    @property
    def final(self) -> float:
        """Value at the last stamp."""
        return float(self.values[-1])

    def summary(self) -> dict[str, float | int | str]:
        """Return the statistics with their number of values, unit and definition, ready for JSON."""
        return {
            "rmse": self.rmse,
            "mean": self.mean,
            "median": self.median,
            "max": self.max,
            "count": len(self.values),
            "unit": self.unit,
            "definition": self.definition,
        }


@dataclass(frozen=True, eq=False)
class RelativePoseError:
    """Both parts of the relative pose error, over the same pairs.

    Attributes:
        translation: metres.
        rotation: angles, degrees.
        delta: how far apart the poses of a pair are.
        unit: unit of `delta`.
    """

    translation: ErrorSeries
    rotation: ErrorSeries
    delta: float
    unit: Literal["s", "frames"]


def relative_pose_error(
    estimate: Trajectory, truth: Trajectory, delta: float = 1.0, unit: Literal["s", "frames"] = "s"
) -> RelativePoseError:
    """Return how far the estimated motion over `delta` is from the true one. Equation (15).

    Unit "s" is what TUM's `evaluate_rpe.py --fixed_delta --delta DELTA --delta_unit s` computes. Each pose i is paired
    with the pose j nearest to `delta` seconds later, except pairs that end at the last pose. The truth is taken at its
    stamps nearest to those of i and j, where both lie within twice its median interval; beyond 40 ms between true
    poses, within 0.02 s of one, which TUM's script does not ask for. The error is
    `inv(est_j_T_i) @ true_j_T_i`. At delta = 1 the RMSE of its translation is the drift in m/s. TUM's tool draws
    10,000 pairs at random if there are more; here all of them count.

    Unit "frames" pairs pose i with pose i + delta of the associated poses (`associate`, 0.02 s), and the error is as
    printed in the paper: `inv(true_i_T_j) @ est_i_T_j`. The rotation angles of the two forms agree; their translations
    differ by about the rotation error times the distance travelled. Neither kind pairs poses of different segments.
    Poses that are not finite are left out.

    Args:
        estimate: estimated trajectory, camera to world.
        truth: ground truth; its world frame may differ.
        delta: how far apart the poses of a pair are, in `unit`.
        unit: seconds or frames.

    Returns:
        One error of translation and one of rotation per pair.

    Raises:
        GavoError: nothing to compare: no two poses `delta` apart that the truth covers, or delta not positive
            (for frames: not a whole number), or not a number.
    """
    estimate, truth = _known(estimate), _known(truth)
    delta = as_number("relative pose error: delta", delta)
    if not np.isfinite(delta) or delta <= 0:
        raise GavoError(f"relative pose error: delta must be positive and finite, not {delta}")
    if unit == "s":
        return _relative_pose_error_seconds(estimate, truth, delta)
    if unit == "frames":
        if delta != int(delta):
            raise GavoError(f"relative pose error: delta must be a whole number of frames, not {delta}")
        return _relative_pose_error_frames(estimate, truth, int(delta))
    raise GavoError(f"relative pose error: unit must be s or frames, not {unit!r}")


def absolute_trajectory_error(
    estimate: Trajectory, truth: Trajectory, max_difference: float = MAX_DIFFERENCE
) -> ErrorSeries:
    """Return the distances between associated positions after the best rigid alignment of the estimate (no scale).

    Association is `associate` by time; the alignment minimises the sum of squared distances (Horn 1987, Umeyama 1991).
    Each segment of the estimate is aligned by itself, as the poses of segments relative to each other are unknown.
    Segments of a single pose are left out, and so are poses that are not finite.

    Raises:
        GavoError: fewer than two poses associate, or no two of one segment; an argument is of the wrong type.
    """
    max_difference = as_number("absolute trajectory error: max_difference", max_difference)
    estimated, true = _associated(_known(estimate), _known(truth), max_difference, "absolute trajectory error")
    segments, counts = np.unique(estimated.segments, return_counts=True)
    told = np.isin(estimated.segments, segments[counts > 1])
    if not told.any():
        raise GavoError("absolute trajectory error: no two poses of one segment associate")
    estimated, true = estimated[told], true[told]
    stamps, distances = estimated.timestamps, np.zeros(len(estimated))
    for segment in segments[counts > 1]:
        here = estimated.segments == segment
        positions, true_positions = estimated.world_T_camera[here, :3, 3], true[here, :3, 3]
        rotation, translation = align_rigidly(positions, true_positions)
        distances[here] = np.linalg.norm(positions @ rotation.T + translation - true_positions, axis=1)
    definition = (
        "distance between estimated and true position after rigid (SE(3), no scale) least-squares alignment; "
        f"nearest stamps within {max_difference:g} s"
    )
    return ErrorSeries(distances, stamps, "m", definition)


def distance_error(estimate: Trajectory, truth: Trajectory, max_gap: float = MAX_GAP) -> ErrorSeries:
    """Return ‖p_est − p_true‖ of each pose, both seen from their own first pose: accumulated drift. Equation (17).

    The paper plots it, and cites its equation without printing it. The truth is interpolated (slerp) at the estimate's
    stamps. Poses it does not cover (outside it, or in a gap longer than `max_gap` seconds) are left out, and so are
    poses that are not finite. The first covered pose of each segment is that segment's common origin.

    Raises:
        GavoError: the truth covers no pose of the estimate; an argument is of the wrong type.
    """
    max_gap = as_number("distance error: max_gap", max_gap)
    estimate, truth = _known(estimate), _known(truth)
    estimate = estimate[np.argsort(estimate.timestamps, kind="stable")]
    true, valid = truth.interpolate(estimate.timestamps, max_gap)
    if not valid.any():
        raise GavoError("distance error: the ground truth covers no pose of the estimate")
    truth = _sorted(truth)
    estimate = _in_segments_of_both(estimate, truth.segments[_closest_index(truth.timestamps, estimate.timestamps)])
    estimated, true, segments = estimate.world_T_camera[valid], true[valid], estimate.segments[valid]
    first = np.unique(segments, return_index=True)[1][np.unique(segments, return_inverse=True)[1]]
    from_first = inverse(estimated[first]) @ estimated
    true_from_first = inverse(true[first]) @ true
    distances = np.linalg.norm((from_first - true_from_first)[:, :3, 3], axis=1)
    definition = "distance between estimated and true position, both relative to the first pose; truth interpolated"
    return ErrorSeries(distances, estimate.timestamps[valid], "m", definition)


def _known(trajectory: Trajectory) -> Trajectory:
    """Return the poses that are finite, with finite stamps.

    Raises:
        GavoError: it is not a trajectory, or a pose is not a rigid transform.
    """
    require_trajectory(trajectory)
    trajectory.require_rigid()
    known = np.isfinite(trajectory.world_T_camera).all(axis=(1, 2)) & np.isfinite(trajectory.timestamps)
    return trajectory if known.all() else trajectory[known]


def align_rigidly(
    points: Float[np.ndarray, "n 3"], targets: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]]:
    """Return the rotation R and translation t of least Σ ‖R points_i + t − targets_i‖² (Umeyama 1991, scale 1)."""
    center, target_center = points.mean(axis=0), targets.mean(axis=0)
    u, _, vt = np.linalg.svd((targets - target_center).T @ (points - center))
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ mirror @ vt
    return rotation, target_center - rotation @ center


def _relative_pose_error_seconds(estimate: Trajectory, truth: Trajectory, delta: float) -> RelativePoseError:
    estimate, truth = _sorted(estimate), _sorted(truth)
    if len(estimate) < 2 or len(truth) < 2:
        raise GavoError("relative pose error: estimate and ground truth need at least two poses each")
    end = _closest_index(estimate.timestamps, estimate.timestamps + delta)
    start = np.flatnonzero((end != len(estimate) - 1) & (estimate.timestamps[end] > estimate.timestamps))
    end = end[start]
    apart = float(np.median(np.diff(estimate.timestamps)))
    if len(start) == 0 and apart > delta:
        raise GavoError(
            f"relative pose error: no two poses about {delta:g} s apart: those of the estimate are {apart:.3g} s apart"
        )
    nearest = _closest_index(truth.timestamps, estimate.timestamps)
    estimate = _in_segments_of_both(estimate, truth.segments[nearest])
    interval = np.median(np.diff(truth.timestamps))
    is_sparse = interval > ROUNDED * SPARSE
    farthest = MAX_DIFFERENCE if is_sparse else 2 * interval
    far = np.abs(truth.timestamps[nearest] - estimate.timestamps) > farthest
    covered = ~far[start] & ~far[end] & (estimate.segments[start] == estimate.segments[end])
    start, end = start[covered], end[covered]
    if len(start) == 0:
        raise GavoError(f"relative pose error: no poses {delta:g} s apart that the ground truth covers")
    estimated, true = estimate.world_T_camera, truth.world_T_camera[nearest]
    end_T_start = inverse(estimated[end]) @ estimated[start]
    true_end_T_start = inverse(true[end]) @ true[start]
    reach = f" within {MAX_DIFFERENCE:g} s" if is_sparse else ""
    definition = f"inv(est_j_T_i) @ true_j_T_i over {delta:g} s (TUM evaluate_rpe.py, fixed delta), nearest true stamps"
    definition += reach
    error = inverse(end_T_start) @ true_end_T_start
    return _relative_pose_error(error, estimate.timestamps[start], definition, delta, "s")


def _relative_pose_error_frames(estimate: Trajectory, truth: Trajectory, delta: int) -> RelativePoseError:
    associated, true = _associated(estimate, truth, MAX_DIFFERENCE, "relative pose error")
    stamps, estimated, segments = associated.timestamps, associated.world_T_camera, associated.segments
    start = np.flatnonzero(segments[:-delta] == segments[delta:])
    if len(start) == 0:
        raise GavoError(f"relative pose error: no associated poses {delta} frames apart ({len(stamps)} associate)")
    start_T_end = inverse(estimated[start]) @ estimated[start + delta]
    true_start_T_end = inverse(true[start]) @ true[start + delta]
    span = "1 frame" if delta == 1 else f"{delta} frames"
    definition = f"inv(true_i_T_j) @ est_i_T_j over {span}, all pairs, nearest stamps within {MAX_DIFFERENCE:g} s"
    error = inverse(true_start_T_end) @ start_T_end
    return _relative_pose_error(error, stamps[start], definition, delta, "frames")


def _relative_pose_error(
    error: Float[np.ndarray, "n 4 4"],
    stamps: Float[np.ndarray, " n"],
    definition: str,
    delta: float,
    unit: Literal["s", "frames"],
) -> RelativePoseError:
    distances = np.linalg.norm(error[:, :3, 3], axis=1)
    return RelativePoseError(
        translation=ErrorSeries(distances, stamps, "m", f"length of the translation of {definition}"),
        rotation=ErrorSeries(
            np.degrees(rotation_angle(error[:, :3, :3])), stamps, "deg", f"angle of the rotation of {definition}"
        ),
        delta=delta,
        unit=unit,
    )


def rotation_angle(rotation: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch"]:
    """Return the angle of rotation matrices in radians, 0 to π, accurate for small angles too (arccos is not)."""
    skew = rotation - np.swapaxes(rotation, -1, -2)
    sine = np.sqrt(skew[..., 2, 1] ** 2 + skew[..., 0, 2] ** 2 + skew[..., 1, 0] ** 2)
    cosine = np.trace(rotation, axis1=-2, axis2=-1) - 1
    return np.arctan2(sine, cosine)


def _associated(
    estimate: Trajectory, truth: Trajectory, max_difference: float, what: str
) -> tuple[Trajectory, Float[np.ndarray, "n 4 4"]]:
    """Return the estimate's associated poses, in the order of their stamps, and the true `world_T_camera`."""
    i, j = associate(estimate.timestamps, truth.timestamps, max_difference)
    if len(i) < 2:
        raise GavoError(
            f"{what}: only {len(i)} poses of estimate and ground truth are within {max_difference:g} s of each other"
        )
    return _in_segments_of_both(estimate[i], truth.segments[j]), truth.world_T_camera[j]


def _in_segments_of_both(estimate: Trajectory, others: Int[np.ndarray, " n"]) -> Trajectory:
    """Split the estimate's segments where the truth's segment (`others`, at each pose) changes."""
    pairs = np.stack([estimate.segments, others], axis=1)
    return replace(estimate, segments=np.unique(pairs, axis=0, return_inverse=True)[1].reshape(-1))


def _sorted(trajectory: Trajectory) -> Trajectory:
    return trajectory[np.argsort(trajectory.timestamps, kind="stable")]


def _closest_index(sorted_stamps: Float[np.ndarray, " n"], queries: Float[np.ndarray, " m"]) -> Int[np.ndarray, " m"]:
    """Return the index of the stamp nearest to each query.

    Of two equally near ones it is the one that a bisection of [0, n) meets first, as in TUM's tool.
    """
    low, high = np.zeros(len(queries), np.int64), np.full(len(queries), len(sorted_stamps))
    best = np.zeros(len(queries), np.int64)
    while np.any(low < high):
        middle = np.minimum((low + high) // 2, len(sorted_stamps) - 1)
        stamp = sorted_stamps[middle]
        nearer = (low < high) & (np.abs(stamp - queries) < np.abs(sorted_stamps[best] - queries))
        best = np.where(nearer, middle, best)
        above = stamp > queries
        low, high = np.where((low < high) & ~above, middle + 1, low), np.where((low < high) & above, middle, high)
    return best


def quantiles_of(errors: Sequence[float] | Float[np.ndarray, " n"], shares: Sequence[float]) -> list[float]:
    """Quantiles of errors, which are infinite where a camera was lost: nothing lies between a number and infinity."""
    method = "linear" if np.all(np.isfinite(errors)) else "higher"
    return np.quantile(errors, shares, method=method).tolist()
