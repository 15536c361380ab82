"""Distinct modes of E among many motions."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Integer

from gavo_jax.se3 import log

NICHE = (0.08, 0.08)
"""Metres and radians of ξ within which two motions count as one mode."""
CLEARED = 1e9
"""Added to the error of a motion whose mode is taken; above any error."""


def _niches(motions: Float[Array, "n 4 4"]) -> Float[Array, "n 6"]:
    """ξ in units of `NICHE`: what lies less than 1 apart counts as one mode."""
    return log(motions) / jnp.repeat(jnp.stack([jnp.float32(radius) for radius in NICHE]), 3)


def _near(places: Float[Array, "n 6"], index: Integer[Array, ""]) -> Bool[Array, " n"]:
    """Which motions share the mode of one of them."""
    return jnp.sum((places - places[index]) ** 2, axis=1) < 1.0


def best_distinct(motions: Float[Array, "n 4 4"], errors: Float[Array, " n"], count: int) -> Integer[Array, " k"]:
    """Indices of the `count` best motions with no two of one mode, best first (clearing, Petrowski 1996).

    Where there are fewer modes than that, the last places go to motions whose modes are taken.
    """
    if count == 1:
        return jnp.argmin(errors)[None]
    places = _niches(motions)

    def pick(cleared: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        best = jnp.argmin(cleared)
        return jnp.where(_near(places, best), cleared + CLEARED, cleared).at[best].set(jnp.inf), best

    worthless = jnp.where(jnp.isfinite(errors), jnp.minimum(errors, CLEARED / 2), 10 * CLEARED)
    return jax.lax.scan(pick, worthless, length=count)[1]


def rival_error(motions: Float[Array, "n 4 4"], errors: Float[Array, " n"]) -> Float[Array, ""]:
    """Error of the best motion outside the winner's mode, over the winner's; +inf where there is none."""
    best = jnp.argmin(errors)
    others = jnp.where(_near(_niches(motions), best), jnp.inf, errors)
    return jnp.min(others) / jnp.maximum(errors[best], 1e-6)
