"""A small camera, and compiled ways to move and warp points."""

import jax
import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.image.warp import warp
from gavo_jax.se3 import exp

CAMERA = Camera(60.0, 58.0, 31.2, 24.1, 64, 48)
jit_exp = jax.jit(exp)
jit_warp = jax.jit(warp)


def plane(a: float, b: float, c: float) -> np.ndarray:
    """Inverse depth a + b u + c v of a plane, [48, 64]."""
    v, u = np.mgrid[:48, :64]
    return (a + b * u + c * v).astype(np.float32)
