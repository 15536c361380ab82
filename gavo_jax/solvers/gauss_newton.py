"""The classic energy-based method: Gauss-Newton on E with the loss's weights, the paper's second baseline."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from gavo_jax.objective.derivatives import Linearization
from gavo_jax.objective.problem import Problem
from gavo_jax.solvers.base import Best, Bounds, Candidates, PerLevel, static, within


class GaussNewtonState(NamedTuple):
    """The iterate, E's quadratic model there, the step to be tried next, and the damping."""

    x: Float[Array, " 6"]
    model: Linearization
    trial: Float[Array, " 6"]
    damping: Float[Array, ""]
    bounds: Bounds


STEP_ACCEPTED, STEP_REFUSED = 0.3, 10.0
"""Factors on the damping after a step that lowered E, and after one that didn't."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GaussNewton(PerLevel):
    """Gauss-Newton steps, damped (Levenberg-Marquardt) so that E never rises.

    A robust loss makes it the re-weighted least squares of Kerl et al. 2013; with L2 it is the classic method.

    Attributes:
        iterations: Largest number of steps (static, an entry per level; 0 skips the level).
        patience: Steps without progress that end a level (static).
        damping: Initial damping, relative to the Hessian's diagonal.
    """

    iterations: tuple[int, ...] = static((0, 12, 12, 15, 20))
    patience: int = static(3, least=1)
    damping: float = within(1e-4, 0)

    def init(self, key: PRNGKeyArray, problem: Problem, guess: Float[Array, "g 6"], bounds: Bounds) -> GaussNewtonState:
        """Start from the first guess."""
        del key, problem
        unknown = jnp.float32(jnp.inf)
        model = Linearization(unknown, jnp.float32(0.0), jnp.zeros(6), jnp.zeros((6, 6)))
        return GaussNewtonState(guess[0], model, guess[0], jnp.float32(self.damping / STEP_ACCEPTED), bounds)

    def step(self, key: PRNGKeyArray, state: GaussNewtonState, problem: Problem) -> GaussNewtonState:
        """Linearise at the trial, keep it if E fell, and solve the damped normal equations for the next one."""
        del key
        model = problem.linearize(state.trial)
        better = model.error < state.model.error
        x, model = jax.tree.map(lambda a, b: jnp.where(better, a, b), (state.trial, model), (state.x, state.model))
        damping = jnp.where(better, state.damping * STEP_ACCEPTED, state.damping * STEP_REFUSED + 1e-3)
        damping = jnp.clip(damping, 1e-6, 1e6)
        damped = model.hessian + damping * jnp.diag(jnp.diag(model.hessian) + 1e-6)
        trial = x - jax.scipy.linalg.solve(damped, model.gradient, assume_a="pos")
        trial = jnp.where(jnp.all(jnp.isfinite(trial)), jnp.clip(trial, state.bounds.lower, state.bounds.upper), x)
        return GaussNewtonState(x, model, trial, damping, state.bounds)

    def best(self, state: GaussNewtonState) -> Best:
        """Return the iterate."""
        return Best(state.x, state.model.error)

    def candidates(self, state: GaussNewtonState) -> Candidates:
        """Return only the iterate."""
        return Candidates(state.x[None], state.model.error[None])
