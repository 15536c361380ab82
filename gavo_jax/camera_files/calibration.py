"""Calibration of an RGB-D device, from a preset's name or a file, with checks of its values."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gavo_jax.camera import MAX_SIDE, MIN_SIDE, PRESETS, Camera
from gavo_jax.camera_check import DISTORTION_COUNTS, doubt_about_gain, doubt_about_lens
from gavo_jax.camera_files.foreign import hint_of_ending
from gavo_jax.camera_files.makes import PARSERS, PROJECTION, Table
from gavo_jax.camera_files.words import CAMERA_KEYS, DEVICE_KEYS, MODELS, REQUIRED, model_of
from gavo_jax.errors import GavoError, as_path, read_text, shown
from gavo_jax.se3 import is_rigid, rigid

MAX_CAMERA_FILE_BYTES, MAX_JSON_BYTES = 65536, 2**24
"""Largest camera file, bytes; one of JSON may hold the pose of every frame, too."""

LONGEST_LENS = 20
"""Focal length over the image's side: a view of 3 degrees. More is a unit mistaken, or a digit too many."""

SHORTEST_LENS = 0.1
"""The same, of a view of 157 degrees; less is a focal length in millimetres."""

OFF_CENTRE, LIKE = 0.25, 0.1
"""Where the principal point is off the middle by such a share of it, and by nearly the same share along both sides,
the numbers are of an image of another size."""

FAR_OFF = 0.55
"""Share of half a side by which a principal point may be off the middle, as in a cropped image."""

MOST_K1, MOST_RADIAL = 100.0, 1000.0
"""Largest of OpenCV's coefficients; what is larger was meant as something else."""

MOST_VIGNETTING = 6
"""Largest number of coefficients of vignetting."""

DEPTH_SCALE = 5000.0
"""Default depth scale, units per metre: the TUM benchmark's."""

MOST_DELAY = 0.1
"""Largest plausible delay between colour and depth, seconds; more is of another frame."""

LARGEST_SHIFT = 10.0
"""Metres between the colour and the depth camera of one device; more is a unit mistaken."""

ROTATION_TOLERANCE = 1e-3
"""Tolerance of rotation matrices, which may be printed with few digits."""

RIG_KEYS = ("depth", "colour_T_depth", "color_T_depth")


Size = tuple[int, int]
"""Width and height, pixels."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """The cameras of an RGB-D device.

    Attributes:
        color: the colour camera; its `depth_scale` is that of the depth images.
        depth: the depth camera; None where depth is registered to colour, so that one camera is both.
        color_T_depth: maps points of the depth camera into the colour camera, metres.
        origin: where the numbers come from, for messages.
        states_depth_scale: whether that source states the depth scale; else `color.depth_scale` is an assumption.
        preset: the preset's name, if it is one, so that the sensor is known.
        depth_delay: seconds from depth's stamp (the colour image's, if it has none) to its actual time, up to
            `MOST_DELAY`.
    """

    color: Camera
    depth: Camera | None = None
    color_T_depth: Float[np.ndarray, "4 4"] | None = None
    origin: str = "as given"
    states_depth_scale: bool = True
    preset: str | None = None
    depth_delay: float = 0.0

    def __post_init__(self) -> None:
        """Raise GavoError if the depth camera's pose is missing or not a rigid transform, or the delay is too long."""
        if not abs(self.depth_delay) <= MOST_DELAY:
            raise GavoError(f"depth_delay: must be from -{MOST_DELAY:g} to {MOST_DELAY:g} s, not {self.depth_delay:g}")
        if (self.depth is None) != (self.color_T_depth is None):
            raise GavoError("a calibration needs a depth camera and color_T_depth, or neither if depth is registered")
        place = self.color_T_depth
        if place is not None and not (np.shape(place) == (4, 4) and is_rigid(place, ROTATION_TOLERANCE)):
            raise GavoError("color_T_depth: expected a 4x4 matrix of a rotation and a translation")

    def with_depth_scale(self, scale: float) -> "Calibration":
        """The same calibration with a known depth scale."""
        return replace(self, color=replace(self.color, depth_scale=scale), states_depth_scale=True)

    def with_depth_of_size(self, width: int, height: int) -> "Calibration":
        """The same calibration for depth of another size that is registered to colour, as from phones.

        Unchanged if there is a depth camera, if depth has colour's size, or if the aspect ratios differ.
        """
        color = self.color
        if self.depth is not None or (width, height) == (color.width, color.height):
            return self
        if width * color.height != height * color.width:
            return self
        return replace(self, depth=color.resized(width, height), color_T_depth=np.eye(4))

    def with_color(self, color: Camera) -> "Calibration":
        """The same calibration with another colour camera; depth's is scaled from it if depth is registered."""
        depth, moved = self.depth, self.color_T_depth
        if depth is None or moved is None:
            return replace(self, color=color)
        of_view = self.color.resized(depth.width, depth.height)
        is_of_view = np.allclose(moved, np.eye(4)) and np.allclose(of_view.matrix, depth.matrix)
        return replace(self, color=color, depth=color.resized(depth.width, depth.height) if is_of_view else depth)


