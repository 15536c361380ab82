"""Robust losses: the cost of a residual."""

from collections.abc import Callable, Hashable
from functools import cache

import jax
import jax.numpy as jnp

from gavo_jax.errors import line_of

Loss = Callable[[jax.Array], jax.Array]
"""Non-negative cost of the squared normalised residual s = (r/σ)²: any function with a finite derivative. Populations
search without the derivative; the last step, the covariance and the status need it."""


def l2(s: jax.Array) -> jax.Array:
    """ρ(s) = s: plain least squares, as in the paper's error."""
    return s


def huber(s: jax.Array) -> jax.Array:
    """Quadratic up to 1.345 σ, linear beyond (95 % efficient under Gaussian noise)."""
    k = 1.345
    return jnp.where(s <= k * k, s, 2.0 * k * jnp.sqrt(jnp.maximum(s, k * k)) - k * k)


def cauchy(s: jax.Array) -> jax.Array:
    """c² log(1 + s/c²), c = 2.385."""
    c2 = 2.385**2
    return c2 * jnp.log1p(s / c2)


def student_t(s: jax.Array) -> jax.Array:
    """Negative log-likelihood of a t distribution of 5 degrees of freedom (Kerl et al. 2013), scaled to ρ'(0) = 1."""
    return 5.0 * jnp.log1p(s / 5.0)


def geman_mcclure(s: jax.Array) -> jax.Array:
    """s/(1 + s/c²), c = 3: redescending and free of transcendental functions."""
    return s / (1.0 + s / 9.0)


def truncated(s: jax.Array) -> jax.Array:
    """min(s, 2.795²): quadratic up to 2.8 σ, constant beyond. Populations need no derivative there."""
    return jnp.minimum(s, 2.795**2)


def fault_of_loss(loss: Loss) -> str:
    """Return why a function is not a loss, in words that continue its name; empty if it is one."""
    if not isinstance(loss, Hashable):
        return "must be hashable: a program is compiled for each loss"
    return "" if loss in LOSSES.values() else _fault_of_values(loss)


@cache
def _fault_of_values(loss: Loss) -> str:
    """Return what is wrong with the values of a function; empty if nothing is."""
    s = jnp.array([0.0, 0.5, 4.0, 1e4], jnp.float32)
    try:
        value, slope = jax.jit(lambda s: jax.jvp(loss, (s,), (jnp.ones_like(s),)))(s)
    except Exception as error:  # third-party code may fail in any way
        return f"cannot be used: {line_of(error)}"
    if not isinstance(value, jax.Array) or value.shape != s.shape or not jnp.issubdtype(value.dtype, jnp.floating):
        return "must return as many real numbers as it is given"
    if not jnp.isfinite(value).all():
        return "must be finite for all values from 0"
    if (value < 0).any():
        return "must not be negative: a point out of view is recognised by its cost"
    if not jnp.isfinite(slope).all():
        return "must have a finite derivative, also at 0: covariance and status use it"
    return ""


LOSSES: dict[str, Loss] = {
    "l2": l2,
    "huber": huber,
    "cauchy": cauchy,
    "student-t": student_t,
    "geman-mcclure": geman_mcclure,
    "truncated": truncated,
}
