"""Readers of the ground truth beside the frames: files of TUM, ICL-NUIM and Redwood, and pose matrices."""

import fnmatch
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gavo_jax.datasets.clocks import DEVICE_INTERVALS, TICK, UNITS, clock_unit, in_seconds, unit_of
from gavo_jax.datasets.names import FEWEST, mask_numbers
from gavo_jax.errors import GavoError, data_rows, number
from gavo_jax.se3 import rigid
from gavo_jax.trajectory import Trajectory, rotation_from_quaternion
from gavo_jax.trajectory_rows import MAX_MAGNITUDE, SHORTEST_QUATERNION

TRUTH = "groundtruth.txt"
"""Name of a ground truth in TUM's format."""

OTHER_NAMES = re.compile(
    r"(.*[-_])?(gt|ground[-_]?truth|(cam(era)?)?poses?|traj|trajectory|extrinsics?)(_left)?\.(txt|csv|tum|log)"
    r"|\d+\.pose",
    re.IGNORECASE,
)
"""Files that look like a trajectory, but aren't read, as their format is unknown. The last is of UW's RGB-D Scenes."""

OTHER_FOLDERS = re.compile(r"(.*[-_])?(poses?|traj|trajectory|extrinsics?)", re.IGNORECASE)
"""Folders that look as if they held a trajectory."""

NO_TRUTH = "an estimate by the program that wrote the images, not the truth; gavo evaluate can compare a run with it"

LOG = "trajectory.log"
"""Name of a trajectory in Redwood's format, which Open3D also writes."""

ICL = "*.gt.freiburg"
"""ICL-NUIM's trajectory: TUM's format with frame numbers for stamps, and y pointing up."""

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
"""Converts between ICL-NUIM's axes, with y up (hence the negative fy on its page), and those of its images, with y
down. It is applied to both sides of a pose, which thus stays a rigid transform."""

SKEWED = 0.01
"""Largest deviation of any element of a pose from the nearest rigid transform."""

MAX_POSE_BYTES = 4096

MILLISECOND = 1e-3
"""A millisecond in seconds."""

MAX_NUMBER = 10**18
"""Upper bound of frame numbers."""

LARGEST = 1e10
"""Largest value in a file of poses, including seconds since 1970."""

Seconds = Callable[[np.ndarray], np.ndarray]
"""Maps frame numbers to times, seconds; NaN where a time is unknown."""


class Counted(NamedTuple):
    """Frames that are numbered instead of stamped."""

    numbers: Sequence[float]
    seconds: Seconds


def truth_in(
    folder: Path, frames: Iterable[float], counted: Counted | None, depth: Mapping[int, float] | None = None
) -> Trajectory | None:
    """Read the ground truth in a folder; None if there is none.

    Args:
        folder: folder of the frames.
        frames: their stamps, seconds. Of the possible units of the truth's stamps, the one that overlaps these best is
            chosen.
        counted: their numbers, where they have no stamps of their own. A truth whose stamps are whole numbers may then
            count frames; that is preferred unless they look like stamps since 1970. A pose whose number has no time is
            left out.
        depth: time of each depth image by its number, if a truth may be in Redwood's format; see `read_log`.

    Raises:
        GavoError: it cannot be read.
    """
    if (folder / TRUTH).exists():
        try:
            truth = Trajectory.read_tum(folder / TRUTH)
        except GavoError as error:
            raise GavoError(f"{error}; rename it to have it ignored") from None
        return _timed(truth, folder / TRUTH, list(frames), counted)
    if (file := icl_truth(folder)) is not None:
        return _read_icl(file, counted)
    return read_log(folder / LOG, depth) if depth and (folder / LOG).exists() else None