def load_camera(path_or_name: str | Path) -> Camera:
    """Return a camera from a preset's name (fr1, fr2, fr3, bonn, icl) or from a file; see `load_calibration`.

    Of a file that does not say the unit of depth, `depth_scale` is the TUM benchmark's 5000 to a metre.

    Raises:
        GavoError: no such preset or file, an unreadable line, or an unknown, missing, non-finite or absurd value.
    """
    return load_calibration(path_or_name).color


def load_calibration(
    path_or_name: str | Path,
    size: Size | Callable[[], Size] | None = None,
    depth_scale: float = DEPTH_SCALE,
    is_rectified: bool = False,
) -> Calibration:
    """Return the calibration of a preset or from a file.

    TOML keys: fx, fy, cx, cy, width, height; optional distortion (a list in OpenCV's order), model ("pinhole" or
    "fisheye"), vignetting (a list, see `Camera`), depth_scale, readout and depth_delay (seconds). Depth that is not
    registered to colour: a table [depth] with the same keys, and `colour_T_depth`, four rows of four numbers. YAML: the
    same keys, ROS `camera_info`, Kalibr.
    OpenCV FileStorage: YAML, XML or JSON, also ORB-SLAM's. JSON: Open3D, `cam_params.json` of Replica, intrinsics of
    RealSense's SDK, or NeRF's `transforms.json`. Text: a matrix of 3×3 or 4×4, or one row `fx fy cx cy [distortion]`.

    Args:
        path_or_name: fr1, fr2, fr3, bonn, icl, or a file.
        size: width and height of the images, or a function that finds them, for files that do not state them.
        depth_scale: raw units per metre, for files that do not state them.
        is_rectified: whether the images come from ROS without distortion, so that the lens of a ROS camera_info is not
            theirs.

    Raises:
        GavoError: no such preset or file, an unreadable line, or an unknown, missing, non-finite or absurd value.
    """
    if (name := str(path_or_name)) in PRESETS:
        return Calibration(PRESETS[name], origin=f"preset {name}", preset=name)
    path = as_path(path_or_name)
    suffix = path.suffix.lower()
    if suffix not in PARSERS:
        *suffixes, last = PARSERS
        endings = f"{', '.join(suffixes)} or {last}"
        if path.is_file():
            raise GavoError(f"{path}: a camera file ends in {endings}{hint_of_ending(path)}")
        raise GavoError(f"unknown camera {name!r}: neither one of {', '.join(PRESETS)} nor a file ({endings})")
    most = MAX_JSON_BYTES if suffix == ".json" else MAX_CAMERA_FILE_BYTES
    table, origin = PARSERS[suffix](path, read_text(path, most)), str(path)
    projection = table.pop(PROJECTION, None)
    if is_rectified and projection is not None:
        table, origin = _rectified(path, table, projection), f"{path}, without its lens: the images are rectified"
    if size is not None and not {"width", "height"} <= table.keys():
        width, height = size() if callable(size) else size
        table = {"width": width, "height": height, **table}
    for key in table:
        if key not in CAMERA_KEYS + DEVICE_KEYS + RIG_KEYS:
            known = CAMERA_KEYS + DEVICE_KEYS + RIG_KEYS[:2]
            raise GavoError(f"{path}: {key[:60]!r}: unknown key (known: {', '.join(known)})")
    depth, color_T_depth = _depth_camera(path, table)
    own = {key: value for key, value in table.items() if key not in DEVICE_KEYS + RIG_KEYS}
    delay = _number(f"{path}: depth_delay", table.get("depth_delay", 0.0), -MOST_DELAY, MOST_DELAY)
    if isinstance(table.get("depth"), dict) and "depth_scale" in table["depth"]:
        own["depth_scale"] = table["depth"]["depth_scale"]
    color = camera_from_table(path, own, depth_scale)
    return Calibration(color, depth, color_T_depth, origin, "depth_scale" in own, depth_delay=delay)


