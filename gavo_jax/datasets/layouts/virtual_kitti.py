"""Rendered drives of Virtual KITTI 2 (Cabon et al. 2020)."""

import re
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
from jaxtyping import Float

from gavo_jax.camera_files.calibration import Calibration
from gavo_jax.datasets.files import Reading, Size
from gavo_jax.datasets.layouts.numbered import NumberedFolder, found_among, of_matrices
from gavo_jax.datasets.names import Found
from gavo_jax.datasets.truth import numbers_in, pose_of
from gavo_jax.errors import GavoError, data_rows
from gavo_jax.trajectory import inverse

CENTIMETRES = 100.0
"""Depth units per metre; the sky, at 655.35 m, is no reading."""

RATE = 10.0
"""Frames per second, those of the KITTI drives that it imitates."""

CAMERA = "Camera_0"
"""The left camera of the stereo pair."""

NUMBER = re.compile(r"\d{1,9}", re.ASCII)
"""Number of a frame or a camera."""

TEXTS = "it is in the dataset's vkitti_2.0.3_textgt.tar.gz"


class VirtualKitti(NumberedFolder):
    """A variation of a scene (`Scene01/clone`): `frames/rgb/Camera_0/`, `frames/depth/Camera_0/`, and text files.

    `intrinsic.txt` and `extrinsic.txt` have a row for each frame and camera: the intrinsics, and camera_T_world.
    """

    kind: ClassVar[str] = "drive of Virtual KITTI 2"
    DEPTH_SCALE: ClassVar[float] = CENTIMETRES
    INTRINSICS: ClassVar[str] = "intrinsic.txt"
    POSES: ClassVar[str] = "extrinsic.txt"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by either of its image folders, which are separate downloads."""
        return any(folder.is_dir() for folder in _folders(path))

    @classmethod
    def find(cls, path: Path) -> Found:
        """The images of both kinds, each in its folder."""
        color, depth = folders = _folders(path)
        for folder, other in (folders, folders[::-1]):
            if not folder.is_dir():
                kind = folder.parent.name
                raise GavoError(f"{folder}: no such folder beside that of {other.parent.name}: unpack {kind}, too")
        return found_among(color.glob("rgb_*"), depth.glob("depth_*"))

    @classmethod
    def own_camera(cls, path: Path, size: Size) -> Calibration:
        """The common camera of the frames' rows."""
        file = path / cls.INTRINSICS
        if not file.is_file():
            raise GavoError(f"{file}: no such file: {TEXTS}; or pass --camera")
        rows = [numbers_in(place, row, 4) for place, row in _rows(file).values()]
        found = [[[row[0], 0.0, row[2]], [0.0, row[1], row[3]], [0.0, 0.0, 1.0]] for row in rows if row]
        return of_matrices(file, found, size, CENTIMETRES)

    @classmethod
    def stamps(cls, path: Path) -> dict[int, float]:
        """Stamps from the frame numbers at `RATE`."""
        return {number: number / RATE for number in cls.find(path).color}

    @classmethod
    def poses(cls, path: Path) -> dict[int, Float[np.ndarray, "4 4"]]:
        """The poses of the rows, inverted to world_T_camera."""
        file = path / cls.POSES
        rows = _rows(file) if file.is_file() else {}
        found = {frame: pose_of(place, row) for frame, (place, row) in rows.items()}
        return {frame: inverse(pose) for frame, pose in found.items() if pose is not None}

    @classmethod
    def open(cls, path: Path, reading: Reading) -> Self:
        """Open the folder; its depth unit is known."""
        return super().open(path, replace(reading, depth_scale=reading.depth_scale or CENTIMETRES))


def _folders(path: Path) -> tuple[Path, Path]:
    """The folders of colour and depth."""
    return path / "frames/rgb" / CAMERA, path / "frames/depth" / CAMERA


def _rows(file: Path) -> dict[int, tuple[str, list[str]]]:
    """The location (file:line) and the fields after frame and camera of each row of `CAMERA`, by frame number."""
    rows: dict[int, tuple[str, list[str]]] = {}
    for place, (frame, *fields) in data_rows(file):
        if frame == "frame":
            continue
        if not (NUMBER.fullmatch(frame) and fields and NUMBER.fullmatch(fields[0])):
            found = " ".join([frame, *fields])[:60]
            raise GavoError(f"{place}: expected the numbers of a frame and a camera first, found {found!r}")
        if int(fields[0]) != int(CAMERA[-1]):
            continue
        if int(frame) in rows:
            raise GavoError(f"{place}: frame {int(frame)} appears twice")
        rows[int(frame)] = place, fields[1:]
    if not rows:
        raise GavoError(f"{file}: contains no row for any frame of {CAMERA}: download or copy it again")
    return rows
