"""Losses: what they are near zero and far from it, and that any callable is one."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from observed import build, jit_error, random_motions, random_pair, staircase

from gavo_jax.errors import GavoError
from gavo_jax.objective.losses import LOSSES
from gavo_jax.settings import AlignmentOptions, Settings
from gavo_jax.settings_check import require_settings


@pytest.mark.parametrize("loss", LOSSES)
def test_a_loss_is_its_argument_near_zero_and_never_falls(loss: str) -> None:
    s = np.linspace(0, 400, 2001, dtype=np.float32)
    rho = jax.jit(LOSSES[loss])(s)
    assert float(rho[0]) == 0
    assert float(jax.jit(LOSSES[loss])(jnp.float32(1e-3))) == pytest.approx(1e-3, rel=2e-3)
    assert np.all(np.diff(rho) >= -1e-3)
    assert np.all(rho <= s * (1 + 1e-5))
    assert np.all(np.isfinite(jax.jit(jax.vmap(jax.grad(LOSSES[loss])))(s)))


class Unhashable:
    """A loss that holds what may change."""

    __hash__ = None  # pyright: ignore[reportAssignmentType]

    def __call__(self, s: jax.Array) -> jax.Array:
        return s


@pytest.mark.parametrize(
    ("loss", "words"),
    [
        (jnp.sqrt, "must have a finite derivative, also at 0"),
        (lambda s: 1, "must return as many real numbers as it is given"),
        (jnp.sum, "must return as many real numbers"),
        (lambda s: s > 4, "must return as many real numbers"),
        (lambda s: (s, s), "must return as many real numbers"),
        (lambda s: -jnp.exp(-s), "must not be negative"),
        (jnp.log, "must be finite for all values from 0"),
        (lambda s: np.sqrt(s), "cannot be used: "),
        (lambda s: jax.pure_callback(np.abs, s, s), "cannot be used: Pure callbacks do not support JVP"),
        (lambda: 0, "cannot be used: "),
        (Unhashable(), "must be hashable"),
    ],
)
def test_what_is_no_loss_is_told_before_anything_is_compiled(loss: Any, words: str) -> None:
    """The square root searched well, and each pair was `low_texture`; others ended in a traceback."""
    settings = Settings(alignment=AlignmentOptions(loss=loss))
    with pytest.raises(GavoError, match=f"settings: alignment.loss: .*{words}"):
        require_settings(settings)
    require_settings(replace(settings, alignment=AlignmentOptions(loss=staircase)))


def test_any_callable_is_a_loss() -> None:
    pair = random_pair(11)
    motion = random_motions(1)[0]
    terms = oracle.residuals(pair, np.asarray(motion, float))
    expected = 400 * np.ceil(np.minimum((terms.grey / 20) ** 2, 9)).mean()
    objective = build(pair, staircase, (20.0, 0.01, 0.0))
    assert float(jit_error(objective, motion)[0]) == pytest.approx(expected, rel=1e-3)
