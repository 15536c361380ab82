"""Registration of depth to colour: depth images are warped into the colour camera by both cameras' calibration."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float, UInt16

from gavo_jax.camera import Camera

FOOTPRINT = 1.1
"""Factor by which a reading's footprint in the colour image is enlarged: surfaces are seldom seen head-on."""

MARGIN = 8
"""Largest footprint, and farthest outside the image that a reading can still reach into it, pixels."""

SAME_SURFACE = 0.03
"""Largest relative difference of two readings, two pixels apart, that are of one surface."""

NEVER = np.uint16(65535)
"""Raw depth beyond any reading."""


TO_THE_END = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-10)
"""Termination criteria of undistortion: after OpenCV's default of five iterations rays of a wide view are off by
pixels."""


@dataclass(frozen=True, eq=False)
class Registration:
    """Warps depth images into the colour camera; under occlusion the nearest surface is kept.

    Attributes:
        depth: the depth camera as it records.
        color: the camera into which depth is warped: that of the frames, rectified or not.
        color_T_depth: rigid transform from the depth camera to the colour camera, metres.
    """

    depth: Camera
    color: Camera
    color_T_depth: Float[np.ndarray, "4 4"]

    def __call__(self, depth: UInt16[np.ndarray, "h w"], units: float) -> UInt16[np.ndarray, "height width"]:
        """Return a depth image as the colour camera sees it.

        Args:
            depth: raw depth of the depth camera's size, 0 = no reading.
            units: depth units per metre, of both images.
        """
        flat = depth.ravel()
        seen = np.flatnonzero(flat)
        x, y, z = self._points(seen, flat[seen].astype(np.float32) / np.float32(units))
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = self._pixels(x, y, z)
        raw = z * np.float32(units) + np.float32(0.5)
        moved = np.where((z > 0) & (raw < NEVER), raw, 0).astype(np.uint16)
        return self._splat(u, v, moved, [size[seen] for size in self._footprints])

    def _points(self, seen: np.ndarray, metres: np.ndarray) -> list[np.ndarray]:
        """Return the readings as points in the colour camera: x, y, z."""
        shift = self.color_T_depth[:3, 3].astype(np.float32)
        return [axis[seen] * metres + shift[i] for i, axis in enumerate(self._rays)]

    def _pixels(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project points to columns and rows of the colour image; NaN for those outside the lens's view."""
        camera = self.color
        if not camera.is_distorted:
            return camera.fx * x / z + np.float32(camera.cx), camera.fy * y / z + np.float32(camera.cy)
        points = np.stack([x / z, y / z, np.ones_like(z)], -1).astype(np.float64)[:, None]
        distortion, still = np.array(camera.distortion), np.zeros(3)
        if camera.model == "fisheye":
            pixels = cv2.fisheye.projectPoints(points, still, still, camera.matrix, distortion)[0]
        else:
            pixels = cv2.projectPoints(points, still, still, camera.matrix, distortion)[0]
        pixels[np.hypot(points[..., 0], points[..., 1]) > camera.reach] = np.nan
        return pixels[:, 0, 0].astype(np.float32), pixels[:, 0, 1].astype(np.float32)

    def _splat(self, u: np.ndarray, v: np.ndarray, depth: np.ndarray, sizes: list[np.ndarray]) -> np.ndarray:
        """Draw each reading over the pixels that it covers, keeping the nearest."""
        height, width = self.color.height, self.color.width
        most = [int(np.ceil(size.max())) for size in self._footprints]
        around = (-MARGIN < u) & (u < width + MARGIN) & (-MARGIN < v) & (v < height + MARGIN)
        near = around & (depth > 0)
        u, v, depth, halves = u[near], v[near], depth[near], [size[near] / 2 for size in sizes]
        left, top = (np.ceil(place - half).astype(np.int32) for place, half in zip((u, v), halves, strict=True))
        right, bottom = u + halves[0], v + halves[1]
        drawn = np.full(height * width, NEVER)
        for i in range(most[1]):
            for j in range(most[0]):
                column, row = left + j, top + i
                inside = (column < np.minimum(right, width)) & (row < np.minimum(bottom, height))
                inside &= (column >= 0) & (row >= 0)
                np.minimum.at(drawn, (row * width + column)[inside], depth[inside])
        drawn[drawn == NEVER] = 0
        return _without_cracks(drawn.reshape(height, width))

    @cached_property
    def _footprints(self) -> tuple[np.ndarray, np.ndarray]:
        """Size in columns and rows of the colour image of each depth pixel on a surface seen head-on.

        It is that of the box around the pixel, which may be turned: one camera may be mounted on its side.
        """
        x, y = (axis.reshape(self.depth.height, self.depth.width) for axis in self._rays[:2])
        columns, rows = (
            FOOTPRINT * focal * sum(np.abs(change) for change in np.gradient(axis))
            for focal, axis in ((self.color.fx, x), (self.color.fy, y))
        )
        return tuple(np.minimum(size, MARGIN).ravel().astype(np.float32) for size in (columns, rows))

    @cached_property
    def _rays(self) -> Float[np.ndarray, "3 pixels"]:
        """Points that the pixels of the depth camera see at 1 m along its axis, in the axes of the colour camera."""
        camera = self.depth
        v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
        pixels, distortion = np.stack([u.ravel(), v.ravel()], -1)[:, None], np.array(camera.distortion)
        if camera.model == "fisheye":
            ends = cv2.fisheye.undistortPoints(pixels, camera.matrix, distortion)[:, 0]
        else:
            ends = cv2.undistortPoints(pixels, camera.matrix, distortion, criteria=TO_THE_END)[:, 0]
        rays = np.concatenate([ends, np.ones((len(ends), 1))], axis=1)
        return (self.color_T_depth[:3, :3] @ rays.T).astype(np.float32)


def _without_cracks(depth: UInt16[np.ndarray, "h w"]) -> UInt16[np.ndarray, "h w"]:
    """Fill single pixels left empty between two readings of one surface, as happens on slanted surfaces."""
    for image in (depth, depth.T):
        before, after = image[:, :-2], image[:, 2:]
        low, high = np.minimum(before, after), np.maximum(before, after)
        crack = (image[:, 1:-1] == 0) & (low > 0) & (high - low < SAME_SURFACE * high)
        image[:, 1:-1][crack] = low[crack] + (high - low)[crack] // 2
    return depth
