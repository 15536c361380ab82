"""The pinhole camera: intrinsics, pyramid levels, projection (5)(6), lens distortion and camera files."""

import re
import tomllib
from dataclasses import MISSING, dataclass, fields, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8, UInt16

from gavo_jax.errors import GavoError, read_text

MAX_SIDE = 8192
"""Largest image width or height accepted, in pixels."""

RIM = 4
"""Depth that comes from within this many pixels of the raw image's border is dropped by undistortion."""

MAX_CAMERA_FILE_BYTES = 65536

LONGEST_LENS = 20
"""Focal length over the image's side: a view of 3 degrees. More is a unit mistaken, or a digit too many."""


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["fx", "fy", "cx", "cy", "depth_scale", "readout"],
    meta_fields=["width", "height", "distortion"],
)
@dataclass(frozen=True)
class Camera:
    """A pinhole camera with its image size; a JAX pytree (sizes and distortion are static).

    Pixel centres have integer coordinates: the image covers [-1/2, width - 1/2] × [-1/2, height - 1/2].

    Attributes:
        fx: focal length along x, pixels.
        fy: focal length along y, pixels.
        cx: principal point, column, pixels.
        cy: principal point, row, pixels.
        width: image width, pixels.
        height: image height, pixels.
        distortion: k1, k2, p1, p2, k3 of the Brown-Conrady model, in OpenCV's order; of the images as recorded.
        depth_scale: raw depth units per metre (metres = raw / depth_scale).
        readout: seconds from the exposure of the first row to that of the last (rolling shutter); 0 = all at once.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    depth_scale: float = 5000.0
    readout: float = 0.0

    @staticmethod
    def preset(name: str) -> "Camera":
        """Return a camera of the TUM RGB-D benchmark by name: fr1, fr2 or fr3 (640×480, depth / 5000).

        Raises:
            GavoError: the name is none of these.
        """
        if name not in PRESETS:
            raise GavoError(f"unknown camera {name!r}: not one of {', '.join(PRESETS)}")
        return PRESETS[name]

    @property
    def is_distorted(self) -> bool:
        """Whether the images as recorded carry lens distortion."""
        return any(self.distortion)

    def level(self, k: int) -> "Camera":
        """Return the camera of pyramid level k, whose image is 2^k times smaller along each side.

        A pixel of level k averages 2^k × 2^k pixels, so centres map as c' = (c + 1/2) / 2^k - 1/2.
        Distortion is kept as it is: it acts on normalised coordinates.
        """
        fx, fy, cx, cy = self.scaled(0.5**k)
        return replace(self, fx=fx, fy=fy, cx=cx, cy=cy, width=self.width >> k, height=self.height >> k)

    def scaled(self, scale: Any) -> tuple[Any, Any, Any, Any]:
        """fx, fy, cx, cy of an image `scale` times as large, or of several; see `level`."""
        return (
            self.fx * scale,
            self.fy * scale,
            (self.cx + 0.5) * scale - 0.5,
            (self.cy + 0.5) * scale - 0.5,
        )

    def project(self, points: Float[Array | np.ndarray, "*batch 3"]) -> Float[Array | np.ndarray, "*batch 2"]:
        """Project points of the camera frame (metres; x right, y down, z forward) to pixels: P. Equation (5).

        No distortion is put on. Works on NumPy and JAX arrays alike. Points at z = 0 give infinities or NaN; masking
        them, and those behind the camera, is the caller's part.
        """
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        return _stack(*to_pixels(self, x, y, 1 / z))

    def back_project(
        self, pixels: Float[Array | np.ndarray, "*batch 2"], depth: Float[Array | np.ndarray, "*batch"]
    ) -> Float[Array | np.ndarray, "*batch 3"]:
        """Lift pixels at a depth (metres along z) to points of the camera frame: P⁻¹, no distortion. Equation (6)."""
        x, y = to_ray(self, pixels[..., 0], pixels[..., 1])
        return _stack(x * depth, y * depth, depth)

    def rectified(self) -> "Camera":
        """Return the camera of undistorted images: the same intrinsics, no distortion."""
        return replace(self, distortion=(0.0,) * 5)

    def undistort(
        self, grey: UInt8[np.ndarray, "height width *channels"], depth: UInt16[np.ndarray, "height width"]
    ) -> tuple[UInt8[np.ndarray, "height width *channels"], UInt16[np.ndarray, "height width"]]:
        """Take the lens distortion out of an image (grey or colour) and its depth; both go to `rectified()`.

        The same objects come back where the camera has no distortion.
        """
        return self.undistort_image(grey), self.undistort_depth(depth)

    def undistort_image(self, image: UInt8[np.ndarray, "height width *channels"]) -> np.ndarray:
        """Undistort grey or colour, bilinear; the border is replicated: a black rim would stay put as the scene moves.

        Raises:
            ValueError: the image is not of the camera's size.
        """
        if not self.is_distorted:
            return image
        self._check_size(image)
        coordinates, fractions, _ = _undistortion_maps(self)
        return cv2.remap(image, coordinates, fractions, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def undistort_depth(self, depth: UInt16[np.ndarray, "height width"]) -> np.ndarray:
        """Undistort raw depth, nearest (never mixed across an edge); 0 where its source lies outside or within `RIM`.

        Raises:
            ValueError: the depth is not of the camera's size.
        """
        if not self.is_distorted:
            return depth
        self._check_size(depth)
        _, _, nearest = _undistortion_maps(self)
        none = np.empty(0, np.float32)
        return cv2.remap(depth, nearest, none, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)

    def _check_size(self, image: np.ndarray) -> None:
        if image.shape[:2] != (self.height, self.width):
            raise ValueError(f"image of {self.height} rows and {self.width} columns expected, got {image.shape[:2]}")


def to_pixels(camera: Any, x: Any, y: Any, per_depth: Any = 1.0) -> tuple[Any, Any]:
    """Columns and rows at which points x, y (metres) at depth 1/`per_depth` are seen, by a `Camera` or whatever has its
    fx, fy, cx and cy.
    """
    return camera.fx * x * per_depth + camera.cx, camera.fy * y * per_depth + camera.cy


def to_ray(camera: Any, u: Any, v: Any) -> tuple[Any, Any]:
    """x/z and y/z of what is seen at columns and rows, the inverse of `to_pixels`."""
    return (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy


READOUT = 0.02
"""Seconds, of freiburg1. The images alone (`benchmarks/shutter.py`) say 0.019 on two clips and less on a third; 0.02
drifted a little less there. Taken over for the two others, which are of like make but were not at hand."""

PRESETS = {
    "fr1": Camera(517.3, 516.5, 318.6, 255.3, 640, 480, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633), readout=READOUT),
    "fr2": Camera(520.9, 521.0, 325.1, 249.7, 640, 480, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172), readout=READOUT),
    "fr3": Camera(535.4, 539.2, 320.1, 247.6, 640, 480, readout=READOUT),
}
"""Cameras of the TUM RGB-D benchmark (Sturm et al. 2012), as its page of file formats gives them."""


def _stack(*arrays: Any) -> Any:
    """Stack along a new last axis; stays in NumPy where every array is NumPy's."""
    if all(isinstance(array, np.ndarray | np.generic) for array in arrays):
        return np.stack(arrays, axis=-1)
    return jnp.stack(arrays, axis=-1)


