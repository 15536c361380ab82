"""The images that are shown: downscaled, warped, and residuals."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from gavo_jax.camera import Camera, in_image
from gavo_jax.datasets.base import Frame
from gavo_jax.number_types import grey_bytes
from gavo_jax.viewer.colors import RESIDUAL_COLORS, color_of_body

IMAGE_WIDTH = 320
"""Maximum width of the images shown, pixels."""
JPEG_QUALITY = 85
RESIDUAL_RANGE = 40.0
"""Grey levels at which the residual image's colours saturate."""


def encode_jpeg(image: UInt8[np.ndarray, "h w *channels"]) -> bytes:
    """Return an image, grey or BGR, as the bytes of a JPEG file."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


class Shown(NamedTuple):
    """A frame as it is shown."""

    timestamp: float
    grey: UInt8[np.ndarray, "h w"]
    depth: Float[np.ndarray, "h w"]
    """Metres; 0 = no reading."""
    picture: UInt8[np.ndarray, "h w *channels"]
    """BGR if the frame has colours, else grey."""
    jpeg: bytes
    """The picture, encoded."""


def shrink(frame: Frame, camera: Camera, depth_scale: float) -> Shown:
    """Return a frame as it is shown.

    Args:
        frame: The frame, without distortion.
        camera: Camera of the images shown; see `shown_camera`.
        depth_scale: Units of the frame's depth per metre.
    """
    size, step = (camera.width, camera.height), frame.grey.shape[1] // camera.width

    def resized(image: UInt8[np.ndarray, "h w *channels"]) -> UInt8[np.ndarray, "h w *channels"]:
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA) if step > 1 else image

    grey = resized(grey_bytes(frame.grey))
    picture = grey if frame.color is None else cv2.cvtColor(resized(frame.color), cv2.COLOR_RGB2BGR)
    raw = np.asarray(frame.depth)[step // 2 :: step, step // 2 :: step][: size[1], : size[0]]
    depth = raw.astype(np.float32) * np.float32(1 / depth_scale)
    return Shown(frame.timestamp, grey, depth, picture, encode_jpeg(picture))


def tinted(
    picture: UInt8[np.ndarray, "h w *channels"], masks: Iterable[tuple[int, Bool[np.ndarray, "h w"]]]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return a picture as BGR, with each body's mask half covered by its colour."""
    shown = np.repeat(picture[..., None], 3, axis=2) if picture.ndim == 2 else picture.copy()
    for number, mask in masks:
        color = np.array(color_of_body(number)[::-1], np.float32)
        shown[mask] = (0.5 * shown[mask] + 0.5 * color).astype(np.uint8)
    return shown


def color_residual(
    warped: UInt8[np.ndarray, "h w"], reference: UInt8[np.ndarray, "h w"], seen: Bool[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the residuals warped − reference as BGR; black where nothing is seen."""
    factor = 127.5 / RESIDUAL_RANGE
    colored = cv2.applyColorMap(cv2.addWeighted(warped, factor, reference, -factor, 127.5), RESIDUAL_COLORS)
    return cv2.bitwise_and(colored, colored, mask=seen.view(np.uint8))


def shown_camera(camera: Camera) -> Camera:
    """Return the camera of the images shown: that of the finest level at most `IMAGE_WIDTH` wide."""
    level = 0
    while camera.width >> level > IMAGE_WIDTH:
        level += 1
    return camera.level(level)


def rays(camera: Camera) -> Float[np.ndarray, "h w 3"]:
    """Return the points at depth 1 on the rays of the pixels."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32))
    return np.asarray(camera.back_project(np.stack([u, v], axis=-1), np.ones_like(u)), np.float32)


def warp_target(
    reference: Shown, target: Shown, target_T_reference: Float[np.ndarray, "4 4"], camera: Camera
) -> tuple[UInt8[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Return the target warped to the reference, I_{t+1}(ω(ξ, p)), black where undefined, and where it is defined.

    Args:
        reference: The frame whose depth is used.
        target: The frame that is sampled.
        target_T_reference: g(ξ).
        camera: Camera of both, without distortion.
    """
    height, width = reference.grey.shape
    matrix = camera.matrix
    u, v = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    known = reference.depth > 0
    inverse_depth = np.divide(1, reference.depth, out=np.zeros_like(reference.depth), where=known)
    turn = (matrix @ target_T_reference[:3, :3] @ np.linalg.inv(matrix)).astype(np.float32)
    shift = (matrix @ target_T_reference[:3, 3]).astype(np.float32)
    x, y, z = (a * u + (b * v + c) + d * inverse_depth for (a, b, c), d in zip(turn, shift, strict=True))
    seen = known & (z > 1e-3)
    x /= z
    y /= z
    seen &= in_image(camera, x, y)
    sampled = cv2.remap(target.grey, x, y, cv2.INTER_LINEAR)
    return cv2.bitwise_and(sampled, sampled, mask=seen.view(np.uint8)), seen
