"""Local changes of light: lenses darken corners, lamps flicker while rows are exposed, shadows fall.

One gain and bias for the whole image cannot model such changes. Static parts would seem to move, and the search would
find a motion that explains them. Changes of light are smooth, or uniform along a row. Texture that moved is neither:
its residuals have both signs within a small part of the image.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

CELLS, SMALLEST = 10, 6.0
"""Cells along the longer side of the image, and side of the smallest cell in pixels: gains of smaller ones would
explain texture. The gain is linear between the centres of cells.
"""
STRIP = 3.0
"""Height in pixels of the strips of rows that have a gain of their own where a lamp flickers."""
FLICKER = 0.8
"""Largest share of the residuals' power that the strips' gains leave where a lamp flickers. Clips without such a lamp
keep at least 0.91.
"""
UNCHANGED = 900.0
"""Mean squared grey of a cell, squared grey levels, at which its gain is half-way between 1 and the regression's."""
LARGE = 20.0
"""Residual, in grey levels, whose weight is a quarter."""
ROUNDS = 2


def light_change(
    residual: Float[Array, "v h w"], grey: Float[Array, "v h w"], weight: Float[Array, "v h w"]
) -> Float[Array, "v h w"]:
    """Return how much brighter every place became, as a share of its grey: the local gain less 1.

    Args:
        residual: Residuals of pixels in V other images, grey levels.
        grey: The pixels as bright as the others show them, grey levels.
        weight: Weight of each pixel.
    """
    height, width = residual.shape[1:]
    cell = max(max(height, width) / CELLS, SMALLEST)
    rows, columns, strips = _shares(height, cell), _shares(width, cell), _shares(height, STRIP)
    everywhere = np.ones((width, 1), np.float32)

    def gain(residual: jax.Array, weight: jax.Array, rows: np.ndarray, columns: np.ndarray) -> jax.Array:
        def summed(image: jax.Array) -> jax.Array:
            return jnp.einsum("hr,vhw,wc->vrc", rows, image, columns)

        moment = summed(weight * grey**2) + UNCHANGED * jnp.maximum(summed(weight), 1.0)
        return jnp.einsum("hr,vrc,wc->vhw", rows, summed(weight * grey * residual) / moment, columns)

    def power(residual: jax.Array) -> jax.Array:
        square = residual**2
        return jnp.sum(weight * square / (1.0 + square / LARGE**2), axis=(1, 2), keepdims=True)

    def refine(_: int, change: jax.Array) -> jax.Array:
        trusted = weight / (1.0 + ((residual - grey * change) / LARGE) ** 2) ** 2
        flicker = gain(residual, trusted, strips, everywhere)
        flickers = power(residual - grey * flicker) < FLICKER * power(residual)
        flicker = jnp.where(flickers, flicker, 0.0)
        return flicker + gain(residual - grey * flicker, trusted, rows, columns)

    return jax.lax.fori_loop(0, ROUNDS, refine, jnp.zeros_like(residual))


def _shares(size: int, cell: float) -> Float[np.ndarray, "n cells"]:
    """How far each pixel of a side belongs to each cell along it: linear between the cells' centres."""
    count = max(2, round(size / cell))
    places = np.clip((np.arange(size) + 0.5) / size * count - 0.5, 0.0, count - 1.0)
    return np.maximum(0.0, 1.0 - np.abs(places[:, None] - np.arange(count))).astype(np.float32)