def _timed(truth: Trajectory, place: Path, frames: list[float], counted: Counted | None) -> Trajectory:
    """Convert the stamps of a ground truth to seconds."""
    stamps = truth.timestamps
    known = clock_unit(stamps.tolist())
    readings = [np.array(in_seconds(stamps.tolist(), counted_in(truth)))]
    if _are_whole(truth) and counted:
        of_frames = counted.seconds(stamps + _behind(stamps, place, np.array(counted.numbers)))
        if np.isfinite(of_frames).any():
            readings.insert(1 if known else 0, of_frames)
    if not known:
        readings += [unit * stamps for unit in (*UNITS[1:], TICK)]
    low, high = min(frames), max(frames)

    def met(reading: np.ndarray) -> float:
        """Share of the frames' time span that the stamps overlap, rounded to a tenth."""
        return round(
            float(min(high, np.nanmax(reading)) - max(low, np.nanmin(reading))) / max(high - low, MILLISECOND), 1
        )

    return _with_times(truth, max(readings, key=lambda reading: max(met(reading), 0.0)))


def _with_times(truth: Trajectory, times: Float[np.ndarray, " n"]) -> Trajectory:
    """The poses whose times are known, at these times."""
    return replace(truth, timestamps=times)[np.isfinite(times)]


def _behind(numbers: np.ndarray, place: Path, images: np.ndarray) -> int:
    """Return the offset from a truth's frame numbers to those of the images.

    Where there are as many poses as images, both without gaps, they pair in order.

    Raises:
        GavoError: one counts from 0 and the other from 1, and the ends differ too: the pairing is ambiguous.
    """
    if not (_is_without_gap(numbers) and _is_without_gap(images)):
        return 0
    (a, b), (c, d) = ((round(min(some)), round(max(some))) for some in (images, numbers))
    if len(images) == len(numbers):
        return a - c
    if {a, c} == {0, 1} and b != d and min(len(images), len(numbers)) >= FEWEST:
        raise GavoError(
            f"{place}: poses are numbered {c} to {d}, images {a} to {b}: give the poses the numbers of their images"
        )
    return 0


def _is_without_gap(numbers: np.ndarray) -> bool:
    return len(numbers) > 1 and bool((np.diff(np.sort(numbers)) == 1).all())


def unread_truth(folder: Path, truth: Trajectory | None, estimates: str = "") -> list[str]:
    """List files and folders of poses that aren't read, one line for each form of name, with advice; none if a truth
    was read. What a run has written into its source's folder is passed over.

    Args:
        folder: folder of the frames.
        truth: the ground truth that was read, if any.
        estimates: glob pattern of poses estimated by the program that wrote the folder.
    """
    entries = [] if truth is not None else sorted(folder.iterdir())
    found = set(fnmatch.filter((entry.name for entry in entries), estimates))
    ours = {"trajectory.txt"} if (folder / "metrics.json").is_file() else set()
    others = [
        entry.name
        for entry in entries
        if entry.name not in found | ours and (OTHER_FOLDERS if entry.is_dir() else OTHER_NAMES).fullmatch(entry.name)
    ]
    alike: dict[str, list[str]] = {}
    for name in others:
        alike.setdefault(mask_numbers(name), []).append(name)
    return [f"{name}: {NO_TRUTH}" for name in sorted(found)] + [_how_to_name(folder, names) for names in alike.values()]


def _how_to_name(folder: Path, names: list[str]) -> str:
    """Describe how to make a file or folder of poses, or one file per frame, the ground truth."""
    path, into = folder / names[0], f"write it as rows of timestamp tx ty tz qx qy qz qw into {TRUTH}"
    if len(names) > 1:
        return f"{names[0]} and {len(names) - 1} more: if they are the true trajectory, {into}"
    try:
        rows = data_rows(path)
    except GavoError:
        rows = []
    if path.is_dir() or (rows and len(rows[0][1]) != 8):
        return f"{path.name}: if it is the true trajectory, {into}"
    return f"{path.name}: if it is the true trajectory (timestamp tx ty tz qx qy qz qw), rename it to {TRUTH}"


def counted_in(trajectory: Trajectory) -> float:
    """The unit of a trajectory's stamps, seconds: as whole numbers at a camera's rate, or as stamps since 1970."""
    stamps = trajectory.timestamps.tolist()
    return (_are_whole(trajectory) and unit_of(stamps, DEVICE_INTERVALS[0])) or clock_unit(stamps) or 1.0


