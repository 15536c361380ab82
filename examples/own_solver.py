"""A custom solver: differential evolution (Storn and Price 1997), DE/best/1, beside the genetic algorithm.

Run it as `python examples/own_solver.py`.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

import gavo_jax as gavo
from gavo_jax.solvers import Best, Bounds, Candidates, PerLevel, Problem, Schedule, initial_population, static


class State(NamedTuple):
    """Candidates with their errors, the next trials, and the bounds."""

    x: Float[Array, "p 6"]
    error: Float[Array, " p"]
    trial: Float[Array, "p 6"]
    bounds: Bounds


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class DifferentialEvolution(PerLevel):
    """Mixes each candidate with a mutant: the best one plus a scaled difference of two others."""

    iterations: Schedule = static((0, 15, 15, 20, 30))
    patience: int = static(1000)
    population: int = static(32)
    weight: float = 0.6
    crossover: float = 0.9

    def init(self, key: PRNGKeyArray, problem: Problem, guess: Float[Array, "g 6"], bounds: Bounds) -> State:
        """A cloud around the guesses, in units of `Problem`: a step of 1 changes the image by a grey level."""
        x = initial_population(key, self.population, 3.0, guess, bounds)
        return State(x, jnp.full(self.population, jnp.inf), x, bounds)

    def step(self, key: PRNGKeyArray, state: State, problem: Problem) -> State:
        """Score the trials, keep those that are better, and make the next ones."""
        error, _ = problem.score(state.trial)
        better = error < state.error
        x, error = jnp.where(better[:, None], state.trial, state.x), jnp.where(better, error, state.error)
        keys = jax.random.split(key, 3)
        first, second = (x[jax.random.permutation(k, self.population)] for k in keys[:2])
        mutant = x[jnp.argmin(error)] + self.weight * (first - second)
        trial = jnp.where(jax.random.uniform(keys[2], x.shape) < self.crossover, mutant, x)
        return State(x, error, jnp.clip(trial, state.bounds.lower, state.bounds.upper), state.bounds)

    def best(self, state: State) -> Best:
        """The candidate of the smallest error."""
        return Best(state.x[jnp.argmin(state.error)], jnp.min(state.error))

    def candidates(self, state: State) -> Candidates:
        """All candidates with their errors."""
        return Candidates(state.x, state.error)


def main() -> gavo.Alignment:
    """Align two frames with it, then register it under a name."""
    sequence = gavo.SyntheticSequence(frames=2)
    pair = gavo.align(sequence[0], sequence[1], sequence.camera, DifferentialEvolution())
    first, second = sequence.ground_truth.world_T_camera
    off = 1e3 * np.linalg.norm(pair.target_T_reference[:3, 3] - (np.linalg.inv(second) @ first)[:3, 3])
    print(f"{pair.status}: {off:.2f} mm off the exact motion, error {float(pair.error):.2f}")
    gavo.register("differential-evolution", DifferentialEvolution())
    assert isinstance(gavo.preset("differential-evolution").solver, gavo.solvers.Solver)
    return pair


if __name__ == "__main__":
    main()
