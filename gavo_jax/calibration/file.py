"""Writing of a calibration as this package's camera file."""

from pathlib import Path

import tomli_w

from gavo_jax.camera import Camera
from gavo_jax.camera_files.calibration import Calibration
from gavo_jax.errors import write_bytes


def write_camera_file(path: str | Path, calibration: Calibration, comments: tuple[str, ...] = ()) -> None:
    """Write a camera file that `load_calibration` reads back.

    Args:
        path: ends in .toml.
        calibration: the cameras, with lens distortion.
        comments: comment lines at the top.

    Raises:
        GavoError: the file cannot be written.
    """
    table = _table(calibration.color) | {"depth_scale": float(calibration.color.depth_scale)}
    if calibration.depth_delay:
        table["depth_delay"] = float(calibration.depth_delay)
    if calibration.color_T_depth is not None:
        table["colour_T_depth"] = calibration.color_T_depth.tolist()
    if calibration.depth is not None:
        table["depth"] = _table(calibration.depth)
    lines = [f"# {line}" for line in comments]
    write_bytes(path, ("\n".join([*lines, tomli_w.dumps(table)])).encode("utf-8"))


def _table(camera: Camera) -> dict[str, object]:
    table: dict[str, object] = {name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy")}
    table |= {"width": camera.width, "height": camera.height}
    if camera.is_distorted:
        table |= {"distortion": [float(value) for value in camera.distortion], "model": camera.model}
    if any(camera.vignetting):
        table["vignetting"] = [float(value) for value in camera.vignetting]
    return table | {"readout": float(camera.readout)}
