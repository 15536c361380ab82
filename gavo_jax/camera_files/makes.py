"""Camera files as several makes of software write them: TOML, ROS, Kalibr, OpenCV, Open3D, ORB-SLAM, plain numbers.

A parser returns what a file says as a table of the keys of our own TOML file; `calibration` checks the numbers.
"""

import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from gavo_jax.camera_files.colmap import read_colmap
from gavo_jax.camera_files.exports import (
    Table,
    is_nerfstudio,
    is_openloris,
    is_realsense,
    read_nerfstudio,
    read_openloris,
    read_realsense,
)
from gavo_jax.camera_files.foreign import hint_of_text, refuse_bop_camera, refuse_foreign
from gavo_jax.camera_files.kalibr import is_kalibr, is_one_of_kalibr, read_kalibr, read_one_of_kalibr
from gavo_jax.camera_files.storage import read_storage, real_of, values_of
from gavo_jax.camera_files.words import (
    CAMERA_KEYS,
    DEVICE_KEYS,
    FOCAL,
    LENS_MODEL,
    MATRIX,
    first,
    known,
    numbers_of,
    rest_of_camera,
)
from gavo_jax.errors import GavoError, line_of, number, parse_json, parse_toml, shown

PROJECTION = "projection_matrix"
"""Key of a ROS camera_info: the 3×4 projection matrix of the images rectified by ROS's image_proc."""

NESTED = ("camera", "cam", "camera_params", "cam_params")
"""Tables in which Replica, NICE-SLAM, SplaTAM and others keep a camera."""

SAME_CAMERA = 0.5
"""Largest difference (pixels) between a scan's colour and depth intrinsics if depth is registered."""

WIDEST_HALF, FOCAL_RATIOS = 1.5, (0.67, 1.5)
"""Limits for a row of unnamed numbers: principal point over focal length, and the range of fx / fy.

Beyond them the numbers are in another order."""

FOCAL_TOLERANCE = 0.03
"""Largest usual difference between fx and fy, as a share of fx."""

MOST_SKEW = 0.5
"""Largest skew of a camera matrix, pixels."""


def _parse_yaml(path: Path, text: str) -> Table:
    if text.startswith("%YAML:1.0") or "!!opencv-matrix" in text:
        return _parse_storage(path, text)
    import yaml  # takes its time, and few files are of this kind

    try:
        values = next(yaml.load_all(text, _yaml_loader()), None)  # printed messages end with the start of another
    except (yaml.YAMLError, ValueError, RecursionError, TypeError, AttributeError, OverflowError) as error:
        raise GavoError(f"{path}: not YAML: {line_of(error)}") from None
    return _of_known_make(path, values)


@cache
def _yaml_loader() -> type[Any]:
    """A loader that refuses duplicate keys (YAML keeps the last) and reads 1e-3 as a number (YAML 1.1: text)."""
    import yaml

    class Loader(yaml.SafeLoader):
        def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
            keys = [key.value for key, _ in node.value] if isinstance(node, yaml.MappingNode) else []
            if twice := next((key for key in keys if keys.count(key) > 1), None):
                raise ValueError(f"key given twice: {str(twice)[:60]!r}")
            return super().construct_mapping(node, deep)

    number = re.compile(r"[-+]?\d+[eE][-+]?\d+$")
    Loader.add_implicit_resolver("tag:yaml.org,2002:float", number, list("-+0123456789"))
    return Loader


def _parse_json(path: Path, text: str) -> Table:
    if '"opencv-matrix"' in text:
        return _parse_storage(path, text)
    return _of_known_make(path, parse_json(path, text))


