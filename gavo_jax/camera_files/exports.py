"""Cameras as programs and datasets write them: RealSense's SDK with lens models of its own, nerfstudio, OpenLORIS."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gavo_jax.camera_files.words import Table, numbers_of, refuse_unknown, rest_of_camera, unit_of_depth
from gavo_jax.errors import GavoError, shown

Rays = tuple[np.ndarray, np.ndarray]

Lens = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[Rays, Rays]]
"""Maps a grid of points and coefficients to undistorted points and their distorted positions."""

GRID = 25
"""Points along either side of the image to which OpenCV's model is fitted."""

SDK_MODELS = ("none", "modified_brown_conrady", "inverse_brown_conrady", "ftheta", "brown_conrady", "kannala_brandt4")
"""Lens models of RealSense's SDK, in the order of its numbers for them."""


def _brown(x: np.ndarray, y: np.ndarray, k: np.ndarray, scaled: bool = False) -> Rays:
    """Radial and tangential terms, coefficients k1 k2 p1 p2 k3; `scaled`: tangential after radial."""
    square = x**2 + y**2
    radial = 1 + k[0] * square + k[1] * square**2 + k[4] * square**3
    u, v = (x * radial, y * radial) if scaled else (x, y)
    return (
        x * radial + 2 * k[2] * u * v + k[3] * (square + 2 * u**2),
        y * radial + 2 * k[3] * u * v + k[2] * (square + 2 * v**2),
    )


LENSES: dict[str, Lens] = {
    "brown_conrady": lambda x, y, k: ((x, y), _brown(x, y, k)),
    "modified_brown_conrady": lambda x, y, k: ((x, y), _brown(x, y, k, scaled=True)),
    "inverse_brown_conrady": lambda x, y, k: (_brown(x, y, k), (x, y)),
}
"""The SDK's models by name, as in `rsutil.h`."""


def sdk_distortion(whose: str, model: Any, coefficients: Any, table: Table) -> list[float]:
    """Convert a lens model of RealSense's SDK to OpenCV's k1 k2 p1 p2 k3; empty without distortion.

    OpenCV's model is linear in its coefficients: they are fitted over the image by linear least squares.

    Args:
        whose: begins the message.
        model: as the SDK or its tools print it, or its number.
        coefficients: five.
        table: fx, fy, cx, cy, width and height.

    Raises:
        GavoError: a lens model that is none of ours.
    """
    numbered = SDK_MODELS[model] if isinstance(model, int) and 0 <= model < len(SDK_MODELS) else str(model)
    name = numbered.rsplit(".", 1)[-1].lower().replace(" ", "_").removeprefix("rs2_distortion_")
    k = np.array(coefficients, float)
    if name == "none" or not k.any():
        return []
    if name not in LENSES:
        raise GavoError(f"{whose} lens model is {name[:60]}: not one of none, {', '.join(LENSES)}")
    if k.shape != (5,) or not np.all(np.isfinite([*k, table["fx"], table["fy"]])) or 0 in (table["fx"], table["fy"]):
        raise GavoError(f"{whose} lens model needs a focal length other than 0, and five finite coefficients")
    u, v = np.meshgrid(np.linspace(0, table["width"] - 1, GRID), np.linspace(0, table["height"] - 1, GRID))
    (x, y), seen = LENSES[name]((u - table["cx"]) / table["fx"], (v - table["cy"]) / table["fy"], k)
    columns = [np.stack(_brown(x, y, unit)) - np.stack([x, y]) for unit in np.eye(5)]
    matrix = np.stack([column.ravel() for column in columns], axis=1)
    found, *_ = np.linalg.lstsq(matrix, (np.stack(seen) - np.stack([x, y])).ravel(), rcond=None)
    return found.tolist()


def is_realsense(values: Table) -> bool:
    """Whether a file has the names of RealSense's SDK."""
    return "ppx" in values


def read_realsense(path: Path, values: Table) -> Table:
    """Looks like intrinsics of RealSense's SDK."""
    names = {"fx": "fx", "fy": "fy", "cx": "ppx", "cy": "ppy", "width": "width", "height": "height"}
    table = {ours: values[theirs] for ours, theirs in names.items()}
    distortion = values.get("distortion")  # its model by librealsense's own names, or the coefficients
    model = values.get("model", distortion if isinstance(distortion, str) else values.get("distortion_model", "none"))
    told = rest_of_camera(str(path), {key: value for key, value in values.items() if not isinstance(value, str)})
    coefficients = told.pop("distortion", None) or [0.0] * 5
    if model == "none" and any(coefficients):
        raise GavoError(f"{path}: lens coefficients without a lens model: expected one of {', '.join(LENSES)}")
    lens = sdk_distortion(f"{path}: the", model, coefficients, table)
    told.pop("model", None)
    return {**told, **table, **({"distortion": lens} if lens else {})}


LIKE = 0.01
"""Largest difference between frames' intrinsics, as a share of the focal length; autofocus stays below it."""

FOCUS_KEYS = ("fx", "fl_x", "fy", "fl_y", "cx", "cy")
"""Keys of a camera that its focus changes; a focal length first."""


