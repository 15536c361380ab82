"""Exposure of images, and points of earlier frames as a later exposure would show them."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gavo_jax.image.pyramid import Pyramid
from gavo_jax.objective.estimates import MIDDLE_GREY, Brightness
from gavo_jax.objective.points import Reference

GAIN_CHANGED = 1.6
"""Ratio of two images' contrasts beyond which the camera must have changed its gain. Below it the views alone may
explain the ratio, and the search estimates the gain itself.
"""


class Exposure(NamedTuple):
    """Brightness and contrast of an image: mean and standard deviation, grey levels."""

    mean: Float[Array, ""]
    spread: Float[Array, ""]

    @classmethod
    def of(cls, pyramid: Pyramid) -> "Exposure":
        """Measure the exposure on the coarsest level, where noise adds nothing to the contrast."""
        grey = pyramid[-1].grey
        return cls(jnp.mean(grey), jnp.maximum(jnp.std(grey), 0.1))


SLOW_GAIN, SLOW_SHIFT = 1.35, 40.0
"""Gain, or its reciprocal, and change of a medium grey in grey levels, above which earlier points are adapted to the
newest frame. Slow changes of exposure add up beyond what a search estimates.
"""


def in_one_brightness(keyframe: Reference, newest: Reference, brightness: Brightness) -> tuple[Reference, Reference]:
    """Bring a keyframe and the points that may renew it to one exposure.

    It is the keyframe's exposure, or the newest frame's if the two differ much.

    Args:
        keyframe: Points of earlier frames, all of one exposure.
        newest: The newest frame's points.
        brightness: Gain and bias that turn the keyframe's grey into the newest frame's.
    """
    gain, bias = brightness
    shift = (gain - 1.0) * MIDDLE_GREY + bias
    differs = (jnp.maximum(gain, 1.0 / gain) > SLOW_GAIN) | (jnp.abs(shift) > SLOW_SHIFT)
    there, back = Brightness(gain, bias), Brightness(1.0 / gain, -bias / gain)
    return _changed(keyframe, there, differs), _changed(newest, back, ~differs)


def _changed(reference: Reference, brightness: Brightness, applies: Bool[Array, ""]) -> Reference:
    gain, bias = jnp.where(applies, brightness.gain, 1.0), jnp.where(applies, brightness.bias, 0.0)
    return reference.brightened(gain, bias)


def in_exposure(reference: Reference, before: Exposure, after: Exposure) -> Reference:
    """Points as another exposure would show them, if it differs too much for a search to estimate it."""
    gain = after.spread / jnp.maximum(before.spread, 0.1)
    differs = (before.spread > 0) & ((gain > GAIN_CHANGED) | (gain < 1.0 / GAIN_CHANGED))
    return _changed(reference, Brightness(gain, after.mean - gain * before.mean), differs)