def _of_known_make(path: Path, values: Any) -> Table:
    """Convert a table of any known make, or the rows of a matrix, to our keys; others stay as they are."""
    if isinstance(values, list) and len(values) == 3:
        values = {"camera_matrix": values}
    if not isinstance(values, dict) or not values:
        raise GavoError(f"{path}: not a camera file: no `key: value` in it")
    if not all(isinstance(key, str) for key in values):
        raise GavoError(f"{path}: not a camera file: a key is not text")
    for is_of_make, read in MAKES:
        if is_of_make(values):
            try:
                return read(path, values)
            except GavoError:
                raise
            except KeyError as error:
                raise GavoError(f"{path}: {read.__doc__ or ''} Its entry {error} is missing") from None
            except (TypeError, ValueError, IndexError, AttributeError, OverflowError):
                raise GavoError(f"{path}: {read.__doc__ or ''} Entries are missing, or have the wrong type") from None
    refuse_foreign(path, values)
    return values


def of_matrix(place: str, numbers: list[Any]) -> Table:
    """Intrinsics fx, fy, cx and cy of a 3×3 matrix, row by row or, as Open3D and MATLAB have it, column by column.

    Args:
        place: names the file in messages.
        numbers: nine, or three rows of three.

    Raises:
        GavoError: they are no camera matrix.
        ValueError: they are not nine.
    """
    numbers = numbers_of(numbers)
    fx, skew, cx, below, fy, cy, left, right, one = numbers
    if not any(isinstance(number, str) for number in numbers):
        if not any(numbers):
            raise GavoError(f"{place}: the camera matrix is zero, as the camera was never calibrated: pass --camera")
        if not (cx or cy):
            skew, cx, below, cy, left, right = below, left, skew, right, cx, cy
        if below or left or right or one != 1 or abs(skew) > MOST_SKEW:
            raise GavoError(f"{place}: not a camera matrix (fx 0 cx, 0 fy cy, 0 0 1): {shown(numbers)}")
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy}


def _read_open3d(path: Path, values: Table) -> Table:
    """Looks like Open3D's intrinsics."""
    values = {**values, **values.get("intrinsic", {})}
    size = {"width": values["width"], "height": values["height"]}
    return {**of_matrix(str(path), values["intrinsic_matrix"]), **size, **rest_of_camera(str(path), values)}


def _read_nested(path: Path, values: Table) -> Table:
    """Looks like Replica's cam_params."""
    camera = next(values[name] for name in NESTED if isinstance(values.get(name), dict))
    unit = {"depth_scale": camera["scale"]} if "scale" in camera else {}
    return {**{key: camera[key] for key in FOCAL}, **rest_of_camera(str(path), {**camera, **unit})}


def _read_ros(path: Path, values: Table) -> Table:
    """Looks like a ROS camera_info."""
    region = values.get("roi")
    if isinstance(region, dict) and (region.get("x_offset") or region.get("y_offset")):
        raise GavoError(f"{path}: roi: starts inside the image: write the numbers of the cropped image, and omit roi")
    return {
        **of_matrix(str(path), numbers_of(first(values, MATRIX))),
        **rest_of_camera(str(path), values),
        PROJECTION: numbers_of(first(values, ("projectionmatrix", "p"))),
    }


def _read_vins(path: Path, values: Table) -> Table:
    """Looks like a camera of VINS."""
    return {**{key: values["projection_parameters"][key] for key in FOCAL}, **rest_of_camera(str(path), values)}


def _read_flat(path: Path, values: Table) -> Table:
    """Looks like a camera of single numbers."""
    refuse_bop_camera(path, values)
    kept = {*CAMERA_KEYS, *DEVICE_KEYS} - {"depth_scale"}
    if first(values, LENS_MODEL) is not None:
        kept.remove("distortion")  # belongs to that model
    ours = {key: value for key, value in values.items() if key in kept or not known(key)}
    others = {key: value for key, value in values.items() if key not in ours}
    return {**ours, **rest_of_camera(str(path), others)}


def _is_open3d(values: Table) -> bool:
    return "intrinsic_matrix" in values or isinstance(values.get("intrinsic"), dict)


def _is_nested(values: Table) -> bool:
    return any(isinstance(values.get(name), dict) for name in NESTED)


def _is_ros(values: Table) -> bool:
    return first(values, MATRIX) is not None


