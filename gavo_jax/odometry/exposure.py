"""How a camera exposes, and points of earlier frames as a later exposure would show them."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from gavo_jax.image.pyramid import Pyramid
from gavo_jax.objective.points import Reference

LARGEST_GAIN = 1.6
"""Ratio of two images' contrasts beyond which the camera must have changed its gain; below, views may differ by that
much, and the search estimates the gain itself."""


class Exposure(NamedTuple):
    """How bright an image is, and how rich in contrast: mean and standard deviation, grey levels."""

    mean: Float[Array, ""]
    spread: Float[Array, ""]

    @classmethod
    def of(cls, pyramid: Pyramid) -> "Exposure":
        """Measure it on the coarsest level, where noise adds nothing to the contrast."""
        grey = pyramid[-1].grey
        return cls(jnp.mean(grey), jnp.maximum(jnp.std(grey), 0.1))


def in_exposure(reference: Reference, before: Exposure, after: Exposure) -> Reference:
    """Points as they would be with another exposure, if it differs so much that a search would not find it."""
    gain = after.spread / jnp.maximum(before.spread, 0.1)
    differs = (before.spread > 0) & ((gain > LARGEST_GAIN) | (gain < 1.0 / LARGEST_GAIN))
    gain = jnp.where(differs, gain, 1.0)
    grey = jnp.where(differs, gain * (reference.grey - before.mean) + after.mean, reference.grey)
    return reference._replace(grey=grey, grey_u=gain * reference.grey_u, grey_v=gain * reference.grey_v)
