"""E, its gradient and its Gauss-Newton Hessian at one motion, from sampled image gradients."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gavo_jax.camera import Camera, to_ray
from gavo_jax.image.levels import ImagePlane
from gavo_jax.image.shutter import delayed_slopes
from gavo_jax.image.warp import Slopes, Warped
from gavo_jax.objective.error import LINEARIZED_CHUNK, Objective, Residuals
from gavo_jax.objective.points import Reference


class Linearization(NamedTuple):
    """E, its gradient and its Gauss-Newton Hessian (with the loss's weights) at one motion, in search coordinates."""

    error: Float[Array, ""]
    overlap: Float[Array, ""]
    gradient: Float[Array, " 6"]
    hessian: Float[Array, "6 6"]


def pixel_jacobian(slopes: Slopes, warped: Warped, camera: Camera | ImagePlane) -> Float[Array, "6 n"]:
    """Derivative with respect to a step δ on the target's side, exp(δ) · target_T_reference, through u, v and 1/z."""
    (x, y), q = to_ray(camera, warped.u, warped.v), warped.inverse_depth
    pull_x, pull_y = slopes.along_u * camera.fx, slopes.along_v * camera.fy
    pull_z = -(pull_x * x + pull_y * y + slopes.along_inverse_depth * q)
    # a barrier, or XLA would compute the samples anew for each of the six rows
    x, y, q, pull_x, pull_y, pull_z = jax.lax.optimization_barrier((x, y, q, pull_x, pull_y, pull_z))
    turns = (y * pull_z - pull_y, pull_x - x * pull_z, x * pull_y - y * pull_x)
    return jnp.stack([q * pull_x, q * pull_y, q * pull_z, *turns]).reshape(6, -1)


def depth_slopes(along_u: Float[Array, "*n"], along_v: Float[Array, "*n"], facing: Float[Array, "*n"]) -> Slopes:
    """Slopes of depth residuals, from those of the inverse-depth image and its surface's inclination."""
    return Slopes(facing * along_u, facing * along_v, -facing)


Term = tuple[Float[Array, "6 n"], Float[Array, " n"], Float[Array, " n"]]
"""A channel's Jacobian, residuals and weights."""


def linearize(objective: Objective, motion: Float[Array, "4 4"], tangent: Float[Array, "6 6"]) -> Linearization:
    """E of one direction and its first two derivatives at a motion, in coordinates with step exp(tangent · dx)."""
    mean = objective.mean_residual(motion)

    def part(reference: Reference) -> tuple[jax.Array, jax.Array, jax.Array]:
        r = objective.residuals(motion, reference, mean)
        gradient, hessian = normal_equations(weighted_terms(objective, reference, r))
        return objective.sums(objective.cost(r)), gradient, hessian

    return linearization(objective, tangent, *objective.sum_over_points(part, LINEARIZED_CHUNK))


def linearization(
    objective: Objective, tangent: Float[Array, "6 6"], sums: jax.Array, gradient: jax.Array, hessian: jax.Array
) -> Linearization:
    """E and its derivatives from sums over the points: costs, number of points inside, and normal equations."""
    error, overlap = objective.error_and_overlap(sums)
    factor = 2.0 / objective.divisor(sums[1])
    return Linearization(error, overlap, factor * tangent.T @ gradient, factor * tangent.T @ hessian @ tangent)


def weighted_terms(objective: Objective, reference: Reference, r: Residuals) -> list[Term]:
    """Return each channel's J [6, N], r [N] and w [N], for a step on the target's side.

    Divided by the number of points, Σ J w r is half of E's gradient and Σ w J Jᵀ half of its Gauss-Newton Hessian.
    """
    scales, facing, shutter = objective.scales, reference.facing, objective.shutter(reference)
    grey, depth = r.grey_sample, r.depth_sample
    one = jnp.float32(1.0)
    along = Slopes(grey.along_u, grey.along_v, jnp.zeros_like(r.grey))
    channels = [(r.grey, scales.grey, r.inside, one, along)]
    if objective.use_depth:
        along = depth_slopes(depth.along_u, depth.along_v, facing)
        channels.append((r.depth, scales.depth, r.depth_valid, scales.depth_factor, along))
    terms = []
    for residual, scale, mask, factor, slopes in channels:
        if shutter is not None:
            slopes = delayed_slopes(slopes, reference.points, r.warped, shutter, objective.plane)
        jacobian = jnp.where(mask.reshape(-1) > 0, pixel_jacobian(slopes, r.warped, objective.plane), 0.0)
        s = (residual / scale) ** 2
        _, slope = jax.jvp(objective.loss, (s,), (jnp.ones_like(s),))
        weight = factor * jnp.where(mask > 0, slope, 0.0)
        terms.append((jacobian, residual.reshape(-1), weight.reshape(-1)))
    return terms


def normal_equations(terms: list[Term]) -> tuple[Float[Array, " 6"], Float[Array, "6 6"]]:
    """Σ J w r and Σ w J Jᵀ over the points of all channels."""
    gradient = jnp.asarray(sum(jacobian @ (weight * residual) for jacobian, residual, weight in terms))
    return gradient, jnp.asarray(sum((jacobian * weight) @ jacobian.T for jacobian, _, weight in terms))