def _is_vins(values: Table) -> bool:
    return isinstance(values.get("projection_parameters"), dict)


def _is_flat(values: Table) -> bool:
    return "fx" in values


MAKES: tuple[tuple[Callable[[Table], bool], Callable[[Path, Table], Table]], ...] = (
    (_is_open3d, _read_open3d),
    (_is_nested, _read_nested),
    (_is_ros, _read_ros),
    (is_kalibr, read_kalibr),
    (is_one_of_kalibr, read_one_of_kalibr),
    (_is_vins, _read_vins),
    (is_openloris, read_openloris),
    (is_realsense, read_realsense),
    (is_nerfstudio, read_nerfstudio),
    (_is_flat, _read_flat),
)
"""Test and reader of each make; the first whose test succeeds is used."""


def _parse_storage(path: Path, text: str) -> Table:
    """OpenCV's FileStorage: matrices by the names that OpenCV's own examples use, or ORB-SLAM's keys."""
    return read_storage(path, text, lambda storage: _storage_orb(storage) or _storage_table(path, storage))


def _storage_table(path: Path, storage: Any) -> Table:
    """What a FileStorage holds, read as YAML or JSON of the same names would be."""
    values = values_of(storage)
    if not (_is_ros(values) or _is_vins(values) or is_openloris(values) or _is_flat(values)):
        raise GavoError(f"{path}: camera_matrix: missing, or not 3x3")
    return _of_known_make(path, values)


def _storage_orb(storage: Any) -> Table | None:
    """The keys of an ORB-SLAM settings file (`Camera.fx` or `Camera1.fx`); None for other files."""
    prefix = next((p for p in ("Camera", "Camera1") if not storage.getNode(f"{p}.fx").empty()), None)
    if prefix is None:
        return None

    def real(name: str) -> float | None:
        node = storage.getNode(name)
        return None if node.empty() else real_of(node, name)

    table: Table = {key: real(f"{prefix}.{key}") for key in FOCAL}
    for key in ("width", "height"):
        value = real(f"Camera.{key}")
        table[key] = None if value is None else int(value)
    kind = storage.getNode("Camera.type")
    table["model"] = _orb_model(kind.string() if kind.isString() else "PinHole")
    keys = ("k1", "k2", "k3", "k4") if table["model"] == "fisheye" else ("k1", "k2", "p1", "p2", "k3")
    table["distortion"] = [real(f"{prefix}.{key}") or 0.0 for key in keys]
    table["depth_scale"] = real("DepthMapFactor") or real("RGBD.DepthMapFactor")
    return {key: value for key, value in table.items() if value is not None}


def _orb_model(kind: str) -> str:
    """Our name of ORB-SLAM's camera type; an unknown one is returned unchanged and refused later."""
    return {"PinHole": "pinhole", "Rectified": "pinhole", "KannalaBrandt8": "fisheye"}.get(kind, kind)


def _parse_xml(path: Path, text: str) -> Table:
    if "<opencv_storage" not in text[:1000]:
        raise GavoError(f"{path}: not a camera file of OpenCV (no <opencv_storage>)")
    return _parse_storage(path, text)


def _parse_sens(path: Path, text: str) -> Table:
    """The `info.txt` that BundleFusion, 3RScan and ScanNet's `.sens` come with: `name = values`, matrices of 4×4."""
    values = {name.strip(): value.split() for name, _, value in (line.partition("=") for line in text.splitlines())}
    identity = np.eye(4).ravel()

    def camera(kind: str) -> Table:
        matrix = np.array([float(value) for value in values[f"m_calibration{kind}Intrinsic"]]).reshape(4, 4)
        turned = [float(value) for value in values.get(f"m_calibration{kind}Extrinsic", identity)]
        if not np.allclose(turned, identity, atol=1e-6):
            raise GavoError(f"{path}: m_calibration{kind}Extrinsic: must be the identity; others are not supported")
        size = {side.lower(): int(values[f"m_{kind.lower()}{side}"][0]) for side in ("Width", "Height")}
        return {**of_matrix(str(path), matrix[:3, :3].ravel().tolist()), **size}

    try:
        color, depth = camera("Color"), camera("Depth")
        scale = {"depth_scale": float(values["m_depthShift"][0])} if "m_depthShift" in values else {}
    except GavoError:
        raise
    except (KeyError, ValueError, IndexError) as error:
        raise GavoError(f"{path}: looks like the info.txt of a scan, but is not one: {line_of(error)}") from None
    same = all(abs(color[key] - depth[key]) < SAME_CAMERA for key in color)
    return {**color, **scale} if same else {**color, **scale, "depth": depth}


