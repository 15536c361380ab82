"""A camera of Intel's RealSense line, through the library pyrealsense2 (extra `[realsense]`)."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.datasets.live import LiveImages
from gavo_jax.errors import GavoError
from gavo_jax.libusb import import_with_libusb

NAME = "realsense"

SIZE, RATE = (640, 480), 30
"""Pixels and frames per second that every camera of the line delivers."""

PATIENCE = 5000
"""Milliseconds without a frame after which the camera counts as gone."""

METRES_PER_UNIT = 1e-3
"""Of depth, where the camera does not say."""


class RealSense:
    """Colour and depth of the first camera that is found, depth registered to colour by the SDK.

    Attributes:
        name: realsense.
        camera: its factory calibration of colour, distortion included.
    """

    name = NAME

    def __init__(self, size: tuple[int, int] = SIZE, rate: int = RATE, sdk: Any = None) -> None:
        """Start the streams.

        Args:
            size: width and height, pixels.
            rate: frames per second.
            sdk: stands for the library, in tests.

        Raises:
            GavoError: the library is not installed, there is no camera, or it does not deliver such frames.
        """
        self._sdk = _import_sdk() if sdk is None else sdk
        rs = self._sdk
        self._pipeline, config = rs.pipeline(), rs.config()
        config.enable_stream(rs.stream.color, *size, rs.format.rgb8, rate)
        config.enable_stream(rs.stream.depth, *size, rs.format.z16, rate)
        try:
            profile = self._pipeline.start(config)
        except RuntimeError as error:
            raise GavoError(f"{NAME}: no camera that delivers {size[0]}x{size[1]} at {rate} Hz: {error}") from None
        self._align = rs.align(rs.stream.color)
        self._open = True
        intrinsics = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
        scale = profile.get_device().first_depth_sensor().get_depth_scale() or METRES_PER_UNIT
        self.camera = camera_of(intrinsics, 1.0 / scale)

    def read(self) -> LiveImages | None:
        """Wait for the next pair of images; None once it is closed."""
        if not self._open:
            return None
        try:
            frames = self._align.process(self._pipeline.wait_for_frames(PATIENCE))
        except RuntimeError as error:
            if not self._open:
                return None
            raise GavoError(f"{NAME}: the camera delivers no more frames: {error}") from None
        color, depth = frames.get_color_frame(), frames.get_depth_frame()
        # the SDK's buffers are its own and few: what is kept has to be copied
        return LiveImages(
            np.array(color.get_data()),
            np.array(depth.get_data()),
            color.get_timestamp() / 1e3,
            depth.get_timestamp() / 1e3,
        )

    def close(self) -> None:
        """Stop the streams."""
        if self._open:
            self._open = False
            self._pipeline.stop()


def camera_of(intrinsics: Any, depth_scale: float) -> Camera:
    """A camera of the SDK's intrinsics.

    Args:
        intrinsics: of the colour stream.
        depth_scale: raw depth units per metre.

    Raises:
        GavoError: a lens model that is none of ours.
    """
    camera = Camera(
        intrinsics.fx,
        intrinsics.fy,
        intrinsics.ppx,
        intrinsics.ppy,
        intrinsics.width,
        intrinsics.height,
        depth_scale=depth_scale,
    )
    coefficients = np.array(intrinsics.coeffs, float)
    model = str(intrinsics.model).rsplit(".", 1)[-1].lower()
    if model == "none" or not coefficients.any():
        return camera
    if model not in LENSES:
        raise GavoError(f"{NAME}: the colour stream's lens model is {model}: not one of none, {', '.join(LENSES)}")
    return replace(camera, distortion=_as_opencv(LENSES[model], coefficients, camera))


Rays = tuple[np.ndarray, np.ndarray]


def _brown(x: np.ndarray, y: np.ndarray, k: np.ndarray, scaled: bool = False) -> Rays:
    """Radial and tangential terms, coefficients k1 k2 p1 p2 k3; `scaled`: the latter of what the radial ones left."""
    square = x**2 + y**2
    radial = 1 + k[0] * square + k[1] * square**2 + k[4] * square**3
    u, v = (x * radial, y * radial) if scaled else (x, y)
    return (
        x * radial + 2 * k[2] * u * v + k[3] * (square + 2 * u**2),
        y * radial + 2 * k[3] * u * v + k[2] * (square + 2 * v**2),
    )


Lens = Callable[
    [np.ndarray, np.ndarray, np.ndarray], tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
]
"""From a grid of points and coefficients: ideal points, and where the lens shows them."""

LENSES: dict[str, Lens] = {
    "brown_conrady": lambda x, y, k: ((x, y), _brown(x, y, k)),
    "modified_brown_conrady": lambda x, y, k: ((x, y), _brown(x, y, k, scaled=True)),
    "inverse_brown_conrady": lambda x, y, k: (_brown(x, y, k), (x, y)),
}
"""The SDK's models by name, as `rsutil.h` has them."""

GRID = 25
"""Points along either side of the image to which OpenCV's model is fitted."""


def _as_opencv(lens: Lens, coefficients: np.ndarray, camera: Camera) -> tuple[float, ...]:
    """OpenCV's k1 k2 p1 p2 k3 that show what another model shows: linear in them, so least squares over the image."""
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, GRID), np.linspace(0, camera.height - 1, GRID))
    (x, y), seen = lens((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, coefficients)
    columns = [np.stack(_brown(x, y, unit)) - np.stack([x, y]) for unit in np.eye(5)]
    matrix = np.stack([column.ravel() for column in columns], axis=1)
    found, *_ = np.linalg.lstsq(matrix, (np.stack(seen) - np.stack([x, y])).ravel(), rcond=None)
    return tuple(found.tolist())


def _import_sdk() -> Any:
    try:
        return import_with_libusb("pyrealsense2")
    except ImportError as error:
        raise GavoError(f"{NAME}: pyrealsense2 cannot be imported ({error}): install 'gavo-jax[realsense]'") from None
