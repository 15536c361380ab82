"""Twists for property tests, and the matrices that they stand for."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst


def twists(reach: float) -> st.SearchStrategy[np.ndarray]:
    """ξ of [6] with entries within ± reach, the identity and its neighbourhood included."""
    value = (
        st.floats(-reach, reach, allow_subnormal=False) | st.floats(-1e-6, 1e-6, allow_subnormal=False) | st.just(0.0)
    )
    return npst.arrays(np.float64, 6, elements=value).map(lambda xi: xi.astype(np.float32))


def hat(xi: np.ndarray) -> np.ndarray:
    """ξ̂ of ξ = (v, w), equation (3): rotation's cross-product matrix, translation in the last column."""
    x, y, z = xi[3:]
    return np.array([[0, -z, y, xi[0]], [z, 0, -x, xi[1]], [-y, x, 0, xi[2]], [0, 0, 0, 0]], np.float64)
