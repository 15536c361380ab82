"""Phone scans with ARKit's camera and pose of each frame in JSON files."""

import re
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
from gavo_jax.datasets.clocks import INTERVALS, is_between, told_stamp
from gavo_jax.datasets.files import Entry, Reading, Size
from gavo_jax.datasets.layouts.image_folders import plain_files
from gavo_jax.datasets.layouts.nerf import FLIP, pose_of_rows
from gavo_jax.datasets.layouts.numbered import NumberedFolder, of_matrices
from gavo_jax.datasets.layouts.pairing import Paired, paired_at
from gavo_jax.datasets.layouts.plain_folder import PlainFolder
from gavo_jax.datasets.names import unpaired
from gavo_jax.datasets.own_camera import own_camera_file
from gavo_jax.datasets.truth import Seconds, by_stamp
from gavo_jax.errors import GavoError, read_json_object, read_text
from gavo_jax.trajectory import Trajectory


class ScanNetPlusPlus(NumberedFolder):
    """An iPhone scan of ScanNet++ (Yeshwanth et al. 2023), after its toolbox has written `rgb/` and `depth/`.

    Depth is in millimetres, registered to colour at a seventh of its size. `pose_intrinsic_imu.json` has stamp, camera
    and pose of each frame, `frame_000000` and so on: `aligned_pose` in the scan's world, else `pose` in ARKit's.
    """

    kind: ClassVar[str] = "scan of ScanNet++"
    depth_is_of_view: ClassVar[bool] = True
    STAMPS: ClassVar[str] = "pose_intrinsic_imu.json"
    POSES: ClassVar[tuple[str, ...]] = ("aligned_pose", "pose")

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by `pose_intrinsic_imu.json` beside images."""
        return (path / cls.STAMPS).is_file() and all(plain_files(path))

    @classmethod
    def own_camera(cls, path: Path, size: Size) -> Calibration:
        """The common camera of the frames."""
        file = path / cls.STAMPS
        matrices = [frame["intrinsic"] for frame in _frames(file).values() if "intrinsic" in frame]
        return of_matrices(file, matrices, size, MILLIMETRES)

    @classmethod
    def stamps(cls, path: Path) -> dict[int, float]:
        """Stamps of the frames, seconds."""
        file = path / cls.STAMPS
        found = {number: frame["timestamp"] for number, frame in _frames(file).items() if "timestamp" in frame}
        return {number: told_stamp(str(file), stamp) for number, stamp in found.items()}

    @classmethod
    def poses(cls, path: Path) -> dict[int, Float[np.ndarray, "4 4"]]:
        """ARKit's poses, aligned to the scan if the dataset has aligned them."""
        frames = _frames(path / cls.STAMPS)
        key = next((key for key in cls.POSES if any(key in frame for frame in frames.values())), cls.POSES[0])
        given = {number: frame[key] for number, frame in frames.items() if key in frame}
        found = {number: pose_of_rows(f"{path / cls.STAMPS}: frame {number}", rows) for number, rows in given.items()}
        return {number: pose for number, pose in found.items() if pose is not None}


class ScannerApp(NumberedFolder):
    """An *All Data* export of 3D Scanner App: `frame_00000.jpg`, `depth_00000.png`, `frame_00000.json`.

    Depth is in millimetres, registered to colour at another size; there are more depth than colour images. A frame's
    JSON file has its stamp, its camera, and the pose of a camera that looks along -z.
    """

    kind: ClassVar[str] = "scan of 3D Scanner App"
    depth_is_of_view: ClassVar[bool] = True
    STAMPS: ClassVar[str] = "frame_*.json"
    POSE: ClassVar[str] = "cameraPoseARFrame"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by JSON files of frames, with ARKit's pose in the first found, beside images."""
        file = next(path.glob(cls.STAMPS), None)
        return file is not None and cls.POSE in read_text(file, MAX_JSON_BYTES) and all(plain_files(path))

    @classmethod
    def own_camera(cls, path: Path, size: Size) -> Calibration:
        """The common camera of the frames."""
        matrices = [matrix for _, matrix in cls._said(path, "intrinsics").values()]
        return of_matrices(path / cls.STAMPS, matrices, size, MILLIMETRES)

    @classmethod
    def stamps(cls, path: Path) -> dict[int, float]:
        """Stamps of the frames, seconds since the phone was started."""
        return {number: told_stamp(str(file), stamp) for number, (file, stamp) in cls._said(path, "time").items()}

    @classmethod
    def poses(cls, path: Path) -> dict[int, Float[np.ndarray, "4 4"]]:
        """ARKit's poses."""
        said = cls._said(path, cls.POSE)
        found = {number: pose_of_rows(str(file), rows) for number, (file, rows) in said.items()}
        return {number: pose @ FLIP for number, pose in found.items() if pose is not None}

    @classmethod
    def _said(cls, path: Path, key: str) -> dict[int, tuple[Path, Any]]:
        """The value of a key in each frame's file, with the file, by frame number."""
        numbers = {file: file.stem.removeprefix("frame_") for file in sorted(path.glob(cls.STAMPS))}
        written = tuple((file, file.stat().st_mtime_ns) for file, number in numbers.items() if number.isdecimal())
        found = {file: said.get(key) for file, said in _read_files(written).items()}
        return {int(numbers[file]): (file, value) for file, value in found.items() if value is not None}


