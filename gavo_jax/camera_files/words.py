"""Names that programs give to a camera's size, distortion and depth unit.

Names are compared without case and punctuation. Unknown names that look like distortion or a depth unit are refused,
since silently ignoring distortion causes drift.
"""

import re
from typing import Any

import numpy as np

from gavo_jax.camera_check import DISTORTION_COUNTS
from gavo_jax.errors import GavoError, shown

Table = dict[str, Any]

FOCAL = ("fx", "fy", "cx", "cy")
REQUIRED = (*FOCAL, "width", "height")
CAMERA_KEYS = (*REQUIRED, "distortion", "model", "vignetting", "depth_scale", "readout")
"""Keys of a camera in our own files; `REQUIRED` ones are in every file."""
DEVICE_KEYS = ("depth_delay",)
"""Keys of our own files that belong to a device, not to one of its cameras."""

MATRIX = ("cameramatrix", "k", "m1")
"""Names of a camera matrix: fx, fy, cx and cy."""

LENS = (
    *("distortion", "distortioncoefficients", "distortioncoeffs", "distortioncoeff", "distortionparameters"),
    *("distcoeffs", "distcoeff", "distcoefs", "distcoefficients", "dist", "coeffs", "d", "d1"),
)
"""Names of a list of distortion coefficients, or of a table of them by name."""

LENS_MODEL = ("distortionmodel", "distortiontype", "modeltype")
"""Names of an entry that always holds a lens model."""
ANY_MODEL = ("model", "cameramodel")
"""Names of an entry that holds a lens model or the make of the device."""

IS_FISHEYE = ("fisheye", "fisheyemodel", "isfisheye")
"""Names of a flag that says whether the lens is a fisheye."""

UNIT = ("depthscale", "depthfactor", "pngdepthscale", "depthmapfactor")
"""Names of raw depth units per metre, or of metres per unit."""

METRES_PER_UNIT = ("depthunits", "depthunit")
"""Names of metres per raw depth unit, or of the unit's name."""

UNITS_BY_NAME = {
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 1000.0),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
}
"""Raw depth units per metre, by the unit's name."""

WIDTH, HEIGHT, SIZE = ("width", "imagewidth", "w"), ("height", "imageheight", "h"), ("imagesize", "resolution")
"""Names of the image's width, of its height and of both, pixels."""

COPIED_KEYS = ("readout", "depth_delay")
"""Keys that are read unchanged, as in our own files."""

LEAST_UNITS = 0.05
"""Fewest raw depth units per metre; a smaller number is taken for metres per unit."""

ORDER = {"pinhole": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), "fisheye": ("k1", "k2", "k3", "k4")}
"""Order of OpenCV's distortion coefficients, by model."""

LOOKS_LIKE_A_LENS = re.compile(r"distort|^dist(?!ance)|^[kd]c$|coef|fisheye|^depth.*(scale|factor|unit)")

MODELS = {
    "pinhole": "pinhole",
    "none": "pinhole",
    "plumb_bob": "pinhole",
    "radtan": "pinhole",
    "radial_tangential": "pinhole",
    "brown": "pinhole",
    "opencv": "pinhole",
    "rational": "pinhole",
    "rational_polynomial": "pinhole",
    "fisheye": "fisheye",
    "equidistant": "fisheye",
    "kannalabrandt8": "fisheye",
    "opencv_fisheye": "fisheye",
}
"""Names of distortion models, as ROS, Kalibr and others call them; see `model_of`."""


def model_of(name: Any) -> str | None:
    """Our name of a distortion model: "pinhole" or "fisheye"; None if unknown."""
    return MODELS.get(name.lower().replace("-", "_")) if isinstance(name, str) else None


