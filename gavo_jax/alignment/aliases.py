"""Self-similarity of a frame: on a repetitive pattern, a motion could win just because it was found first."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gavo_jax.alignment.evidence import evidence
from gavo_jax.image.sampling import Target
from gavo_jax.objective.error import Objective
from gavo_jax.se3 import exp

REACH = (20, 15)
"""Largest horizontal and vertical shifts that are tried, in pixels of the level."""
SHIFT_POINTS = 480
"""Number of points that a shift's evidence is taken on."""
LEAST_LIKENESS = 0.6
"""Ratio of a shift's evidence to that of no shift above which the shifted frame looks like itself."""
MOST_ALIASES = 4
"""Largest number of shifts that are kept, those with the most evidence."""
PEAK = 5
"""Width in pixels of the window in which a shift must be the maximum; shifts within half of it do not count."""


def self_motions(objective: Objective, own: Target) -> Float[Array, "k 4 4"]:
    """Find lateral and vertical motions after which a frame looks as before; NaN where there are fewer.

    Args:
        objective: Objective of a level, with the frame as its reference.
        own: The same frame, packed as a target.
    """
    plane, q = objective.plane, objective.reference.points.q
    here = replace(objective, target=own, backward=None)
    depth = 1.0 / jnp.maximum(jnp.sum(q) / jnp.maximum(jnp.sum(q > 0), 1.0), 1e-3)
    across, down = jnp.meshgrid(*(jnp.arange(-reach, reach + 1.0) for reach in REACH), indexing="ij")
    steps = jnp.stack([across.ravel() * depth / plane.fx, down.ravel() * depth / plane.fy], axis=-1)
    motions = exp(jnp.concatenate([steps, jnp.zeros((steps.shape[0], 4))], axis=-1))
    found = jax.lax.map(lambda motion: evidence(here, motion, SHIFT_POINTS), motions, batch_size=31)
    # over the points still in view, so that large shifts are not at a disadvantage
    likeness = jnp.where(found.total > 0.1 * jnp.max(found.total), found.seen, -jnp.inf).reshape(across.shape)
    around = jax.lax.reduce_window(likeness, -jnp.inf, jax.lax.max, (PEAK, PEAK), (1, 1), "SAME")
    is_alias = (likeness == around) & (likeness > LEAST_LIKENESS * jnp.max(likeness))
    is_alias &= jnp.maximum(jnp.abs(across), jnp.abs(down)) > PEAK // 2
    values, chosen = jax.lax.top_k(jnp.where(is_alias, likeness, -jnp.inf).ravel(), MOST_ALIASES)
    return jnp.where(jnp.isfinite(values)[:, None, None], motions[chosen], jnp.nan)
