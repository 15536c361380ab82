"""First-order descent with an optax optimiser on the same objective."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from gavo_jax.objective.problem import Problem
from gavo_jax.solvers.base import Best, Bounds, Candidates, PerLevel, Schedule, static, within


class GradientState(NamedTuple):
    """The last evaluated iterate and its error, the next iterate, the optimiser's state and the current rate."""

    x: Float[Array, " 6"]
    error: Float[Array, ""]
    trial: Float[Array, " 6"]
    optimizer: optax.OptState
    rate: Float[Array, ""]
    bounds: Bounds


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GradientDescent(PerLevel):
    """Descent along ∇E by any optax optimiser that takes a learning rate; Adam by default.

    The gradient comes from sampled image gradients (`Problem.linearize`), not from reverse mode through the gather.

    Attributes:
        iterations: Largest number of steps (static, an entry per level; 0 skips the level).
        patience: Steps without progress that end a level (static).
        learning_rate: Initial learning rate (Adam's first step) in search units, an entry per level.
        decay: Factor on the rate from step to step.
        optimizer: optax's constructor, called with a learning rate of 1 (static).
    """

    iterations: tuple[int, ...] = static((0, 30, 40, 50, 60))
    patience: int = static(15, least=1)
    learning_rate: Schedule = within((0.5, 0.5, 1.0, 2.0, 4.0), 0)
    decay: float = within(0.93, 0)
    optimizer: Callable[[float], optax.GradientTransformation] = static(optax.adam)

    def init(self, key: PRNGKeyArray, problem: Problem, guess: Float[Array, "g 6"], bounds: Bounds) -> GradientState:
        """Start from the first guess."""
        del key, problem
        x, unknown = guess[0], jnp.float32(jnp.inf)
        return GradientState(
            x, unknown, x, self.optimizer(1.0).init(x), jnp.float32(self.here(self.learning_rate)), bounds
        )

    def step(self, key: PRNGKeyArray, state: GradientState, problem: Problem) -> GradientState:
        """Evaluate the iterate and take one step of the optimiser, scaled by the decaying rate."""
        del key
        x = state.trial
        model = problem.linearize(x)
        updates, optimizer_state = self.optimizer(1.0).update(model.gradient, state.optimizer, x)
        trial = jnp.clip(x + state.rate * jnp.asarray(updates), state.bounds.lower, state.bounds.upper)
        return GradientState(x, model.error, trial, optimizer_state, state.rate * self.decay, state.bounds)

    def best(self, state: GradientState) -> Best:
        """Return the iterate."""
        return Best(state.x, state.error)

    def candidates(self, state: GradientState) -> Candidates:
        """Return only the iterate."""
        return Candidates(state.x[None], state.error[None])
