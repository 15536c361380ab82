"""Motions that are rigid, and those that are not; `exp` and `log` are tested with the warp and at full size."""

import jax.numpy as jnp
import numpy as np
import scipy.linalg

from gavo_jax.se3 import departure_from_rigid, rigid

TURN = scipy.linalg.expm(np.array([[0, -0.3, 0.2], [0.3, 0, -0.1], [-0.2, 0.1, 0]]))


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


def test_departure_tells_rounding_from_garbage() -> None:
    kinds = [motion(TURN), motion(1.001 * TURN), motion(TURN + 0.5)]
    departures = np.asarray(departure_from_rigid(jnp.asarray(np.stack(kinds), jnp.float32)))
    assert departures[0] < 1e-6 and departures[1] > 1e-3 and departures[2] > 0.1
