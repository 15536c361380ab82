"""Trajectories of a camera: TUM and KITTI files, interpolation and association by time."""

import heapq
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from gavo_jax.errors import (
    GavoError,
    GavoWarning,
    as_number,
    blamed,
    read_text,
    shown,
    write_bytes,
)
from gavo_jax.se3 import is_rigid
from gavo_jax.trajectory_rows import NO_POSE, TRAJECTORY_HEADER, parse_row, rows_of_poses, segment_comment, segments_of

MAX_GAP = 0.1
"""Longest stretch between two samples, in seconds, that `Trajectory.interpolate` bridges unless told otherwise."""
ROUNDED = 1.01
"""Ratio up to which a stretch is as long as another: stamps are rounded."""

SAME_PLACE = 1e-3
"""Distance in metres up to which two poses of one stamp are the same but for rounding."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Timestamped poses of a camera.

    Attributes:
        timestamps: seconds.
        world_T_camera: rigid transforms from the camera's frame (x right, y down, z forward) into the world, metres.
        segments: number of the segment of each pose; the motion between two segments is unknown, so they do not share a
            world frame. All 0 by default.
    """

    timestamps: Float[np.ndarray, " n"]
    world_T_camera: Float[np.ndarray, "n 4 4"]
    segments: Int[np.ndarray, " n"] = None  # pyright: ignore[reportAssignmentType]

    def __post_init__(self) -> None:
        """Copy all to arrays; raise ValueError if they are not numbers or their shapes do not match."""
        timestamps = _numbers("timestamps", self.timestamps).astype(np.float64)
        world_T_camera = _numbers("world_T_camera", self.world_T_camera).astype(np.float64)
        given = None if self.segments is None else _numbers("segments", self.segments, "iu").astype(int)
        if timestamps.ndim != 1 or world_T_camera.shape != (len(timestamps), 4, 4):
            raise ValueError(f"expected shapes [n] and [n, 4, 4], got {timestamps.shape} and {world_T_camera.shape}")
        object.__setattr__(self, "timestamps", timestamps)
        object.__setattr__(self, "world_T_camera", world_T_camera)
        segments = np.zeros(len(timestamps), int) if given is None else given
        if segments.shape != timestamps.shape:
            raise ValueError(f"expected one segment per pose, got {segments.shape} for {timestamps.shape}")
        if np.any(segments < 0):
            raise ValueError(f"segments are numbered from 0, but one is {segments.min()}")
        object.__setattr__(self, "segments", segments)

    def require_rigid(self) -> None:
        """Check that all finite poses are rigid transforms; poses that are not finite stand for unknown ones.

        Raises:
            GavoError: one is not; the message names the first.
        """
        broken = np.flatnonzero(np.isfinite(self.world_T_camera).all(axis=(1, 2)) & ~is_rigid(self.world_T_camera))
        if len(broken):
            needed = "expected a rotation, a column of metres beside it, and 0 0 0 1 below"
            raise GavoError(f"pose {broken[0]} of {len(self)} is not a rigid transform: {needed}")

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.timestamps)

    def __getitem__(self, which: Any) -> "Trajectory":
        """Return some of the poses, by a slice, a mask or a list of indices."""
        if np.ndim(which) == 0 and not isinstance(which, slice):
            needed = "expected a slice, a mask or a list of indices"
            raise TypeError(f"Trajectory: {needed}, got {shown(which)}; a single pose is world_T_camera[i]")
        return Trajectory(self.timestamps[which], self.world_T_camera[which], self.segments[which])

    @staticmethod
    def read_tum(path: str | Path) -> "Trajectory":
        """Read a file of `timestamp tx ty tz qx qy qz qw` rows (camera to world), `#` comments.

        If a comment or a first row names the columns with qw before qx, as EuRoC's does, quaternions are read in that
        order. Of a table with more columns, those of the pose are read. A comment of `segment_comment` begins a
        segment. Rows are sorted by their stamps; of rows with equal stamps the first is kept. Quaternions are
        normalised. Rows with a zero quaternion or numbers that are not finite are left out, as trackers write them
        where they lost their markers. A `GavoWarning` says how many, and how many rows of equal stamps are at different
        places.

        Raises:
            GavoError: unreadable or empty file, or a row (named as file:line) that is malformed or absurdly large; no
                row has a pose.
        """
        text = read_text(path)
        all_places, is_w_first = rows_of_poses(text, path)
        parsed = [parse_row(place, fields) for place, fields in all_places]
        if not parsed:
            raise GavoError(f"{path}: contains no trajectory (no rows)")
        places = [place for place, row in zip(all_places, parsed, strict=True) if row is not None]
        rows = [row for row in parsed if row is not None]
        if not rows:
            raise GavoError(f"{all_places[0][0]}: no pose in this row or any other: {NO_POSE}")
        if lost := len(parsed) - len(rows):
            warnings.warn(f"{path}: {lost} of {len(parsed)} rows left out: {NO_POSE}", GavoWarning, stacklevel=2)
        segments = segments_of(text, [int(place.rpartition(":")[2]) for place, _ in places])
        table = np.array(rows)
        if is_w_first:
            table[:, 4:] = np.roll(table[:, 4:], -1, axis=1)
        _, first, kept = np.unique(table[:, 0], return_index=True, return_inverse=True)
        apart = np.linalg.norm(table[:, 1:4] - table[first[kept.reshape(-1)], 1:4], axis=1)
        if elsewhere := np.count_nonzero(apart > SAME_PLACE):
            line = (
                f"{path}: {elsewhere} of {len(parsed)} rows left out: an earlier row has their stamp and another place"
            )
            warnings.warn(line, GavoWarning, stacklevel=2)
        table = table[first]
        world_T_camera = np.zeros((len(table), 4, 4))
        world_T_camera[:, :3, :3] = rotation_from_quaternion(table[:, 4:])
        world_T_camera[:, :3, 3] = table[:, 1:4]
        world_T_camera[:, 3, 3] = 1.0
        return Trajectory(table[:, 0], world_T_camera, segments[first])

    def write_tum(self, path: str | Path) -> None:
        """Write rows of `timestamp tx ty tz qx qy qz qw` that read back exactly.

        Raises:
            GavoError: a pose is not a rigid transform, or the file cannot be written; no partial file is left.
        """
        self.require_rigid()
        lines = [TRAJECTORY_HEADER]
        before, stamp = 0, None
        for i, row in enumerate(map(format_tum_row, self.timestamps, self.world_T_camera)):
            if self.segments[i] != before:
                lines.append(segment_comment(self.segments[i], stamp, self.timestamps[i]))
            lines.append(row)
            before, stamp = self.segments[i], self.timestamps[i]
        write_lines(path, lines)

    def write_kitti(self, path: str | Path) -> None:
        """Write the upper 3×4 of each matrix, row by row, twelve numbers per line (KITTI odometry format, no stamps).

        Raises:
            GavoError: a pose is not a rigid transform, or the file cannot be written; no partial file is left.
        """
        self.require_rigid()
        rows = self.world_T_camera[:, :3].reshape(len(self), 12)
        write_lines(path, (" ".join(_digits(value, 9) for value in row) for row in rows))

    def interpolate(
        self, timestamps: float | Float[np.ndarray, "*m"], max_gap: float = MAX_GAP
    ) -> tuple[Float[np.ndarray, "*m 4 4"], Bool[np.ndarray, "*m"]]:
        """Interpolate `world_T_camera` at other stamps: the translation linearly, the rotation by slerp.

        Args:
            timestamps: seconds, in any order; a single number gives a single pose.
            max_gap: seconds; a stamp between two samples further apart than this is not valid.

        Returns:
            Transforms, NaN where not valid, and the mask of the valid ones: those on a sample or between two near
            ones of one segment.

        Raises:
            GavoError: an argument is not a number.
        """
        max_gap, asked = as_number("interpolate: max_gap", max_gap), _as_stamps(timestamps)
        poses, valid = self._interpolate(asked.ravel(), max_gap)
        return poses.reshape(*asked.shape, 4, 4), valid.reshape(asked.shape)

    def _interpolate(
        self, timestamps: Float[np.ndarray, " m"], max_gap: float
    ) -> tuple[Float[np.ndarray, "m 4 4"], Bool[np.ndarray, " m"]]:
        order = np.argsort(self.timestamps, kind="stable")
        times, samples, segments = self.timestamps[order], self.world_T_camera[order], self.segments[order]
        result = np.full((len(timestamps), 4, 4), np.nan)
        valid = np.zeros(len(timestamps), bool)
        if len(times) == 0:
            return result, valid
        right = np.clip(np.searchsorted(times, timestamps), 0, len(times) - 1)
        left = np.where(times[right] == timestamps, right, np.maximum(right - 1, 0))
        gap = times[right] - times[left]
        valid = (times[left] <= timestamps) & (timestamps <= times[right]) & (gap <= ROUNDED * max_gap)
        known = np.asarray(np.isfinite(samples).all(axis=(1, 2)))
        valid &= (segments[left] == segments[right]) & known[left] & known[right]
        fraction = np.divide(timestamps - times[left], gap, out=np.zeros_like(gap), where=gap > 0)[valid]
        start, end = samples[left[valid]], samples[right[valid]]
        between = np.zeros((len(fraction), 4, 4))
        between[:, :3, :3] = rotation_from_quaternion(
            _slerp(
                quaternion_from_rotation(start[:, :3, :3]), quaternion_from_rotation(end[:, :3, :3]), fraction[:, None]
            )
        )
        between[:, :3, 3] = start[:, :3, 3] + fraction[:, None] * (end[:, :3, 3] - start[:, :3, 3])
        between[:, 3, 3] = 1.0
        result[valid] = between
        return result, valid


