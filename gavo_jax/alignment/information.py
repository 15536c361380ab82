"""Information of two frames about each direction of motion, compared with that of noise alone.

The Hessian of E is a sum of squared image gradients, and noise has gradients too: a textureless wall looks as well
determined as a picture. The noise of two frames is independent, though. So each direction's information is taken from
products of a point's gradient in the reference with its gradient in the target. What both frames show adds up, what
only one shows cancels, and the variance of what remains by chance is known.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gavo_jax.camera import to_pixels
from gavo_jax.image.warp import Slopes, Warped
from gavo_jax.objective.derivatives import Term, depth_slopes, pixel_jacobian
from gavo_jax.objective.error import Residuals
from gavo_jax.objective.points import Reference
from gavo_jax.objective.problem import Problem

SIGNIFICANCE = 4.0
"""Number of standard deviations of noise alone below which a direction's information counts as none."""
BY_MANY = 20.0
"""The same for tempered information, in which no point counts much more than others: 400 points have to agree. The few
steepest points may hold most of the information, whose variance then hides what all the others tell. Fewer points, as
along the edges of a plain corridor, do not show how far they can be trusted.
"""
MIN_ALIGNED_SHARE = 1e-3
"""Mean squared cosine between image gradients and a direction's flow below which its information counts as none.
Interpolated gradients are wrong by two or three per cent, so that a stripe seems to constrain motion along itself."""
SAMPLED_POINTS = 4800
"""Number of evenly spread points that the information is taken from if there are twice as many or more."""
MIN_INFORMATION = 0.01
"""Squared grey levels per m² or rad² below which information counts as none, whatever the number of points."""


class Information(NamedTuple):
    """Six directions δ of a step on the reference's side, orthogonal in the optical flow that they cause."""

    directions: Float[Array, "6 6"]
    """The directions as columns; metres and radians."""
    curvature: Float[Array, " 6"]
    """Curvature of E along the directions, as far as both frames confirm it."""
    determined: Bool[Array, " 6"]
    """Whether that curvature exceeds what noise and interpolation would give."""

    def inverse(self) -> Float[Array, "6 6"]:
        """Inverse of E's Hessian over the determined directions; 0 along the others."""
        values = jnp.where(self.determined, 1.0 / jnp.where(self.determined, self.curvature, 1.0), 0.0)
        return (self.directions * values) @ self.directions.T


def measure_information(problem: Problem, r: Residuals, terms: list[Term], is_body: Bool[Array, ""]) -> Information:
    """Measure the frames' information at the problem's origin, given its residuals and `weighted_terms`.

    Information from a few steep points has a large variance, which could mask that of depth. For a body, grey and depth
    are therefore also tested separately. For the whole image they are not: where grey settles on a wrong match, depth
    that determines the other directions would confirm it.
    """
    objective, plane, every = problem.objective, problem.objective.plane, max(1, r.inside.shape[-1] // SAMPLED_POINTS)
    factor = 2.0 * every / objective.divisor(jnp.sum(r.inside))
    reference, r, terms = jax.tree.map(lambda leaf: leaf[..., ::every], (objective.reference, r, terms))
    points = reference.points
    here = Warped(*to_pixels(plane, points.x, points.y), points.q, jnp.ones_like(points.q))
    nothing, one = jnp.zeros_like(points.q), jnp.ones_like(points.q)

    def step(along_u: jax.Array, along_v: jax.Array, along_inverse_depth: jax.Array) -> jax.Array:
        return pixel_jacobian(Slopes(along_u, along_v, along_inverse_depth), here, plane)

    flow_u, flow_v, flow_q = step(one, nothing, nothing), step(nothing, one, nothing), step(nothing, nothing, one)
    possible, products, noise = jnp.zeros((6, 6)), [], []
    for seen, (target, _, weight) in zip(_slopes(reference, r, objective.use_depth), terms, strict=True):
        before, after = seen
        weight = factor * weight
        first = step(before.along_u, before.along_v, before.along_inverse_depth)
        second = problem.tangent.T @ target
        product = (first * weight) @ second.T
        products.append(0.5 * (product + product.T))
        across = weight * (_steepness(before) * _steepness(after)).reshape(-1)
        possible += (flow_u * across) @ flow_u.T + (flow_v * across) @ flow_v.T
        along = weight * (before.along_inverse_depth**2).reshape(-1)
        possible += (flow_q * along) @ flow_q.T
        noise.append((weight, first, second))
    directions = _whitening(possible + MIN_INFORMATION * jnp.eye(6))
    values, turn = jnp.linalg.eigh(directions.T @ sum(products) @ directions)
    directions = directions @ turn
    told = jnp.stack([jnp.sum(directions * (product @ directions), axis=0) for product in products])
    parts = [weight * (directions.T @ a) * (directions.T @ b) for weight, a, b in noise]
    variance = jnp.stack([jnp.sum(part**2, axis=1) for part in parts])
    is_told = values > SIGNIFICANCE * jnp.sqrt(jnp.sum(variance, axis=0))
    is_told |= _is_told_by_many(parts[0])
    is_told |= is_body & jnp.any(told > SIGNIFICANCE * jnp.sqrt(variance), axis=0)
    return Information(directions, values, is_told & (values > MIN_ALIGNED_SHARE))


def _is_told_by_many(products: Float[Array, "6 n"]) -> Bool[Array, " 6"]:
    """Whether products of grey gradients add up when they are tempered, so that each counts at most as one."""
    usual = jnp.mean(jnp.sqrt(jnp.abs(products)), axis=1, keepdims=True) ** 2
    tempered = products / (jnp.abs(products) + usual + 1e-30)
    return jnp.sum(tempered, axis=1) > BY_MANY * jnp.sqrt(jnp.sum(tempered**2, axis=1))


def _slopes(reference: Reference, r: Residuals, use_depth: bool) -> list[tuple[Slopes, Slopes]]:
    """Return each channel's slopes, of the reference and of the target."""
    facing = reference.facing
    flat = jnp.zeros_like(facing)
    grey = Slopes(reference.grey_u, reference.grey_v, flat), Slopes(r.grey_sample.along_u, r.grey_sample.along_v, flat)
    if not use_depth:
        return [grey]
    before = depth_slopes(reference.slope_u, reference.slope_v, facing)
    after = depth_slopes(r.depth_sample.along_u, r.depth_sample.along_v, facing)
    return [grey, (before, after)]


def _steepness(slopes: Slopes) -> Float[Array, "*n"]:
    return jnp.sqrt(slopes.along_u**2 + slopes.along_v**2)


def _whitening(possible: Float[Array, "6 6"]) -> Float[Array, "6 6"]:
    """Return W with Wᵀ A W = identity for a positive semi-definite A, regularised where it is singular."""
    size = jnp.sqrt(jnp.maximum(jnp.diag(possible), 1e-12))  # metres and radians on one footing
    values, vectors = jnp.linalg.eigh(possible / jnp.outer(size, size))
    return vectors * jax.lax.rsqrt(jnp.maximum(values, 1e-5)) / size[:, None]
