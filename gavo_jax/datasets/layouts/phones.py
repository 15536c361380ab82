"""Phone scans: Stray Scanner, ARKitScenes, and exports of Record3D."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from jaxtyping import Float

from gavo_jax.camera_files.calibration import Calibration, load_calibration
from gavo_jax.datasets.assembly import MILLIMETRES
from gavo_jax.datasets.files import Entry, Reading, Size
from gavo_jax.datasets.layouts.image_folders import plain_files
from gavo_jax.datasets.layouts.listed_times import FrameClock
from gavo_jax.datasets.layouts.numbered import NumberedFolder, of_each_frame
from gavo_jax.datasets.layouts.pairing import Paired
from gavo_jax.datasets.layouts.plain_folder import PlainFolder, by_rate
from gavo_jax.datasets.own_camera import own_camera_file, told_in
from gavo_jax.datasets.truth import Seconds, numbers_in, posed
from gavo_jax.errors import GavoError, data_rows
from gavo_jax.trajectory import Trajectory, inverse


class StrayScan(NumberedFolder):
    """A scan of the app Stray Scanner: `rgb.mp4`, or its frames in `rgb/`, with `depth/` and `odometry.csv`.

    Depth is registered to colour, in millimetres. `odometry.csv` has the stamp and pose of each frame by its number;
    y of the camera points down, as ours. Older versions wrote only poses, newer ones add each frame's camera.
    """

    kind: ClassVar[str] = "scan of Stray Scanner"
    depth_is_of_view: ClassVar[bool] = True
    STAMPS: ClassVar[str] = "odometry.csv"
    MATRIX: ClassVar[str] = "camera_matrix.csv"
    FILM: ClassVar[tuple[int, int]] = (1920, 1440)
    """Image size to which the camera matrix refers, pixels."""

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by the app's own files beside images."""
        return all((path / name).is_file() for name in (cls.STAMPS, cls.MATRIX)) and all(plain_files(path))

    @classmethod
    def own_camera(cls, path: Path, size: Size) -> Calibration:
        """The film's camera, scaled to the size of the images."""
        width, height = size
        if width * cls.FILM[1] != height * cls.FILM[0]:
            film = "x".join(map(str, cls.FILM))
            raise GavoError(
                f"{path}: images of {width}x{height}, from a film of {film}: pass --camera, or do not crop them"
            )
        found = load_calibration(path / cls.MATRIX, cls.FILM, MILLIMETRES)
        return replace(found, color=found.color.resized(width, height))

    @classmethod
    def stamps(cls, path: Path) -> dict[int, float]:
        """The stamps, if the file has that column."""
        return {n: stamp for n, (stamp, _) in _odometry(path / cls.STAMPS).items() if stamp is not None}

    @classmethod
    def poses(cls, path: Path) -> dict[int, Float[np.ndarray, "4 4"]]:
        """ARKit's poses."""
        return {n: pose for n, (_, pose) in _odometry(path / cls.STAMPS).items()}


class ArkitScenes(PlainFolder):
    """A scan of ARKitScenes (Baruch et al. 2021): `lowres_wide/`, `lowres_depth/`, a camera file per frame, and poses.

    A row of `lowres_wide.traj` is a stamp and camera_T_world as a rotation vector and a translation.
    """

    kind: ClassVar[str] = "scan of ARKitScenes"
    scale_is_open: ClassVar[bool] = False
    CAMERAS: ClassVar[str] = "lowres_wide_intrinsics"
    POSES: ClassVar[str] = "lowres_wide.traj"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by the cameras beside the images."""
        return (path / cls.CAMERAS).is_dir() and (path / "lowres_wide").is_dir() and super().recognises(path)

    @classmethod
    def calibrate(cls, path: Path, entries: Sequence[Entry], reading: Reading) -> Calibration:
        """The camera file in the folder, else the common camera of the frames."""
        files = sorted((path / cls.CAMERAS).glob("*.pincam"))
        if own_camera_file(path) is not None or not files:
            return super().calibrate(path, entries, reading)
        return of_each_frame(path / cls.CAMERAS, files, partial(load_calibration, depth_scale=MILLIMETRES))

    @classmethod
    def truth(cls, path: Path, paired: Paired) -> tuple[Trajectory | None, list[str]]:
        """ARKit's poses, unless the folder has a ground truth."""
        found, unread = super().truth(path, paired)
        if found is not None or not (path / cls.POSES).is_file():
            return found, unread
        return _read_turns(path / cls.POSES), []


