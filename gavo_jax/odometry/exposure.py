"""How a camera exposes, and points of earlier frames as a later exposure would show them."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gavo_jax.image.pyramid import Pyramid
from gavo_jax.objective.estimates import MIDDLE_GREY, Brightness
from gavo_jax.objective.points import Reference

GAIN_CHANGED = 1.6
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


SLOW_GAIN, SLOW_SHIFT = 1.35, 40.0
"""Gain, or its reciprocal, and grey levels by which a medium grey changes, from which on earlier frames' points are
taken along: exposure that changes little by little adds up, beyond what a search estimates."""


def in_one_brightness(keyframe: Reference, newest: Reference, brightness: Brightness) -> tuple[Reference, Reference]:
    """A keyframe and the points that may renew it, as of one exposure: the keyframe's, or the newest frame's if that
    differs much.

    Args:
        keyframe: Points of earlier frames, all of one exposure.
        newest: The newest frame's points.
        brightness: Gain and bias that make the newest frame's grey of the keyframe's.
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
    """Points as they would be with another exposure, if it differs so much that a search would not find it."""
    gain = after.spread / jnp.maximum(before.spread, 0.1)
    differs = (before.spread > 0) & ((gain > GAIN_CHANGED) | (gain < 1.0 / GAIN_CHANGED))
    return _changed(reference, Brightness(gain, after.mean - gain * before.mean), differs)
