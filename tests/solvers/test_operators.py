"""The operators, each by itself on arrays that the test gives."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from quadratic import Quadratic, bowl, cube

from gavo_jax.solvers.base import Bounds
from gavo_jax.solvers.operators import (
    SMALLEST_CHANCE,
    crossover,
    draw,
    fitness,
    initial_population,
    mutate,
    roulette,
    surrogate_minimum,
    survive,
)

WIDE = cube(100.0)


def test_first_population_is_uniform_within_the_bounds() -> None:
    bounds = Bounds(jnp.array([-1.0, 0, 2, -5, 0.1, -1]), jnp.array([1.0, 0.5, 3, 5, 0.2, 0]))
    guess = (bounds.lower + bounds.upper)[None] / 2
    x = np.asarray(initial_population(jax.random.key(0), 4000, None, guess, bounds))
    np.testing.assert_array_equal(x[0], guess[0])
    for gene in range(6):
        low, high = float(bounds.lower[gene]), float(bounds.upper[gene])
        assert scipy.stats.kstest(x[1:, gene], "uniform", (low, high - low)).pvalue > 1e-3


def test_first_population_with_a_spread_is_a_cloud_about_the_guesses() -> None:
    guesses = jnp.stack([jnp.zeros(6), jnp.full(6, 50.0)])
    x = np.asarray(initial_population(jax.random.key(0), 4000, 2.0, guesses, WIDE))
    np.testing.assert_array_equal(x[:2], guesses)
    for offset in (x[2::2] - 0.0, x[3::2] - 50.0):
        assert np.std(offset) == pytest.approx(2.0, rel=0.05)
        np.testing.assert_allclose(offset.mean(axis=0), 0, atol=0.3)


def test_fitness_falls_with_the_error_over_the_least() -> None:
    errors = np.array([2.0, 2.05, 2.5, 4.0])
    found = fitness(jnp.asarray(errors, jnp.float32), 8.0)
    expected = np.exp(-8 * errors / errors.min())
    np.testing.assert_allclose(found / found.sum(), expected / expected.sum(), rtol=1e-4)


def test_only_a_finite_error_is_fit() -> None:
    np.testing.assert_array_equal(fitness(jnp.array([1.0, jnp.inf, jnp.nan]), 8.0), [1, 0, 0])
    np.testing.assert_array_equal(fitness(jnp.full(3, jnp.inf), 8.0), 0)


def test_the_wheel_stops_where_the_cumulative_sum_says() -> None:
    chance = jnp.array([[SMALLEST_CHANCE, 0.09], [0.11, 0.59], [0.61, 1.0]])
    np.testing.assert_array_equal(roulette(jnp.array([1.0, 5.0, 4.0]), chance), [[0, 0], [1, 1], [2, 2]])
    assert np.all(roulette(jnp.array([0.0, 1.0, 0.0]), chance) == 1)


def test_mutation_moves_each_gene_by_normal_numbers_of_its_own_size() -> None:
    delta = jnp.array([1.0, 0.0, 0.1, 2.0, 3.0, 0.5])
    chance = draw(jax.random.key(0), 4000)[:, :6]
    moved = np.asarray(mutate(jnp.ones((4000, 6)), chance, delta)) - 1.0
    np.testing.assert_allclose(moved, scipy.stats.norm.ppf(chance) * delta, atol=2e-4)
    assert np.all(np.isfinite(mutate(jnp.ones((1, 6)), jnp.full((1, 6), SMALLEST_CHANCE), delta)))


def test_crossover_takes_each_gene_from_between_the_parents_and_a_bit_beyond() -> None:
    parents = jnp.stack([jnp.zeros((3, 6)), jnp.arange(6.0) * jnp.ones((3, 6))], axis=1)
    chance = jnp.array([0.0, 0.5, 1.0])[:, None] * jnp.ones(6)
    expected = np.array([-0.25, 0.5, 1.25])[:, None] * np.arange(6)
    np.testing.assert_allclose(crossover(parents, chance, 0.25), expected, rtol=1e-6)


def test_survivors_are_the_best_of_both_generations() -> None:
    parents, offspring = jnp.zeros((4, 6)).at[:, 0].set(jnp.arange(4.0)), jnp.ones((4, 6)).at[:, 0].set(jnp.arange(4.0))
    errors, offspring_errors = jnp.array([1.0, 3.0, 5.0, jnp.inf]), jnp.array([jnp.inf, 2.0, 9.0, 1.0])
    x, error = survive(parents, errors, offspring, offspring_errors, jnp.arange(4) < 3)
    np.testing.assert_array_equal(error, [1, 1, 2, np.inf])
    np.testing.assert_array_equal(x[:3, :2], [[0, 0], [3, 1], [1, 1]])


jit_surrogate = jax.jit(surrogate_minimum)


def evaluated(problem: Quadratic, count: int, seed: int, spread: float = 1.0) -> tuple[jax.Array, jax.Array]:
    """A population about the origin in the order of its errors."""
    x = jnp.asarray(np.random.default_rng(seed).normal(0, spread, (count, 6)), jnp.float32)
    error, _ = problem.score(x)
    order = jnp.argsort(error)
    return x[order], error[order]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_fit_finds_the_minimum_of_a_round_bowl_from_few(seed: int, scale: float) -> None:
    problem = replace(bowl(seed, spread=1.0, reach=scale), floor=scale**2)
    x, error = evaluated(problem, 12, seed, spread=scale)
    found = jit_surrogate(x, error)
    nearest = np.linalg.norm(x - problem.centre, axis=1).min()
    assert np.linalg.norm(found - problem.centre) < 0.02 * nearest


@pytest.mark.parametrize("seed", range(3))
def test_fit_gets_close_to_the_minimum_of_an_elongated_bowl(seed: int) -> None:
    problem = bowl(seed, spread=4.0, reach=1.0)
    x, error = evaluated(problem, 64, seed)
    found = jit_surrogate(x, error)
    excess = float(problem.score(found[None])[0][0]) - problem.floor
    assert excess < 0.1 * (float(error[0]) - problem.floor)


def test_fit_survives_worthless_candidates() -> None:
    problem = bowl(1, spread=1.0)
    x, error = evaluated(problem, 24, 1)
    found = jit_surrogate(x, error.at[16:].set(jnp.inf))
    nearest = np.linalg.norm(x - problem.centre, axis=1).min()
    assert np.linalg.norm(found - problem.centre) < 0.1 * nearest
    one = jit_surrogate(x, jnp.full(24, jnp.inf).at[0].set(1.0))
    np.testing.assert_allclose(one, x[0], atol=1e-3)
    assert np.all(np.isfinite(jit_surrogate(x, jnp.full(24, jnp.inf))))


def test_fit_to_one_and_the_same_candidate_stays_there() -> None:
    x = jnp.ones((24, 6))
    np.testing.assert_allclose(jit_surrogate(x, jnp.full(24, 3.0)), x[0], atol=1e-3)


def test_fit_never_leaps_away() -> None:
    # a saddle has no minimum: the step stays within the population's reach
    problem = Quadratic(jnp.zeros(6), jnp.diag(jnp.array([1.0, 1, 1, -1, -1, -1])))
    x, error = evaluated(problem, 64, 3)
    assert np.linalg.norm(jit_surrogate(x, error) - x[0]) < 10.0
