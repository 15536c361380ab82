"""Rigid motions and twists, equation (3), against SciPy; motions that are rigid, and those that are not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from twists import hat, twists

from gavo_jax.se3 import GENERATORS, adjoint, departure_from_rigid, exp, is_rigid, log, right_jacobian, rigid

TURN = scipy.linalg.expm(np.array([[0, -0.3, 0.2], [0.3, 0, -0.1], [-0.2, 0.1, 0]]))
jit_exp, jit_log, jit_jacobian = jax.jit(exp), jax.jit(log), jax.jit(right_jacobian)


def motion(rotation: np.ndarray) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation, (0.1, -0.2, 0.3)
    return result


def test_rounding_is_taken_out_in_double_precision() -> None:
    rounded = motion(TURN).astype(np.float32)
    found = rigid(np.stack([rounded, np.eye(4, dtype=np.float32)]))
    assert found.dtype == np.float64 and found.shape == (2, 4, 4)
    np.testing.assert_allclose(
        found[:, :3, :3].swapaxes(1, 2) @ found[:, :3, :3], np.stack([np.eye(3)] * 2), atol=1e-15
    )
    np.testing.assert_allclose(found[0], motion(TURN), atol=1e-7)
    np.testing.assert_array_equal(found[0, :, 3], rounded[:, 3])


def test_what_is_not_finite_stays_so_alone() -> None:
    broken = motion(TURN)
    broken[1, 1] = np.nan
    found = rigid(np.stack([broken, motion(TURN)]))
    np.testing.assert_array_equal(found[0], broken)
    np.testing.assert_allclose(found[1], motion(TURN), atol=1e-15)


def test_numbers_printed_with_few_digits_are_a_motion() -> None:
    rounded = np.round(motion(TURN), 3)
    assert is_rigid(rounded, 0.01)
    found = rigid(rounded)
    np.testing.assert_allclose(found[:3, :3].T @ found[:3, :3], np.eye(3), atol=1e-15)
    np.testing.assert_allclose(found, motion(TURN), atol=1e-3)
    assert not is_rigid(rounded, 1e-5)


@pytest.mark.parametrize(
    "matrix",
    [
        np.zeros((4, 4)),
        motion(TURN).T,
        motion(1.02 * TURN),
        motion(TURN @ np.diag([1.0, 1.0, -1.0])),
        motion(np.full((3, 3), np.nan)),
        motion(np.full((3, 3), 1e200)),
        2.0 * motion(TURN),
        motion(TURN) + np.outer([0, 0, 0, 1], [0.005, 0, 0, 0]),
        motion(TURN) + np.diag([0, 0, 0, 0.005]),
    ],
    ids=[
        "zeros",
        "transposed",
        "scaled",
        "mirrored",
        "not finite",
        "too large to square",
        "all of it doubled",
        "a last row that leans",
        "a last number that is not 1",
    ],
)
def test_other_numbers_are_none(matrix: np.ndarray) -> None:
    assert not is_rigid(matrix, 0.01)


def test_departure_tells_rounding_from_garbage() -> None:
    kinds = [motion(TURN), motion(1.001 * TURN), motion(TURN + 0.5)]
    departures = np.asarray(departure_from_rigid(jnp.asarray(np.stack(kinds), jnp.float32)))
    assert departures[0] < 1e-6 and departures[1] > 1e-3 and departures[2] > 0.1


@given(twists(1.7))
def test_exp_is_the_matrix_exponential_translation_first(xi: np.ndarray) -> None:
    np.testing.assert_allclose(jit_exp(xi), scipy.linalg.expm(hat(xi)), atol=3e-6)


@given(twists(1.7))
def test_log_undoes_exp(xi: np.ndarray) -> None:
    np.testing.assert_allclose(jit_log(jit_exp(xi)), xi, atol=2e-5)


def test_exp_of_a_batch_is_exp_of_each() -> None:
    xi = np.random.default_rng(0).normal(0, 0.3, (2, 3, 6)).astype(np.float32)
    batch = np.asarray(exp(jnp.asarray(xi)))
    assert batch.shape == (2, 3, 4, 4)
    np.testing.assert_allclose(batch[1, 2], scipy.linalg.expm(hat(xi[1, 2])), atol=1e-6)


def test_generators_are_the_twists_matrix() -> None:
    xi = np.array([1.0, 2, 3, 4, 5, 6])
    np.testing.assert_allclose(GENERATORS @ xi, hat(xi))


@given(twists(0.3), twists(1.0))
def test_right_jacobian_to_second_order(xi: np.ndarray, direction: np.ndarray) -> None:
    h = 1e-5
    moved = [scipy.linalg.expm(hat(xi.astype(float) + sign * h * direction)) for sign in (1, -1)]
    base = scipy.linalg.expm(hat(xi))
    tangent = np.linalg.inv(base) @ (moved[0] - moved[1]) / (2 * h)
    third_order = np.linalg.norm(xi) ** 3 * np.linalg.norm(direction)
    assert np.abs(tangent - hat(np.asarray(jit_jacobian(xi)) @ direction)).max() <= 0.1 * third_order + 1e-5


@given(twists(1.0), twists(1.0))
def test_adjoint_takes_a_step_to_the_other_side(xi: np.ndarray, step: np.ndarray) -> None:
    motion = scipy.linalg.expm(hat(xi))
    moved = hat(np.asarray(jax.jit(adjoint)(jnp.asarray(motion, jnp.float32))) @ step) @ motion
    np.testing.assert_allclose(moved, motion @ hat(step), atol=1e-5)