def _rectified(path: Path, table: Table, projection: Any) -> Table:
    """The camera of images without distortion: that of the projection matrix, where it is not left out or zero."""
    table = {key: value for key, value in table.items() if key not in ("distortion", "model")}
    if projection in ([], [0] * 12):
        return table
    if not isinstance(projection, list) or len(projection) != 12:
        raise GavoError(f"{path}: {PROJECTION}: must be twelve numbers (three rows of four)")
    return {**table, "fx": projection[0], "cx": projection[2], "fy": projection[5], "cy": projection[6]}


def camera_from_table(path: Path | str, values: Table, depth_scale: float, part: str = "") -> Camera:
    """Check a camera's values, key by key, and build it.

    Args:
        path: names the file in messages.
        values: by the keys of a camera file.
        depth_scale: where the values do not say it.
        part: stands before a key's name in messages.

    Raises:
        GavoError: a value is missing, or is not what it may be.
    """
    for key in REQUIRED:
        if key not in values:
            raise GavoError(f"{path}: {part}{key}: missing")

    def number(key: str, low: float, high: float, default: float | None = None) -> float:
        return _number(f"{path}: {part}{key}", values.get(key, default), low, high)

    def whole(key: str) -> int:
        value = values[key]
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if isinstance(value, bool) or not isinstance(value, int) or not MIN_SIDE <= value <= MAX_SIDE:
            fault = f"must be a whole number from {MIN_SIDE} to {MAX_SIDE}, not {shown(value)}"
            raise GavoError(f"{path}: {part}{key}: {fault}")
        return value

    width, height = whole("width"), whole("height")
    distortion, model = _distortion(path, part, values)
    if isinstance(values["fy"], int | float) and values["fy"] < 0:
        why = "as in ICL-NUIM, where y points up: remove the sign, since image rows run from the top"
        raise GavoError(f"{path}: {part}fy: negative ({shown(values['fy'])}), {why}")
    cx, cy = number("cx", -width, 2 * width), number("cy", -height, 2 * height)
    _check_middle(f"{path}: {part}cx, {part}cy", (cx, cy), (width, height))
    camera = Camera(
        fx=number("fx", SHORTEST_LENS * width, LONGEST_LENS * width),
        fy=number("fy", SHORTEST_LENS * height, LONGEST_LENS * height),
        cx=cx,
        cy=cy,
        width=width,
        height=height,
        distortion=distortion,
        depth_scale=number("depth_scale", 1e-3, 1e6, depth_scale),
        readout=number("readout", 0, 1, 0.0),
        model=model,
        vignetting=_vignetting(f"{path}: {part}vignetting", values.get("vignetting", [])),
    )
    if any(camera.vignetting) and (doubt := doubt_about_gain(camera)):
        raise GavoError(f"{path}: {part}vignetting: {doubt}")
    if doubt := doubt_about_lens(camera):
        raise GavoError(f"{path}: {part}distortion: {doubt}")
    return camera


def _check_middle(place: str, point: tuple[float, float], size: Size) -> None:
    """Refuse a principal point that is the middle of an image of another size, or of one on its side, or far off."""
    x, y = (2 * at / side for at, side in zip(point, size, strict=True))
    across, down = (2 * at / side for at, side in zip(point, reversed(size), strict=True))
    is_off = abs(x - 1) > OFF_CENTRE / 2 and abs(y - 1) > OFF_CENTRE / 2
    is_turned = is_off and abs(across - 1) < LIKE and abs(down - 1) < LIKE
    if is_turned or abs(x - y) < LIKE and abs(x - 1) > OFF_CENTRE and abs(y - 1) > OFF_CENTRE:
        other = f"{2 * point[0]:.0f}x{2 * point[1]:.0f}"
        raise GavoError(
            f"{place}: {point[0]:g} {point[1]:g} is the middle of an image of about {other}, not of "
            f"{size[0]}x{size[1]}: {'rotate' if is_turned else 'scale'} fx, fy, cx and cy to match the images"
        )
    if max(abs(x - 1), abs(y - 1)) > FAR_OFF:
        raise GavoError(
            f"{place}: {point[0]:g} {point[1]:g} is far from the middle of an image of {size[0]}x{size[1]}: "
            "exchanged with fx and fy, or of an image of another size?"
        )


