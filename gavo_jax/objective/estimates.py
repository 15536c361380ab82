"""Estimates from the data before a level is searched: scales, brightness, and trust in depth and in the match."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gavo_jax.objective.error import Objective, Residuals, Scales
from gavo_jax.objective.points import SATURATED

ROUNDS = 6
"""Number of iterations of the re-weighted estimates below; each reduces the remaining error several times."""


def _t_weight(s: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Weight of residuals under a t distribution of 5 degrees of freedom (Kerl et al. 2013), s = (r/σ)²."""
    return 6.0 / (5.0 + s)


def _t_scales(residual: Float[Array, "c n"], mask: Float[Array, "c n"]) -> Float[Array, " c"]:
    """Scales of t distributions fitted to the masked residuals of some channels, by fixed-point iteration."""
    square = mask * residual**2
    count = jnp.maximum(jnp.sum(mask, axis=1), 1.0)

    def refine(_: int, variance: jax.Array) -> jax.Array:
        return jnp.sum(square * _t_weight(square / jnp.maximum(variance[:, None], 1e-20)), axis=1) / count

    return jnp.sqrt(jax.lax.fori_loop(0, ROUNDS, refine, jnp.sum(square, axis=1) / count))


SMALLEST_GREY_SCALE = 0.5
"""Lower bound on the grey scale, grey levels: rounding alone causes 0.3."""
SMALLEST_DEPTH_SCALE = 5e-4
"""Lower bound on the depth scale, 1/m: a sixth of the quantisation of a structured-light sensor."""


def _independent_share(
    residual: jax.Array, mask: jax.Array, scale: jax.Array, columns: jax.Array | int
) -> Float[Array, ""]:
    """Share of a channel's residuals that are effectively independent, from the correlation of neighbours.

    n_eff/n = ∏ (1 − ρ)/(1 + ρ) over the two image directions, ρ being the lag-one correlation of the weighted residuals
    (an autoregressive model along either direction). Where depth and colour are not synchronous, whole surfaces share
    their error: ρ is near 1 and the share falls to a few per cent.
    """
    weighted = mask * residual * _t_weight((residual / scale) ** 2)
    place = jnp.arange(residual.shape[-1])
    share = jnp.float32(1.0)
    for step, has_next in ((1, place % columns < columns - 1), (columns, True)):
        following, following_mask = (
            jnp.take(a, place + step, axis=-1, mode="fill", fill_value=0.0) for a in (weighted, mask)
        )
        both = mask * following_mask * has_next
        product = jnp.sum(both * weighted * following)
        power = 0.5 * jnp.sum(both * (weighted**2 + following**2))
        rho = jnp.clip(product / jnp.maximum(power, 1e-20), 0.0, 0.98)
        share *= (1.0 - rho) / (1.0 + rho)
    return share


FULL_DEPTH_RATIO = 0.3
"""Ratio of the independent share of depth residuals to that of grey ones above which depth has its whole weight."""
LEAST_DEPTH_TRUST = 1 / 3
"""Share of its weight that depth always keeps."""


def depth_trust(objective: Objective, target_T_reference: Float[Array, "4 4"], scales: Scales) -> Float[Array, ""]:
    """Factor on depth's weight: 1, falling to a third where depth residuals, more than grey's, are correlated."""
    r = objective.residuals(target_T_reference)
    depth = _independent_share(r.depth, r.depth_valid, scales.depth, objective.columns)
    grey = _independent_share(r.grey, lit_in_both(r), scales.grey, objective.columns)
    return jnp.clip(depth / grey / FULL_DEPTH_RATIO, LEAST_DEPTH_TRUST, 1.0)


def lit_in_both(r: Residuals) -> Float[Array, "*n"]:
    """Return 1 where a point is inside and saturated in neither image, else 0.

    Two saturated pixels agree whatever the motion, and would make the noise seem smaller than it is.
    """
    return r.inside * r.lit * (r.grey_sample.value < SATURATED)


def estimate_scales(r: Residuals, depth_weight: jax.Array | float) -> Scales:
    """Estimate the scales of the grey and depth residuals of one motion; the weight of depth is as given."""
    found = jnp.maximum(measured_scales(r), jnp.array([SMALLEST_GREY_SCALE, SMALLEST_DEPTH_SCALE]))
    return Scales(found[0], found[1], jnp.float32(depth_weight))


