"""Distinct modes among motions: one motion of each, best first, and how far the best other mode is behind."""

import jax
import jax.numpy as jnp
import pytest

from gavo_jax.alignment.modes import NICHE, best_distinct, rival_error
from gavo_jax.se3 import exp


def sideways(*metres: float) -> jax.Array:
    return exp(jnp.stack([jnp.array([x, 0.0, 0.0, 0.0, 0.0, 0.0]) for x in metres]))


def picked(motions: jax.Array, errors: list[float], count: int) -> list[int]:
    return jax.jit(best_distinct, static_argnums=2)(motions, jnp.array(errors), count).tolist()


def test_the_best_motion_of_each_mode_comes_first() -> None:
    motions = sideways(0.0, 0.01, 0.5, 0.51, 1.0)
    assert picked(motions, [3.0, 2.0, 5.0, 4.0, 1.0], 3) == [4, 1, 3]


@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_of_motions_whose_modes_are_taken_the_better_one_comes_first(scale: float) -> None:
    motions = sideways(0.0, 0.01, 0.02, 0.03)
    assert picked(motions, [scale * error for error in (4.0, 3.0, 1.0, 2.0)], 4) == [2, 3, 1, 0]


def test_a_mode_that_is_taken_less_often_comes_first() -> None:
    motions = sideways(0.0, 0.01, 0.02, 0.5, 0.51)
    assert picked(motions, [1.0, 2.0, 3.0, 8.0, 9.0], 5) == [0, 3, 1, 4, 2]


def test_motions_without_a_finite_error_come_last() -> None:
    motions = sideways(0.0, 0.5, 0.01, 1.0)
    assert picked(motions, [float("nan"), float("inf"), 1.0, 2.0], 3) == [2, 3, 1]
    assert picked(motions, [float("nan"), 3.0, 1.0, 2.0], 4) == [2, 3, 1, 0]
    assert picked(sideways(0.0, 0.01, 0.02), [2.0, 1.0, float("inf")], 3) == [1, 0, 2]


def test_errors_may_be_negative() -> None:
    assert picked(sideways(0.0, 0.5, 1.0), [-1.0, -3.0, -2.0], 3) == [1, 2, 0]


def test_the_rival_is_the_best_motion_of_another_mode() -> None:
    motions, errors = sideways(0.0, 0.5 * NICHE[0], 0.5, 1.0), jnp.array([1.0, 1.5, 4.0, 3.0])
    assert rival_error(motions, errors, jnp.array(0)) == 3.0
    assert rival_error(motions[:2], errors[:2], jnp.array(0)) == jnp.inf