class Record3D(PlainFolder):
    """An EXR + RGB export of the app Record3D: numbered images and `metadata.json`.

    `metadata.json` has the camera and the frames' times, as `frameTimestamps` by number, or as `fps`.
    """

    kind: ClassVar[str] = "export of Record3D"
    depth_is_of_view: ClassVar[bool] = True
    FILE: ClassVar[str] = "metadata.json"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by the camera in `metadata.json`, beside images."""
        file = path / cls.FILE
        return file.is_file() and "K" in told_in(file) and super().recognises(path)

    @classmethod
    def clock(cls, path: Path, color: list[Path], depth: list[Path]) -> FrameClock:
        """Times of the frames from `frameTimestamps`, else from `fps`."""
        told = told_in(path / cls.FILE)
        stamps = told.get("frameTimestamps")
        if isinstance(stamps, list) and len(stamps) > 1:
            return FrameClock(_clock_of(f"{path / cls.FILE}: frameTimestamps", stamps))
        return FrameClock(by_rate(told.get("fps")))


def _clock_of(place: str, stamps: list[Any]) -> Seconds:
    """Map frame numbers, from 0, to the given stamps of all frames.

    Raises:
        GavoError: the stamps are no increasing times. The returned function raises it for a number beyond the last.
    """
    try:
        times = np.array(stamps, np.float64)
    except (TypeError, ValueError):
        times = np.empty(0)
    if times.shape != (len(stamps),) or not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
        raise GavoError(f"{place}: expected increasing seconds: pass --rate to ignore timestamps")

    def at(numbers: np.ndarray) -> np.ndarray:
        if np.max(numbers) > len(times) - 1:
            raise GavoError(
                f"{place}: only {len(times)} times, but there is a frame {np.max(numbers):.0f}: pass --rate instead"
            )
        return np.interp(numbers, np.arange(len(times)), times)

    return at


def _odometry(path: Path) -> dict[int, tuple[float | None, np.ndarray]]:
    """Read stamps and poses by frame number; there may be a header, and columns after the ninth are ignored."""
    rows, found = data_rows(path), {}
    if rows and "qx" in rows[0][1]:
        rows = rows[1:]
    for at, (place, fields) in enumerate(rows):
        is_bare = len(fields) == 7
        values = numbers_in(place, fields[:9], 7 if is_bare else 9)
        pose = None if values is None else posed(values[-7:])
        if values is None or pose is None:
            continue
        found[at if is_bare else int(values[1])] = None if is_bare else values[0], pose
    if not found:
        raise GavoError(f"{path}: contains no trajectory (no rows)")
    return found


def _read_turns(path: Path) -> Trajectory:
    """Read rows of a stamp and camera_T_world (rotation vector and translation) as a trajectory."""
    rows = [values for place, fields in data_rows(path) if (values := numbers_in(place, fields, 7)) is not None]
    if not rows:
        raise GavoError(f"{path}: contains no trajectory (no rows)")
    table = np.array(rows)
    table = table[np.unique(table[:, 0], return_index=True)[1]]
    camera_T_world = np.tile(np.eye(4), (len(table), 1, 1))
    camera_T_world[:, :3, :3] = [cv2.Rodrigues(turn)[0] for turn in table[:, 1:4]]
    camera_T_world[:, :3, 3] = table[:, 4:]
    return Trajectory(table[:, 0], inverse(camera_T_world))
