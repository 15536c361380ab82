"""An objective in search coordinates, as solvers see it."""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gavo_jax.objective.derivatives import (
    Linearization,
    Term,
    linearization,
    linearize,
    normal_equations,
    weighted_terms,
)
from gavo_jax.objective.error import Objective, Residuals, both_directions
from gavo_jax.se3 import adjoint, exp, right_jacobian, rigid_inverse

TILES = (8, 6)
"""Tiles across and down the image, for `Problem.scatter`."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Problem:
    """An objective in search coordinates x: target_T_reference = origin · exp(basis · x).

    With origin = basis = identity x is ξ itself, the paper's chromosome. With `precondition` a unit step in any
    direction of x changes the image by one grey level.
    """

    objective: Objective
    origin: Float[Array, "4 4"]
    basis: Float[Array, "6 6"]
    centre: Float[Array, "4 4"] | None = None
    """Motion at the centre of the search; `reach` is the largest translation (m) and rotation (rad) from it, beyond
    which a candidate is invalid. None: only the solver's bounds limit the search."""
    reach: Float[Array, " 2"] | None = None
    searched: Bool[Array, ""] | bool = True
    """Whether to search at all; if not, every candidate of a population is invalid and none costs anything."""

    def with_sway(self, twist: Float[Array, " 6"]) -> "Problem":
        """Return the problem with a sway of the target; see `alignment.sway`."""
        return replace(self, objective=replace(self.objective, sway=twist))

    def transform(self, x: Float[Array, "*batch 6"]) -> Float[Array, "*batch 4 4"]:
        """Return target_T_reference for search coordinates."""
        return self.origin @ exp(x @ self.basis.T)

    def score(
        self, x: Float[Array, "p 6"], counted: Bool[Array, " p"] | None = None
    ) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        """Errors and overlaps of P candidates; NaN becomes +inf here, for every population.

        Candidates that are not `counted` have an error of +inf and cost nothing on a CPU. They are the empty places of
        a population that is smaller on one level than on another.
        """
        # a barrier, or XLA would compute each motion anew for each of its 16 entries
        motions = jax.lax.optimization_barrier(self.transform(x))
        counted = jnp.ones(x.shape[0], bool) if counted is None else counted
        error, overlap = self.objective.score(motions, counted & self.searched)
        return jnp.where(jnp.isnan(error) | self.is_out_of_reach(motions), jnp.inf, error), overlap

    def is_out_of_reach(self, motions: Float[Array, "*p 4 4"]) -> Bool[Array, "*p"]:
        """Whether motions lie beyond `reach` from the centre."""
        if self.centre is None or self.reach is None:
            return jnp.zeros(motions.shape[:-2], bool)
        offset = rigid_inverse(self.centre) @ motions
        turned = jnp.linalg.norm(offset[..., :3, :3] - jnp.eye(3), axis=(-2, -1))
        farthest = 2.0**1.5 * jnp.sin(0.5 * jnp.minimum(self.reach[1], jnp.pi))  # ‖R − I‖ of that angle
        return (jnp.linalg.norm(offset[..., :3, 3], axis=-1) > self.reach[0]) | (turned > farthest)

    def linearize(self, x: Float[Array, " 6"]) -> Linearization:
        """E and its first two derivatives, from sampled image gradients instead of reverse-mode differentiation."""
        motion, tangent = self._tangent(x)
        model = linearize(self.objective, motion, tangent)
        backward = self.objective.backward
        if backward is None:
            return model
        inverse = rigid_inverse(motion)
        other = linearize(backward, inverse, -adjoint(inverse) @ tangent)
        error, overlap = both_directions(model[:2], other[:2])
        return Linearization(error, overlap, *(0.5 * (a + b) for a, b in zip(model[2:], other[2:], strict=True)))

    def linearize_residuals(self, r: Residuals) -> Linearization:
        """E and its derivatives at x = 0 from its residuals; from the reference to the target only."""
        return self.linearize_terms(r, weighted_terms(self.objective, self.objective.reference, r))

    def linearize_terms(self, r: Residuals, terms: list[Term]) -> Linearization:
        """E and its derivatives at x = 0 from its residuals and each channel's terms."""
        sums = self.objective.sums(self.objective.cost(r))
        return linearization(self.objective, self.tangent, sums, *normal_equations(terms))

    def scatter(self, r: Residuals, terms: list[Term]) -> Float[Array, "6 6"]:
        """Covariance of E's gradient at x = 0; from the reference to the target only.

        It comes from the gradient's spread over tiles of the target image. Residuals of neighbouring pixels are
        correlated, but tiles are nearly independent. With the inverse Hessian on both sides this gives the
        cluster-robust ("sandwich") covariance of an M-estimate.
        """
        objective, plane = self.objective, self.objective.plane
        column = jnp.clip(r.warped.u * (TILES[0] / plane.width), 0, TILES[0] - 1).astype(jnp.int32)
        row = jnp.clip(r.warped.v * (TILES[1] / plane.height), 0, TILES[1] - 1).astype(jnp.int32)
        tile = (row * TILES[0] + column).reshape(-1)
        pull = jnp.asarray(sum(jacobian * (weight * residual) for jacobian, residual, weight in terms))
        sum_by_tile = partial(jax.ops.segment_sum, segment_ids=tile, num_segments=TILES[0] * TILES[1])
        by_tile = self.tangent.T @ jax.vmap(sum_by_tile)(pull)
        by_tile *= 2.0 / objective.divisor(jnp.sum(r.inside))
        used = jnp.sum(jnp.any(by_tile != 0, axis=0))
        return (by_tile @ by_tile.T) * used / jnp.maximum(used - 1, 1)

    def examine(self, r: Residuals) -> tuple[Linearization, Float[Array, "6 6"], list[Term]]:
        """Return E's derivatives at x = 0 from its residuals, its gradient's covariance, and the channels' terms."""
        # a barrier, or XLA would compute them anew for each use
        terms = jax.lax.optimization_barrier(weighted_terms(self.objective, self.objective.reference, r))
        return self.linearize_terms(r, terms), self.scatter(r, terms), terms

    @property
    def tangent(self) -> Float[Array, "6 6"]:
        """Jacobian J with transform(dx) ≈ exp(J dx) · origin."""
        return adjoint(self.origin) @ self.basis

    def _tangent(self, x: Float[Array, " 6"]) -> tuple[Float[Array, "4 4"], Float[Array, "6 6"]]:
        """Return the motion, and J with transform(x + dx) ≈ exp(J dx) · motion."""
        motion = self.transform(x)
        return motion, adjoint(motion) @ right_jacobian(self.basis @ x) @ self.basis
