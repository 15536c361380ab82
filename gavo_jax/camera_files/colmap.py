"""COLMAP's `cameras.txt`: a row for each camera, CAMERA_ID MODEL WIDTH HEIGHT PARAMS."""

import re
from pathlib import Path

from gavo_jax.camera_files.words import ORDER, Table
from gavo_jax.errors import GavoError, number

MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", *ORDER["pinhole"]),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", *ORDER["fisheye"]),
}
"""COLMAP's models that are OpenCV's, and their parameters in order."""

ROW = re.compile(r"^\s*\d+[ \t]+([A-Z][A-Z_]+)[ \t]+(\d+)[ \t]+(\d+)[ \t]+(\S.*?)\s*$", re.MULTILINE)

HALF = 0.5
"""COLMAP's centre of the first pixel, pixels; ours is 0."""


def read_colmap(path: Path, text: str) -> Table | None:
    """Read the camera of a `cameras.txt`, if the text has rows of such a file; else None.

    Raises:
        GavoError: its cameras differ, or one is of a model that OpenCV does not have.
    """
    cameras = [_camera(path, *row) for row in ROW.findall(text)]
    if not cameras:
        return None
    if any(camera != cameras[0] for camera in cameras):
        raise GavoError(f"{path}: {len(cameras)} cameras of COLMAP: leave that of the images alone there")
    return cameras[0]


def _camera(path: Path, model: str, width: str, height: str, parameters: str) -> Table:
    names = MODELS.get(model)
    if names is None:
        raise GavoError(f"{path}: COLMAP's model {model[:60]} is not read: {', '.join(MODELS)} are")
    try:
        named = dict(zip(names, map(number, parameters.split()), strict=True))
    except ValueError:
        wanted = " ".join(names)
        raise GavoError(f"{path}: COLMAP's {model} has the numbers {wanted}, not {parameters[:60]!r}") from None
    fx, fy = (named.get(key, named.get("f", 0.0)) for key in ("fx", "fy"))
    table: Table = {"width": int(width), "height": int(height), "fx": fx, "fy": fy}
    table |= {key: named[key] - HALF for key in ("cx", "cy")}
    order = ORDER["fisheye"] if model.endswith("FISHEYE") else ORDER["pinhole"][: 8 if model == "FULL_OPENCV" else 4]
    if any(named.get(key) for key in order) or model.endswith("FISHEYE"):
        table["distortion"] = [named.get(key, 0.0) for key in order]
    return {**table, "model": "fisheye"} if model.endswith("FISHEYE") else table
