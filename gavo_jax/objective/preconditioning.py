"""Search coordinates in which a unit step in any direction changes the image equally."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gavo_jax.camera import to_pixels
from gavo_jax.image.warp import Slopes, Warped
from gavo_jax.objective.derivatives import depth_slopes, pixel_jacobian
from gavo_jax.objective.error import Objective


def reference_curvature(objective: Objective) -> Float[Array, "6 6"]:
    """A = mean of JᵀJ at zero motion from the reference frame alone: half the Hessian of E for a perfect match.

    J is taken in a step on the reference's side, target_T_reference = origin · exp(ξ), where it does not depend on
    the origin. No target is needed, so A is known before the search.
    """
    reference, plane, scales = objective.reference, objective.plane, objective.scales
    points, facing = reference.points, reference.facing
    valid = (points.q > 0).astype(jnp.float32)
    warped = Warped(*to_pixels(plane, points.x, points.y), points.q, valid)

    def curvature(slopes: Slopes) -> jax.Array:
        jacobian = pixel_jacobian(slopes, warped, plane) * valid.reshape(-1)
        return jacobian @ jacobian.T / jnp.maximum(jnp.sum(valid), 1.0)

    total = curvature(Slopes(reference.grey_u, reference.grey_v, jnp.zeros_like(valid)))
    if objective.use_depth:
        depth = curvature(depth_slopes(reference.slope_u, reference.slope_v, facing))
        total += scales.depth_factor * depth
    return total


LARGEST_UNIT_STEP = 0.05
"""Largest size of a unit step in directions that the image hardly constrains, metres or radians."""


def preconditioner(curvature: Float[Array, "6 6"]) -> Float[Array, "6 6"]:
    """Return B with BᵀAB = identity: B = V Λ^(−1/2) for A = V Λ Vᵀ, regularised where A is nearly singular."""
    ridge = jnp.eye(6) / LARGEST_UNIT_STEP**2
    values, vectors = jnp.linalg.eigh(curvature + ridge)
    return vectors * jax.lax.rsqrt(jnp.maximum(values, 1e-9))


def unconditioner(basis: Float[Array, "6 6"]) -> Float[Array, "6 6"]:
    """Return the inverse of a `preconditioner`, whose columns are orthogonal."""
    return (basis / jnp.sum(basis**2, axis=0)).T
