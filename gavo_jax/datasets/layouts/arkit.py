"""Scans of phones that say camera and pose of each frame in JSON, as ARKit found them."""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from gavo_jax.camera_files.calibration import MAX_JSON_BYTES, Calibration, camera_from_table
from gavo_jax.camera_files.exports import common_camera
from gavo_jax.camera_files.words import REQUIRED
from gavo_jax.datasets.assembly import MILLIMETRES
from gavo_jax.datasets.clocks import told_stamp
from gavo_jax.datasets.files import Entry, Reading, Size, own_camera_file
from gavo_jax.datasets.layouts.image_folders import plain_files
from gavo_jax.datasets.layouts.nerf import FLIP, pose_of_rows
from gavo_jax.datasets.layouts.numbered import NumberedFolder, PlainFolder, of_matrices
from gavo_jax.datasets.layouts.pairing import Paired
from gavo_jax.datasets.truth import by_stamp
from gavo_jax.errors import GavoError, read_json_object, read_text
from gavo_jax.trajectory import Trajectory


class ScanNetPlusPlus(NumberedFolder):
    """A scan of ScanNet++ (Yeshwanth et al. 2023) by its iPhone, once its toolbox has written `rgb/` and `depth/`.

    Depth is in millimetres, of colour's view at a seventh of its size. `pose_intrinsic_imu.json` has stamp, camera and
    pose of each frame, `frame_000000` and so on: `aligned_pose` in the scan's world, else `pose` in ARKit's.
    """

    kind: ClassVar[str] = "scan of ScanNet++"
    depth_is_of_view: ClassVar[bool] = True
    STAMPS: ClassVar[str] = "pose_intrinsic_imu.json"
    POSES: ClassVar[tuple[str, ...]] = ("aligned_pose", "pose")

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by that file, beside images."""
        return (path / cls.STAMPS).is_file() and all(plain_files(path))

    @classmethod
    def own_camera(cls, path: Path, size: Size) -> Calibration:
        """What the frames' cameras have in common."""
        file = path / cls.STAMPS
        matrices = [frame["intrinsic"] for frame in _frames(file).values() if "intrinsic" in frame]
        return of_matrices(file, matrices, size, MILLIMETRES)

    @classmethod
    def stamps(cls, path: Path) -> dict[int, float]:
        """Those of the frames, which are seconds."""
        file = path / cls.STAMPS
        found = {number: frame["timestamp"] for number, frame in _frames(file).items() if "timestamp" in frame}
        return {number: told_stamp(str(file), stamp) for number, stamp in found.items()}

    @classmethod
    def poses(cls, path: Path) -> dict[int, Float[np.ndarray, "4 4"]]:
        """What ARKit found, moved into the scan where the dataset did so."""
        frames = _frames(path / cls.STAMPS)
        key = next((key for key in cls.POSES if any(key in frame for frame in frames.values())), cls.POSES[0])
        given = {number: frame[key] for number, frame in frames.items() if key in frame}
        found = {number: pose_of_rows(f"{path / cls.STAMPS}: frame {number}", rows) for number, rows in given.items()}
        return {number: pose for number, pose in found.items() if pose is not None}


class ScannerApp(NumberedFolder):
    """What 3D Scanner App exports as *All Data*: `frame_00000.jpg`, `depth_00000.png`, `frame_00000.json`.

    Depth is in millimetres, of colour's view at a size of its own; there is more of it than of colour. A frame's file
    has its stamp, its camera, and the pose of a camera that looks along -z.
    """

    kind: ClassVar[str] = "scan of 3D Scanner App"
    depth_is_of_view: ClassVar[bool] = True
    STAMPS: ClassVar[str] = "frame_*.json"
    POSE: ClassVar[str] = "cameraPoseARFrame"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by the frames' files, of which one has such a pose, beside images."""
        file = next(path.glob(cls.STAMPS), None)
        return file is not None and cls.POSE in read_text(file, MAX_JSON_BYTES) and all(plain_files(path))

    @classmethod
    def own_camera(cls, path: Path, size: Size) -> Calibration:
        """What the frames' cameras have in common."""
        matrices = [matrix for _, matrix in cls._said(path, "intrinsics").values()]
        return of_matrices(path / cls.STAMPS, matrices, size, MILLIMETRES)

    @classmethod
    def stamps(cls, path: Path) -> dict[int, float]:
        """Those of the frames, which are seconds since the phone was switched on."""
        return {number: told_stamp(str(file), stamp) for number, (file, stamp) in cls._said(path, "time").items()}

    @classmethod
    def poses(cls, path: Path) -> dict[int, Float[np.ndarray, "4 4"]]:
        """What ARKit found."""
        said = cls._said(path, cls.POSE)
        found = {number: pose_of_rows(str(file), rows) for number, (file, rows) in said.items()}
        return {number: pose @ FLIP for number, pose in found.items() if pose is not None}

    @classmethod
    def _said(cls, path: Path, key: str) -> dict[int, tuple[Path, Any]]:
        """What the frames' files say by a key, by the frames' numbers."""
        numbers = {file: file.stem.removeprefix("frame_") for file in sorted(path.glob(cls.STAMPS))}
        written = tuple((file, file.stat().st_mtime_ns) for file, number in numbers.items() if number.isdecimal())
        found = {file: said.get(key) for file, said in _read_files(written).items()}
        return {int(numbers[file]): (file, value) for file, value in found.items() if value is not None}


