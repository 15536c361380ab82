"""Frames from a live camera: checked, rectified, and dropped when they arrive faster than they are tracked."""

import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, Self

import cv2
import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.camera_check import require_camera
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.images import without_invalid
from gavo_jax.errors import GavoError
from gavo_jax.number_types import as_array


class LiveImages(NamedTuple):
    """A pair of images from a device."""

    color: np.ndarray
    """RGB of uint8 [H, W, 3], or grey [H, W]."""
    depth: np.ndarray
    """Registered to colour: uint16 [H, W] in units of the camera's `depth_scale`, or floats in metres; 0 or not finite
    = no reading."""
    timestamp: float
    """Stamp of the colour image, seconds, by any clock that only goes forward."""
    depth_timestamp: float | None = None
    """Stamp of the depth image, by the same clock; None where it is the colour image's."""


class LiveDevice(Protocol):
    """A live camera, or a stand-in for one."""

    @property
    def name(self) -> str:
        """Short name for tables and folders."""
        ...

    @property
    def camera(self) -> Camera:
        """The camera as it records, with distortion."""
        ...

    def read(self) -> LiveImages | None:
        """Wait for the next images; None at the end.

        Raises:
            GavoError: the device is gone.
        """
        ...

    def close(self) -> None:
        """Release the device; a `read` that is waiting returns."""
        ...


LEAST_UNITS = 500.0
"""Fewest depth units per metre at which float depth is rounded to whole units; in coarser ones it stays float."""


def frame_of(images: LiveImages, camera: Camera, color: bool = False) -> Frame:
    """Make an undistorted frame from a device's images.

    Args:
        images: images as delivered by the device.
        camera: the camera as it records; the frame is that of `camera.rectified()`.
        color: whether the frame has RGB beside grey.

    Raises:
        GavoError: an image has the wrong size or type; the message says what was expected.
    """
    require_camera(camera)
    if not isinstance(images, LiveImages):
        raise GavoError(f"expected gavo.LiveImages(color, depth, timestamp), got {type(images).__name__}")
    size = (camera.height, camera.width)
    image, depth = np.asarray(images.color), np.asarray(images.depth)
    if image.dtype != np.uint8 or image.shape not in (size, (*size, 3)):
        raise GavoError(
            f"colour image is {image.dtype} of shape {image.shape}: expected uint8 of {size} (grey) or "
            f"{(*size, 3)} (RGB)"
        )
    if depth.shape != size or not (depth.dtype.newbyteorder("=") == np.uint16 or depth.dtype.kind == "f"):
        raise GavoError(
            f"depth image is {depth.dtype} of shape {depth.shape}: expected uint16 or floats in metres, of {size}"
        )
    image, depth = as_array(images.color), as_array(images.depth)
    if depth.dtype != np.uint16:
        raw = depth * np.float32(camera.depth_scale)
        raw = np.where(np.isfinite(raw) & (raw > 0) & (raw < 65535), raw, np.float32(0))
        depth = raw if camera.depth_scale < LEAST_UNITS else (raw + np.float32(0.5)).astype(np.uint16)
    depth = without_invalid(depth)
    image, depth = camera.undistort(np.ascontiguousarray(image), np.ascontiguousarray(depth))
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    rgb = None
    if color:
        rgb = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    return Frame(grey, depth, images.timestamp, rgb, images.depth_timestamp)


@dataclass
class Newest:
    """Iterates over the newest images of a device: a thread reads them, and those not consumed in time are dropped.

    Otherwise, an odometry slower than the camera would lag ever further behind. So the next frame replaces one that is
    still waiting, which is counted as dropped.

    Attributes:
        device: the device; it is closed on exit.
        received: number of images received so far.
        dropped: number of those replaced by a newer one.
    """

    device: LiveDevice
    received: int = 0
    dropped: int = 0
    _waiting: LiveImages | None = None
    _fault: BaseException | None = None
    _ended: bool = False
    _changed: threading.Condition = field(default_factory=threading.Condition)
    _thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        """Start the thread that reads images."""
        self._thread = threading.Thread(target=self._take, name=f"reads {self.device.name}", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        with self._changed:
            self._ended = True
        self.device.close()
        if self._thread is not None:
            self._thread.join(timeout=5.0)

    def __iter__(self) -> Iterator[LiveImages]:
        """Yield the newest images each time, waiting for them if there are none yet.

        Raises:
            GavoError: the device failed, or nothing reads it: this is no `with` block.
        """
        if self._thread is None:
            raise GavoError("Newest reads images inside a with block: with gavo.Newest(device) as newest: …")
        while True:
            with self._changed:
                while self._waiting is None and not self._ended:
                    self._changed.wait(timeout=0.1)  # an unlimited wait would block Ctrl-C on some systems
                images, self._waiting = self._waiting, None
                if images is None:
                    if self._fault is not None:
                        raise self._fault
                    return
            yield images

    def _take(self) -> None:
        try:
            while not self._ended and (images := self.device.read()) is not None:
                if isinstance(images, LiveImages):  # a device may read into the same arrays each time
                    images = images._replace(color=np.array(images.color), depth=np.array(images.depth))
                with self._changed:
                    self.received += 1
                    self.dropped += self._waiting is not None
                    self._waiting = images
                    self._changed.notify()
        except BaseException as error:
            self._fault = error if isinstance(error, GavoError) else GavoError(f"{self.device.name}: {error}")
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify()