class Polycam(PlainFolder):
    """The `keyframes/` of Polycam's raw data: `images/`, `depth/` and `cameras/`, with a JSON file for each frame.

    Names count microseconds. Depth is in millimetres, registered to colour at another size. A camera's file has the
    intrinsics and the pose of a camera that looks along -z, `t_00` to `t_23`; `corrected_cameras/`, if present, has the
    poses refined by the app.
    """

    kind: ClassVar[str] = "scan of Polycam"
    depth_is_of_view: ClassVar[bool] = True
    scale_is_open: ClassVar[bool] = False
    CAMERAS: ClassVar[str] = "cameras"
    CORRECTED: ClassVar[str] = "corrected_cameras"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by the camera files beside the images."""
        return any((path / cls.CAMERAS).glob("*.json")) and super().recognises(path)

    @classmethod
    def calibrate(cls, path: Path, entries: Sequence[Entry], reading: Reading) -> Calibration:
        """The camera file in the folder, else the common camera of the frames."""
        if own_camera_file(path) is not None:
            return super().calibrate(path, entries, reading)
        tables = [
            {key: value for key, value in read_json_object(file).items() if key in REQUIRED}
            for entry in entries
            if (file := path / cls.CAMERAS / f"{entry.color.stem}.json").is_file()
        ]
        folder = path / cls.CAMERAS
        if not tables:
            raise GavoError(f"{folder}: contains no camera for any of these images: pass --camera")
        color = camera_from_table(folder, common_camera(str(folder), tables), MILLIMETRES)
        return Calibration(color, origin=f"{folder}, the median of {len(tables)}")

    @classmethod
    def pair(cls, path: Path, color: list[Path], depth: list[Path], reading: Reading, seconds: Seconds) -> Paired:
        """Pair the images of the same name, which is their time; as in any folder if the names cannot be times."""
        named = {file.stem: file for file in depth}
        both = [file for file in color if file.stem in named and re.fullmatch(r"\d{1,15}", file.stem)]
        stamps = [1e-6 * int(file.stem) for file in both]
        if reading.rate or len(set(stamps)) < 2 or not is_between(stamps, INTERVALS):
            return super().pair(path, color, depth, reading, seconds)
        paired = paired_at(both, [named[file.stem] for file in both], stamps)
        return paired._replace(left_out=unpaired((len(color), len(depth)), len(both), "with the same name"))

    @classmethod
    def truth(cls, path: Path, paired: Paired) -> tuple[Trajectory | None, list[str]]:
        """The app's poses, unless the folder has a ground truth."""
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
    """Read JSON files, given with their modification times; cached for stamps, cameras and poses."""
    return {file: read_json_object(file) for file, _ in written}


def _frames(file: Path) -> dict[int, dict[str, Any]]:
    """The entries of a file by frame number."""
    status = file.stat()
    return _read_frames(file, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=1)
def _read_frames(file: Path, written: int, size: int) -> dict[int, dict[str, Any]]:
    """Read the entries of a file with this modification time and size; cached for stamps, cameras and poses."""
    frames = {}
    for name, frame in read_json_object(file).items():
        number = name.removeprefix("frame_")
        if not number.isdecimal() or not isinstance(frame, dict):
            raise GavoError(f"{file}: {name[:60]!r}: expected frame_000000 and so on, with the values of each")
        frames[int(number)] = frame
    return frames