class Polycam(PlainFolder):
    """The `keyframes/` of Polycam's raw data: `images/`, `depth/` and `cameras/`, a file of JSON for each frame.

    Depth is in millimetres, of colour's view at a size of its own. A camera's file has its numbers and the pose of a
    camera that looks along -z, `t_00` to `t_23`; where the app has corrected them, `corrected_cameras/` has better.
    """

    kind: ClassVar[str] = "scan of Polycam"
    depth_is_of_view: ClassVar[bool] = True
    scale_is_open: ClassVar[bool] = False
    CAMERAS: ClassVar[str] = "cameras"
    CORRECTED: ClassVar[str] = "corrected_cameras"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by the cameras' files beside the images."""
        return any((path / cls.CAMERAS).glob("*.json")) and super().recognises(path)

    @classmethod
    def calibrate(cls, path: Path, entries: Sequence[Entry], reading: Reading) -> Calibration:
        """A camera file in the folder, else what the frames' cameras have in common."""
        if own_camera_file(path) is not None:
            return super().calibrate(path, entries, reading)
        tables = [
            {key: value for key, value in read_json_object(file).items() if key in REQUIRED}
            for entry in entries
            if (file := path / cls.CAMERAS / f"{entry.color.stem}.json").is_file()
        ]
        folder = path / cls.CAMERAS
        if not tables:
            raise GavoError(f"{folder}: has no camera of any of these images: say --camera")
        color = camera_from_table(folder, common_camera(str(folder), tables), MILLIMETRES)
        return Calibration(color, origin=f"{folder}, the median of {len(tables)}")

    @classmethod
    def truth(cls, path: Path, paired: Paired) -> tuple[Trajectory | None, list[str]]:
        """What the app found, unless a better one lies there."""
        found, unread = super().truth(path, paired)
        folder = path / (cls.CORRECTED if (path / cls.CORRECTED).is_dir() else cls.CAMERAS)
        if found is not None:
            return found, unread
        poses: dict[float, np.ndarray] = {}
        for entry in paired.entries:
            file = folder / f"{entry.color.stem}.json"
            values = read_json_object(file) if file.is_file() else {}
            rows = [[values.get(f"t_{row}{column}") for column in range(4)] for row in range(3)]
            if values and (pose := pose_of_rows(str(file), rows)) is not None:
                poses[entry.stamp] = pose @ FLIP
        return by_stamp(poses) if poses else None, unread


@lru_cache(maxsize=1)
def _read_files(written: tuple[tuple[Path, int], ...]) -> dict[Path, dict[str, Any]]:
    """What each of some files says that were written then; read once for stamps, cameras and poses."""
    return {file: read_json_object(file) for file, _ in written}


def _frames(file: Path) -> dict[int, dict[str, Any]]:
    """What a file says of each frame, by the frames' numbers."""
    status = file.stat()
    return _read_frames(file, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=1)
def _read_frames(file: Path, written: int, size: int) -> dict[int, dict[str, Any]]:
    """`_frames`, of a file that was written then; read once for its stamps, cameras and poses."""
    frames = {}
    for name, frame in read_json_object(file).items():
        number = name.removeprefix("frame_")
        if not number.isdecimal() or not isinstance(frame, dict):
            raise GavoError(f"{file}: {name[:60]!r}: expected frame_000000 and so on, and what is said of each")
        frames[int(number)] = frame
    return frames
