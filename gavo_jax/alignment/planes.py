"""The large planes in a frame's depth, and rectified (frontal) views of them."""

from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64

from gavo_jax.camera import Camera, inverse_depth, to_ray

MAX_PLANES, MIN_PLANE_SHARE = 3, 0.25
"""Largest number of planes, and the smallest share of the readings on each."""
STEP = 5
"""Stride of the readings that planes are fitted to, in pixels of the reduced frame."""
TRIES = 150
"""Random triples of readings per plane: a plane with a quarter of the readings is found in 9 of 10 frames."""
INLIER_TOLERANCE = (0.01, 0.02)
"""Largest distance of an inlier from a plane in inverse depth: 1/m, and as a share of the reading."""
MIDDLE = (2.0, 98.0)
"""Percentiles, along either axis, of the part of a plane that a frontal view covers."""
EVERY = 7
"""Stride of the pixels that determine which part of the plane is covered."""
MIN_COVERED_PIXELS, NARROW = 16, 8
"""Smallest number of these pixels, and smallest side of the view in pixels."""


class Plane(NamedTuple):
    """A plane in front of a camera: the points X with normal · X = distance."""

    normal: Float64[np.ndarray, " 3"]
    """Unit normal, away from the camera."""
    distance: float
    """Distance from the camera, metres, above 0."""

    @property
    def foot(self) -> Float64[np.ndarray, " 3"]:
        """The plane's point nearest to the camera, metres."""
        return self.distance * self.normal


class Small(NamedTuple):
    """A frame reduced in size."""

    grey: Float[np.ndarray, "h w"]
    inverse_depth: Float[np.ndarray, "h w"]
    """1/m; 0 = no reading."""
    camera: Camera
    """Camera of the smaller images."""

    @property
    def slopes(self) -> tuple[Float[np.ndarray, " w"], Float[np.ndarray, " h"]]:
        """The x and y of the rays (x, y, 1) through its columns and rows."""
        rows, columns = (np.arange(size, dtype=np.float32) for size in self.grey.shape)
        return to_ray(self.camera, columns, rows)

    def inverse_depth_of(self, plane: Plane) -> Float[np.ndarray, "h w"]:
        """Inverse depth, 1/m, of a plane at each pixel; negative where the ray points away from it."""
        x, y = self.slopes
        a, b, c = (plane.normal / plane.distance).astype(np.float32)
        return a * x + (b * y + c)[:, None]


class StraightView(NamedTuple):
    """A frontal view of a plane: the image of a camera that looks along its normal."""

    grey: Float[np.ndarray, "h w"]
    inside: Bool[np.ndarray, "h w"]
    """Where the view shows the plane."""
    axes: Float64[np.ndarray, "2 3"]
    """Steps on the plane by a pixel to the right and by one down, metres, in the camera's axes."""


def smaller(grey: Any, depth: Any, camera: Camera, factor: int) -> Small:
    """Reduce a frame's size.

    Args:
        grey: [H, W].
        depth: Raw depth; 0 = no reading.
        camera: Camera of both.
        factor: Reduction along either side.
    """
    by = 1 / factor
    small = cv2.resize(np.asarray(grey, np.float32), None, fx=by, fy=by, interpolation=cv2.INTER_AREA)
    read = cv2.resize(np.asarray(depth, np.float32), None, fx=by, fy=by, interpolation=cv2.INTER_NEAREST)
    fx, fy, cx, cy = map(float, camera.scaled(by))
    height, width = small.shape
    seen_by = replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)
    return Small(small, inverse_depth(read, camera).astype(np.float32), seen_by)


def planes(frame: Small) -> list[Plane]:
    """Find the planes with at least a quarter of the readings each, the largest first."""
    q = frame.inverse_depth[::STEP, ::STEP]
    x, y = (slopes[::STEP] for slopes in frame.slopes)
    row, column = np.nonzero(q > 0)
    q = q[row, column]
    rays = np.stack([x[column], y[row], np.ones_like(q)], axis=-1)
    generator, left, found = np.random.default_rng(0), np.arange(len(q)), []
    least = max(MIN_PLANE_SHARE * len(q), 3)
    while len(found) < MAX_PLANES and len(left) >= least:
        slopes = _most_supported(rays[left], q[left], generator)
        of_it = left[_is_near(rays[left] @ slopes, q[left])]
        if len(of_it) < least:
            break
        slopes = np.linalg.lstsq(rays[of_it].astype(np.float64), q[of_it], rcond=None)[0]
        found.append(Plane(slopes / np.linalg.norm(slopes), 1 / float(np.linalg.norm(slopes))))
        left = left[~_is_near(rays[left] @ slopes, q[left])]
    return found


def _is_near(plane: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Whether inverse depths lie on a plane."""
    return np.abs(plane - q) < np.maximum(INLIER_TOLERANCE[0], INLIER_TOLERANCE[1] * q)


def _most_supported(
    rays: Float[np.ndarray, "n 3"], q: Float[np.ndarray, " n"], generator: np.random.Generator
) -> Float[np.ndarray, " 3"]:
    """Return the plane through three readings with the most inliers, as a linear function of the ray."""
    threes = generator.integers(len(q), size=(TRIES, 3))
    corners = rays[threes]
    is_open = np.abs(np.linalg.det(corners)) > 1e-6
    corners[~is_open] = np.eye(3)
    slopes = np.linalg.solve(corners, q[threes][..., None])[..., 0]
    support = np.count_nonzero(_is_near(slopes @ rays.T, q), axis=1)
    return slopes[np.argmax(np.where(is_open, support, -1))]


def seen_straight(frame: Small, plane: Plane) -> StraightView | None:
    """Return the frontal view of a plane, or None if it would show too little of it.

    Pixels without a reading are taken to show the plane.
    """
    expected, q = frame.inverse_depth_of(plane), frame.inverse_depth
    inside = (expected > 0) & ((q == 0) | _is_near(expected, q))
    row, column = np.nonzero(inside)
    row, column = row[::EVERY], column[::EVERY]
    if len(row) < MIN_COVERED_PIXELS:
        return None
    right, down = _axes(plane.normal)
    x, y = frame.slopes
    points = np.stack([x[column], y[row], np.ones_like(x[column])], axis=-1) / expected[row, column, None]
    low, high = np.percentile(points @ np.stack([right, down], axis=-1), MIDDLE, axis=0)
    pixel = max(float(np.sqrt(np.prod(high - low) / frame.grey.size)), 1e-9)
    size = np.round((high - low) / pixel)
    if size.min() < NARROW:
        return None
    corner = plane.foot + low[0] * right + low[1] * down
    homography = frame.camera.matrix @ np.stack([pixel * right, pixel * down, corner], axis=-1)
    grey, there = (
        cv2.warpPerspective(image, homography, size.astype(int).tolist(), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        for image in (frame.grey, inside.astype(np.float32))
    )
    return StraightView(grey, there > 0.99, pixel * np.stack([right, down]))


def _axes(normal: Float64[np.ndarray, " 3"]) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]:
    """Return two axes in a plane: the camera's right, projected onto it, and down."""
    right = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    if np.linalg.norm(right) < 1e-3:
        right = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    right /= np.linalg.norm(right)
    return right, np.cross(normal, right)
