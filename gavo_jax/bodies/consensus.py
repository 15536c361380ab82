"""What the image's area says of a motion: each block has one vote, whatever its contrast.

A search weighs points by their information. So a high-contrast body outweighs a larger, plainer scene, which a slightly
wrong motion explains nearly as well. Here every block of the image tells how much better a motion of its own would
explain it. A plain block tells this as firmly as a rich one, from all its pixels together.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gavo_jax.bodies.pixel_evidence import View, compare
from gavo_jax.camera import Camera
from gavo_jax.image.levels import image_plane
from gavo_jax.image.warp import Slopes
from gavo_jax.objective.derivatives import pixel_jacobian
from gavo_jax.se3 import exp

STRIDE = 2
"""Spacing of the sampled pixels along either side of the image."""
CELL = 4
"""Sampled pixels along either side of a block."""
LEAST_GREY, LEAST_DEPTH = 1.0, 8e-4
"""Smallest standard deviations of a pixel's residuals: grey levels, 1/m."""
BOUND = 6.0
"""Standard deviations at which a residual's weight falls to a quarter, to limit the effect of occlusions and edges."""
FARTHER = 2.0
"""Largest depth, over the median depth, up to which a pixel's weight grows: it is the area of its surface, depth
squared.
"""
ROUNDS = 4
"""Rounds of re-weighting the blocks by their gains, relative to the median."""
DRAWS, DRAWN = 48, 6
"""Random draws to start from, and blocks in each: beside a strong body, the median's nearest minimum is not its least
one.
"""
HALVINGS = 16
DISSENT = 6.0
"""Gain of a block, over the median gain, above which it does not move with the others."""


class Blocks(NamedTuple):
    """Normal equations of B blocks at one motion, for a step δ on the target's side, and the weight of each block."""

    hessian: Float[Array, "b 6 6"]
    gradient: Float[Array, "b 6"]
    whitened: Float[Array, "b 6 7"]
    """L⁻¹ [H g], the whitened Hessian and gradient, where LLᵀ is the damped Hessian."""
    credit: Float[Array, " b"]


class Opinion(NamedTuple):
    """The opinion of the image's area on a motion."""

    dissent: Float[Array, ""]
    """What the median block would gain by a motion of its own."""
    least: Float[Array, ""]
    """What the median block would gain at `target_T_reference`."""
    target_T_reference: Float[Array, "4 4"]
    """The motion that the area asks for."""
    dissenting: Bool[Array, "h w"]
    """Pixels of blocks that do not follow `target_T_reference`."""


def has_blocks(camera: Camera) -> bool:
    """Whether an image is large enough for a block."""
    return min(_grid(camera)) > 0


def ask_area(
    here: View, there: View, target_T_here: Float[Array, "4 4"], credit: Float[Array, "h w"], camera: Camera
) -> Opinion:
    """The opinion of a view's area on a motion, and the motion with the least median of what blocks would gain.

    Args:
        here: The view.
        there: The view that the motion leads to.
        target_T_here: The motion.
        credit: Weight of each pixel.
        camera: Camera of the views' level.
    """
    blocks = _equations(here, there, target_T_here, credit, camera)

    def middle_gain(delta: jax.Array) -> jax.Array:
        return weighted_median(gain_of_its_own(blocks, delta), blocks.credit)

    def settle(_: int, delta: jax.Array) -> jax.Array:
        gains = gain_of_its_own(blocks, delta)
        weight = blocks.credit / (1.0 + gains / (2.0 * weighted_median(gains, blocks.credit))) ** 2
        hessian = jnp.einsum("b,bij->ij", weight, blocks.hessian)
        return -jnp.linalg.solve(hessian + jnp.eye(6), weight @ blocks.gradient)

    nothing = jnp.zeros(6)
    asked_by_few = _steps_of_few(blocks)
    best_of_few = asked_by_few[jnp.argmin(jax.vmap(middle_gain)(asked_by_few))]
    settled = jax.vmap(lambda start: jax.lax.fori_loop(0, ROUNDS, settle, start))(jnp.stack([nothing, best_of_few]))
    delta = settled[jnp.argmin(jax.vmap(middle_gain)(settled))]
    gains = gain_of_its_own(blocks, delta)
    least = weighted_median(gains, blocks.credit)
    return Opinion(
        middle_gain(nothing),
        least,
        exp(delta) @ target_T_here,
        _pixels_of(gains > DISSENT * least, camera),
    )


