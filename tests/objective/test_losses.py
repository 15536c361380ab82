"""Losses: what they are near zero and far from it, and that any callable is one."""

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from observed import build, jit_error, random_motions, random_pair, staircase

from gavo_jax.objective.losses import LOSSES


@pytest.mark.parametrize("loss", LOSSES)
def test_a_loss_is_its_argument_near_zero_and_never_falls(loss: str) -> None:
    s = np.linspace(0, 400, 2001, dtype=np.float32)
    rho = jax.jit(LOSSES[loss])(s)
    assert float(rho[0]) == 0
    assert float(jax.jit(LOSSES[loss])(jnp.float32(1e-3))) == pytest.approx(1e-3, rel=2e-3)
    assert np.all(np.diff(rho) >= -1e-3)
    assert np.all(rho <= s * (1 + 1e-5))
    assert np.all(np.isfinite(jax.jit(jax.vmap(jax.grad(LOSSES[loss])))(s)))


def test_any_callable_is_a_loss() -> None:
    pair = random_pair(11)
    motion = random_motions(1)[0]
    terms = oracle.residuals(pair, np.asarray(motion, float))
    expected = 400 * np.ceil(np.minimum((terms.grey / 20) ** 2, 9)).mean()
    objective = build(pair, staircase, (20.0, 0.01, 0.0))
    assert float(jit_error(objective, motion)[0]) == pytest.approx(expected, rel=1e-3)