def common_camera(place: str, cameras: list[Table]) -> Table:
    """Combine the frames' cameras into one, if they differ by no more than autofocus explains.

    Args:
        place: names the file in messages.
        cameras: cameras of the frames, with the same keys.

    Returns:
        The median of the values that focus changes; the others have to be equal.

    Raises:
        GavoError: they differ by more.
    """
    moved = [key for key in FOCUS_KEYS if key in cameras[0]]
    rest = [{key: value for key, value in camera.items() if key not in moved} for camera in cameras]
    fault = f"{place}: the frames have different cameras: write the most common one as a camera file"
    if any(camera != rest[0] for camera in rest) or any(key not in camera for key in moved for camera in cameras):
        raise GavoError(fault)
    try:
        table = np.array([[camera[key] for key in moved] for camera in cameras], float)
    except (TypeError, ValueError, OverflowError):
        if any(camera != cameras[0] for camera in cameras):
            raise GavoError(fault) from None
        return cameras[0]  # whose entries are no numbers, as is said later
    middle = np.median(table, axis=0)
    off = np.abs(table - middle).max(initial=0.0)
    if middle.size and not off <= LIKE * middle[0]:
        raise GavoError(f"{fault} ({moved[int(np.abs(table - middle).max(axis=0).argmax())]} differs by {off:.4g})")
    return {**rest[0], **dict(zip(moved, middle.tolist(), strict=True))}


NERF_KEYS = (
    *("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2"),
    *("camera_model", "is_fisheye", "distortion_params"),
)
"""Keys of a camera in NeRF's transforms, where each frame has its own."""


def is_nerfstudio(values: Table) -> bool:
    """Whether a file has the names of NeRF's transforms."""
    return "fl_x" in values or isinstance(values.get("frames"), list)


NERF_UNITS = ("integer_depth_scale", "depth_unit_scale_factor")
"""Metres per unit of depth in whole numbers, as instant-ngp, NeRFCapture and nerfstudio call them."""


def read_nerfstudio(path: Path, values: Table) -> Table:
    """Looks like NeRF's transforms."""
    if cameras := _nerf_cameras(values):
        values = {**values, **common_camera(str(path), cameras)}
    size = {ours: values[theirs] for ours, theirs in (("width", "w"), ("height", "h")) if theirs in values}
    if "fl_x" not in values and "camera_angle_x" in values:
        raise GavoError(
            f"{path}: an angle of view alone: write fl_x = w / (2 tan(camera_angle_x / 2)), cx, cy, w and h"
        )
    table = {"fx": values["fl_x"], "fy": values.get("fl_y", values["fl_x"]), "cx": values["cx"], "cy": values["cy"]}
    if any(numbers_of(values.get("distortion_params"))):
        raise GavoError(
            f"{path}: distortion_params: their order is not certain: write them as k1, k2, p1 and p2, or k1 to k4 of a "
            "fisheye"
        )
    table |= _nerf_unit(str(path), values)
    is_fisheye = values.get("is_fisheye")  # instant-ngp's word for it
    model = values.get("camera_model", "OPENCV_FISHEYE" if is_fisheye else "OPENCV")
    if is_fisheye and model != "OPENCV_FISHEYE":
        raise GavoError(f"{path}: is_fisheye contradicts camera_model {shown(model)}: remove the wrong one")
    if model == "OPENCV_FISHEYE":
        return {**table, **size, "model": "fisheye", "distortion": [values.get(f"k{i}", 0.0) for i in range(1, 5)]}
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE") or values.get("k4"):
        raise GavoError(
            f"{path}: camera_model {shown(model)} or its k4 is not supported; OPENCV, OPENCV_FISHEYE and PINHOLE are"
        )
    lens = [values.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")]
    return {**table, **size, **({"distortion": lens} if any(lens) else {})}


def _nerf_unit(place: str, values: Table) -> Table:
    """The unit of depth by NeRF's names, else by those of other programs; empty if there is none."""
    rest = {key: value for key, value in values.items() if key not in (*NERF_UNITS, "distortion_params")}
    refuse_unknown(place, rest)
    told = next(({"depth_scale": 1 / values[key]} for key in NERF_UNITS if values.get(key)), {})
    return told or unit_of_depth(place, rest)


def _nerf_cameras(values: Table) -> list[Table]:
    """Cameras of the frames; missing keys come from the top level, as in instant-ngp and NeRFCapture.

    Empty if there are no frames, or if only the top level has a camera.
    """
    frames = values.get("frames")
    told = [frame for frame in frames if isinstance(frame, dict)] if isinstance(frames, list) else []
    above = {key: values[key] for key in NERF_KEYS if key in values}
    if "fl_x" in above and not any(key in frame for frame in told for key in NERF_KEYS):
        return []
    return [{**above, **{key: frame[key] for key in NERF_KEYS if key in frame}} for frame in told]


OPENLORIS_COLOR = "d400_color_optical_frame"
"""The colour camera among the sensors of OpenLORIS-Scene's robots, to which `aligned_depth` is registered."""

MAX_FOCAL_DIFFERENCE = 0.05
"""Largest relative difference of OpenLORIS's fx and fy; more means that the numbers are in another order."""


def is_openloris(values: Table) -> bool:
    """Whether a file has the names of OpenLORIS-Scene's sensors."""
    return OPENLORIS_COLOR in values


def read_openloris(path: Path, values: Table) -> Table:
    """Looks like the sensors of OpenLORIS-Scene."""
    camera = values[OPENLORIS_COLOR]
    if camera.get("model") != "pinhole":
        raise GavoError(f"{path}: {OPENLORIS_COLOR}: model {shown(camera.get('model'))}: only pinhole is supported")
    ((fx, cx, fy, cy),) = camera["intrinsics"]
    if abs(fx - fy) > MAX_FOCAL_DIFFERENCE * fx:
        raise GavoError(f"{path}: {OPENLORIS_COLOR}: {fx:g} {cx:g} {fy:g} {cy:g} does not look like fx cx fy cy")
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy, **rest_of_camera(str(path), camera)}
