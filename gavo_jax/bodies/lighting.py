"""Light that changes from place to place: lenses darken corners, lamps flicker while rows are exposed, shadows fall.

One gain and bias for the whole image leave such changes over, and a part of the scene would seem to move. They are
smooth, and texture that moved is not: its residuals are of both signs within a small part of the image.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

CELLS, SMALLEST = 10, 6.0
"""Cells along the longer side of the image, and pixels of the smallest one: a gain of less would explain texture.
The gain is linear from the centre of one cell to that of the next."""
UNCHANGED = 900.0
"""Squared grey levels of a cell's mean pixel at which its gain is half-way between 1 and the regression's."""
LARGE = 20.0
"""Grey levels at which a residual counts by a quarter."""
ROUNDS = 2


def light_residual(
    residual: Float[Array, "v h w"], grey: Float[Array, "v h w"], weight: Float[Array, "v h w"]
) -> Float[Array, "v h w"]:
    """Return the part of grey residuals that a gain of every place's own explains, grey levels.

    Args:
        residual: Of pixels in V other images, grey levels.
        grey: The pixels as bright as the others show them, grey levels.
        weight: How far each pixel counts.
    """
    height, width = residual.shape[1:]
    rows, columns = _shares(height, max(height, width)), _shares(width, max(height, width))

    def cells(image: jax.Array) -> jax.Array:
        return jnp.einsum("hr,vhw,wc->vrc", rows, image, columns)

    def refine(_: int, change: jax.Array) -> jax.Array:
        trusted = weight / (1.0 + ((residual - change) / LARGE) ** 2) ** 2
        moment = cells(trusted * grey**2) + UNCHANGED * jnp.maximum(cells(trusted), 1.0)
        return grey * jnp.einsum("hr,vrc,wc->vhw", rows, cells(trusted * grey * residual) / moment, columns)

    return jax.lax.fori_loop(0, ROUNDS, refine, jnp.zeros_like(residual))


def _shares(size: int, longest: int) -> Float[np.ndarray, "n cells"]:
    """How far each pixel of a side belongs to each cell along it: linear between the cells' centres."""
    count = max(2, round(size / max(longest / CELLS, SMALLEST)))
    places = np.clip((np.arange(size) + 0.5) / size * count - 0.5, 0.0, count - 1.0)
    return np.maximum(0.0, 1.0 - np.abs(places[:, None] - np.arange(count))).astype(np.float32)
