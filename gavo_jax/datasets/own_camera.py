"""The camera file of a folder: its names, what it says, and what takes its place."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gavo_jax.camera import preset_for_sequence
from gavo_jax.camera_files.calibration import MAX_JSON_BYTES, Calibration, load_calibration
from gavo_jax.camera_files.makes import PARSERS
from gavo_jax.datasets.images import read_bytes
from gavo_jax.datasets.truth import icl_truth
from gavo_jax.errors import GavoError, read_json_object, read_text

CAMERA_FILES = (
    *(f"{name}{ending}" for name in ("camera", "calibration", "camera_info") for ending in (".toml", ".yaml", ".yml")),
    *("camera_intrinsic.json", "camera_intrinsics.json", "camera.json", "cam_params.json", "camera.xml"),
    *("camera-intrinsics.txt", "camera_intrinsics.txt", "camera_intrinsic.txt", "intrinsics.txt", "calibration.txt"),
    *("intrinsics_color.txt", "intrinsic_color.txt", "intrinsic/intrinsic_color.txt", "colorIntrinsics.txt"),
)
"""Names by which a camera file in a folder, or in its parent, is recognised."""

LOOKS_LIKE_A_CAMERA = re.compile(r"cam|intrinsic|calib|^K(?![a-z])", re.IGNORECASE)
OF_POSES = re.compile(r"pose|traj|extrinsic", re.IGNORECASE)
"""Matches other files whose names contain the camera's."""

MOST_NAMED = 3
"""Most files that a message names."""

SCANS, OF_A_SCAN = ("info.txt", "_info.txt"), b"m_calibrationColorIntrinsic"
"""Names of a scan's info file, and a key that it contains: other programs use the same names."""

EXPORTED_CAMERA_FILES = (
    *("cam_K.txt", "K.txt", "intrinsic.txt"),
    *(f"intrinsics{ending}" for ending in (".toml", ".yaml", ".yml", ".json")),
    *("calibration.json", "camera_matrix.csv", "transforms.json", "metadata.json"),
)
"""Names of camera files exported by other programs, which may be estimates, or of many cameras: used only if there is
no other camera."""


def told_in(file: Path) -> dict[str, Any]:
    """The JSON object in a file beside the images; empty if it cannot be read as one."""
    try:
        return read_json_object(file, MAX_JSON_BYTES)
    except GavoError:
        return {}


def own_camera_file(folder: Path) -> Path | None:
    """The camera file in a folder; None if there is none.

    Raises:
        GavoError: it is that of colour, and the depth camera's file beside it differs.
    """
    file = next((folder / name for name in CAMERA_FILES if (folder / name).is_file()), None)
    if file is None:
        return info_of_scan(folder)
    other = file.with_name(re.sub("(_|^)color", r"\1depth", file.name))
    if other.is_file() and read_text(other).split() != read_text(file).split():
        raise GavoError(
            f"{file}: {other.name} beside it belongs to another camera: pass --camera with a file for both cameras "
            "([depth], colour_T_depth), or for one if depth is registered to colour"
        )
    return file


def nearest_camera_file(folder: Path) -> Path | None:
    """The camera file in a folder, else one folder up: of a link to it, beside the link before what it points to.

    Raises:
        GavoError: as `own_camera_file`.
    """
    above = [folder.parent] if folder.name != ".." else []  # the parent of `..` is the folder that it leaves
    found = (own_camera_file(place) for place in (folder, *above, folder.resolve().parent))
    return next((file for file in found if file is not None), None)


def info_of_scan(folder: Path) -> Path | None:
    """The info file of a scan, with both cameras, in a folder; None if there is none."""
    files = (folder / name for name in SCANS)
    return next((file for file in files if file.is_file() and OF_A_SCAN in read_bytes(file)), None)


def preset_or_export(folder: Path, load: Callable[[Path], Calibration]) -> Calibration:
    """The preset that a folder's name implies, else a camera file exported to it by another program.

    Raises:
        GavoError: there is neither, or the file cannot be read.
    """
    try:
        return preset_by_name(folder)
    except GavoError:
        files = (folder / name for name in EXPORTED_CAMERA_FILES if (folder / name).is_file())
        file = next((file for file in files if file.stem != "metadata" or "K" in told_in(file)), None)
        if file is None:
            raise
    return load(file)


def preset_by_name(folder: Path) -> Calibration:
    """The preset implied by a folder's name, or by a trajectory of ICL-NUIM in it.

    Raises:
        GavoError: no preset is implied; the message says what would help.
    """
    try:
        return load_calibration(preset_for_sequence(folder.resolve().name))
    except GavoError as error:
        if icl_truth(folder) is not None:
            return load_calibration("icl")
        raise GavoError(f"{folder}: no camera file in it, and {error}{_lookalikes(folder)}") from None


def _lookalikes(folder: Path) -> str:
    """Name the files in a folder that may hold its camera, for a message; empty if there are none."""
    files = [file.name for file in sorted(folder.iterdir()) if file.suffix.lower() in PARSERS and file.is_file()]
    alike = [name for name in files if LOOKS_LIKE_A_CAMERA.search(name) and not OF_POSES.search(name)]
    if not alike:
        return ""
    names = ", ".join(name[:60] for name in alike[:MOST_NAMED]) + ", …" * (len(alike) > MOST_NAMED)
    return f"; if it is in {names}: --camera {folder / alike[0]}"
