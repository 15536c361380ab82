"""The large planes that a frame shows, by its depth, and its image as it is seen from straight before one of them."""

from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64

from gavo_jax.camera import Camera, inverse_depth, to_ray

MOST, LARGE = 3, 0.25
"""Planes that are looked for, and the share of the readings that each has at least."""
STEP = 5
"""From one reading to the next, in pixels of the smaller frame, that planes are looked for among."""
TRIES = 150
"""Threes of readings that are tried for each plane: one that has a quarter of them is found in 9 of 10 frames."""
NEAR = (0.01, 0.02)
"""How far a reading lies from a plane at most, 1/m, and as a share of its inverse depth."""
MIDDLE = (2.0, 98.0)
"""Percentiles, along either side, of the part of a plane that a view from straight before it holds."""
EVERY = 7
"""Pixels of which one is asked where the plane lies."""
LEAST, NARROW = 16, 8
"""Pixels that are asked, and that the view has along either side, at least."""


class Plane(NamedTuple):
    """A plane before a camera: the points X with normal · X = distance."""

    normal: Float64[np.ndarray, " 3"]
    """Unit normal, away from the camera."""
    distance: float
    """Distance from the camera, metres, above 0."""

    @property
    def foot(self) -> Float64[np.ndarray, " 3"]:
        """Its point that is nearest to the camera, metres."""
        return self.distance * self.normal


class Small(NamedTuple):
    """A frame made smaller."""

    grey: Float[np.ndarray, "h w"]
    inverse_depth: Float[np.ndarray, "h w"]
    """1/m; 0 where nothing was read."""
    camera: Camera
    """Camera of the smaller images."""

    @property
    def slopes(self) -> tuple[Float[np.ndarray, " w"], Float[np.ndarray, " h"]]:
        """The x and y of the rays (x, y, 1) through its columns and rows."""
        rows, columns = (np.arange(size, dtype=np.float32) for size in self.grey.shape)
        return to_ray(self.camera, columns, rows)

    def inverse_depth_of(self, plane: Plane) -> Float[np.ndarray, "h w"]:
        """What its pixels would read, 1/m, if they showed a plane; below 0 where they look away from it."""
        x, y = self.slopes
        a, b, c = (plane.normal / plane.distance).astype(np.float32)
        return a * x + (b * y + c)[:, None]


class StraightView(NamedTuple):
    """An image as a camera sees it that looks along a plane's normal."""

    grey: Float[np.ndarray, "h w"]
    inside: Bool[np.ndarray, "h w"]
    """Where it shows the plane."""
    axes: Float64[np.ndarray, "2 3"]
    """What a pixel to the right and one down are on the plane, metres, by the camera's axes."""


def smaller(grey: Any, depth: Any, camera: Camera, factor: int) -> Small:
    """A frame with fewer pixels.

    Args:
        grey: [H, W].
        depth: In units of the camera's; 0 where nothing was read.
        camera: Of both.
        factor: By how much smaller along either side.
    """
    by = 1 / factor
    small = cv2.resize(np.asarray(grey, np.float32), None, fx=by, fy=by, interpolation=cv2.INTER_AREA)
    read = cv2.resize(np.asarray(depth, np.float32), None, fx=by, fy=by, interpolation=cv2.INTER_NEAREST)
    fx, fy, cx, cy = map(float, camera.scaled(by))
    height, width = small.shape
    seen_by = replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)
    return Small(small, inverse_depth(read, camera).astype(np.float32), seen_by)


def planes(frame: Small) -> list[Plane]:
    """The planes that have a quarter of the readings each, the largest first."""
    q = frame.inverse_depth[::STEP, ::STEP]
    x, y = (slopes[::STEP] for slopes in frame.slopes)
    row, column = np.nonzero(q > 0)
    q = q[row, column]
    rays = np.stack([x[column], y[row], np.ones_like(q)], axis=-1)
    generator, left, found = np.random.default_rng(0), np.arange(len(q)), []
    least = max(LARGE * len(q), 3)
    while len(found) < MOST and len(left) >= least:
        slopes = _most_supported(rays[left], q[left], generator)
        of_it = left[_is_near(rays[left] @ slopes, q[left])]
        if len(of_it) < least:
            break
        slopes = np.linalg.lstsq(rays[of_it].astype(np.float64), q[of_it], rcond=None)[0]
        found.append(Plane(slopes / np.linalg.norm(slopes), 1 / float(np.linalg.norm(slopes))))
        left = left[~_is_near(rays[left] @ slopes, q[left])]
    return found


def _is_near(plane: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Whether inverse depths are those of a plane."""
    return np.abs(plane - q) < np.maximum(NEAR[0], NEAR[1] * q)


def _most_supported(
    rays: Float[np.ndarray, "n 3"], q: Float[np.ndarray, " n"], generator: np.random.Generator
) -> Float[np.ndarray, " 3"]:
    """The plane through three readings, as inverse depth by ray, that most others are near to."""
    threes = generator.integers(len(q), size=(TRIES, 3))
    corners = rays[threes]
    is_open = np.abs(np.linalg.det(corners)) > 1e-6
    corners[~is_open] = np.eye(3)
    slopes = np.linalg.solve(corners, q[threes][..., None])[..., 0]
    support = np.count_nonzero(_is_near(slopes @ rays.T, q), axis=1)
    return slopes[np.argmax(np.where(is_open, support, -1))]


def seen_straight(frame: Small, plane: Plane) -> StraightView | None:
    """A frame as it is seen from straight before a plane, or None where too little of it would be; what was not read is
    taken for the plane.
    """
    expected, q = frame.inverse_depth_of(plane), frame.inverse_depth
    inside = (expected > 0) & ((q == 0) | _is_near(expected, q))
    row, column = np.nonzero(inside)
    row, column = row[::EVERY], column[::EVERY]
    if len(row) < LEAST:
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
    """Two axes along a plane: to the camera's right as far as that lies in it, and down."""
    right = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    if np.linalg.norm(right) < 1e-3:
        right = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    right /= np.linalg.norm(right)
    return right, np.cross(normal, right)
