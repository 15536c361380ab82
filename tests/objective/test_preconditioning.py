"""Search coordinates in which E is about round."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from observed import build, jit_linearize, jit_problem_score, smooth_pair

from gavo_jax.objective.losses import l2
from gavo_jax.objective.preconditioning import preconditioner, reference_curvature, unconditioner
from gavo_jax.objective.problem import Problem


def preconditioned(depth_weight: float) -> tuple[Problem, np.ndarray]:
    """The problem of a perfect match in the coordinates of its preconditioner, and the curvature A."""
    pair = smooth_pair(rim=2)
    objective = build(pair, l2, (1.0, 0.01, depth_weight))
    curvature = reference_curvature(objective)
    return Problem(objective, jnp.eye(4), preconditioner(curvature)), np.asarray(curvature, float)


@pytest.mark.parametrize("depth_weight", [0.0, 0.3])
def test_preconditioner_makes_the_curvature_round(depth_weight: float) -> None:
    problem, curvature = preconditioned(depth_weight)
    basis = np.asarray(problem.basis, float)
    round_curvature = basis.T @ curvature @ basis
    np.testing.assert_allclose(round_curvature, np.diag(np.diag(round_curvature)), atol=2e-3)
    diagonal = np.sort(np.diag(round_curvature))
    assert np.all(diagonal < 1.001) and diagonal[0] > 0.3 and np.all(diagonal[2:] > 0.9)


def test_preconditioner_of_a_blank_image_is_finite_and_small() -> None:
    basis = np.asarray(preconditioner(jnp.zeros((6, 6))))
    assert np.isfinite(basis).all() and np.abs(basis).max() <= 0.1


def test_unconditioner_is_the_preconditioners_inverse() -> None:
    problem, _ = preconditioned(0.3)
    np.testing.assert_allclose(unconditioner(problem.basis) @ problem.basis, np.eye(6), atol=1e-5)


@pytest.mark.parametrize("depth_weight", [0.0, 0.3])
def test_curvature_is_half_the_hessian_of_a_perfect_match(depth_weight: float) -> None:
    problem, curvature = preconditioned(depth_weight)
    hessian = jit_linearize(replace(problem, basis=jnp.eye(6)), jnp.zeros(6)).hessian
    np.testing.assert_allclose(0.5 * hessian, curvature, atol=0.1 * np.abs(curvature).max())


def test_a_unit_step_in_any_direction_costs_about_one_squared_grey_level() -> None:
    problem, _ = preconditioned(0.0)
    rng = np.random.default_rng(0)
    directions = np.concatenate([np.eye(6), -np.eye(6), rng.normal(size=(20, 6))])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    error, _ = jit_problem_score(problem, directions.astype(np.float32))
    assert np.all(error > 0.5) and np.all(error < 1.5)
    assert np.mean(error) == pytest.approx(1, abs=0.25)