def require_trajectory(trajectory: Any) -> None:
    """Check that a value is a `Trajectory`.

    Raises:
        GavoError: It is not, but a path or an array of poses, say.
    """
    if not isinstance(trajectory, Trajectory):
        hint = "gavo.Trajectory.read_tum(path) or gavo.Trajectory(timestamps, world_T_camera)"
        raise GavoError(f"expected a Trajectory, got {type(trajectory).__name__}: {hint}")


def _numbers(name: str, values: Any, kinds: str = "iuf") -> np.ndarray:
    """An array of one of the kinds of numbers; a date would become a number of whatever unit it has."""
    with blamed("Trajectory: expected numbers"):
        array = np.asarray(values)
    if array.size and array.dtype.kind not in kinds:
        whole = "" if "f" in kinds else "whole "
        raise GavoError(f"Trajectory: expected {whole}numbers: {name} has {array.dtype}")
    return array


def _as_stamps(stamps: Any) -> Float[np.ndarray, "*m"]:
    try:
        numbers = np.asarray(stamps)
    except ValueError:  # lists of unequal lengths
        numbers = np.asarray(None)
    if numbers.dtype.kind not in "iuf":
        raise GavoError(f"interpolate: timestamps: expected numbers of seconds, got {shown(stamps)}")
    return numbers.astype(np.float64)


