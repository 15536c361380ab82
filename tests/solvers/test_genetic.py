"""The genetic algorithm with the paper's operators, one by one, as it uses them."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from quadratic import Given, bowl, cube

from gavo_jax.solvers.base import Bounds
from gavo_jax.solvers.genetic import GeneticAlgorithm, GeneticState

WIDE = cube(100.0)


def paper(population: int, mutants: float = 0.3, mutation_rate: float = 0.1) -> GeneticAlgorithm:
    """One level of the paper's algorithm."""
    solver = GeneticAlgorithm(
        population=(population,),
        iterations=(1,),
        mutants=mutants,
        surrogate=False,
        spread=None,
        mutation_step=None,
        mutation_decay=1.0,
        mutation_rate=mutation_rate,
    )
    return solver.at_level(0)


@jax.jit
def first_step(
    key: jax.Array, solver: GeneticAlgorithm, problem: Any, guess: jax.Array, bounds: Bounds
) -> GeneticState:
    """The state after one generation; its `offspring` are the first ones bred."""
    return solver.step(key, solver.init(key, problem, guess, bounds), problem)


many_first_steps = jax.jit(jax.vmap(first_step, in_axes=(0, None, None, None, None)))


def members(count: int) -> jax.Array:
    """Chromosomes (i, 0, …, 0), which `Given` looks its errors up by."""
    return jnp.zeros((count, 6)).at[:, 0].set(jnp.arange(count, dtype=jnp.float32))


def test_roulette_draws_in_proportion_to_the_fitness() -> None:
    errors = np.array([3.0, 2.0, 2.2, 2.6, 2.05])
    # all mutants that do not move: the offspring are what the wheel drew
    solver = paper(len(errors), mutants=1.0, mutation_rate=0.0)
    keys = jax.random.split(jax.random.key(0), 4000)
    drawn = many_first_steps(keys, solver, Given(jnp.asarray(errors, jnp.float32)), members(5), WIDE).offspring
    counts = np.bincount(np.rint(np.asarray(drawn[..., 0])).astype(int).reshape(-1), minlength=5)
    fitness = np.exp(-8 * errors / errors.min())
    assert scipy.stats.chisquare(counts, counts.sum() * fitness / fitness.sum()).pvalue > 1e-3


def test_roulette_never_draws_the_worthless() -> None:
    errors = jnp.array([jnp.inf, 1.0, jnp.inf, 1.1])
    solver = paper(4, mutants=1.0, mutation_rate=0.0)
    keys = jax.random.split(jax.random.key(1), 500)
    drawn = np.asarray(many_first_steps(keys, solver, Given(errors), members(4), WIDE).offspring[..., 0])
    assert set(np.unique(np.rint(drawn))) == {1.0, 3.0}


def test_an_error_of_zero_is_no_trouble() -> None:
    solver = paper(4, mutants=1.0, mutation_rate=0.0)
    state = first_step(jax.random.key(0), solver, Given(jnp.array([1.0, 0.0, 2.0, 3.0])), members(4), WIDE)
    np.testing.assert_array_equal(state.offspring, members(4)[jnp.array([1, 1, 1, 1])])


def test_mutation_is_the_rate_times_the_bounds_width() -> None:
    bounds = Bounds(jnp.array([-4.0, -2, -1, -8, -0.4, -40]), jnp.array([4.0, 3, 1, 8, 0.6, 40]))
    solver = paper(4000, mutants=1.0, mutation_rate=0.05)
    x = first_step(jax.random.key(0), solver, bowl(), jnp.zeros((4000, 6)), bounds).offspring
    delta = 0.05 * np.asarray(bounds.upper - bounds.lower)
    for gene in range(6):
        assert scipy.stats.kstest(np.asarray(x[:, gene]), "norm", (0, delta[gene])).pvalue > 1e-3
    independent = np.corrcoef(np.asarray(x).T) - np.eye(6)
    assert np.abs(independent).max() < 0.07


def test_mutation_step_and_decay() -> None:
    solver = replace(paper(500, mutants=1.0), mutation_step=3.0, mutation_decay=0.5)
    state = first_step(jax.random.key(0), solver, bowl(), jnp.zeros((500, 6)), WIDE)
    assert np.std(state.offspring) == pytest.approx(3.0, rel=0.05)
    np.testing.assert_allclose(state.mutation_step, 1.5)


def test_thirty_per_cent_are_mutants() -> None:
    # children of one and the same parent are that parent, unless they mutate
    state = first_step(jax.random.key(0), paper(40), bowl(), jnp.ones((40, 6)), WIDE)
    moved = np.any(np.asarray(state.offspring) != 1.0, axis=1)
    assert state.offspring.shape == (40, 6)
    assert moved.sum() == 12
    assert np.all(np.asarray(state.offspring)[moved] != 1.0), "a mutant changes in every gene"


@pytest.mark.parametrize("width", [0.0, 0.25, 0.5])
def test_crossover_range(width: float) -> None:
    solver = replace(paper(2000, mutants=0.0), crossover_range=width)
    guesses = jnp.tile(jnp.stack([jnp.zeros(6), jnp.ones(6)]), (1000, 1))
    equal = Given(jnp.ones(3))
    x = np.asarray(first_step(jax.random.key(0), solver, equal, guesses, WIDE).offspring)
    assert x.min() >= -width - 1e-6 and x.max() <= 1 + width + 1e-6
    mixed = x[np.any((x != 0) & (x != 1), axis=1)]
    assert 800 < len(mixed) < 1200, "half of the couples are of two different parents"
    for gene in range(6):
        assert scipy.stats.kstest(mixed[:, gene], "uniform", (-width, 1 + 2 * width)).pvalue > 1e-3
    assert np.abs(np.corrcoef(mixed.T) - np.eye(6)).max() < 0.15, "α is drawn for every gene"


def test_the_best_of_parents_and_offspring_survive() -> None:
    problem: Any = bowl(seed=7)
    solver = paper(30)
    state = first_step(jax.random.key(0), solver, problem, jnp.zeros((1, 6)), cube(3.0))
    for i in range(5):
        everyone = np.concatenate([state.population, state.offspring])
        errors = np.concatenate([state.error, problem.score(state.offspring)[0]])
        state = solver.step(jax.random.key(i), state, problem)
        np.testing.assert_allclose(state.error, np.sort(errors)[:30], rtol=1e-5)
        np.testing.assert_allclose(state.population, everyone[np.argsort(errors, kind="stable")[:30]], rtol=1e-5)
        assert solver.best(state).error == state.error[0]


def test_offspring_stay_within_the_bounds() -> None:
    bounds = cube(0.5)
    state = first_step(jax.random.key(0), replace(paper(200), mutation_rate=3.0), bowl(), jnp.zeros((1, 6)), bounds)
    assert np.abs(state.offspring).max() == 0.5