def gain_of_its_own(blocks: Blocks, delta: Float[Array, " 6"]) -> Float[Array, " b"]:
    """Return how far each block's squared residuals, in variances, would fall under a motion of its own instead of δ.

    This is pᵀH⁻¹p, where p = Hδ + g.
    """
    pull = blocks.whitened[..., :6] @ delta + blocks.whitened[..., 6]
    return jnp.sum(pull**2, axis=-1)


def _steps_of_few(blocks: Blocks) -> Float[Array, "d 6"]:
    """Steps that random draws of a few blocks ask for; the draws depend on the number of blocks only."""
    of = np.random.default_rng(0).integers(0, len(blocks.credit), (DRAWS, DRAWN))
    credit = blocks.credit[of]
    hessian = jnp.einsum("db,dbij->dij", credit, blocks.hessian[of])
    gradient = jnp.einsum("db,dbi->di", credit, blocks.gradient[of])
    return -_solved(hessian + jnp.eye(6), gradient)


def _grid(camera: Camera) -> tuple[int, int]:
    """Rows and columns of the grid of blocks."""
    rows, columns = (-(-size // STRIDE) // CELL for size in (camera.height, camera.width))
    return rows, columns


def _pixels_of(blocks: Bool[Array, " b"], camera: Camera) -> Bool[Array, "h w"]:
    """Pixels of the given blocks; pixels at the right and bottom that belong to no block are never among them."""
    rows, columns = _grid(camera)
    pixels = jnp.repeat(jnp.repeat(blocks.reshape(rows, columns), CELL * STRIDE, 0), CELL * STRIDE, 1)
    pixels = pixels[: camera.height, : camera.width]  # where a side is odd, the last block may reach beyond it
    return jnp.pad(pixels, ((0, camera.height - pixels.shape[0]), (0, camera.width - pixels.shape[1])))


def _equations(
    here: View, there: View, target_T_here: Float[Array, "4 4"], credit: Float[Array, "h w"], camera: Camera
) -> Blocks:
    plane = image_plane(camera)
    compared = compare(here, jax.tree.map(lambda leaf: leaf[None], there), target_T_here[None], camera, STRIDE)
    r = jax.tree.map(lambda leaf: leaf[0], compared.residuals)
    area = surface_area(compared.inverse_depth)
    counted = credit[::STRIDE, ::STRIDE].reshape(-1) * area * r.inside
    nothing = jnp.zeros_like(r.grey)
    along_grey = Slopes(r.grey_sample.along_u, r.grey_sample.along_v, nothing)
    along_depth = Slopes(-r.depth_sample.along_u, -r.depth_sample.along_v, nothing + 1.0)
    parts: list[jax.Array] = [counted / CELL**2] + [nothing] * 27
    for residual, mask, least, slopes in (
        (r.grey, r.inside, LEAST_GREY, along_grey),
        (r.depth, r.depth_valid, LEAST_DEPTH, along_depth),
    ):
        scale = jnp.maximum(1.48 * median_by_bisection(jnp.abs(residual), mask * counted > 0), least)
        weight = jnp.where(mask > 0, (1.0 + (residual / (BOUND * scale)) ** 2) ** -2 / scale**2, 0.0)
        rows = [*jnp.where(mask > 0, pixel_jacobian(slopes, r.warped, plane), 0.0), residual]
        own = [weight * rows[i] * rows[j] for i in range(6) for j in range(i, 7)]
        parts = [parts[0], *(part + one for part, one in zip(parts[1:], own, strict=True))]
    credit, *sums = block_sums(jnp.stack(parts), camera)
    entry = {pair: one for pair, one in zip(((i, j) for i in range(6) for j in range(i, 7)), sums, strict=True)}
    gradient = jnp.stack([entry[i, 6] for i in range(6)], axis=-1)
    hessian = jnp.stack([jnp.stack([entry[min(i, j), max(i, j)] for j in range(6)], -1) for i in range(6)], -2)
    size = jnp.trace(hessian, axis1=1, axis2=2)[:, None, None]
    damped = hessian + (1e-3 * size + 1.0) * jnp.eye(6)
    whitened = _whitened(damped, jnp.concatenate([hessian, gradient[..., None]], axis=-1))
    return Blocks(hessian, gradient, whitened, credit)


def surface_area(inverse_depth: Float[Array, " n"]) -> Float[Array, " n"]:
    """Relative area of the surface that each pixel shows, 1 at the median depth; 0 where there is no reading."""
    has = inverse_depth > 0
    depth = jnp.where(has, 1.0 / jnp.maximum(inverse_depth, 1e-3), 0.0)
    return jnp.minimum(depth / jnp.maximum(median_by_bisection(depth, has), 1e-3), FARTHER) ** 2


def block_sums(values: Float[Array, "c n"], camera: Camera) -> Float[Array, "c b"]:
    """Sum the values of sampled pixels over each block; pixels left over at the right and bottom are dropped."""
    height, width = (-(-size // STRIDE) for size in (camera.height, camera.width))
    rows, columns = _grid(camera)
    image = values.reshape(-1, height, width)[:, : rows * CELL, : columns * CELL]
    return image.reshape(-1, rows, CELL, columns, CELL).sum((2, 4)).reshape(-1, rows * columns)


def _solved(matrices: Float[Array, "b 6 6"], right: Float[Array, "b 6"]) -> Float[Array, "b 6"]:
    """Solve positive definite systems by Gauss-Jordan elimination: a call of LAPACK takes ten times as long."""
    rows = jnp.moveaxis(jnp.concatenate([matrices, right[..., None]], axis=-1), 0, -1)
    for k in range(6):
        pivot = rows[k] / rows[k, k]
        rows = (rows - rows[:, k, None] * pivot).at[k].set(pivot)
    return rows[:, 6].T


def _whitened(matrices: Float[Array, "b 6 6"], right: Float[Array, "b 6 c"]) -> Float[Array, "b 6 c"]:
    """L⁻¹ times the right-hand sides, for positive definite matrices LLᵀ, by Gaussian elimination."""
    rows = jnp.moveaxis(jnp.concatenate([matrices, right], axis=-1), 0, -1)
    whitened = []
    for _ in range(6):  # each pass removes the first row and column that are left
        pivot = rows[0] / jnp.sqrt(rows[0, 0])
        rows = rows[1:, 1:] - rows[1:, :1] / rows[0, 0] * rows[0, 1:]
        whitened.append(pivot[-right.shape[-1] :])
    return jnp.moveaxis(jnp.stack(whitened), -1, 0)


def median_by_bisection(values: Float[Array, " n"], counted: Bool[Array, " n"]) -> Float[Array, ""]:
    """Median of the `counted` non-negative values, to a small fraction of the largest one.

    Bisection is used, as sorting would take longer than all else here.
    """
    half = 0.5 * jnp.sum(counted)

    def halve(_: int, limits: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = limits
        middle = 0.5 * (low + high)
        is_above = jnp.sum(counted & (values < middle)) < half
        return jnp.where(is_above, middle, low), jnp.where(is_above, high, middle)

    return jax.lax.fori_loop(0, HALVINGS, halve, (jnp.float32(0.0), jnp.max(jnp.where(counted, values, 0.0))))[1]


def weighted_median(values: Float[Array, " b"], weights: Float[Array, " b"]) -> Float[Array, ""]:
    """Smallest of some non-negative values up to which half of the weight lies.

    This bisects the bits of the floats, which sort as the floats do: sorting takes twenty times as long.
    """
    half = 0.5 * jnp.sum(weights)
    bits = jax.lax.bitcast_convert_type(values, jnp.int32)

    def halve(_: int, limits: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = limits
        middle = low + (high - low) // 2
        is_enough = jnp.sum(jnp.where(bits <= middle, weights, 0.0)) >= half
        return jnp.where(is_enough, low, middle + 1), jnp.where(is_enough, middle, high)

    infinity = jax.lax.bitcast_convert_type(jnp.float32(jnp.inf), jnp.int32)
    return jax.lax.bitcast_convert_type(jax.lax.fori_loop(0, 31, halve, (jnp.int32(0), infinity))[1], jnp.float32)