def _parse_numbers(path: Path, text: str) -> Table:
    """A matrix of 3×3 or 4×4, or one row `fx fy cx cy [distortion]` or `width height fx fy cx cy`; `#` comments.

    Rows end with a line, or with a semicolon as in MATLAB. COLMAP's cameras.txt is read, too.
    """
    if "m_calibrationColorIntrinsic" in text:
        return _parse_sens(path, text)
    if (camera := read_colmap(path, text)) is not None:
        return camera
    whole = (part for line in text.splitlines() for part in line.split("#")[0].split(";"))
    lines = [re.split(r"[\s,]+", line.strip(" \t[],")) for line in whole]
    try:
        rows = [[number(field) for field in line] for line in lines if line != [""]]
        if len(rows) == 1 and len(rows[0]) == 9 and not any(rows[0][at] for at in (1, 3, 6, 7)):
            return of_matrix(str(path), rows[0])
        if len(rows) == 1 and len(rows[0]) == 6:
            return _with_size(path, rows[0])
        if len(rows) == 1 and len(rows[0]) >= 4:
            fx, fy, cx, cy, *distortion = rows[0]
            _check_order(path, fx, fy, cx, cy)
            lens = {"distortion": distortion} if distortion else {}
            return {"fx": fx, "fy": fy, "cx": cx, "cy": cy, **lens}
        matrix = np.array(rows)
        if matrix.shape not in ((3, 3), (4, 4), (3, 4)) or matrix[:3, 3:].any():
            raise ValueError
    except GavoError:
        raise
    except ValueError:
        hint = hint_of_text(text)
        raise GavoError(f"{path}: neither a 3x3 or 4x4 matrix nor a row of fx fy cx cy{hint}") from None
    return of_matrix(str(path), matrix[:3, :3].ravel().tolist())


def _with_size(path: Path, row: list[float]) -> Table:
    """The camera of a row whose images' size stands first or last: the two numbers between which the centre lies."""
    for width, height, fx, fy, cx, cy in (row, row[4:] + row[:4]):
        if width.is_integer() and height.is_integer() and 0 < cx < width and 0 < cy < height:
            _check_order(path, fx, fy, cx, cy)
            return {"width": int(width), "height": int(height), "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    raise ValueError


def _check_order(path: Path, fx: float, fy: float, cx: float, cy: float) -> None:
    is_wide = cx > fx * WIDEST_HALF or cy > abs(fy) * WIDEST_HALF
    is_turned = abs(cx - fx) < FOCAL_TOLERANCE * fx and abs(fy - fx) > 5 * FOCAL_TOLERANCE * fx  # fx cx fy cy
    if is_turned or is_wide or not FOCAL_RATIOS[0] * abs(fy) < fx < FOCAL_RATIOS[1] * abs(fy):
        raise GavoError(f"{path}: {fx:g} {fy:g} {cx:g} {cy:g} does not look like fx fy cx cy")


PARSERS: dict[str, Callable[[Path, str], Table]] = {
    ".toml": parse_toml,
    ".yaml": _parse_yaml,
    ".yml": _parse_yaml,
    ".json": _parse_json,
    ".xml": _parse_xml,
    ".txt": _parse_numbers,
    ".csv": _parse_numbers,
    ".pincam": _parse_numbers,
}
"""Parser of a camera file, by the file's ending."""