def _distortion(path: Path | str, part: str, values: Table) -> tuple[tuple[float, ...], Any]:
    given = values.get("model", "pinhole")
    model = model_of(given)
    if model is None:
        raise GavoError(f"{path}: {part}model: {shown(given)} is not one of {', '.join(MODELS)}")
    numbers = values.get("distortion", [])
    lengths = (0, *DISTORTION_COUNTS[model])
    if not isinstance(numbers, list) or len(numbers) not in lengths or ("distortion" in values and numbers == []):
        wanted = (
            "4 numbers (k1 k2 k3 k4)"
            if model == "fisheye"
            else "4, 5, 8, 12 or 14 numbers (k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]])"
        )
        raise GavoError(f"{path}: {part}distortion: must be a list of {wanted}, not {_count(numbers)}")
    most = (MOST_K1, *[MOST_RADIAL] * 13)
    checked = tuple(
        _number(f"{path}: {part}distortion", value, -limit, limit) for value, limit in zip(numbers, most, strict=False)
    )
    return checked + (0.0,) * max(0, (4 if model == "fisheye" else 5) - len(checked)), model


def _vignetting(place: str, numbers: Any) -> tuple[float, ...]:
    if not isinstance(numbers, list) or len(numbers) > MOST_VIGNETTING:
        raise GavoError(f"{place}: must be a list of up to {MOST_VIGNETTING} numbers (k1 k2 …), not {_count(numbers)}")
    return tuple(_number(place, value, -MOST_RADIAL, MOST_RADIAL) for value in numbers)


def _count(numbers: Any) -> str:
    return str(len(numbers)) if isinstance(numbers, list) else shown(numbers)


def _number(place: str, value: Any, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise GavoError(f"{place}: must be a number from {low:g} to {high:g}, not {shown(value)}")
    return float(value)


def _depth_camera(path: Path, table: Table) -> tuple[Camera | None, np.ndarray | None]:
    """The depth camera and `color_T_depth` of a table; None where depth is registered."""
    depth = table.get("depth")
    pose = table.get("colour_T_depth", table.get("color_T_depth"))
    if depth is None and pose is None:
        return None, None
    if not isinstance(depth, dict):
        raise GavoError(
            f"{path}: depth: expected a table [depth] with fx, fy, cx, cy, width and height, beside colour_T_depth"
        )
    depth = dict(depth)
    inner = [depth.pop(key) for key in RIG_KEYS[1:] if key in depth]
    pose = inner[0] if pose is None and inner else pose
    for key in depth:
        if key not in CAMERA_KEYS:
            raise GavoError(f"{path}: depth.{key[:60]}: unknown key (known: {', '.join(CAMERA_KEYS)})")
    return camera_from_table(path, depth, DEPTH_SCALE, "depth."), _rigid(f"{path}: colour_T_depth", pose)


def _rigid(place: str, rows: Any) -> np.ndarray:
    """Check that rows are those of a rigid transform in metres; none stand for the identity."""
    if rows is None:
        return np.eye(4)
    try:
        matrix = np.array(rows, float)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise ValueError
    except (ValueError, TypeError, OverflowError):
        raise GavoError(f"{place}: must be four rows of four numbers") from None
    if not is_rigid(matrix, ROTATION_TOLERANCE):
        raise GavoError(f"{place}: not a rigid transform (a rotation and a translation, last row 0 0 0 1)")
    if np.abs(matrix[:3, 3]).max() > LARGEST_SHIFT:
        raise GavoError(f"{place}: a translation of more than {LARGEST_SHIFT:g} m; is it in metres?")
    return rigid(matrix)