def icl_truth(folder: Path) -> Path | None:
    """The ICL-NUIM trajectory in a folder; None if there is none.

    Raises:
        GavoError: there are several.
    """
    files = sorted(file for file in folder.glob(ICL) if not file.name.startswith("."))
    if len(files) > 1:
        raise GavoError(f"{folder}: contains both {files[0].name} and {files[1].name}: keep only one of them")
    return files[0] if files else None


def _read_icl(path: Path, counted: Counted | None) -> Trajectory:
    truth = Trajectory.read_tum(path)
    if not _are_whole(truth):
        raise GavoError(
            f"{path}: expected frame numbers in the first column: rename it to {TRUTH} if they are timestamps"
        )
    if counted is None:
        raise GavoError(
            f"{path}: its poses have frame numbers, but the images have timestamps: give the poses timestamps, in a "
            f"file named {TRUTH}"
        )
    mirrored = replace(truth, world_T_camera=MIRROR @ truth.world_T_camera @ MIRROR)
    times = counted.seconds(truth.timestamps)
    if not np.isfinite(times).any():
        low, high = truth.timestamps[[0, -1]]
        raise GavoError(
            f"{path}: none of its frames ({low:.0f} to {high:.0f}) has an image: give the poses their numbers"
        )
    return _with_times(mirrored, times)


def _are_whole(truth: Trajectory) -> bool:
    return np.array_equal(truth.timestamps, np.round(truth.timestamps))


def read_log(path: Path, times: Mapping[int, float]) -> Trajectory | None:
    """Read a Redwood trajectory: blocks of three numbers, of which the third is the frame's, and a 4×4 matrix.

    The third number counts depth images from 1, so it is one ahead where the images' own numbers start from 0. Where
    neither fits, but there are as many poses as images, they pair in order (as in part of a longer recording).

    Args:
        path: the file.
        times: times of depth images by their numbers, seconds; NaN where unknown.

    Returns:
        The finite poses; None if there are none.

    Raises:
        GavoError: it is malformed (the message names file and line), or its frames are not those of `times`.
    """
    blocks, poses = _blocks(path), {}
    for frame, (place, fields) in blocks.items():
        if (pose := pose_of(place, fields)) is not None:
            poses[frame] = pose
    numbers = sorted(times)
    both = (0, 1) if numbers[0] else (1, 0)
    ahead = max(both, key=lambda ahead: len(blocks.keys() & {n + ahead for n in numbers}))
    named = {n + ahead: times[n] for n in numbers}
    if not blocks.keys() & named.keys():
        if len(blocks) != len(numbers):
            raise GavoError(f"{path}: none of its frames ({min(blocks)} to {max(blocks)}) has an image")
        named = {ours: times[n] for ours, n in zip(sorted(blocks), numbers, strict=True)}
    known = [frame for frame in sorted(poses) if np.isfinite(named.get(frame, np.nan))]
    if not known:
        return None
    stamps = np.array([named[frame] for frame in known])
    order = np.argsort(stamps, kind="stable")
    return Trajectory(stamps[order], np.stack([poses[frame] for frame in known])[order])


def _blocks(path: Path) -> dict[int, tuple[str, list[str]]]:
    """The sixteen matrix fields and the location (file:line) of each block, by its third number."""
    rows, blocks = data_rows(path), {}
    if not rows:
        raise GavoError(f"{path}: contains no trajectory (no rows)")
    for (place, head), *matrix in (rows[at : at + 5] for at in range(0, len(rows), 5)):
        if len(head) != 3 or not all(re.fullmatch(r"-?\d{1,18}", field) for field in head):
            raise GavoError(f"{place}: expected three whole numbers before each matrix, found {' '.join(head)[:60]!r}")
        if len(matrix) != 4 or any(len(fields) != 4 for _, fields in matrix):
            raise GavoError(f"{place}: expected four rows of four numbers after it")
        frame = int(head[2])
        if frame in blocks:
            raise GavoError(f"{place}: frame {frame} appears twice")
        blocks[frame] = place, [field for _, fields in matrix for field in fields]
    return blocks


