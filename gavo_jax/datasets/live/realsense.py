"""Intel RealSense cameras, through the library pyrealsense2 (extra `[realsense]`)."""

from dataclasses import asdict, replace
from typing import Any

import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.camera_files.exports import sdk_distortion
from gavo_jax.datasets.live.frames import LiveImages
from gavo_jax.errors import GavoError
from gavo_jax.libusb import import_with_libusb

NAME = "realsense"

SIZE, RATE = (640, 480), 30
"""Image size, pixels, and frames per second that every RealSense camera supports."""

PATIENCE = 5000
"""Timeout for a frame, milliseconds, after which the camera is considered gone."""

METRES_PER_UNIT = 1e-3
"""Metres per unit of depth, where the camera does not state it."""


class RealSense:
    """Colour and depth of the first camera found, with depth registered to colour by the SDK.

    Attributes:
        name: realsense.
        camera: factory calibration of the colour camera, with distortion.
    """

    name = NAME

    def __init__(self, size: tuple[int, int] = SIZE, rate: int = RATE, sdk: Any = None) -> None:
        """Start the streams.

        Args:
            size: width and height, pixels.
            rate: frames per second.
            sdk: stand-in for the library in tests.

        Raises:
            GavoError: the library is not installed, there is no camera, or it does not support this size and rate.
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
        # copied, since the SDK reuses its few buffers
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
    """Convert the SDK's intrinsics to a `Camera`.

    Args:
        intrinsics: intrinsics of the colour stream.
        depth_scale: raw depth units per metre.

    Raises:
        GavoError: the lens model is not supported.
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
    lens = sdk_distortion(f"{NAME}: the colour stream's", intrinsics.model, intrinsics.coeffs, asdict(camera))
    return replace(camera, distortion=tuple(lens)) if lens else camera


def _import_sdk() -> Any:
    try:
        return import_with_libusb("pyrealsense2")
    except ImportError as error:
        raise GavoError(
            f"{NAME}: pyrealsense2 cannot be imported ({error}): pip install 'gavo-jax[realsense]'"
        ) from None