def plain(name: str) -> str:
    """A name without case and punctuation."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def first(values: Table, names: tuple[str, ...]) -> Any:
    """The value of the first of `names` that has one; None if none has."""
    found = {plain(key): value for key, value in reversed(values.items())}
    return next((found[name] for name in names if found.get(name) is not None), None)


def numbers_of(entry: Any) -> list[Any]:
    """Flatten a number, a list of numbers or rows, or the `data` of a matrix."""
    if isinstance(entry, dict):
        entry = entry["data"]
    flat: list[Any] = []
    for value in entry if isinstance(entry, list) else [] if entry is None else [entry]:
        flat += value if isinstance(value, list) else [value]
    return flat


def rest_of_camera(place: str, values: Table) -> Table:
    """Read size, lens, depth unit and `COPIED_KEYS` keys, everything but the camera matrix, into our keys.

    Args:
        place: names the file in messages.
        values: the entries of the file.

    Raises:
        GavoError: an unknown name looks like distortion or a depth unit.
    """
    refuse_unknown(place, values)
    copied = {key: values[key] for key in COPIED_KEYS if key in values}
    return {**_size(values), **_lens(values), **unit_of_depth(place, values), **copied}


def known(key: str) -> bool:
    """Whether `rest_of_camera` reads a name."""
    lens, units = (*LENS, *LENS_MODEL, *ANY_MODEL, *IS_FISHEYE, *ORDER["pinhole"]), (*UNIT, *METRES_PER_UNIT)
    return plain(key) in (*lens, *units, *WIDTH, *HEIGHT, *SIZE) or key in COPIED_KEYS


def camera_info_distortion(model: str, coefficients: list[Any]) -> Table:
    """Convert a lens model and coefficients to our keys; without coefficients only a fisheye model is kept."""
    if len(coefficients):
        return {"distortion": coefficients, "model": model or "plumb_bob"}
    return {"model": model} if model_of(model) == "fisheye" else {}


def _lens(values: Table) -> Table:
    model, given = _lens_model(values), first(values, LENS)
    given = values if given is None else given  # k1, k2, … may stand beside the rest
    by_name = isinstance(given, dict) and "data" not in given
    return camera_info_distortion(model, _by_name(given, model) if by_name else numbers_of(given))


def _lens_model(values: Table) -> Any:
    """The name of the lens model; empty if the file has none."""
    named = first(values, LENS_MODEL)
    if named is not None:
        return named
    return "fisheye" if first(values, IS_FISHEYE) or model_of(first(values, ANY_MODEL)) == "fisheye" else ""


def _by_name(values: Table, model: Any) -> list[Any]:
    """Coefficients k1, k2, … in OpenCV's order and number; missing ones are zero."""
    kind = model_of(model) or "pinhole"
    found = {plain(key): value for key, value in values.items() if value is not None}
    last = max((at for at, name in enumerate(ORDER[kind]) if name in found), default=-1)
    count = next(count for count in (0, *DISTORTION_COUNTS[kind]) if count > last)
    return [found.get(name, 0.0) for name in ORDER[kind][:count]]


def _size(values: Table) -> Table:
    both = numbers_of(first(values, SIZE))
    sides = (first(values, WIDTH), first(values, HEIGHT))
    width, height = both if None in sides and len(both) == 2 else sides
    return {key: value for key, value in (("width", width), ("height", height)) if value is not None}


def unit_of_depth(place: str, values: Table) -> Table:
    """Read the unit of depth into our key; empty if there is none.

    Raises:
        GavoError: it may be either of metres per unit and units per metre, or is an unknown name.
    """
    unit = first(values, UNIT)
    if unit is None and (told := first(values, METRES_PER_UNIT)) is not None:
        is_metres = isinstance(told, int | float) and 0 < told < LEAST_UNITS
        unit = told if is_metres else UNITS_BY_NAME.get(str(told).strip().lower())
        if unit is None:
            fault = f"expected metres per unit, below {LEAST_UNITS:g}, or mm or m, found {shown(told)}"
            raise GavoError(f"{place}: the unit of depth: {fault}: write depth_scale, in units per metre")
    if isinstance(unit, int | float) and 0 < unit < LEAST_UNITS:
        unit = 1 / unit
    return {} if unit is None else {"depth_scale": unit}


def refuse_unknown(place: str, values: Table) -> None:
    """Refuse unknown names that look like distortion or a depth unit.

    Raises:
        GavoError: there is one with a value other than 0.
    """
    for key, value in values.items():
        if known(key) or not LOOKS_LIKE_A_LENS.search(plain(key)) or isinstance(value, bool | str):
            continue
        try:
            is_told = value is not None and bool(np.any(np.array(numbers_of(value), float)))
        except (TypeError, ValueError, KeyError):
            is_told = True
        if is_told:
            raise GavoError(
                f"{place}: {key[:60]!r}: unknown, but looks like lens distortion or a unit of depth: "
                "rename it to distortion_coefficients or depth_scale"
            )