@lru_cache(maxsize=8)
def _undistortion_maps(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return fixed-point maps for cv2.remap: coordinates and fractions (bilinear), coordinates (nearest)."""
    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    distortion = np.array(camera.distortion)
    size = (camera.width, camera.height)
    u, v = cv2.initUndistortRectifyMap(matrix, distortion, np.eye(3), matrix, size, cv2.CV_32FC1)
    coordinates, fractions = cv2.convertMaps(u, v, cv2.CV_16SC2)
    inside = (u >= RIM) & (u <= camera.width - 1 - RIM) & (v >= RIM) & (v <= camera.height - 1 - RIM)
    outside = np.float32(-1)
    nearest, _ = cv2.convertMaps(
        np.where(inside, u, outside), np.where(inside, v, outside), cv2.CV_16SC2, nninterpolation=True
    )
    return coordinates, fractions, nearest


def load_camera(path_or_name: str | Path) -> Camera:
    """Return a camera from a preset's name (fr1, fr2, fr3) or from a small TOML or YAML file.

    Keys: fx, fy, cx, cy, width, height; optional distortion (4 or 5 numbers: k1 k2 p1 p2 [k3]), depth_scale and readout
    (seconds).
    YAML is read in its flat form only: one `key: number` or `key: [number, …]` a line, `#` comments.

    Raises:
        GavoError: no such preset or file, an unreadable line, or an unknown, missing, non-finite or absurd value.
    """
    if str(path_or_name) in PRESETS:
        return PRESETS[str(path_or_name)]
    path = Path(path_or_name)
    parsers = {".toml": _parse_toml, ".yaml": _parse_flat_yaml, ".yml": _parse_flat_yaml}
    if path.suffix.lower() not in parsers:
        known = ", ".join(PRESETS)
        raise GavoError(f"unknown camera {str(path_or_name)!r}: neither one of {known} nor a .toml or .yaml file")
    values = parsers[path.suffix.lower()](path, read_text(path, MAX_CAMERA_FILE_BYTES))
    return _camera_from_values(path, values)


def camera_for_sequence(name: str) -> Camera:
    """Return the preset that a TUM sequence's name speaks of: `…freiburg1…`, `fr1_xyz`, ….

    Raises:
        GavoError: the name speaks of none; the message asks for a camera.
    """
    match = re.search(r"(?<![a-z])(?:freiburg|fr)([123])(?!\d)", name.lower())
    if match is None:
        raise GavoError(f"no camera known for sequence {name!r}: say which with --camera fr1, fr2, fr3 or a file")
    return PRESETS[f"fr{match.group(1)}"]


def _parse_toml(path: Path, text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise GavoError(f"{path}: not TOML: {' '.join(str(error).split())[:200]}") from None


def _parse_flat_yaml(path: Path, text: str) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        line = line.split("#", 1)[0].strip()
        if line in ("", "---"):
            continue
        key, colon, value = (part.strip() for part in line.partition(":"))
        if not colon or key in values:
            raise GavoError(
                f"{path}:{number}: {'key given twice' if colon else 'not a `key: value` line'}: {line[:60]!r}"
            )
        try:
            if value.startswith("[") and value.endswith("]"):
                values[key] = [_number(item) for item in value[1:-1].split(",") if item.strip()]
            else:
                values[key] = _number(value)
        except ValueError:
            raise GavoError(
                f"{path}:{number}: {key[:60]}: neither a number nor a list of numbers: {value[:60]!r}"
            ) from None
    return values


def _number(text: str) -> int | float:
    try:
        return int(text)
    except ValueError:
        return float(text)


def _camera_from_values(path: Path, values: dict[str, Any]) -> Camera:
    """Check the values of a camera file, key by key, and build the camera."""
    names = [field.name for field in fields(Camera)]
    required = [field.name for field in fields(Camera) if field.default is MISSING]
    for key in values:
        if key not in names:
            raise GavoError(f"{path}: {key[:60]!r}: unknown key (known: {', '.join(names)})")
    for key in required:
        if key not in values:
            raise GavoError(f"{path}: {key}: missing")

    def number(key: str, value: Any, low: float, high: float, kind: type = float) -> Any:
        allowed = (int,) if kind is int else (int, float)
        if isinstance(value, bool) or not isinstance(value, allowed) or not low <= value <= high:
            what = "a whole number" if kind is int else "a number"
            raise GavoError(f"{path}: {key}: must be {what} from {low:g} to {high:g}")
        return kind(value)

    width = number("width", values["width"], 16, MAX_SIDE, int)
    height = number("height", values["height"], 16, MAX_SIDE, int)
    distortion = values.get("distortion", [0.0] * 5)
    if not isinstance(distortion, list) or len(distortion) not in (4, 5):
        raise GavoError(f"{path}: distortion: must be a list of 4 or 5 numbers (k1 k2 p1 p2 [k3])")
    k1, k2, p1, p2, k3 = (number("distortion", value, -100, 100) for value in [*distortion, 0.0][:5])
    return Camera(
        fx=number("fx", values["fx"], 1, LONGEST_LENS * width),
        fy=number("fy", values["fy"], 1, LONGEST_LENS * height),
        cx=number("cx", values["cx"], -width, 2 * width),
        cy=number("cy", values["cy"], -height, 2 * height),
        width=width,
        height=height,
        distortion=(k1, k2, p1, p2, k3),
        depth_scale=number("depth_scale", values.get("depth_scale", 5000.0), 1e-3, 1e6),
        readout=number("readout", values.get("readout", 0.0), 0, 1),
    )
