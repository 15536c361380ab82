"""Particle swarm optimisation with Clerc's constriction, the paper's first baseline."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from gavo_jax.objective.problem import Problem
from gavo_jax.solvers.base import Best, Bounds, Candidates, PerLevel, Schedule, largest, static, within
from gavo_jax.solvers.operators import initial_population


class SwarmState(NamedTuple):
    """Particles, their velocities and memories."""

    x: Float[Array, "p 6"]
    velocity: Float[Array, "p 6"]
    memory: Float[Array, "p 6"]
    memory_error: Float[Array, " p"]
    bounds: Bounds
    largest_velocity: Float[Array, " 6"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ParticleSwarm(PerLevel):
    """Global-best particle swarm: v' = χ (v + c₁ r₁ (memory − x) + c₂ r₂ (best − x)).

    Attributes:
        population: Number of particles (static, an entry per level).
        iterations: Largest number of iterations (static, an entry per level; 0 skips the level).
        patience: Iterations without progress that end a level (static).
        spread: Standard deviation of the initial particles about the guess, search units, an entry per level; None
            draws them uniformly within the bounds.
        constriction: χ; Clerc and Kennedy 2002 give 0.7298 for c₁ + c₂ = 4.1.
        cognitive: c₁, the pull towards a particle's own best.
        social: c₂, the pull towards the swarm's best.
        velocity_clamp: Largest velocity as a share of the bounds' width, or of 6 x spread if there is a spread.
    """

    population: Schedule = static((0, 20, 24, 32, 64), least=4)
    iterations: tuple[int, ...] = static((0, 12, 14, 16, 24))
    patience: int = static(1000, least=1)
    spread: Schedule | None = within((1.0, 1.0, 1.5, 2.0, 6.0), 0)
    constriction: float = within(0.7298, 0)
    cognitive: float = within(2.05, 0)
    social: float = within(2.05, 0)
    velocity_clamp: float = within(0.2, 0)

    def init(self, key: PRNGKeyArray, problem: Problem, guess: Float[Array, "g 6"], bounds: Bounds) -> SwarmState:
        """Place the particles about the guesses, at rest."""
        del problem
        places, spread = largest(self.population), self.here(self.spread)
        x = initial_population(key, places, spread, guess, bounds)
        width = bounds.upper - bounds.lower if spread is None else jnp.full(6, 6.0 * spread)
        unknown = jnp.full(places, jnp.inf)
        return SwarmState(x, jnp.zeros_like(x), x, unknown, bounds, self.velocity_clamp * width)

    def step(self, key: PRNGKeyArray, state: SwarmState, problem: Problem) -> SwarmState:
        """Evaluate the particles, then move each once; coordinates that reach a bound stop there.

        Places beyond the level's population stay empty: their error is +inf.
        """
        present = jnp.arange(state.x.shape[0]) < self.here(self.population)
        error, _ = problem.score(state.x, present)
        better = error < state.memory_error
        memory = jnp.where(better[:, None], state.x, state.memory)
        memory_error = jnp.where(better, error, state.memory_error)
        own, social = jax.random.uniform(key, (2, *state.x.shape))
        leader = memory[jnp.argmin(memory_error)]
        pull = self.cognitive * own * (memory - state.x) + self.social * social * (leader - state.x)
        velocity = self.constriction * (state.velocity + pull)
        velocity = jnp.clip(velocity, -state.largest_velocity, state.largest_velocity)
        moved = state.x + velocity
        x = jnp.clip(moved, state.bounds.lower, state.bounds.upper)
        velocity = jnp.where(x == moved, velocity, 0.0)
        return state._replace(x=x, velocity=velocity, memory=memory, memory_error=memory_error)

    def best(self, state: SwarmState) -> Best:
        """Return the swarm's best memory."""
        leader = jnp.argmin(state.memory_error)
        return Best(state.memory[leader], state.memory_error[leader])

    def candidates(self, state: SwarmState) -> Candidates:
        """Return the particles' memories; NaN in the empty places."""
        present = jnp.arange(state.x.shape[0]) < self.here(self.population)
        return Candidates(jnp.where(present[:, None], state.memory, jnp.nan), state.memory_error)
