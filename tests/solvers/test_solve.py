"""Every solver on every problem, through the one loop: the axioms that hold for all of them."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from quadratic import Quadratic, bowl, cube, search

from gavo_jax.solvers.base import Bounds, Solution, diversity_stop, stagnation, static_stop
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.solvers.genetic import GeneticAlgorithm
from gavo_jax.solvers.gradient import GradientDescent
from gavo_jax.solvers.particle_swarm import ParticleSwarm

# one entry a level; the tests use level 0 alone
SOLVERS: dict[str, Any] = {
    "ga": GeneticAlgorithm(population=(48,), iterations=(30,), spread=(2.0,), mutation_step=(1.0,)),
    "ga-crossed": GeneticAlgorithm(
        population=(64,), iterations=(60,), surrogate=False, spread=(2.0,), mutation_step=(1.0,), mutation_decay=0.93
    ),
    "ga-paper": GeneticAlgorithm(
        population=(96,),
        iterations=(120,),
        patience=40,
        surrogate=False,
        spread=None,
        mutation_step=None,
        mutation_decay=1.0,
        mutation_rate=0.03,
    ),
    "pso": ParticleSwarm(population=(40,), iterations=(80,), spread=(2.0,)),
    "pso-uniform": ParticleSwarm(population=(40,), iterations=(80,), spread=None),
    "gauss-newton": GaussNewton(iterations=(12,)),
    "adam": GradientDescent(iterations=(120,), learning_rate=(0.3,), decay=0.97),
    "sgd": GradientDescent(iterations=(120,), learning_rate=(0.1,), decay=1.0, optimizer=optax.sgd),
}
DERIVATIVE_FREE = ("ga", "ga-crossed", "ga-paper", "pso", "pso-uniform")
TOLERANCE = {"ga-crossed": 0.3, "ga-paper": 0.6, "adam": 0.03}
"""How far from the minimum a run may end, in units in which the first population reaches over 4; 0.01 elsewhere."""

BOX = cube(4.0)
GUESS = jnp.zeros((1, 6))
jit_search = jax.jit(search)


def run(name: str, problem: Any, seed: int = 0, bounds: Bounds = BOX, guess: jax.Array = GUESS) -> Solution:
    return jit_search(jax.random.key(seed), SOLVERS[name].at_level(0), problem, guess, bounds)


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("spread", [1.0, 4.0], ids=["round", "elongated"])
def test_finds_the_minimum(name: str, spread: float) -> None:
    problem = bowl(seed=1, spread=spread)
    solution = run(name, problem)
    distance = np.linalg.norm(solution.x - problem.centre)
    assert distance < TOLERANCE.get(name, 0.01)
    assert float(solution.error) == pytest.approx(float(problem.score(solution.x[None])[0][0]), rel=1e-5)


@pytest.mark.parametrize("name", SOLVERS)
def test_best_so_far_never_rises(name: str) -> None:
    solution = run(name, bowl(seed=2))
    count = int(solution.iterations)
    history = np.asarray(solution.history)
    assert history.shape == (SOLVERS[name].iterations[0],)
    assert np.all(np.diff(history[:count]) <= 0) and np.all(np.isnan(history[count:]))
    assert history[count - 1] == solution.error


@pytest.mark.parametrize("name", SOLVERS)
def test_same_key_same_bits(name: str) -> None:
    problem = bowl(seed=3)
    for a, b in zip(jax.tree.leaves(run(name, problem)), jax.tree.leaves(run(name, problem)), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", DERIVATIVE_FREE)
def test_another_key_another_search(name: str) -> None:
    problem = bowl(seed=3)
    assert np.any(run(name, problem, seed=0).candidates.x != run(name, problem, seed=1).candidates.x)


@pytest.mark.parametrize("name", SOLVERS)
def test_bounds_are_honoured(name: str) -> None:
    # the minimum lies outside, and so would be any error below the floor
    bounds = Bounds(jnp.array([-1.0, -1, -0.2, -1, -1, -1]), jnp.array([1.0, 0.3, 1, 1, 1, 0.1]))
    problem = Quadratic(jnp.array([0.0, 2.0, -1.5, 0.2, 0.0, 0.6]), jnp.eye(6), box=bounds)
    solution = run(name, problem, bounds=bounds)
    assert float(solution.error) >= 1.0, "a candidate outside the bounds was evaluated"
    best = jnp.clip(problem.centre, *bounds)
    assert np.linalg.norm(solution.x - best) < TOLERANCE.get(name, 0.01)
    assert np.all(solution.candidates.x >= bounds.lower) and np.all(solution.candidates.x <= bounds.upper)


@pytest.mark.parametrize("name", SOLVERS)
def test_never_worse_than_the_guess(name: str) -> None:
    problem = bowl(seed=4)
    solution = run(name, problem, guess=problem.centre[None])
    assert float(solution.error) == pytest.approx(1.0, abs=1e-4)
    np.testing.assert_allclose(solution.x, problem.centre, atol=0.01)


@pytest.mark.parametrize("name", ["ga", "pso"])
def test_one_good_guess_among_bad_ones_is_enough(name: str) -> None:
    problem = bowl(seed=4)
    guesses = jnp.stack([jnp.full(6, 3.9), jnp.full(6, -3.9), problem.centre])
    assert float(run(name, problem, guess=guesses).error) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("name", SOLVERS)
def test_survives_a_problem_without_finite_errors(name: str) -> None:
    hopeless = replace(bowl(), floor=jnp.inf)
    solution = run(name, hopeless)
    assert np.isinf(solution.error) and np.all(np.isfinite(solution.x))
    assert np.all(np.abs(solution.x) <= 4)


@pytest.mark.parametrize("name", DERIVATIVE_FREE)
def test_survives_candidates_without_finite_errors(name: str) -> None:
    problem = bowl(seed=5, reach=0.8)

    blind = replace(problem, centre=problem.centre.at[0].set(0.7), blind_below=-0.5)
    solution = run(name, blind)
    assert np.linalg.norm(solution.x - blind.centre) < TOLERANCE.get(name, 0.01)


@pytest.mark.parametrize("name", [name for name in SOLVERS if name != "adam"])  # optax's own Adam is not strict
def test_strict_dtypes(name: str) -> None:
    with jax.numpy_dtype_promotion("strict"):
        solution = jax.eval_shape(search, jax.random.key(0), SOLVERS[name].at_level(0), bowl(), GUESS, BOX)
    assert solution.x.dtype == solution.error.dtype == solution.history.dtype == jnp.float32


@pytest.mark.parametrize("name", ["ga", "ga-paper", "pso", "gauss-newton", "adam"])
def test_rates_are_inputs_of_one_program(name: str) -> None:
    traces = []

    @jax.jit
    def program(solver: Any) -> jax.Array:
        traces.append(solver)
        return search(jax.random.key(0), solver, problem, GUESS, BOX).error

    solver, problem = SOLVERS[name].at_level(0), bowl()
    for factor in (1.0, 0.9, 0.8):
        scaled = jax.tree.map(lambda leaf, factor=factor: leaf * factor, solver)
        assert np.isfinite(program(replace(scaled, level=0)))
    assert len(jax.tree.leaves(solver)) > 0
    assert len(traces) == 1


RATES = {
    "ga": "mutation_decay",
    "pso": "constriction",
    "gauss-newton": "damping",
    "adam": "learning_rate",
}


@pytest.mark.parametrize("name", RATES)
def test_a_sweep_over_a_rate_is_one_vmap(name: str) -> None:
    solver, problem = SOLVERS[name].at_level(0), bowl(seed=6, spread=4.0)
    own = solver.here(getattr(solver, RATES[name]))
    rates = own * jnp.array([0.5, 0.8, 1.0])

    def final(rate: jax.Array) -> jax.Array:
        return search(jax.random.key(0), replace(solver, **{RATES[name]: rate}), problem, GUESS, BOX).error

    swept = jax.jit(jax.vmap(final))(rates)
    assert swept.shape == (3,)
    assert float(swept[2]) == pytest.approx(float(run(name, problem).error), rel=1e-2)
    if name != "gauss-newton":  # which solves a quadratic exactly at any small damping
        assert len(set(np.asarray(swept).tolist())) > 1


def test_stop_criteria() -> None:
    count = jnp.arange(5)
    np.testing.assert_array_equal(static_stop(count, 3), [False, False, False, True, True])
    np.testing.assert_array_equal(diversity_stop(count, 2), [False, False, True, True, True])


def test_stagnation_counts_iterations_that_gain_too_little() -> None:
    errors = jnp.array([9.8, 9.95, 10.0, 11.0, jnp.inf])
    np.testing.assert_array_equal(stagnation(jnp.int32(4), errors, jnp.float32(10.0), 0.01), [0, 5, 5, 5, 5])
    assert stagnation(jnp.int32(4), jnp.float32(1.0), jnp.float32(jnp.inf), 0.01) == 0


def test_stagnation_stops_the_loop() -> None:
    solver = replace(SOLVERS["pso"], iterations=(200,), patience=6).at_level(0)
    solution = jit_search(jax.random.key(0), solver, bowl(), GUESS, BOX)
    count = int(solution.iterations)
    assert 10 < count < 190
    history = np.asarray(solution.history)
    assert np.isfinite(history[:count]).all() and np.isnan(history[count:]).all()
    # nothing worth mentioning was gained in the last `patience` iterations
    assert history[count - 1] > history[count - 7] * (1 - 1e-3)


def test_patience_does_not_change_what_is_found_before_the_stop() -> None:
    plain = SOLVERS["pso"].at_level(0)
    stopped = replace(plain, patience=10)
    full, cut = (jit_search(jax.random.key(0), s, bowl(), GUESS, BOX) for s in (plain, stopped))
    count = int(cut.iterations)
    np.testing.assert_allclose(cut.history[:count], full.history[:count], rtol=1e-5)


def test_a_level_ends_where_it_gains_less_than_it_should() -> None:
    solver = replace(SOLVERS["pso"], iterations=(200, 200), patience=6, progress=(1e-4, 0.5))
    lasted = [
        int(jit_search(jax.random.key(0), solver.at_level(level), bowl(), GUESS, BOX).iterations) for level in (0, 1)
    ]
    assert 6 < lasted[1] < lasted[0] / 1.5


def test_levels_pick_their_entries() -> None:
    solver = GeneticAlgorithm(population=(2, 4, 8), iterations=(0, 5, 6), spread=(1.0, 2.0, 3.0), mutation_step=None)
    assert solver.levels == (2, 1)
    at = solver.at_level(1)
    assert [at.here(entry) for entry in (at.population, at.iterations, at.spread, at.mutation_step)] == [
        4,
        5,
        2.0,
        None,
    ]
    traced = jax.jit(lambda level: solver.at_level(level).here(solver.spread))
    assert [float(traced(level)) for level in range(3)] == [1.0, 2.0, 3.0]
    assert GaussNewton(iterations=(1, 0, 3)).levels == (2, 0)
