"""Packaged sequences of OpenLORIS-Scene (Shi et al. 2020), taken by robots: TUM's layout with other file names."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from jaxtyping import Float

from gavo_jax.camera_files.calibration import Calibration, load_calibration
from gavo_jax.camera_files.exports import OPENLORIS_COLOR
from gavo_jax.camera_files.storage import read_storage, values_of
from gavo_jax.camera_files.words import numbers_of
from gavo_jax.datasets.assembly import MILLIMETRES
from gavo_jax.datasets.files import Entry, Reading, size_of_most
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.own_camera import own_camera_file
from gavo_jax.datasets.truth import TRUTH, Counted, pose_of
from gavo_jax.errors import GavoError, read_text
from gavo_jax.trajectory import Trajectory

BASE = "base_link"
"""The robot's frame, to which the true poses refer."""


class OpenLoris(TumSequence):
    """A folder with `color.txt`, `aligned_depth.txt`, `sensors.yaml` and `groundtruth.txt`, the robot's poses.

    Depth in `aligned_depth/` is registered to colour, in millimetres; `depth.txt` lists that of the depth camera.
    `trans_matrix.yaml`, with matrices parent_T_child, converts the robot's poses to those of the colour camera.
    """

    kind: ClassVar[str] = "OpenLORIS-Scene sequence"
    LISTS: ClassVar[tuple[str, str]] = ("color.txt", "aligned_depth.txt")
    DEPTH_SCALE: ClassVar[float] = MILLIMETRES
    SENSORS: ClassVar[str] = "sensors.yaml"
    TRANSFORMS: ClassVar[str] = "trans_matrix.yaml"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by its colour list, beside `aligned_depth.txt` or `sensors.yaml`, and no `rgb.txt`."""
        color, *others = (path / name for name in (*cls.LISTS, cls.SENSORS))
        return color.exists() and any(file.exists() for file in others) and not (path / TumSequence.LISTS[0]).exists()

    @classmethod
    def open(cls, path: Path, reading: Reading) -> Self:
        """Open the folder; its registered depth has to be there."""
        if not (depth := path / cls.LISTS[1]).exists():
            tool = "align_depth.py of openloris-scene-tools"
            raise GavoError(f"{depth}: no such file: unpack it and its images, or create them with {tool}")
        return super().open(path, reading)

    @classmethod
    def calibrate(cls, folder: Path, entries: list[Entry]) -> Calibration:
        """The camera file in the folder, else the colour camera of `sensors.yaml`."""
        file = own_camera_file(folder) or folder / cls.SENSORS
        if not file.exists():
            raise GavoError(f"{file}: no such file, which describes the camera: restore it, or pass --camera")
        return load_calibration(file, partial(size_of_most, entries), MILLIMETRES)

    @classmethod
    def truth(cls, folder: Path, stamps: list[float], counted: Counted | None) -> tuple[Trajectory | None, list[str]]:
        """The robot's true poses, converted to the colour camera if its pose on the robot is known."""
        found, unread = super().truth(folder, stamps, counted)
        if found is None or not (folder / TRUTH).exists():
            return found, unread
        base_T_color = _base_T_color(folder / cls.TRANSFORMS)
        if base_T_color is None:
            place = f"{cls.TRANSFORMS} that leads from {BASE} to {OPENLORIS_COLOR}"
            return None, [f"{TRUTH}: not used: it belongs to the robot's body, and there is no {place}"]
        return replace(found, world_T_camera=found.world_T_camera @ base_T_color), []


def _base_T_color(path: Path) -> Float[np.ndarray, "4 4"] | None:
    """Return the colour camera's pose on the robot; None if there is no file, or no chain of transforms in it.

    Raises:
        GavoError: the file is malformed.
    """
    if not path.exists():
        return None
    stored = read_storage(path, read_text(path), values_of, "transforms")
    moves = dict(_transform(f"{path}: trans_matrix[{at}]", move) for at, move in enumerate(_listed(path, stored)))
    frame, base_T_color = OPENLORIS_COLOR, np.eye(4)
    while frame != BASE:
        if frame not in moves:
            return None
        frame, parent_T_frame = moves.pop(frame)
        base_T_color = parent_T_frame @ base_T_color
    return base_T_color


def _listed(path: Path, stored: dict[str, Any]) -> list[Any]:
    moves = stored.get("trans_matrix")
    if not isinstance(moves, list):
        raise GavoError(f"{path}: trans_matrix: expected a list of parent_frame, child_frame and matrix")
    return moves


def _transform(place: str, move: Any) -> tuple[str, tuple[str, np.ndarray]]:
    """The child frame of a transform, with its parent frame and parent_T_child."""
    keys = ("child_frame", "parent_frame", "matrix")
    if not isinstance(move, dict) or not set(keys) <= move.keys():
        raise GavoError(f"{place}: expected parent_frame, child_frame and matrix")
    child, parent, matrix = (move[key] for key in keys)
    pose = pose_of(place, [str(value) for value in numbers_of(matrix)])
    if pose is None:
        raise GavoError(f"{place}: contains numbers that are not finite")
    return child, (parent, pose)
