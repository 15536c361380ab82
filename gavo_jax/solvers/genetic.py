"""The genetic algorithm of the paper, equations (9) to (14); its operators are in `operators`.

Without `surrogate`, `spread` and `mutation_step` it is the paper's: a population uniform within the bounds, fitness, a
roulette wheel, 30 % mutants, intermediate crossover, parents and offspring merged and the best kept.

In preconditioned coordinates (`Problem`) E is close to isotropic, so three things change. The population starts as a
normal cloud. The mutation step is in grey levels and decays within each level. One offspring per generation is bred
from the whole population (`surrogate_minimum`).
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from gavo_jax.objective.problem import Problem
from gavo_jax.solvers.base import Best, Bounds, Candidates, PerLevel, Schedule, largest, static, within
from gavo_jax.solvers.operators import (
    crossover,
    draw,
    fitness,
    initial_population,
    mutate,
    roulette,
    surrogate_minimum,
    survive,
)


class GeneticState(NamedTuple):
    """A population sorted by error, its offspring yet to be evaluated, and the current mutation step."""

    population: Float[Array, "p 6"]
    error: Float[Array, " p"]
    offspring: Float[Array, "p 6"]
    mutation_step: Float[Array, " 6"]
    bounds: Bounds


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GeneticAlgorithm(PerLevel):
    """The paper's genetic algorithm.

    Attributes:
        population: Number of chromosomes (static, an entry per level).
        iterations: Largest number of generations (static, an entry per level; 0 skips the level).
        patience: Generations without progress that end a level (static).
        mutants: Share of the offspring that are mutants, 0.3 in the paper; the rest are crossed.
        surrogate: Whether one offspring is bred from a quadratic fit to the population (static).
        spread: Standard deviation of the first population about the guess, search units, an entry per level; None
            draws it uniformly within the bounds, as the paper does.
        mutation_step: First standard deviation of a mutation, search units, an entry per level; None takes
            δ = mutation_rate (ξ^U − ξ^L), as the paper does.
        mutation_decay: Factor on the step from generation to generation; 1 in the paper.
        mutation_rate: p_m, 0.1 in the paper; used only if `mutation_step` is None.
        crossover_range: d of the intermediate `crossover`: α is uniform in [−d, 1 + d].
        pressure: Factor in the `fitness`, 8 in the paper.
    """

    population: Schedule = static((0, 16, 20, 24, 64), least=4)
    iterations: tuple[int, ...] = static((0, 8, 8, 10, 12))
    patience: int = static(1000, least=1)
    mutants: float = within(0.3, 0, 1)
    surrogate: bool = static(True)
    spread: Schedule | None = within((0.5, 0.5, 2.0, 3.0, 6.0), 0)
    mutation_step: Schedule | None = within((0.5, 0.5, 2.0, 3.0, 6.0), 0)
    mutation_decay: float = within(0.8, 0, 1)
    mutation_rate: float = within(0.1, 0, 1, instead_of="mutation_step")
    crossover_range: float = within(0.25, 0)
    pressure: float = within(8.0, 0)

    def init(self, key: PRNGKeyArray, problem: Problem, guess: Float[Array, "g 6"], bounds: Bounds) -> GeneticState:
        """Make the first population, yet to be evaluated."""
        del problem
        places = largest(self.population)
        x = initial_population(key, places, self.here(self.spread), guess, bounds)
        step = self.mutation_rate * (bounds.upper - bounds.lower)
        if self.mutation_step is not None:
            step = jnp.full(6, self.here(self.mutation_step))
        return GeneticState(x, jnp.full(places, jnp.inf), x, step, bounds)

    def step(self, key: PRNGKeyArray, state: GeneticState, problem: Problem) -> GeneticState:
        """Run one generation: evaluate the offspring, let the best survive, then select, cross and mutate.

        Places beyond the level's population stay empty: their error is +inf, and the wheel never draws them.
        """
        places, size = state.error.shape[0], self.here(self.population)
        present = jnp.arange(places) < size
        offspring_error, _ = problem.score(state.offspring, present)
        population, error = survive(state.population, state.error, state.offspring, offspring_error, present)
        chance = draw(key, places)
        for_genes, for_parents = chance[:, :6], chance[:, 6:]
        parents = population[roulette(fitness(error, self.pressure), for_parents)]
        crossed = crossover(parents, for_genes, self.crossover_range)
        mutated = mutate(parents[:, 0], for_genes, state.mutation_step)
        # crossed offspring first, then the mutants, then in the last present place the one from the quadratic fit
        own, last = jnp.arange(places)[:, None], size - 1
        mutants = jnp.round(self.mutants * jnp.float32(size)).astype(jnp.int32)
        offspring = jnp.where(own > last - int(self.surrogate) - mutants, mutated, crossed)
        if self.surrogate:
            offspring = jnp.where(own == last, surrogate_minimum(population, error), offspring)
        offspring = jnp.clip(offspring, state.bounds.lower, state.bounds.upper)
        return GeneticState(population, error, offspring, state.mutation_step * self.mutation_decay, state.bounds)

    def best(self, state: GeneticState) -> Best:
        """Return the first of the sorted population."""
        return Best(state.population[0], state.error[0])

    def candidates(self, state: GeneticState) -> Candidates:
        """Return the population, best first; NaN in the empty places."""
        present = jnp.arange(state.error.shape[0]) < self.here(self.population)
        return Candidates(jnp.where(present[:, None], state.population, jnp.nan), state.error)
