"""Tracking of one frame's corners in another one, from an approximate motion.

The target is first warped to the reference's view. The remaining displacement, which the motion does not explain, is a
few pixels, and Lucas-Kanade tracking finds it to a fraction of one.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float64, UInt8

from gavo_jax.camera import Camera, to_ray
from gavo_jax.image.motion_compensation import filled_inverse_depth
from gavo_jax.number_types import Depth, grey_bytes

MAX_CORNERS = 500
"""Largest number of corners of a frame; the strongest are kept."""
QUALITY = 0.005
"""Smallest response of a corner, as a share of the strongest one's."""
LEAST_SLOPE = 2.0
"""Smallest gradient of a corner in every direction, grey levels per pixel; noise has about one."""
RESPONSE = 64.0 * 9.0 / (12.0 * 255.0) ** 2
"""OpenCV's response to one grey level per pixel in every direction: sums of its Sobel filter over 3 x 3 pixels."""
SPACING = 1 / 80
"""Smallest distance of two corners, as a share of the image's width."""
WINDOW = 1 / 30
"""Side of the window that is tracked about a corner, as a share of the width."""
LEAST_WINDOW = 3
"""Smallest side in pixels, for small images."""
RETURN = 0.5
"""Largest distance between a corner and where tracking back ends, pixels."""
NEAREST = 0.05
"""Smallest depth at which a point is seen, metres."""


class Matches(NamedTuple):
    """The same corners in two frames."""

    reference: Float64[np.ndarray, "n 2"]
    """Columns and rows of the corners in the reference."""
    target: Float64[np.ndarray, "n 2"]
    """Columns and rows of the same corners in the target."""


def track_corners(
    reference: tuple[UInt8[np.ndarray, "h w"], Depth],
    target: UInt8[np.ndarray, "h w"],
    target_T_reference: Float[np.ndarray, "4 4"],
    camera: Camera,
) -> Matches:
    """Find a frame's corners in another frame.

    Args:
        reference: Grey and depth, 0 = no reading.
        target: Grey.
        target_T_reference: Approximate motion.
        camera: Camera of both, without distortion.
    """
    grey, depth, target = grey_bytes(reference[0]), reference[1], grey_bytes(target)
    column, row, seen = _view(depth, target_T_reference, camera)
    size = max(LEAST_WINDOW, 2 * int(0.5 * WINDOW * camera.width) + 1)
    seen = cv2.erode(seen, np.ones((size, size), np.uint8)) * (depth > 0)
    points = None
    is_corner = seen * (cv2.cornerMinEigenVal(grey, 3) > RESPONSE * LEAST_SLOPE**2).astype(np.uint8)
    if is_corner.any():
        spacing = max(1.0, SPACING * camera.width)
        points = cv2.goodFeaturesToTrack(grey, MAX_CORNERS, QUALITY, spacing, mask=255 * is_corner)
    if points is None:
        return Matches(np.zeros((0, 2)), np.zeros((0, 2)))
    there = cv2.remap(target, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    there = _as_bright(there, grey, seen > 0)
    options = {"winSize": (size, size), "criteria": (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 30, 0.01)}
    found, is_found, _ = cv2.calcOpticalFlowPyrLK(grey, there, points, np.empty(0), **options)
    back, is_back, _ = cv2.calcOpticalFlowPyrLK(there, grey, found, np.empty(0), **options)
    kept = (is_found[:, 0] > 0) & (is_back[:, 0] > 0) & (np.linalg.norm(points - back, axis=2)[:, 0] < RETURN)
    before, after = points[kept, 0], found[kept, 0]
    if not kept.any():
        return Matches(np.zeros((0, 2)), np.zeros((0, 2)))
    landed = [cv2.remap(axis, after[:, :1], after[:, 1:], cv2.INTER_LINEAR)[:, 0] for axis in (column, row)]
    return Matches(before.astype(np.float64), np.stack(landed, axis=-1).astype(np.float64))


def _view(depth: np.ndarray, motion: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return each reference pixel's column and row in the target, and whether it is in view there."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32))
    x, y = to_ray(camera, u, v)
    q = filled_inverse_depth(depth, camera)
    rotation, shift = motion[:3, :3].astype(np.float32), motion[:3, 3].astype(np.float32)
    a, b, c = (rotation[i, 0] * x + rotation[i, 1] * y + rotation[i, 2] + shift[i] * q for i in range(3))
    ahead = c > NEAREST * q
    c = np.where(ahead, c, 1.0)
    column = (camera.fx * a / c + camera.cx).astype(np.float32)
    row = (camera.fy * b / c + camera.cy).astype(np.float32)
    inside = (column > 0) & (column < camera.width - 1) & (row > 0) & (row < camera.height - 1)
    return column, row, (ahead & inside).astype(np.uint8)


def _as_bright(grey: np.ndarray, other: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Give an image the mean and contrast of another one, by the pixels that both see."""
    own, wanted = grey[seen].astype(np.float32), other[seen].astype(np.float32)
    gain = wanted.std() / max(float(own.std()), 1.0)
    return np.clip((grey - own.mean()) * gain + wanted.mean(), 0.0, 255.0).astype(np.uint8)
