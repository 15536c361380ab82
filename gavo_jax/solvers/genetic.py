"""The genetic algorithm of the paper, equations (8) to (14), and the offspring that makes it precise.

With `spread` and `mutation_step` left out every operator is the paper's: a population uniform within the bounds,
fitness f = exp(−8 E/E_min), a roulette wheel by cumulative sum, 30 % mutants ξ' = ξ + p_m (ξ^U − ξ^L) randn,
intermediate crossover with a random α a gene, parents and offspring merged, sorted, and the best kept.

In preconditioned coordinates (`Problem`) E is close to a round bowl, so two things change: the population starts as a
normal cloud and the mutation's step is a number of grey levels that falls within each level. A third is added: one
offspring a generation is bred from the whole population, at the minimum of a quadratic fitted to its errors. It uses
evaluations only, no derivative, and replaces the slow last third of a search (`benchmarks/ablation.py`).
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Integer, PRNGKeyArray

from gavo_jax.objective import Problem
from gavo_jax.solvers.base import Best, Bounds, Candidates, PerLevel, Schedule, largest, static


class GeneticState(NamedTuple):
    """A population in the order of its errors, its offspring yet to be evaluated, and the mutation's present step."""

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
        population: Chromosomes (static, an entry a level).
        iterations: Largest number of generations (static, an entry a level; 0 skips the level).
        patience: Generations without progress that end a level (static).
        mutants: Share of the offspring that are mutants, 0.3 in the paper; the rest are crossed.
        surrogate: Whether one offspring is bred from a quadratic fit to the population (static).
        spread: Standard deviation of the first population about the guess, search units, an entry a level; None
            draws it uniformly within the bounds (9).
        mutation_step: First standard deviation of a mutation, search units, an entry a level; None takes
            δ = mutation_rate (ξ^U − ξ^L) (12).
        mutation_decay: Factor on the step from generation to generation; 1 in the paper.
        mutation_rate: p_m, 0.1 in the paper.
        crossover_range: d of the intermediate crossover: α is uniform in [−d, 1 + d] (13).
        pressure: Factor in the fitness, 8 in the paper (10).
    """

    population: Schedule = static((0, 16, 20, 24, 64))
    iterations: Schedule = static((0, 8, 8, 10, 12))
    patience: int = static(1000)
    mutants: float = 0.3
    surrogate: bool = static(True)
    spread: Schedule | None = (0.5, 0.5, 2.0, 3.0, 6.0)
    mutation_step: Schedule | None = (0.5, 0.5, 2.0, 3.0, 6.0)
    mutation_decay: float = 0.8
    mutation_rate: float = 0.1
    crossover_range: float = 0.25
    pressure: float = 8.0

    def init(self, key: PRNGKeyArray, problem: Problem, guess: Float[Array, "g 6"], bounds: Bounds) -> GeneticState:
        """First population (9)."""
        del problem
        places = largest(self.population)
        x = first_candidates(key, places, self.here(self.spread), guess, bounds)
        step = self.mutation_rate * (bounds.upper - bounds.lower)
        if self.mutation_step is not None:
            step = jnp.full(6, self.here(self.mutation_step))
        return GeneticState(x, jnp.full(places, jnp.inf), x, step, bounds)

    def step(self, key: PRNGKeyArray, state: GeneticState, problem: Problem) -> GeneticState:
        """One generation: evaluate the newcomers, keep the best (14), then select, cross and mutate.

        Places beyond the level's population stay empty: their error is +inf, and the wheel never draws them.
        """
        places, population = state.error.shape[0], self.here(self.population)
        present = jnp.arange(places) < population
        new_error, _ = problem.score(state.offspring, present)
        x = jnp.concatenate([state.population, state.offspring])
        error = jnp.concatenate([state.error, new_error])
        keep = jnp.argsort(error)[:places]
        state = state._replace(population=x[keep], error=jnp.where(present, error[keep], jnp.inf))
        chance = jax.random.uniform(key, (places, 8), minval=SMALLEST_CHANCE)
        parents = state.population[self._select(chance[:, 6:], state.error)]
        last = population - 1
        mutants = jnp.round(self.mutants * jnp.float32(population)).astype(jnp.int32)
        own = jnp.arange(places)[:, None]
        offspring = jnp.where(
            own > last - int(self.surrogate) - mutants,
            self._mutate(chance, parents, state),
            self._cross(chance, parents),
        )
        if self.surrogate:
            offspring = jnp.where(own == last, surrogate_minimum(state.population, state.error), offspring)
        new = jnp.clip(offspring, state.bounds.lower, state.bounds.upper)
        return state._replace(offspring=new, mutation_step=state.mutation_step * self.mutation_decay)

    def best(self, state: GeneticState) -> Best:
        """The first of the sorted population."""
        return Best(state.population[0], state.error[0])

    def candidates(self, state: GeneticState) -> Candidates:
        """The population, best first; NaN in the empty places."""
        present = jnp.arange(state.error.shape[0]) < self.here(self.population)
        return Candidates(jnp.where(present[:, None], state.population, jnp.nan), state.error)

    def _select(self, chance: Float[Array, "p 2"], error: Float[Array, " p"]) -> Integer[Array, "p 2"]:
        """Roulette wheel (11): indices drawn in proportion to the fitness f = exp(−8 E/E_min) (10)."""
        fitness = jnp.exp(-self.pressure * (error / jnp.maximum(error[0], 1e-12) - 1.0))
        up_to = np.triu(np.ones((error.shape[0],) * 2, np.float32))
        wheel = jnp.where(jnp.isfinite(error), fitness, 0.0) @ up_to  # a cumulative sum is many steps, this is one
        # all compared at once: a binary search is a loop, whose turns cost more than they save on a population
        places = jnp.searchsorted(wheel, chance * wheel[-1], method="compare_all")
        return jnp.minimum(places, error.shape[0] - 1)

    def _cross(self, chance: Float[Array, "p 8"], parents: Float[Array, "p 2 6"]) -> Float[Array, "p 6"]:
        """Intermediate crossover with an extra range (13): a + α (b − a), α drawn for every gene."""
        first, second = parents[:, 0], parents[:, 1]
        width = self.crossover_range
        alpha = -width + (1.0 + 2.0 * width) * chance[:, :6]
        return first + alpha * (second - first)

    def _mutate(
        self, chance: Float[Array, "p 8"], parents: Float[Array, "p 2 6"], state: GeneticState
    ) -> Float[Array, "p 6"]:
        """Mutation (12): ξ' = ξ + δ randn, of chromosomes drawn by the wheel."""
        return parents[:, 0] + state.mutation_step * _randn(chance[:, :6])


