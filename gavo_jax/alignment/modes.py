"""Distinct modes of E among many motions."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Integer

from gavo_jax.se3 import log

NICHE = (0.08, 0.08)
"""Metres and radians of ξ within which two motions count as one mode."""
NOT_FINITE, PICKED = 10**6, 10**9
"""Counts that rank a motion whose error is not finite, and one that was already chosen, behind all others."""


def _niches(motions: Float[Array, "n 4 4"]) -> Float[Array, "n 6"]:
    """Return ξ in units of `NICHE`: motions less than 1 apart count as one mode."""
    return log(motions) / jnp.repeat(jnp.stack([jnp.float32(radius) for radius in NICHE]), 3)


def _near(places: Float[Array, "n 6"], index: Integer[Array, ""]) -> Bool[Array, " n"]:
    """Whether motions share the mode of the one with the given index."""
    return jnp.sum((places - places[index]) ** 2, axis=1) < 1.0


def best_distinct(motions: Float[Array, "n 4 4"], errors: Float[Array, " n"], count: int) -> Integer[Array, " k"]:
    """Return the indices of the `count` best motions of distinct modes, best first (clearing, Petrowski 1996).

    If there are fewer modes than that, the remaining places go to the best motions of the modes chosen least often,
    and only then to motions whose error is not finite.
    """
    if count == 1:
        return jnp.argmin(errors)[None]
    places, is_finite = _niches(motions), jnp.isfinite(errors)
    errors = jnp.where(is_finite, errors, jnp.finfo(errors.dtype).max)

    def pick(taken: Integer[Array, " n"], _: None) -> tuple[Integer[Array, " n"], Integer[Array, ""]]:
        best = jnp.argmin(jnp.where(taken == jnp.min(taken), errors, jnp.inf))
        return (taken + _near(places, best)).at[best].set(PICKED), best

    return jax.lax.scan(pick, jnp.where(is_finite, 0, NOT_FINITE), length=count)[1]


def rival_error(
    motions: Float[Array, "n 4 4"], errors: Float[Array, " n"], best: Integer[Array, ""]
) -> Float[Array, ""]:
    """Return the smallest error outside the mode of the motion with index `best`; +inf if there is none."""
    return jnp.min(jnp.where(_near(_niches(motions), best), jnp.inf, errors))
