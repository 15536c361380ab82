"""The pinhole camera: intrinsics, pyramid levels, projection (5)(6), lens distortion, vignetting; named presets."""

import re
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Literal

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8, UInt16

from gavo_jax.errors import GavoError
from gavo_jax.number_types import as_array

MIN_SIDE, MAX_SIDE = 16, 8192
"""Smallest and largest image width or height accepted, in pixels: the coarsest of five levels is 16 times smaller."""

RIM = 4
"""Undistortion drops depth readings within this many pixels of the raw image's border."""

OFF_AXIS = 10.0, 10001
"""Largest x / z at which a lens is examined (84° off axis), and the number of samples up to there."""


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["fx", "fy", "cx", "cy", "depth_scale", "readout"],
    meta_fields=["width", "height", "distortion", "model", "vignetting"],
)
@dataclass(frozen=True)
class Camera:
    """A pinhole camera with its image size; a JAX pytree (sizes, distortion and vignetting are static).

    Pixel centres have integer coordinates: the image covers [-1/2, width - 1/2] × [-1/2, height - 1/2].

    Attributes:
        fx: focal length along x, pixels.
        fy: focal length along y, pixels.
        cx: principal point, column, pixels.
        cy: principal point, row, pixels.
        width: image width, pixels.
        height: image height, pixels.
        distortion: coefficients for the images as recorded, in OpenCV's order: k1, k2, p1, p2, k3 and, for the rational
            model, k4, k5, k6; for a fisheye k1, k2, k3, k4.
        depth_scale: raw depth units per metre (metres = raw / depth_scale).
        readout: seconds from the exposure of the first row to that of the last (rolling shutter); 0 = all at once.
        model: distortion model: "pinhole" (Brown-Conrady, also rational) or "fisheye" (equidistant).
        vignetting: how the images as recorded darken away from the optical axis, as k1, k2, … of the factor that undoes
            it: 1 + k1 r² + k2 r⁴ + …, where r is the tangent of the angle to the axis. An ideal lens darkens by the
            cosine's fourth power, which is (2, 1). Empty = not at all.

    Raises:
        GavoError: a side is not a whole number of pixels, or a length or scale is negative. Traced values and other
            pytree leaves that are not numbers go unchecked.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    depth_scale: float = 5000.0
    readout: float = 0.0
    model: Literal["pinhole", "fisheye"] = "pinhole"
    vignetting: tuple[float, ...] = ()

    def __post_init__(self):
        for name in ("width", "height"):
            if not isinstance(size := getattr(self, name), int | np.integer) or size < 0:
                raise GavoError(f"camera: {name}: expected a whole number of pixels, got {size!r}")
        for name in ("fx", "fy", "depth_scale", "readout"):
            value = getattr(self, name)
            if isinstance(value, int | float | np.integer | np.floating) and value < 0:
                what = "seconds of at least 0" if name == "readout" else "a positive number"
                raise GavoError(f"camera: {name}: expected {what}, got {value!r}")

    @staticmethod
    def preset(name: str) -> "Camera":
        """Return the camera of a benchmark by name: fr1, fr2, fr3 (TUM RGB-D), bonn or icl (640×480, depth / 5000).

        Raises:
            GavoError: unknown name.
        """
        if not isinstance(name, str) or name not in PRESETS:
            raise GavoError(f"unknown camera {name!r}: not one of {', '.join(PRESETS)}")
        return PRESETS[name]

    @property
    def is_distorted(self) -> bool:
        """Whether recorded images have lens distortion; a fisheye's do even if all coefficients are 0."""
        return self.model == "fisheye" or any(self.distortion)

    @property
    def is_rectified(self) -> bool:
        """Whether its images need no rectification: they have neither distortion nor vignetting."""
        return not self.is_distorted and not any(self.vignetting)

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The intrinsic matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def level(self, k: int) -> "Camera":
        """Return the camera of pyramid level k, whose image is 2^k times smaller along each side; see `binned`."""
        return self.binned(2**k)

    def binned(self, pixels: int) -> "Camera":
        """Return the camera of an image whose pixels average n × n each; leftover columns and rows are cut off.

        Centres map as c' = (c + 1/2) / n - 1/2. Distortion is unchanged: it acts on normalised coordinates.

        Raises:
            GavoError: `pixels` is no whole number of at least 1, or larger than the image.
        """
        _require_counts(pixels=pixels)
        if pixels > min(self.width, self.height):
            raise GavoError(f"pixels: an image of {self.width}x{self.height} cannot be {pixels} times smaller")
        fx, fy, cx, cy = self.scaled(1 / pixels)
        size = {"width": self.width // pixels, "height": self.height // pixels}
        return replace(self, fx=fx, fy=fy, cx=cx, cy=cy, **size)

    def resized(self, width: int, height: int) -> "Camera":
        """Return the camera of the same view at another size, two whole numbers of at least 1; raises as `binned`."""
        _require_counts(width=width, height=height)
        (fx, _, cx, _), (_, fy, _, cy) = self.scaled(width / self.width), self.scaled(height / self.height)
        return replace(self, fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)

    def scaled(self, scale: Any) -> tuple[Any, Any, Any, Any]:
        """Return fx, fy, cx, cy of an image `scale` times as large; `scale` may be an array. See `binned`."""
        return (
            self.fx * scale,
            self.fy * scale,
            (self.cx + 0.5) * scale - 0.5,
            (self.cy + 0.5) * scale - 0.5,
        )

    def project(self, points: Float[Array | np.ndarray, "*batch 3"]) -> Float[Array | np.ndarray, "*batch 2"]:
        """Project points of the camera frame (metres; x right, y down, z forward) to pixels: P. Equation (5).

        No distortion is applied. Works on NumPy and JAX arrays alike. Points at z = 0 give infinities or NaN; the
        caller must mask them, and those behind the camera.
        """
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        return _stack(*to_pixels(self, x, y, 1 / z))

    def back_project(
        self, pixels: Float[Array | np.ndarray, "*batch 2"], depth: Float[Array | np.ndarray, "*batch"]
    ) -> Float[Array | np.ndarray, "*batch 3"]:
        """Lift pixels at a depth (metres along z) to points of the camera frame: P⁻¹, no distortion. Equation (6)."""
        x, y = to_ray(self, pixels[..., 0], pixels[..., 1])
        return _stack(x * depth, y * depth, depth)

    @property
    def reach(self) -> float:
        """Largest distance off the axis, as x / z, up to which the lens model is one-to-one; may be infinite.

        Beyond it the distortion polynomial folds back: rays from there land on pixels of other rays.
        """
        return _reach(self.distortion, self.model)

    def rectified(self) -> "Camera":
        """Return the camera of rectified images: the same intrinsics, no distortion, no vignetting."""
        return replace(self, distortion=(0.0,) * 5, model="pinhole", vignetting=())

    def undistort(
        self, grey: UInt8[np.ndarray, "height width *channels"], depth: UInt16[np.ndarray, "height width"]
    ) -> tuple[UInt8[np.ndarray, "height width *channels"], UInt16[np.ndarray, "height width"]]:
        """Rectify an image (grey or colour) and its depth; their camera is then `rectified()`.

        Returns the same objects if there is nothing to remove.
        """
        return self.undistort_image(grey), self.undistort_depth(depth)

    def undistort_image(self, image: UInt8[np.ndarray, "height width *channels"]) -> np.ndarray:
        """Undistort a grey or colour image, bilinearly, with a replicated border, and remove its vignetting.

        A black rim would stand still while the scene moves. Levels that end above 255 become 255, which counts as
        saturated.

        Raises:
            ValueError: the image is not of the camera's size.
        """
        if self.is_rectified:
            return image
        self._check_size(image)
        image = as_array(image)
        if self.is_distorted:
            coordinates, fractions, _ = undistortion_maps(self.on_host())
            image = cv2.remap(image, coordinates, fractions, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        if any(self.vignetting):
            gain = vignetting_gain(self.on_host())
            gain = gain if image.ndim == 2 else cv2.merge([gain] * image.shape[2])
            kind = cv2.CV_8U if image.dtype == np.uint8 else cv2.CV_32F
            image = np.minimum(cv2.multiply(image, gain, dtype=kind), 255)
        return image

    def undistort_depth(self, depth: UInt16[np.ndarray, "height width"]) -> np.ndarray:
        """Undistort raw depth by nearest neighbour (never mixed across an edge).

        It is 0 where the source pixel lies outside the image, within `RIM` of its border or beyond the lens's `reach`.

        Raises:
            ValueError: the depth is not of the camera's size.
        """
        if not self.is_distorted:
            return depth
        self._check_size(depth)
        depth = as_array(depth)
        _, _, nearest = undistortion_maps(self.on_host())
        none = np.empty(0, np.float32)
        return cv2.remap(depth, nearest, none, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)

    def on_host(self) -> "Camera":
        """Return the same camera with Python floats, which are hashable."""
        values = {name: float(getattr(self, name)) for name in ("fx", "fy", "cx", "cy", "depth_scale", "readout")}
        return replace(self, **values)

    def _check_size(self, image: np.ndarray) -> None:
        if image.shape[:2] != (self.height, self.width):
            raise ValueError(f"expected an image of {self.height} rows and {self.width} columns, got {image.shape[:2]}")


def to_pixels(camera: Any, x: Any, y: Any, per_depth: Any = 1.0) -> tuple[Any, Any]:
    """Project points x, y (metres) at depth 1/`per_depth` to columns and rows.

    The camera is a `Camera` or anything else with fx, fy, cx and cy.
    """
    return camera.fx * x * per_depth + camera.cx, camera.fy * y * per_depth + camera.cy


def in_image(camera: Any, u: Any, v: Any) -> Any:
    """Whether pixel coordinates lie in the image, between the centres of its first and last pixels."""
    return (u >= 0) & (u <= camera.width - 1) & (v >= 0) & (v <= camera.height - 1)


def to_ray(camera: Any, u: Any, v: Any) -> tuple[Any, Any]:
    """Return x/z and y/z of the rays through columns and rows; the inverse of `to_pixels`."""
    return (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy


def inverse_depth(depth: Any, camera: Any) -> np.ndarray:
    """Return 1/depth of raw readings, 1/m, in double precision on the host; 0 where there is no reading."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = float(camera.depth_scale) / np.asarray(depth, np.float64)
    return np.where(np.isfinite(inverse) & (inverse > 0), inverse, 0.0)


READOUT = 0.02
"""Readout of freiburg1's sensor, seconds. From the images alone (`benchmarks/shutter.py`) it is 0.019 on two clips and
less on a third; 0.02 drifted slightly less. The other, similar sensors are assumed to share it."""

PRESETS = {
    "fr1": Camera(517.3, 516.5, 318.6, 255.3, 640, 480, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633), readout=READOUT),
    "fr2": Camera(520.9, 521.0, 325.1, 249.7, 640, 480, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172), readout=READOUT),
    "fr3": Camera(535.4, 539.2, 320.1, 247.6, 640, 480, readout=READOUT),
    "bonn": Camera(
        *(542.822841, 542.576870, 315.593520, 237.756098, 640, 480),
        distortion=(0.039903, -0.099343, -0.000730, -0.000144, 0.0),
        readout=READOUT,
    ),
    "icl": Camera(481.2, 480.0, 319.5, 239.5, 640, 480),
}
"""Cameras of the TUM RGB-D benchmark (Sturm et al. 2012; from its page on file formats), of the Bonn RGB-D Dynamic
dataset (Palazzolo et al. 2019) and of the rendered ICL-NUIM (Handa et al. 2014)."""


def _require_counts(**counts: Any) -> None:
    for name, value in counts.items():
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
            raise GavoError(f"{name}: expected a whole number of at least 1, got {value!r}")


def _stack(*arrays: Any) -> Any:
    """Stack along a new last axis; the result is NumPy's if every array is."""
    if all(isinstance(array, np.ndarray | np.generic) for array in arrays):
        return np.stack(arrays, axis=-1)
    return jnp.stack(arrays, axis=-1)


@lru_cache(maxsize=8)
def _reach(distortion: tuple[float, ...], model: str) -> float:
    """Compute `Camera.reach`: where the radius in the image stops growing, by the radial terms alone."""
    if not distortion:
        return float("inf")
    off = np.linspace(0, *OFF_AXIS)
    if model == "fisheye":
        angle = np.arctan(off)
        seen = angle * np.polyval([*distortion[3::-1], 1.0], angle**2)
    else:
        k1, k2, _, _, k3, k4, k5, k6 = (*distortion, 0.0, 0.0, 0.0, 0.0)[:8]
        with np.errstate(divide="ignore", invalid="ignore"):
            seen = off * np.polyval([k3, k2, k1, 1.0], off**2) / np.polyval([k6, k5, k4, 1.0], off**2)
    back = np.flatnonzero(~(np.diff(seen) > 0))
    return float(off[back[0]]) if len(back) else float("inf")


@lru_cache(maxsize=8)
def undistortion_maps(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return fixed-point maps for cv2.remap: coordinates and fractions (bilinear), coordinates (nearest)."""
    matrix, distortion, size = camera.matrix, np.array(camera.distortion), (camera.width, camera.height)
    make = cv2.fisheye.initUndistortRectifyMap if camera.model == "fisheye" else cv2.initUndistortRectifyMap
    u, v = make(matrix, distortion, np.eye(3), matrix, size, cv2.CV_32FC1)
    coordinates, fractions = cv2.convertMaps(u, v, cv2.CV_16SC2)
    inside = (u >= RIM) & (u <= camera.width - 1 - RIM) & (v >= RIM) & (v <= camera.height - 1 - RIM)
    x, y = to_ray(camera, *np.meshgrid(np.arange(camera.width), np.arange(camera.height)))
    inside &= np.hypot(x, y) <= camera.reach
    outside = np.float32(-1)
    nearest, _ = cv2.convertMaps(
        np.where(inside, u, outside), np.where(inside, v, outside), cv2.CV_16SC2, nninterpolation=True
    )
    return coordinates, fractions, nearest


@lru_cache(maxsize=8)
def vignetting_gain(camera: Camera) -> Float[np.ndarray, "height width"]:
    """Return the factor by which each pixel of an undistorted image is brightened."""
    x, y = to_ray(camera, np.arange(camera.width), np.arange(camera.height)[:, None])
    return np.polyval([*camera.vignetting[::-1], 1.0], x**2 + y**2).astype(np.float32)


NAMES_OF_SEQUENCES = {
    r"(?<![a-z])(?:freiburg|fr)([123])(?!\d)": r"fr\1",
    r"(?<![a-z])rgbd_bonn_": "bonn",
    r"(?<![a-z])(?:icl(?![a-z])|living_?room_?traj|office_?room_?traj|traj[0-3]_frei)": "icl",
}
"""Camera preset by a pattern in a sequence's name."""


def preset_for_sequence(name: str) -> str:
    """Return the name of the camera preset for a sequence's name: `…freiburg1…`, `fr1_xyz`, `rgbd_bonn_…`, ….

    Raises:
        GavoError: no preset matches; the message asks for a camera.
    """
    for pattern, preset in NAMES_OF_SEQUENCES.items():
        if match := re.search(pattern, name.lower()):
            return match.expand(preset)
    raise GavoError(
        f"no camera known for sequence {name!r}: put a camera.toml into it, or pass one (--camera, camera=): "
        f"{', '.join(PRESETS)} or a file"
    )