def pose_files(files: Iterable[Path]) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Read one pose per file; the last number in a file's name is the frame's."""
    poses = {}
    for file in files:
        numbers = re.findall(r"\d+", file.name)
        pose = pose_in(file)
        if pose is not None and numbers and int(numbers[-1]) < MAX_NUMBER:
            poses[int(numbers[-1])] = pose
    return poses


def pose_in(file: Path) -> Float[np.ndarray, "4 4"] | None:
    """Read the pose in a file; see `pose_of`."""
    return pose_of(str(file), [field for _, row in data_rows(file, MAX_POSE_BYTES) for field in row])


def pose_of(place: str, fields: Sequence[str]) -> Float[np.ndarray, "4 4"] | None:
    """Parse a rigid transform of sixteen numbers in row-major order; None if not finite (the frame was not tracked).

    Raises:
        GavoError: not sixteen numbers, or not a rigid transform.
    """
    try:
        matrix = np.array([number(field) for field in fields]).reshape(4, 4)
    except ValueError:
        found = f"{len(fields)} fields: {' '.join(fields)[:60]!r}"
        raise GavoError(f"{place}: expected a pose of four rows of four numbers, found {found}") from None
    if not np.isfinite(matrix).all():
        return None
    pose = rigid(matrix)
    pose[3] = (0, 0, 0, 1)
    turns = np.abs(pose - matrix).max() <= SKEWED and np.linalg.det(pose[:3, :3]) > 0
    if turns and np.abs(pose[:3, 3]).max() < MAX_MAGNITUDE:
        return pose
    raise GavoError(f"{place}: the pose is not a rotation and translation (last row 0 0 0 1)")


def by_stamp(poses: Mapping[float, Float[np.ndarray, "4 4"]]) -> Trajectory:
    """Make a trajectory of at least one pose, given by stamp."""
    stamps = sorted(poses)
    return Trajectory(np.array(stamps), np.stack([poses[stamp] for stamp in stamps]))


def numbers_in(place: str, fields: Sequence[str], count: int) -> list[float] | None:
    """Parse the numbers of a row; None if not all are finite.

    Raises:
        GavoError: not `count` numbers, or one is too large.
    """
    try:
        values = [number(field) for field in fields]
    except ValueError:
        values = []
    if len(values) != count:
        raise GavoError(f"{place}: expected {count} numbers, found {' '.join(fields)[:60]!r}")
    if not np.isfinite(values).all():
        return None
    if np.abs(values).max() > LARGEST:
        raise GavoError(f"{place}: contains an absurdly large value")
    return values


def posed(values: Sequence[float]) -> Float[np.ndarray, "4 4"] | None:
    """The pose of tx ty tz qx qy qz qw; None if the quaternion is zero."""
    if np.linalg.norm(values[3:]) < SHORTEST_QUATERNION:
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_quaternion(np.array(values[3:])), values[:3]
    return pose


def in_order(path: Path, images: Iterable[int]) -> Iterable[tuple[int, str, list[str]]]:
    """Read the poses in a file as frame number, location (file:line) and fields.

    If there are as many poses as images, they pair in order; else poses are numbered from 0. A pose takes one row, or
    four rows of four numbers.

    Raises:
        GavoError: there is no row.
    """
    rows, numbers = data_rows(path), sorted(images)
    if not rows:
        raise GavoError(f"{path}: contains no trajectory (no rows)")
    if len(rows[0][1]) == 4 and len(rows) >= 4:
        blocks = (rows[at : at + 4] for at in range(0, len(rows), 4))
        rows = [(block[0][0], [field for _, fields in block for field in fields]) for block in blocks]
    named = numbers if len(numbers) == len(rows) else range(len(rows))
    return [(number, *row) for number, row in zip(named, rows, strict=True)]
