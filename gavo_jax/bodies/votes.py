"""Votes of an image's area between two motions: which one explains each block better.

The comparison needs one measure. So the residuals of both are taken on pixels that both see, in units of the scale that
the better one leaves.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gavo_jax.bodies.consensus import LEAST_DEPTH, LEAST_GREY, STRIDE, block_sums, median_by_bisection, surface_area
from gavo_jax.bodies.pixel_evidence import View, compare
from gavo_jax.camera import Camera
from gavo_jax.compilation.programs import CachedProgram

DECISIVE = 6.0
"""Difference of two costs from which on a block casts its whole vote."""
QUORUM = 0.5
"""Share of the area that has to be in view of both for a margin to count in full."""
FREEDOM = 5.0
"""Degrees of freedom of the t-distribution that defines a pixel's cost (Kerl et al. 2013)."""


class Margin(NamedTuple):
    """By how much the second motion is ahead of the first, from -1 to 1."""

    whole: Float[Array, ""]
    """The margin in the whole image."""
    far: Float[Array, ""]
    """The margin in the far part of the image alone."""


@partial(CachedProgram, returns=(Margin,))
def vote(here: View, there: View, motions: Float[Array, "2 4 4"], near: Bool[Array, "h w"], camera: Camera) -> Margin:
    """Have the blocks of a view choose between two motions into another; a block counts by the area of its surface.

    Args:
        here: The view whose blocks vote.
        there: The other view.
        motions: The two motions there_T_here.
        near: Pixels of `here` outside its far part.
        camera: Camera of the views' level.
    """
    others = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), there)
    compared = compare(here, others, motions, camera, STRIDE)
    r, q = compared.residuals, compared.inverse_depth
    has = q > 0
    cost = jnp.zeros_like(r.grey)
    for residual, mask, least in ((r.grey, r.inside, LEAST_GREY), (r.depth, r.depth_valid, LEAST_DEPTH)):
        both = jnp.all(mask > 0, axis=0) & has
        better = jnp.where(both, jnp.min(jnp.abs(residual), axis=0), 0.0)
        scale = jnp.maximum(1.48 * median_by_bisection(better, both), least)
        t = jnp.log1p((residual / scale) ** 2 / FREEDOM)
        cost += jnp.where(both, 0.5 * (FREEDOM + 1.0) * t, 0.0)
    seen = jnp.all(r.inside > 0, axis=0) & has
    area = surface_area(q)
    far = jnp.where(near[::STRIDE, ::STRIDE].reshape(-1), 0.0, area)
    sums = block_sums(jnp.stack([*cost, area, far, area * seen, far * seen]), camera)
    first, second, area, far, area_seen, far_seen = sums
    vote = jnp.clip((first - second) / DECISIVE, -1.0, 1.0)

    def margin(seen: jax.Array, every: jax.Array) -> jax.Array:
        return jnp.sum(seen * vote) / jnp.maximum(jnp.sum(seen), QUORUM * jnp.sum(every) + 1e-6)

    return Margin(margin(area_seen, area), margin(far_seen, far))
