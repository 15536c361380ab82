"""Scans of phones: Stray Scanner's folders, ARKitScenes, and what Record3D exports."""

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
from gavo_jax.datasets.files import Entry, Reading, Size, own_camera_file, told_in
from gavo_jax.datasets.layouts.image_folders import plain_files
from gavo_jax.datasets.layouts.numbered import NumberedFolder, PlainFolder, by_rate, of_each_frame
from gavo_jax.datasets.layouts.pairing import Paired
from gavo_jax.datasets.truth import Seconds, numbers_in, posed
from gavo_jax.errors import GavoError, data_rows
from gavo_jax.trajectory import Trajectory, inverse


class StrayScan(NumberedFolder):
    """A scan of the app Stray Scanner, once the frames of its film are images: `rgb/`, `depth/`, `odometry.csv`.

    Depth is registered to colour, in millimetres. `odometry.csv` has a stamp and a pose for each frame, by its number:
    of a camera whose y points down, as ours. Older versions wrote poses alone, newer ones add the camera of each frame.
    """

    kind: ClassVar[str] = "scan of Stray Scanner"
    depth_is_of_view: ClassVar[bool] = True
    STAMPS: ClassVar[str] = "odometry.csv"
    MATRIX: ClassVar[str] = "camera_matrix.csv"
    FILM: ClassVar[tuple[int, int]] = (1920, 1440)
    """Pixels, of which the camera matrix is."""

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by the recorder's own files, beside images."""
        return all((path / name).is_file() for name in (cls.STAMPS, cls.MATRIX)) and all(plain_files(path))

    @classmethod
    def own_camera(cls, path: Path, size: Size) -> Calibration:
        """The film's, at the size of the images."""
        width, height = size
        if width * cls.FILM[1] != height * cls.FILM[0]:
            film = "x".join(map(str, cls.FILM))
            raise GavoError(
                f"{path}: images of {width}x{height}, of a film of {film}: say --camera, or do not crop them"
            )
        found = load_calibration(path / cls.MATRIX, cls.FILM, MILLIMETRES)
        return replace(found, color=found.color.resized(width, height))

    @classmethod
    def stamps(cls, path: Path) -> dict[int, float]:
        """The column of stamps, where there is one."""
        return {n: stamp for n, (stamp, _) in _odometry(path / cls.STAMPS).items() if stamp is not None}

    @classmethod
    def poses(cls, path: Path) -> dict[int, Float[np.ndarray, "4 4"]]:
        """What ARKit found."""
        return {n: pose for n, (_, pose) in _odometry(path / cls.STAMPS).items()}


class ArkitScenes(PlainFolder):
    """A scan of ARKitScenes (Baruch et al. 2021): `lowres_wide/`, `lowres_depth/`, a camera for each frame, poses.

    A row of `lowres_wide.traj` is a stamp, the turn as axis times angle and the shift of the world into the camera.
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
        """A camera file in the folder, else what the frames' cameras have in common."""
        files = sorted((path / cls.CAMERAS).glob("*.pincam"))
        if own_camera_file(path) is not None or not files:
            return super().calibrate(path, entries, reading)
        return of_each_frame(path / cls.CAMERAS, files, partial(load_calibration, depth_scale=MILLIMETRES))

    @classmethod
    def truth(cls, path: Path, paired: Paired) -> tuple[Trajectory | None, list[str]]:
        """What ARKit found, unless a better one lies there."""
        found, unread = super().truth(path, paired)
        if found is not None or not (path / cls.POSES).is_file():
            return found, unread
        return _read_turns(path / cls.POSES), []


class Record3D(PlainFolder):
    """What the app Record3D exports as EXR and RGB: images by their numbers, and `metadata.json`.

    That says the camera, and when the frames were taken: `frameTimestamps`, by their numbers, or `fps`.
    """

    kind: ClassVar[str] = "export of Record3D"
    depth_is_of_view: ClassVar[bool] = True
    FILE: ClassVar[str] = "metadata.json"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by the camera in its file, beside images."""
        file = path / cls.FILE
        return file.is_file() and "K" in told_in(file) and super().recognises(path)

    @classmethod
    def clock(cls, path: Path) -> Seconds | None:
        """What its file says, of each frame or of all."""
        told = told_in(path / cls.FILE)  # with a camera file in the folder it need not be one
        stamps = told.get("frameTimestamps")
        if isinstance(stamps, list) and len(stamps) > 1:
            return _clock_of(f"{path / cls.FILE}: frameTimestamps", stamps)
        return by_rate(told.get("fps"))


def _clock_of(place: str, stamps: list[Any]) -> Seconds:
    """Times of frames that count from 0, by the stamps of all of them.

    Raises:
        GavoError: they are no times; or, when it is asked, a frame is beyond the last of them.
    """
    try:
        times = np.array(stamps, np.float64)
    except (TypeError, ValueError):
        times = np.empty(0)
    if times.shape != (len(stamps),) or not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
        raise GavoError(f"{place}: expected increasing seconds: say --rate to do without them")

    def at(numbers: np.ndarray) -> np.ndarray:
        if np.max(numbers) > len(times) - 1:
            raise GavoError(f"{place}: {len(times)} of them, and a frame {np.max(numbers):.0f}: say --rate instead")
        return np.interp(numbers, np.arange(len(times)), times)

    return at


def _odometry(path: Path) -> dict[int, tuple[float | None, np.ndarray]]:
    """Stamps and poses by the numbers of frames; the first line may name the columns, of which the first nine count."""
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
        raise GavoError(f"{path}: holds no trajectory (no rows)")
    return found


def _read_turns(path: Path) -> Trajectory:
    """Rows of a stamp, axis times angle and shift, camera_T_world."""
    rows = [values for place, fields in data_rows(path) if (values := numbers_in(place, fields, 7)) is not None]
    if not rows:
        raise GavoError(f"{path}: holds no trajectory (no rows)")
    table = np.array(rows)
    table = table[np.unique(table[:, 0], return_index=True)[1]]
    camera_T_world = np.tile(np.eye(4), (len(table), 1, 1))
    camera_T_world[:, :3, :3] = [cv2.Rodrigues(turn)[0] for turn in table[:, 1:4]]
    camera_T_world[:, :3, 3] = table[:, 4:]
    return Trajectory(table[:, 0], inverse(camera_T_world))
