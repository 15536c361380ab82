"""Searches without the points that lie on bodies."""

import cv2
import jax
import numpy as np
from jaxtyping import Bool

from gavo_jax.camera import to_pixels
from gavo_jax.image.levels import ImagePlane, Levels
from gavo_jax.objective.points import Reference
from gavo_jax.odometry.tracking import TrackerState


def without_points(
    state: TrackerState, planes: ImagePlane, moving: Bool[np.ndarray, "h w"], levels: Levels
) -> TrackerState:
    """Remove the points that fall on a mask from a tracker's references, on the host, where masks are.

    Args:
        state: The tracker's state.
        planes: Image planes of the searched levels, [L], on the host.
        moving: Mask of the pixels to leave out, at the size of one of these levels.
        levels: The searched levels.
    """
    height, width = moving.shape
    place = next(i for i, size in enumerate(levels.sizes) if size == (height, width))
    plane = jax.tree.map(lambda leaf: leaf[place], planes)
    wide = np.stack([_widened(moving, levels.numbers[place], number) for number in levels.numbers])
    level = np.arange(len(levels.numbers))[:, None]

    def masked(reference: Reference) -> Reference:
        points = reference.points
        u, v = to_pixels(plane, np.asarray(points.x), np.asarray(points.y))
        inside = (u > -0.5) & (v > -0.5) & (u < width - 0.5) & (v < height - 0.5)
        column, row = (np.clip(np.round(a), 0, n - 1).astype(np.int32) for a, n in ((u, width), (v, height)))
        hidden = wide[level, row, column] & inside
        q = np.where(hidden, np.float32(0.0), np.asarray(points.q))
        return reference._replace(points=points._replace(q=q))  # pyright: ignore[reportArgumentType]

    part = state.part._replace(share=np.float32(1.0 - np.mean(moving)))  # pyright: ignore[reportArgumentType]
    return state._replace(previous=masked(state.previous), keyframe=masked(state.keyframe), part=part)


def _widened(mask: Bool[np.ndarray, "h w"], seen: int, number: int) -> Bool[np.ndarray, "h w"]:
    """A mask dilated by a pixel of level `number`, which mixes with its neighbours."""
    radius = max(2 ** (number - seen), 1) if number > seen else 1
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * radius + 1,) * 2, np.uint8)) > 0
