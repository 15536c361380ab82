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


SHARPNESS_LEVEL = 1
"""Level of the pyramid on which sharpness is measured: on the finest one noise would count too."""
MAX_STEEPNESS = 0.75
"""Largest steepness, over the variance: of fine texture, a shift of less than a pixel makes all of E that there can be,
twice the variance.
"""


class Exposure(NamedTuple):
    """Brightness, contrast and sharpness of an image."""

    mean: Float[Array, ""]
    """Grey levels."""
    spread: Float[Array, ""]
    """Standard deviation, grey levels."""
    sharpness: Float[Array, ""]
    """Steepness over the squared contrast: the squared difference of neighbouring pixels, averaged and added over both
    directions, and at most `MAX_STEEPNESS` of the variance.
    """

    @classmethod
    def of(cls, pyramid: Pyramid) -> "Exposure":
        """Measure brightness and contrast on the coarsest level, where noise adds nothing to the contrast."""
        coarse, fine = pyramid[-1].grey, pyramid[SHARPNESS_LEVEL].grey
        spread = jnp.maximum(jnp.std(coarse), 0.1)
        steepness = sum(jnp.mean(jnp.diff(fine, axis=axis) ** 2) for axis in (0, 1))
        return cls(jnp.mean(coarse), spread, jnp.minimum(steepness, MAX_STEEPNESS * jnp.var(fine)) / spread**2)

    def error_per_pixel(self, before: "Exposure") -> Float[Array, ""]:
        """About the photometric error E after a shift of one pixel of level `SHARPNESS_LEVEL`, squared grey levels.

        E between two images depends on contrast and sharpness: it rises when a camera stops, whose motion had blurred
        its images. The sharper of the two images counts.

        Args:
            before: Exposure of the reference.
        """
        found = self.spread**2 * jnp.maximum(self.sharpness, before.sharpness)
        return jnp.maximum(found, 0.01)  # images without any texture


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