SMALLEST_CHANCE = 2.0**-24
"""A generation's random numbers are drawn at once, eight for each offspring, uniform from here to 1: six for its genes,
which are either crossed or mutated, and two for its parents. 0 would be a mutation of infinite size."""


def _randn(chance: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Standard normal numbers from uniform ones."""
    return jnp.sqrt(2.0) * jax.lax.erf_inv(2.0 * chance - 1.0)


def first_candidates(
    key: PRNGKeyArray,
    count: int,
    spread: Float[Array, ""] | float | None,
    guess: Float[Array, "g 6"],
    bounds: Bounds,
) -> Float[Array, "p 6"]:
    """First population: the guesses themselves, then a cloud about them, or uniform draws where `spread` is None."""
    about = guess[jnp.arange(count) % guess.shape[0]]
    chance = jax.random.uniform(key, (count, 8), minval=SMALLEST_CHANCE)[:, :6]
    x = bounds.lower + (bounds.upper - bounds.lower) * chance if spread is None else about + spread * _randn(chance)
    kept = jnp.arange(count)[:, None] < guess.shape[0]
    return jnp.clip(jnp.where(kept, about, x), bounds.lower, bounds.upper)


_PAIRS = np.triu_indices(6, 1)
RIDGE = 0.1
"""How strongly the fit leans to a round bowl; the problem's coordinates make it nearly one."""


def surrogate_minimum(x: Float[Array, "p 6"], error: Float[Array, " p"]) -> Float[Array, " 6"]:
    """Minimum of a quadratic fitted to evaluated candidates, best first, by weighted ridge regression.

    The bowl's mean curvature is fitted freely and its departures from roundness are shrunk, so that a population
    smaller than the 28 coefficients still gives a sound step. Candidates far above the best weigh little, and the
    step is held within four times the population's spread.
    """
    finite = jnp.isfinite(error)
    counted = finite.astype(jnp.float32)
    offset = jnp.where(finite[:, None], x - x[0], 0.0)
    count = jnp.maximum(jnp.sum(counted), 1.0)
    radius = jnp.sqrt(jnp.sum(offset**2) / (6.0 * count)) + 1e-6
    z = offset / radius
    height = jnp.where(finite, error - error[0], 0.0)
    height = height / (jnp.sum(height) / count + 1e-12)
    weight = counted / (1.0 + height) ** 2
    square = jnp.sum(z**2, axis=1, keepdims=True)
    features = jnp.concatenate(
        [jnp.ones_like(square), z, square, z**2 - square / 6.0, z[:, _PAIRS[0]] * z[:, _PAIRS[1]]], axis=1
    )
    penalty = jnp.concatenate([jnp.full(8, 1e-6), jnp.full(21, RIDGE)]) * jnp.sum(weight)
    weighted = features * weight[:, None]
    fit = jax.scipy.linalg.solve(weighted.T @ features + jnp.diag(penalty), weighted.T @ height, assume_a="pos")
    slope, bowl, uneven = fit[1:7], fit[7], fit[8:14] - jnp.mean(fit[8:14])
    cross = jnp.zeros((6, 6)).at[_PAIRS].set(fit[14:])
    values, vectors = jnp.linalg.eigh(jnp.diag(2.0 * (bowl + uneven)) + cross + cross.T)
    step = -vectors @ ((vectors.T @ slope) / jnp.maximum(values, 0.2 * jnp.maximum(bowl, 1e-3)))
    step = step * jnp.minimum(1.0, 4.0 / jnp.maximum(jnp.linalg.norm(step), 1e-9))
    return x[0] + radius * jnp.where(jnp.all(jnp.isfinite(step)), step, 0.0)
