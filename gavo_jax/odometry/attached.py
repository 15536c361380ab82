"""Parts of the camera's carrier that are in view: a gripper, a bonnet, the edge of a hood.

They stay put in the image as the camera moves, and would hold it where it is. Unlike a drawing they have noise, and
their light changes. But the gradients at their edges keep their directions, while those of the scene average out.

An edge of the scene that lies along the motion stays put, too, so only corners count. Of a scene's corners, only those
around one point stay put: the point that the camera moves towards, or turns about. So the corners have to lie apart.
"""

from typing import NamedTuple, Self

import cv2
import numpy as np
from jaxtyping import Bool, Float

from gavo_jax.rigid_motions import length_and_angle
from gavo_jax.trajectory import inverse

SIDE = 160
"""Pixels, about, along the longer side of the images that are compared."""
SLOPE = 2.0
"""Gradient in grey levels a pixel above which there is an edge."""
SHIFT = 1.0
"""Median shift of the edges, in pixels, since the last image that counted: then this one counts."""
MOVED = 3e-3
"""Motion of the camera since then, as found: radians plus metres. What moves before a camera at rest proves nothing."""
MOVES = 24
"""Images that count before anything is known, and over which the means are taken."""
LOOK_EVERY = 4
"""Images that count from one look at the means to the next."""
STEADY = 0.9
"""Length of a mean gradient, over the mean length, above which an edge stays put."""
ALIKE = 0.5
"""Median of the same over all other edges above which the images are too much alike to tell, as of a camera that
trembles: there it is 0.56 to 0.72, and 0.2 to 0.4 where something is attached to a moving camera.
"""
AROUND = 9
"""Pixels across the surroundings in which gradients of different directions make a corner."""
ROUND = 0.1
"""Smaller eigenvalue, over the sum of both, of the surroundings' structure tensor: then there is a corner."""
MIN_CORNERS, STILL_CORNERS = 7e-3, 3e-3
"""Share of the image that has to be steady corner, at first and later. Where nothing is attached it is 0.001 at most if
a hand holds the camera, and 0.005 if it moves straight ahead.
"""
MIN_SPREAD = 0.08
"""Standard deviation of the corners' positions, over the longer side."""


class Attached(NamedTuple):
    """What is known of the parts in view, in images of about `SIDE` pixels."""

    image: Float[np.ndarray, "h w"] | None = None
    """The last image that counted, blurred; None before the first."""
    world_T_camera: Float[np.ndarray, "4 4"] = np.eye(4)
    """Where the camera was at that image."""
    gradient: Float[np.ndarray, "2 h w"] = np.zeros((2, 0, 0), np.float32)
    """Mean gradient over the images that counted."""
    slope: Float[np.ndarray, "h w"] = np.zeros((0, 0), np.float32)
    """Mean length of the gradient."""
    moves: int = 0
    """Number of images that counted."""
    edges: Bool[np.ndarray, "h w"] = np.zeros((0, 0), bool)
    """Edges of the parts in view."""

    def after(self, grey: np.ndarray, world_T_camera: np.ndarray) -> Self:
        """Update with one more image.

        Args:
            grey: The image, 8-bit or float32.
            world_T_camera: The camera's pose as far as it is known, which is that of the image before.
        """
        image = _blurred(grey)
        if self.image is None or self.image.shape != image.shape:
            return self._replace(
                image=image,
                world_T_camera=world_T_camera,
                gradient=np.zeros((2, *image.shape), np.float32),
                slope=np.zeros_like(image),
                moves=0,
                edges=np.zeros(image.shape, bool),
            )
        if _motion(self.world_T_camera, world_T_camera) < MOVED:
            return self
        change, (gradient, slope) = cv2.absdiff(image, self.image), _gradient(image)
        if np.count_nonzero((change > SHIFT * slope) & (slope > SLOPE)) <= 0.5 * np.count_nonzero(slope > SLOPE):
            return self
        moves = self.moves + 1
        weight = np.float32(1.0 / min(moves, MOVES))
        mean = self.gradient + weight * (gradient - self.gradient)
        length = self.slope + weight * (slope - self.slope)
        least = STILL_CORNERS if self.edges.any() else MIN_CORNERS
        is_due = moves >= MOVES and moves % LOOK_EVERY == 0 and not _are_alike(mean, length)
        return self._replace(
            image=image,
            world_T_camera=world_T_camera,
            gradient=mean,
            slope=length,
            moves=moves,
            edges=_steady_edges(mean, length, least) if is_due else self.edges,
        )


def _gradient(image: Float[np.ndarray, "h w"]) -> tuple[Float[np.ndarray, "2 h w"], Float[np.ndarray, "h w"]]:
    """Gradient to the right and down, in grey levels a pixel, and its length."""
    x, y = (cv2.Sobel(image, cv2.CV_32F, *axis, scale=0.125) for axis in ((1, 0), (0, 1)))
    return np.stack([x, y]), cv2.magnitude(x, y)


def _blurred(grey: np.ndarray) -> Float[np.ndarray, "h w"]:
    """A small image, as float32."""
    factor = max(1, round(max(grey.shape) / SIDE))
    size = max(1, grey.shape[1] // factor), max(1, grey.shape[0] // factor)
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small.astype(np.float32), (0, 0), 1.0)


def _motion(world_T_a: np.ndarray, world_T_b: np.ndarray) -> float:
    """Angle in radians plus distance in metres between two poses."""
    length, angle = length_and_angle(inverse(world_T_a) @ world_T_b)
    return float(length + angle)


def _are_alike(mean: Float[np.ndarray, "2 h w"], length: Float[np.ndarray, "h w"]) -> bool:
    """Whether the images hardly differ, so that the scene's edges stay put like those of a part in view."""
    kept = cv2.magnitude(*mean)
    others = (length > SLOPE) & (kept <= STEADY * length)
    return not others.any() or bool(np.median(kept[others] / length[others]) > ALIKE)


def _steady_edges(
    mean: Float[np.ndarray, "2 h w"], length: Float[np.ndarray, "h w"], least: float
) -> Bool[np.ndarray, "h w"]:
    """Edges that stay put and hang together with corners that do.

    None if the corners cover less than `least` of the image, or lie close together.
    """
    kept = cv2.magnitude(*mean)
    steady = (kept > STEADY * length) & (kept > SLOPE)
    x, y = np.where(steady, mean, np.float32(0))
    xx, xy, yy = (cv2.boxFilter(part, -1, (AROUND, AROUND), normalize=False) for part in (x * x, x * y, y * y))
    smaller = (xx + yy) / 2 - np.sqrt((xx - yy) ** 2 / 4 + xy**2)
    corners = steady & (smaller > ROUND * (xx + yy))
    places = np.argwhere(corners)
    if len(places) < least * corners.size or np.hypot(*places.std(axis=0)) < MIN_SPREAD * max(corners.shape):
        return np.zeros_like(steady)
    _, labels = cv2.connectedComponents(cv2.dilate(steady.astype(np.uint8), np.ones((3, 3), np.uint8)))
    return steady & np.isin(labels, labels[corners])
