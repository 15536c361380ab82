"""Motion compensation of a frame, at half its size: global shutter, and depth at the image's timestamp.

Keyframes are aligned with ones from other times, and neither frame's own motion is the motion between the two. So its
effect on a keyframe is removed once, and everything after sees images that were taken at one instant.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Shaped, UInt8

from gavo_jax.camera import Camera, inverse_depth, to_ray
from gavo_jax.image.pyramid import EDGE_TOLERANCE
from gavo_jax.image.shutter import row_time
from gavo_jax.number_types import Depth, grey_bytes, readings_like

HALVING = np.array([1.0, 3.0, 3.0, 1.0]) / 8.0
"""Weights, along either axis, of the pixels that are averaged, as in `pyramid.halve_grey`."""
UNKNOWN_DEPTH = 2.0
"""Depth in metres that is assumed if the whole image has no reading."""


class CompensatedImages(NamedTuple):
    """Motion-compensated images of a keyframe in half size, with the camera `Camera.level(1)`."""

    grey: UInt8[np.ndarray, "h w"]
    depth: Depth
    """Depth in the camera's units, 0 = no reading."""


def compensate_motion(
    grey: Shaped[np.ndarray, "height width"],
    depth: Shaped[np.ndarray, "height width"],
    camera: Camera,
    twist: Float[np.ndarray, " 6"],
    depth_delay: float = 0.0,
) -> CompensatedImages:
    """Convert images from a moving camera to ones taken at a single instant.

    A point that is at P at the frame's timestamp is seen in row v at exp(t ξ̂) P, t = `row_time`(v) readouts; its depth
    is read a delay later. Each pixel looks up grey and depth where its point was then, to first order.

    Args:
        grey: Intensities.
        depth: Raw depth, 0 = no reading.
        camera: Camera of the images, without distortion.
        twist: Motion of the points in the camera, (v, w) in m/s and rad/s.
        depth_delay: Seconds from the colour image's timestamp to the depth image's.
    """
    grey, depth, camera = halve_grey(grey_bytes(grey)), halve_depth(depth), camera.level(1)
    twist = np.asarray(twist, np.float32)
    if not np.any(twist):
        return CompensatedImages(grey, depth)
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32))
    flow = pixel_flow(camera, u, v, filled_inverse_depth(depth, camera), twist)
    seconds = np.float32(camera.readout) * row_time(v, camera)
    seconds = seconds + np.float32(camera.readout / camera.height) * flow[1] * seconds
    if camera.readout:
        column, row = u + seconds * flow[0], v + seconds * flow[1]
        grey = cv2.remap(grey, column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    seconds = seconds + np.float32(depth_delay)
    column, row = u + seconds * flow[0], v + seconds * flow[1]
    read = cv2.remap(depth, column, row, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    moved = read - seconds * (read * flow[2] + np.float32(twist[2] * camera.depth_scale))
    return CompensatedImages(grey, readings_like(depth, np.where((read > 0) & (moved > 0), moved, 0.0)))


def pixel_flow(
    camera: Camera, u: np.ndarray, v: np.ndarray, q: np.ndarray, twist: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flow of each pixel along u and v, pixels per second, and the rotation's part in its depth's relative rate."""
    x, y = to_ray(camera, u, v)
    (a, b, c), (wx, wy, wz) = twist[:3], twist[3:]
    forward = wx * y - wy * x
    away = forward + c * q
    along_u = camera.fx * (wy - wz * y + a * q - x * away)
    along_v = camera.fy * (wz * x - wx + b * q - y * away)
    return along_u.astype(np.float32), along_v.astype(np.float32), forward.astype(np.float32)


def filled_inverse_depth(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Inverse depth, 1/m, with gaps filled from their surroundings."""
    q = inverse_depth(depth, camera).astype(np.float32)
    known = q > 0
    usual = np.float32(np.median(q[known])) if known.any() else np.float32(1.0 / UNKNOWN_DEPTH)
    size = (2 * (camera.width // 16) + 1,) * 2
    count = cv2.blur(known.astype(np.float32), size)
    around = cv2.blur(q, size)
    return np.where(known, q, np.where(count > 0.01, around / np.maximum(count, 0.01), usual))


def halve_grey(grey: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h2 w2"]:
    """Halve a grey image, as the pyramid does."""
    height, width = (size // 2 * 2 for size in grey.shape)
    blurred = cv2.sepFilter2D(
        grey[:height, :width], cv2.CV_32F, HALVING, HALVING, anchor=(1, 1), borderType=cv2.BORDER_REPLICATE
    )
    return np.clip(np.round(blurred[::2, ::2]), 0, 255).astype(np.uint8)


def halve_depth(depth: Shaped[np.ndarray, "h w"]) -> Depth:
    """Halve a depth image: average the readings on the nearest surface of each 2 × 2 block, as in the pyramid."""
    height, width = (size // 2 * 2 for size in depth.shape)
    block = depth[:height, :width].reshape(height // 2, 2, width // 2, 2).transpose(1, 3, 0, 2).reshape(4, -1)
    readings = np.where(block > 0, block.astype(np.float32), np.inf)
    nearest = readings.min(axis=0)
    kept = readings <= nearest / (1.0 - EDGE_TOLERANCE)
    kept &= np.isfinite(readings)
    mean = np.where(kept, readings, 0.0).sum(axis=0) / np.maximum(kept.sum(axis=0), 1)
    return readings_like(depth, mean).reshape(height // 2, width // 2)
