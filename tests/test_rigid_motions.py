"""Rigid motions on the host: exponential and logarithm, the way between two poses, adjoint and covariance."""

import numpy as np
import pytest
from scipy.linalg import expm

from gavo_jax.rigid_motions import adjoint, exp, interpolate, length_and_angle, log, transport_covariance
from gavo_jax.trajectory import inverse

RNG = np.random.default_rng(3)


def test_exponential_and_logarithm_undo_each_other() -> None:
    for xi in (np.zeros(6), 1e-6 * np.arange(6.0), np.array([0.3, -0.2, 0.5, 0.4, -1.0, 0.8])):
        np.testing.assert_allclose(log(exp(xi)), xi, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 9e-5, 1.1e-4, 0.01, 1.0, 3.0])
def test_the_exponential_is_that_of_the_matrix(angle: float) -> None:
    """Catches a translation that bends to the wrong side: the logarithm, of the same Jacobian, undoes that too."""
    v, w = np.array([0.3, -0.2, 0.5]), angle * np.array([0.6, 0.0, -0.8])
    hat = np.zeros((4, 4))
    hat[:3, :3], hat[:3, 3] = np.cross(w, np.eye(3)).T, v
    np.testing.assert_allclose(exp(np.concatenate([v, w])), expm(hat), rtol=0, atol=1e-11)


def test_lengths_and_angles_of_many_are_those_of_each() -> None:
    """Catches norms along the wrong axis, which one motion by itself does not show."""
    many = np.stack([exp(0.5 * RNG.normal(size=6)) for _ in range(5)])
    each = np.array([length_and_angle(one) for one in many])
    np.testing.assert_allclose(np.transpose(length_and_angle(many)), each, rtol=1e-12)


def test_half_the_way_is_as_far_from_either_end() -> None:
    a, b = exp(RNG.normal(size=6)), exp(RNG.normal(size=6))
    np.testing.assert_allclose(interpolate(a, b, 1.0), b, atol=1e-9)
    middle = interpolate(a, b, 0.5)
    np.testing.assert_allclose(length_and_angle(inverse(a) @ middle), length_and_angle(inverse(middle) @ b), atol=1e-9)


def test_the_adjoint_takes_a_step_and_its_covariance_to_the_other_side() -> None:
    a, step = exp(RNG.normal(size=6)), 1e-4 * RNG.normal(size=6)
    np.testing.assert_allclose(a @ exp(step), exp(adjoint(a) @ step) @ a, atol=1e-7)
    moved = adjoint(a) @ step
    np.testing.assert_allclose(transport_covariance(a, np.outer(step, step)), np.outer(moved, moved), atol=1e-20)
