"""Search without the points that are taken to be a body's."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gavo_jax.camera import to_pixels
from gavo_jax.image.levels import ImagePlane, Levels
from gavo_jax.objective.points import Reference
from gavo_jax.odometry.tracking import TrackerState


@partial(jax.jit, static_argnames="levels")
def without_points(state: TrackerState, planes: ImagePlane, moving: Bool[Array, "h w"], levels: Levels) -> TrackerState:
    """The state of a tracker whose references have lost the points that fall on a mask.

    Args:
        state: Of the tracker.
        planes: Of the levels searched, [L].
        moving: Which pixels, of one of these levels, are not to take part.
        levels: The levels.
    """
    height, width = moving.shape
    place = next(i for i, size in enumerate(levels.sizes) if size == (height, width))
    plane = jax.tree.map(lambda leaf: leaf[place], planes)
    wide = jnp.stack([_widened(moving, levels.numbers[place], number) for number in levels.numbers])

    def masked(reference: Reference) -> Reference:
        points = reference.points
        u, v = to_pixels(plane, points.x, points.y)
        inside = (u > -0.5) & (v > -0.5) & (u < width - 0.5) & (v < height - 0.5)
        column, row = (jnp.clip(jnp.round(a), 0, n - 1).astype(jnp.int32) for a, n in ((u, width), (v, height)))
        level = jnp.arange(len(levels.numbers))[:, None]
        hidden = wide[level, row, column] & inside
        return reference._replace(points=points._replace(q=jnp.where(hidden, 0.0, points.q)))

    return state._replace(previous=masked(state.previous), keyframe=masked(state.keyframe))


def _widened(mask: Bool[Array, "h w"], seen: int, number: int) -> Bool[Array, "h w"]:
    """A mask with a border: as wide as a pixel of the level, which mixes with its neighbours."""
    radius = max(2 ** (number - seen), 1) if number > seen else 1
    size = 2 * radius + 1
    image: Float[Array, "h w"] = mask.astype(jnp.float32)
    return jax.lax.reduce_window(image, -jnp.inf, jax.lax.max, (size, size), (1, 1), "SAME") > 0
