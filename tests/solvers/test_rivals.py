"""What is particular to the swarm, to Gauss-Newton and to the optax methods."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from quadratic import Quadratic, bowl, cube, search

from gavo_jax.objective.derivatives import Linearization
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.solvers.gradient import GradientDescent
from gavo_jax.solvers.particle_swarm import ParticleSwarm, SwarmState

BOX = cube(4.0)


@jax.jit
def fly(key: jax.Array, solver: ParticleSwarm, problem: Any) -> SwarmState:
    """Eight states of a swarm, along a leading axis."""

    def step(state: SwarmState, step_key: jax.Array) -> tuple[SwarmState, SwarmState]:
        state = solver.step(step_key, state, problem)
        return state, state

    return jax.lax.scan(step, solver.init(key, problem, jnp.zeros((1, 6)), BOX), jax.random.split(key, 8))[1]


@pytest.mark.parametrize("clamp", [0.05, 0.2])
def test_swarm_velocity_is_clamped_and_memories_only_improve(clamp: float) -> None:
    solver = ParticleSwarm(population=(30,), iterations=(8,), spread=None, velocity_clamp=clamp).at_level(0)
    states = fly(jax.random.key(0), solver, bowl(reach=3.0))
    assert np.abs(states.velocity).max() == pytest.approx(clamp * 8.0), "the clamp was never met"
    assert np.abs(states.x).max() <= 4.0
    assert np.all(np.diff(states.memory_error, axis=0) <= 0)
    last = jax.tree.map(lambda leaf: leaf[-1], states)
    assert solver.best(last).error == last.memory_error.min()


def test_a_particle_that_meets_a_bound_stops_there() -> None:
    problem = replace(bowl(), centre=jnp.full(6, 30.0))
    solver = ParticleSwarm(population=(30,), iterations=(8,), spread=None).at_level(0)
    states = fly(jax.random.key(0), solver, problem)
    at_bound = np.asarray(states.x[-1]) == 4.0
    assert at_bound.mean() > 0.3
    assert np.all(np.asarray(states.velocity[-1])[at_bound] == 0)


def test_gauss_newton_solves_a_quadratic_in_a_few_steps() -> None:
    solver = GaussNewton(iterations=(4,), patience=9).at_level(0)
    problem = bowl(seed=8, spread=1000.0)
    solution = search(jax.random.key(0), solver, problem, jnp.zeros((1, 6)), BOX)
    np.testing.assert_allclose(solution.x, problem.centre, atol=1e-2)


class Overshooting(Quadratic):
    """A quadratic whose Hessian is given ten times too small: plain Gauss-Newton would diverge."""

    def linearize(self, x: jax.Array) -> Linearization:
        model = super().linearize(x)
        return model._replace(hessian=0.1 * model.hessian)


def test_gauss_newton_is_damped_where_a_step_does_not_help() -> None:
    plain = bowl(seed=8, spread=2.0)
    problem = Overshooting(plain.centre, plain.curvature)
    solver = GaussNewton(iterations=(30,), patience=30).at_level(0)
    solution = search(jax.random.key(0), solver, problem, jnp.zeros((1, 6)), BOX)
    assert np.all(np.diff(solution.history) <= 0)
    assert float(solution.error) < 1.05


class Singular(Quadratic):
    """Nothing depends on the last coordinate."""

    def linearize(self, x: jax.Array) -> Linearization:
        model = super().linearize(x)
        keep = jnp.ones(6).at[5].set(0.0)
        return model._replace(gradient=model.gradient * keep, hessian=model.hessian * keep * keep[:, None])


def test_gauss_newton_leaves_what_the_data_do_not_determine() -> None:
    problem = Singular(jnp.array([1.0, -1, 0.5, 0.2, 0.3, 0.0]), jnp.diag(jnp.array([1.0, 2, 3, 1, 2, 0])))
    solution = search(jax.random.key(0), GaussNewton(iterations=(8,)).at_level(0), problem, jnp.zeros((1, 6)), BOX)
    np.testing.assert_allclose(solution.x, problem.centre, atol=1e-2)


@pytest.mark.parametrize("optimizer", [optax.adam, optax.lion, optax.rmsprop, optax.adabelief])
def test_any_optax_optimizer_will_do(optimizer) -> None:
    problem = bowl(seed=9)
    solver = GradientDescent(iterations=(100,), learning_rate=(0.2,), decay=0.96, optimizer=optimizer).at_level(0)
    solution = jax.jit(search)(jax.random.key(0), solver, problem, jnp.zeros((1, 6)), BOX)
    assert float(solution.error) < 1.05
