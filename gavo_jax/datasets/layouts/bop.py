"""Scenes of the BOP challenge (Hodaň et al. 2018): T-LESS, LineMOD, YCB-Video and others in one format."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from gavo_jax.camera_files.calibration import MAX_JSON_BYTES, Calibration, load_calibration
from gavo_jax.datasets.assembly import MILLIMETRES
from gavo_jax.datasets.files import Entry, Reading, size_of_most
from gavo_jax.datasets.layouts.image_folders import plain_files
from gavo_jax.datasets.layouts.numbered import NumberedFolder, of_matrices
from gavo_jax.datasets.own_camera import own_camera_file
from gavo_jax.datasets.truth import pose_of
from gavo_jax.errors import GavoError, read_json_object
from gavo_jax.trajectory import inverse


class BopScene(NumberedFolder):
    """A scene of a BOP dataset: `rgb/000000.png` (or `gray/`), `depth/000000.png`, `scene_camera.json`.

    `scene_camera.json` has the camera matrix of each image by number, its `depth_scale` in millimetres per unit, and in
    some datasets camera_T_world, in millimetres.
    """

    kind: ClassVar[str] = "BOP scene"
    FILE: ClassVar[str] = "scene_camera.json"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by `scene_camera.json` beside images."""
        return (path / cls.FILE).is_file() and all(plain_files(path))

    @classmethod
    def calibrate(cls, path: Path, entries: Sequence[Entry], reading: Reading) -> Calibration:
        """The camera file in the folder, else the common camera of the frames; the depth unit is the scene's."""
        file, size = path / cls.FILE, size_of_most(entries)
        scale = cls.unit(path, reading)
        if (own := own_camera_file(path)) is not None:
            return load_calibration(own, size, scale)
        matrices = [frame["cam_K"] for frame in _frames(file).values() if "cam_K" in frame]
        return of_matrices(file, matrices, size, scale)

    @classmethod
    def unit(cls, path: Path, reading: Reading) -> float:
        """That of the scene, unless it is given."""
        file = path / cls.FILE
        return reading.depth_scale or _depth_scale(file, list(_frames(file).values()))

    @classmethod
    def poses(cls, path: Path) -> dict[int, Float[np.ndarray, "4 4"]]:
        """The poses in the file, inverted to world_T_camera, in metres."""
        found = {}
        for image, frame in _frames(path / cls.FILE).items():
            turn, shift = frame.get("cam_R_w2c"), frame.get("cam_t_w2c")
            if turn is None or shift is None:
                continue
            place = f"{path / cls.FILE}: image {image}"
            camera_T_world = pose_of(place, _fields(place, turn, shift))
            if camera_T_world is not None:
                camera_T_world[:3, 3] /= MILLIMETRES
                found[image] = inverse(camera_T_world)
        return found


def _frames(file: Path) -> dict[int, dict[str, Any]]:
    """The entries of a file by image number."""
    frames = {}
    for name, frame in read_json_object(file, MAX_JSON_BYTES).items():
        if not name.isdecimal() or not isinstance(frame, dict):
            raise GavoError(f"{file}: {name[:60]!r}: expected the number of an image, with its values")
        frames[int(name)] = frame
    return frames


def _depth_scale(file: Path, frames: list[dict[str, Any]]) -> float:
    """Depth units per metre, which have to be equal for all frames."""
    scales = [frame.get("depth_scale", 1.0) for frame in frames] or [1.0]
    scale = scales[0]
    is_number = isinstance(scale, int | float) and not isinstance(scale, bool)
    if not is_number or not scale > 0 or any(other != scale for other in scales):
        raise GavoError(f"{file}: depth_scale: expected one number of millimetres for all images: pass --depth-scale")
    return MILLIMETRES / scale


def _fields(place: str, turn: Any, shift: Any) -> list[str]:
    """The sixteen fields of a pose in row-major order."""
    if not (isinstance(turn, list) and isinstance(shift, list) and (len(turn), len(shift)) == (9, 3)):
        raise GavoError(f"{place}: expected nine numbers in cam_R_w2c, and three in cam_t_w2c")
    rows = [[*turn[3 * row : 3 * row + 3], shift[row]] for row in range(3)]
    return [str(value) for row in rows for value in row] + ["0", "0", "0", "1"]