def stamp_name(timestamp: float) -> str:
    """Format a stamp in seconds as a run's files name frames: to the microsecond."""
    return f"{timestamp:.6f}"


def format_tum_row(timestamp: float, world_T_camera: Float[np.ndarray, "4 4"]) -> str:
    """Return `timestamp tx ty tz qx qy qz qw` without a line end: shortest digits that read back exactly, qw ≥ 0.

    Stamps have at least 6 decimals, the rest at least 9; never an exponent.
    """
    world_T_camera = np.asarray(world_T_camera, np.float64)
    values = [*world_T_camera[:3, 3], *quaternion_from_rotation(world_T_camera[:3, :3])]
    return " ".join([_digits(timestamp, 6), *(_digits(value, 9) for value in values)])


def associate(
    a: Float[np.ndarray, " n"], b: Float[np.ndarray, " m"], max_difference: float
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Pair stamps of two lists, one to one: the closest pair first, then the closest of what is left, and so on.

    The rule of TUM's `associate.py`: all pairs with |a_i − b_j| < max_difference, sorted by that difference, are taken
    in turn where both are still free. The closest free pair is always adjacent in the merged order of what is left, so
    a heap of neighbours does it in O(n log n) whatever max_difference is.

    Returns:
        Indices into `a` and into `b`, in the order of a's stamps.
    """
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    order = np.argsort(np.concatenate([a, b]), kind="stable")
    stamps, source = np.concatenate([a, b])[order].tolist(), order.tolist()
    count = len(order)
    before, after = list(range(-1, count - 1)), list(range(1, count + 1))
    heap: list[tuple[float, float, int, int]] = []

    def offer(i: int, j: int) -> None:
        if 0 <= i and j < count and (source[i] < len(a)) != (source[j] < len(a)):
            difference = stamps[j] - stamps[i]
            if difference < max_difference:
                heapq.heappush(heap, (difference, stamps[i], i, j))

    for i in range(count - 1):
        offer(i, i + 1)
    free = [True] * count
    pairs = []
    while heap:
        _, _, i, j = heapq.heappop(heap)
        if free[i] and free[j]:
            free[i] = free[j] = False
            pairs.append(sorted((source[i], source[j])))
            left, right = before[i], after[j]
            if left >= 0:
                after[left] = right
            if right < count:
                before[right] = left
            offer(left, right)
    table = np.array(pairs, np.int64).reshape(-1, 2)
    table = table[np.argsort(a[table[:, 0]], kind="stable")]
    return table[:, 0], table[:, 1] - len(a)


def rotation_from_quaternion(quaternion: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the rotation matrix of a quaternion (x, y, z, w) of any length but zero."""
    quaternion = np.asarray(quaternion, np.float64)
    x, y, z, w = np.moveaxis(quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_rotation(rotation: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 4"]:
    """Return the unit quaternion (x, y, z, w), w ≥ 0, of a rotation matrix.

    4 q qᵀ is linear in the matrix; its column under the largest diagonal entry is q up to a well-conditioned factor.
    """
    m = np.asarray(rotation, np.float64)
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    xw, yw, zw = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    columns = np.stack(
        [
            np.stack([1 + xx - yy - zz, xy, xz, xw], axis=-1),
            np.stack([xy, 1 - xx + yy - zz, yz, yw], axis=-1),
            np.stack([xz, yz, 1 - xx - yy + zz, zw], axis=-1),
            np.stack([xw, yw, zw, 1 + xx + yy + zz], axis=-1),
        ],
        axis=-2,
    )
    largest = np.argmax(np.diagonal(columns, axis1=-2, axis2=-1), axis=-1)
    quaternion = np.take_along_axis(columns, largest[..., None, None], axis=-2)[..., 0, :]
    quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return np.where(quaternion[..., 3:] < 0, -quaternion, quaternion)


def inverse(a_T_b: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Return `b_T_a` of rigid transforms, by transposing the rotation."""
    a_T_b = np.asarray(a_T_b, np.float64)
    b_T_a = np.zeros_like(a_T_b)
    b_T_a[..., :3, :3] = np.swapaxes(a_T_b[..., :3, :3], -1, -2)
    b_T_a[..., :3, 3] = -np.einsum("...ij,...j->...i", b_T_a[..., :3, :3], a_T_b[..., :3, 3])
    b_T_a[..., 3, 3] = 1.0
    return b_T_a


def _slerp(
    start: Float[np.ndarray, "m 4"], end: Float[np.ndarray, "m 4"], fraction: Float[np.ndarray, "m 1"]
) -> Float[np.ndarray, "m 4"]:
    """Interpolate unit quaternions along the shorter arc at constant speed (Shoemake 1985)."""
    cosine = np.sum(start * end, axis=-1, keepdims=True)
    end = np.where(cosine < 0, -end, end)
    angle = 2 * np.arctan2(
        np.linalg.norm(end - start, axis=-1, keepdims=True), np.linalg.norm(end + start, axis=-1, keepdims=True)
    )
    sine = np.sin(angle)
    small = sine < 1e-9
    safe = np.where(small, 1.0, sine)
    weight_start = np.where(small, 1 - fraction, np.sin((1 - fraction) * angle) / safe)
    weight_end = np.where(small, fraction, np.sin(fraction * angle) / safe)
    return weight_start * start + weight_end * end


def _digits(value: float, decimals: int) -> str:
    return np.format_float_positional(float(value) + 0.0, unique=True, min_digits=decimals)


def write_lines(path: str | Path, lines: Iterable[str]) -> None:
    """Write a text file atomically.

    Raises:
        GavoError: the file cannot be written.
    """
    write_bytes(path, ("\n".join(lines) + "\n").encode("utf-8", "surrogateescape"))
