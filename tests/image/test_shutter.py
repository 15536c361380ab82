"""Points are where the camera sees them when it reads their row, and their slopes with them."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from seen import CAMERA, jit_exp, jit_warp
from twists import hat, twists

from gavo_jax.image.shutter import Shutter, delay, delayed_slopes, row_time
from gavo_jax.image.warp import Points, Slopes, Warped, warp
from gavo_jax.se3 import exp

jit_delay = jax.jit(delay)


@settings(max_examples=30)
@given(twists(0.04), st.sampled_from([0.7, -0.7]), st.integers(0, 99))
def test_delayed_points_are_where_the_camera_sees_them_when_it_reads_their_row(
    xi: np.ndarray, readout: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    x, y, q, seen = rng.uniform(-0.4, 0.4, (4, 50)).astype(np.float32)
    q += 0.7
    ahead = np.stack([x / q, y / q, 1 / q, np.ones_like(q)])
    points = Points(*map(jnp.asarray, (x, y, q)))
    shutter = Shutter(jnp.float32(readout), jnp.asarray(seen))
    found = jit_delay(points, jit_warp(points, jit_exp(xi), CAMERA), shutter, CAMERA)
    v, point = np.full(50, CAMERA.cy), ahead
    for _ in range(30):  # when each point is on the row that is being read
        share = 1 + readout * (row_time(v, CAMERA) - seen)
        point = np.einsum("nij,jn->in", scipy.linalg.expm(share[:, None, None] * hat(xi)), ahead)
        v = CAMERA.fy * point[1] / point[2] + CAMERA.cy
    exact = np.stack([CAMERA.fx * point[0] / point[2] + CAMERA.cx, v, 1 / point[2]])
    at_once = np.stack(jit_warp(points, jit_exp(xi), CAMERA)[:3])
    # what is left is of second order in the motion and in the share of it that passes
    error = np.abs(np.stack(found[:3]) - exact)
    assert np.all(error <= 0.35 * np.abs(exact - at_once).max(axis=0) + 2e-3)


def test_slopes_of_delayed_points_are_their_derivatives() -> None:
    rng = np.random.default_rng(1)
    points = Points(*(jnp.asarray(rng.uniform(0.2, 0.8, 20), jnp.float32) for _ in range(3)))
    warped = warp(points, exp(jnp.asarray(rng.normal(0, 0.05, 6), jnp.float32)), CAMERA)
    shutter = Shutter(jnp.float32(0.6), jnp.asarray(rng.uniform(-0.5, 0.5, 20), jnp.float32))
    slopes = Slopes(*(jnp.asarray(rng.normal(size=20), jnp.float32) for _ in range(3)))

    def sampled(u: jax.Array, v: jax.Array, inverse_depth: jax.Array) -> jax.Array:
        moved = delay(points, Warped(u, v, inverse_depth, warped.inside), shutter, CAMERA)
        return sum((jnp.sum(slope * leaf) for slope, leaf in zip(slopes, moved, strict=False)), jnp.float32(0))

    expected = jax.grad(sampled, (0, 1, 2))(*warped[:3])
    found = delayed_slopes(slopes, points, warped, shutter, CAMERA)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)
