"""E's gradient and Hessian, against central differences of the oracle."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from observed import CAMERA, build, exchanged, jit_linearize, jit_problem_score, jit_residuals, noisy_pair, smooth_pair

from gavo_jax.objective.losses import LOSSES, l2, student_t
from gavo_jax.objective.problem import Problem
from gavo_jax.se3 import exp


def central_differences(f: Callable[[np.ndarray], float], x: np.ndarray, h: float) -> np.ndarray:
    return np.array([(f(x + h * e) - f(x - h * e)) / (2 * h) for e in np.eye(len(x))])


class Place(NamedTuple):
    """Where derivatives are taken: coordinates x about an origin."""

    pair: oracle.Pair
    origin: np.ndarray
    basis: np.ndarray
    x: np.ndarray


@cache
def some_place() -> Place:
    """Of a pair that is nearly aligned; the coordinates are neither metres nor radians."""
    rng = np.random.default_rng(5)
    origin = oracle.expm(rng.normal(0, 0.01, 6))
    basis = np.linalg.qr(rng.normal(size=(6, 6)))[0] * rng.uniform(0.5, 2, 6)
    return Place(smooth_pair(shift=(0.4, -0.3)), origin, basis, rng.normal(0, 0.005, 6))


@cache
def terms_at(*x: float) -> oracle.Terms:
    """The oracle's residuals near `some_place`: every loss is one of the same residuals."""
    pair, origin, basis, _ = some_place()
    return oracle.residuals(pair, origin @ oracle.expm(basis @ np.array(x)))


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("depth_weight", [0.0, 0.3])
def test_gradient_against_central_differences(loss: str, depth_weight: float) -> None:
    pair, origin, basis, x = some_place()
    scales = (6.0, 0.01, depth_weight)

    def reference_error(x: np.ndarray) -> float:
        return oracle.error(terms_at(*x), loss, *scales)

    expected = central_differences(reference_error, x, 1e-7)
    problem = Problem(
        build(pair, LOSSES[loss], scales), jnp.asarray(origin, jnp.float32), jnp.asarray(basis, jnp.float32)
    )
    model = jit_linearize(problem, x.astype(np.float32))
    assert float(model.error) == pytest.approx(reference_error(x), rel=1e-4)
    np.testing.assert_allclose(model.gradient, expected, atol=2e-3 * np.abs(expected).max())


def test_symmetric_gradient_against_central_differences() -> None:
    rng = np.random.default_rng(5)
    forward = smooth_pair(shift=(0.4, -0.3))
    inner = np.pad(np.ones((CAMERA.height - 12, CAMERA.width - 12)), 6)
    forward = forward._replace(target_inverse_depth=forward.target_inverse_depth * inner)
    backward = exchanged(forward)
    scales = (6.0, 0.01, 0.0)
    origin, basis = oracle.expm(rng.normal(0, 0.01, 6)), np.diag(rng.uniform(0.5, 2, 6))
    x = rng.normal(0, 0.005, 6)

    def reference_error(x: np.ndarray) -> float:
        motion = origin @ oracle.expm(basis @ x)
        errors = [
            oracle.error(oracle.residuals(pair, m), "cauchy", *scales)
            for pair, m in ((forward, motion), (backward, np.linalg.inv(motion)))
        ]
        return sum(errors) / 2

    objective = replace(build(forward, LOSSES["cauchy"], scales), backward=build(backward, LOSSES["cauchy"], scales))
    problem = Problem(objective, jnp.asarray(origin, jnp.float32), jnp.asarray(basis, jnp.float32))
    model = jit_linearize(problem, x.astype(np.float32))
    expected = central_differences(reference_error, x, 1e-7)
    assert float(model.error) == pytest.approx(reference_error(x), rel=1e-4)
    np.testing.assert_allclose(model.gradient, expected, atol=2e-3 * np.abs(expected).max())
    assert np.linalg.eigvalsh(np.asarray(model.hessian, float)).min() > 0


def test_gradient_under_a_rolling_shutter() -> None:
    """Against differences of E itself, which rounding and the image's kinks allow to a few per cent."""
    objective = replace(
        build(smooth_pair(shift=(0.4, -0.3)), LOSSES["cauchy"], (6.0, 0.01, 0.3)), readout=jnp.float32(3.0)
    )
    problem = Problem(objective, exp(jnp.full(6, 0.02)), jnp.eye(6))
    x = np.zeros(6, np.float32)

    def error(x: np.ndarray) -> float:
        return float(jit_problem_score(problem, jnp.asarray(x[None], jnp.float32))[0][0])

    model = jit_linearize(problem, x)
    at_once = jit_linearize(replace(problem, objective=replace(objective, readout=None)), x)
    expected = central_differences(error, x.astype(float), 1e-3)
    assert float(model.error) == pytest.approx(error(x), rel=1e-5)
    np.testing.assert_allclose(model.gradient, expected, atol=0.03 * np.abs(expected).max())
    assert np.abs(at_once.gradient - expected).max() > 0.1 * np.abs(expected).max()


@pytest.mark.parametrize("loss", LOSSES)
def test_hessian_is_symmetric_and_positive(loss: str) -> None:
    problem = Problem(build(smooth_pair((1.3, 0.7)), LOSSES[loss], (6.0, 0.01, 0.3)), jnp.eye(4), jnp.eye(6))
    model = jit_linearize(problem, jnp.full(6, 0.003))
    hessian = np.asarray(model.hessian, float)
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-4, atol=1e-4 * np.abs(hessian).max())
    assert np.linalg.eigvalsh(hessian).min() > 0


def test_hessian_predicts_the_gradient_of_a_good_match() -> None:
    problem = Problem(build(smooth_pair(), l2, (1.0, 0.01, 0.0)), jnp.eye(4), jnp.eye(6))
    still = jit_linearize(problem, jnp.zeros(6))
    size = np.sqrt(np.diag(still.hessian))
    for i in range(6):
        # 1 mm or 1 mrad: a fraction of a pixel
        step = jnp.zeros(6).at[i].set(1e-3)
        ahead, behind = jit_linearize(problem, step).gradient, jit_linearize(problem, -step).gradient
        found = np.asarray(ahead - behind) / 2e-3
        assert np.all(np.abs(found - still.hessian[i]) < 0.1 * size[i] * size)


def test_gradient_scatter_is_a_covariance() -> None:
    noise = np.random.default_rng(4).normal(0, 3, (48, 64))
    problem = Problem(build(noisy_pair(noise), student_t, (3.0, 0.01, 0.3)), jnp.eye(4), jnp.eye(6))
    residuals = jit_residuals(problem.objective, problem.origin)
    scatter = np.asarray(jax.jit(lambda problem, residuals: problem.examine(residuals)[1])(problem, residuals), float)
    np.testing.assert_allclose(scatter, scatter.T, rtol=1e-4, atol=1e-4 * np.abs(scatter).max())
    assert np.linalg.eigvalsh(scatter).min() > -1e-5 * np.linalg.eigvalsh(scatter).max()
    assert np.linalg.eigvalsh(scatter).max() > 0
