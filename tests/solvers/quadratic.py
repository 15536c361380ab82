"""Analytic stand-ins for `gavo_jax.objective.problem.Problem`: the solvers are handed nothing else of it."""

import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gavo_jax.objective.derivatives import Linearization
from gavo_jax.solvers.base import Bounds, Solution, solve


def cube(half_width: float) -> Bounds:
    """Bounds of ± half_width about 0."""
    return Bounds(jnp.full(6, -half_width, jnp.float32), jnp.full(6, half_width, jnp.float32))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Quadratic:
    """E(x) = floor + (x − centre)ᵀ A (x − centre).

    Attributes:
        centre: [6].
        curvature: A, [6, 6].
        floor: E at the centre.
        box: outside it E is far below any E inside: whoever evaluates there gives himself away.
        blind_below: E is infinite where the first coordinate is below this.
    """

    centre: jax.Array
    curvature: jax.Array
    floor: float = 1.0
    box: Bounds = cube(math.inf)
    blind_below: float = -math.inf

    def score(self, x: jax.Array, counted: jax.Array | bool = True) -> tuple[jax.Array, jax.Array]:
        """Errors and overlaps of [p, 6]; those that are not counted have an error of +inf."""
        offset = x - self.centre[None]
        error = self.floor + jnp.sum((offset @ self.curvature) * offset, axis=1)
        outside = jnp.any((x < self.box.lower[None]) | (x > self.box.upper[None]), axis=1)
        error = jnp.where(x[:, 0] < self.blind_below, jnp.inf, jnp.where(outside, -1e6, error))
        return jnp.where(counted, error, jnp.inf), jnp.ones_like(error)

    def linearize(self, x: jax.Array) -> Linearization:
        """E, its gradient and Hessian at [6]."""
        error, overlap = self.score(x[None])
        return Linearization(error[0], overlap[0], 2.0 * self.curvature @ (x - self.centre), 2.0 * self.curvature)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Given:
    """Errors looked up by the first gene, rounded to an index: populations whose errors the test decides."""

    errors: jax.Array

    def score(self, x: jax.Array, counted: jax.Array | bool = True) -> tuple[jax.Array, jax.Array]:
        """Errors and overlaps of [p, 6]; those that are not counted have an error of +inf."""
        error = self.errors[jnp.clip(jnp.round(x[:, 0]), 0, self.errors.shape[0] - 1).astype(jnp.int32)]
        return jnp.where(counted, error, jnp.inf), jnp.ones_like(error)


def bowl(seed: int = 0, spread: float = 3.0, reach: float = 1.5) -> Quadratic:
    """A quadratic with axes along random directions, curvatures within `spread` of each other, its centre off zero."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    curvature = axes @ np.diag(np.geomspace(1, spread, 6)) @ axes.T
    return Quadratic(jnp.asarray(rng.uniform(-reach, reach, 6), jnp.float32), jnp.asarray(curvature, jnp.float32))


def search(key: jax.Array, solver: Any, problem: Any, guess: jax.Array, bounds: Bounds) -> Solution:
    """The loop under test, on anything that looks like a problem."""
    return solve(key, solver, problem, guess, bounds)