def measured_scales(r: Residuals) -> Float[Array, "2"]:
    """Return the scales of the grey and depth residuals of one motion, without lower bounds."""
    residual = jnp.stack([r.grey, r.depth]).reshape(2, -1)
    mask = jnp.stack([lit_in_both(r), r.depth_valid]).reshape(2, -1)
    return _t_scales(residual, mask)


class Brightness(NamedTuple):
    """Gain and bias of every view, [V]: I_{t+1}(ω(ξ, p)) ≈ gain · I_t(p) + bias."""

    gain: Float[Array, "*v"]
    bias: Float[Array, "*v"]

    @classmethod
    def unchanged(cls, views: int) -> "Brightness":
        """Return the model in which every view is as bright as the target."""
        return cls(jnp.ones(views), jnp.zeros(views))

    def seen(self, grey: Float[Array, "v n"]) -> Float[Array, "v n"]:
        """Return the grey of the views' points as the target shows it, at most white."""
        return jnp.minimum(self.gain[:, None] * grey + self.bias[:, None], WHITE)


def estimate_brightness(grey: Float[Array, "v n"], r: Residuals) -> Brightness:
    """Estimate each view's brightness at one motion, by re-weighted regression of the samples on the reference's grey.

    The gain is drawn towards 1 where the image has little contrast.
    """
    mask = lit_in_both(r)
    sample = jnp.where(mask > 0, r.grey_sample.value, MIDDLE_GREY) - MIDDLE_GREY
    features = jnp.stack([jnp.ones_like(grey), grey - MIDDLE_GREY, sample], axis=1)

    def refine(_: int, estimate: tuple[Brightness, jax.Array]) -> tuple[Brightness, jax.Array]:
        brightness, variance = estimate
        square = (sample + MIDDLE_GREY - brightness.seen(grey)) ** 2
        mean = jnp.sum(mask * square * _t_weight(square / variance), axis=1) / jnp.maximum(jnp.sum(mask, axis=1), 1.0)
        variance = jnp.maximum(mean, SMALLEST_GREY_SCALE**2)[:, None]
        weight = mask * _t_weight(square / variance)
        moments = jnp.einsum("vin,vn,vjn->vij", features, weight, features)
        moments /= jnp.maximum(moments[:, :1, :1], 1e-6)
        mean_source, mean_sample = moments[:, 0, 1], moments[:, 0, 2]
        spread, covariance = moments[:, 1, 1] - mean_source**2, moments[:, 1, 2] - mean_source * mean_sample
        gain = jnp.clip((covariance + GAIN_PRIOR) / (spread + GAIN_PRIOR), 1.0 / LARGEST_GAIN, LARGEST_GAIN)
        bias = mean_sample + MIDDLE_GREY - gain * (mean_source + MIDDLE_GREY)
        return Brightness(gain, bias), variance

    start = (Brightness.unchanged(grey.shape[0]), jnp.full((grey.shape[0], 1), 1e4))
    return jax.lax.fori_loop(0, ROUNDS, refine, start)[0]


WHITE = 255.0
"""Largest grey level of an image."""
MIDDLE_GREY = 128.0
"""Grey level that moments are taken about, to preserve precision."""
LARGEST_GAIN = 1.8
"""Upper bound on the estimated gain and on its reciprocal: the regression of an image on one that does not match it
would give 0, which hides contrast."""
GAIN_PRIOR = 100.0
"""Variance of the image, squared grey levels, at which the gain is half-way between 1 and the regression's."""
LARGE_GREY_RESIDUAL = 12.0
"""Grey levels above which a residual is large: a true match stays below, except at edges and occlusions."""
LARGE_DEPTH_RESIDUAL = 0.03
"""1/m above which a residual is large: ten times the quantisation of a structured-light sensor."""


class ExplainedShare(NamedTuple):
    """Share of a motion's residuals that are not large."""

    grey: Float[Array, ""]
    depth: Float[Array, ""]


def explained_share(residuals: Residuals) -> ExplainedShare:
    """Return the share of residuals that a motion explains, over points in view with a reading.

    It is NaN where there are no such points.
    """
    r = residuals
    grey = jnp.where(r.lit > 0, r.grey, jnp.minimum(r.grey, 0.0))  # saturated pixels may have been brighter

    def share(residual: jax.Array, mask: jax.Array, large: float) -> jax.Array:
        return jnp.sum(mask * (jnp.abs(residual) < large)) / jnp.sum(mask)

    return ExplainedShare(
        share(grey, r.inside, LARGE_GREY_RESIDUAL), share(r.depth, r.depth_valid, LARGE_DEPTH_RESIDUAL)
    )
