"""What the image's area says of a motion: block after block has one vote, whatever its contrast.

A search counts points by how much they tell, so a body of much contrast outweighs a larger, plainer scene, which a
slightly different motion explains nearly as well. Here every block of the image tells how much better a motion of its
own would explain it. A plain block tells that as firmly as a rich one, by all its pixels together.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gavo_jax.bodies.evidence import View, compare
from gavo_jax.camera import Camera
from gavo_jax.image.levels import image_plane
from gavo_jax.image.warp import Slopes
from gavo_jax.objective.derivatives import pixel_jacobian
from gavo_jax.se3 import exp

STRIDE = 2
"""Pixels of the image from one that is asked to the next, along either side."""
CELL = 4
"""Asked pixels along either side of a block."""
LEAST_GREY, LEAST_DEPTH = 1.0, 8e-4
"""Smallest deviations of a pixel's residuals: grey levels, 1/m."""
BOUND = 6.0
"""Deviations at which a single pixel's residual counts by half as much: what is hidden, and edges."""
FARTHER = 2.0
"""A pixel counts by the area of the surface that it shows, depth squared, up to so many times the usual depth."""
ROUNDS = 4
"""Rounds of re-weighting the blocks, about their median."""
DRAWS, DRAWN = 48, 6
"""Draws to begin from, and blocks of each: where a body is strong, the median's next minimum is not its least one."""
HALVINGS = 16
DISSENT = 6.0
"""Times the usual: from there on a block does not move as the others do."""


class Blocks(NamedTuple):
    """The normal equations of B blocks at one motion, by a step δ on the target's side; and how much each counts."""

    hessian: Float[Array, "b 6 6"]
    gradient: Float[Array, "b 6"]
    whitened: Float[Array, "b 6 7"]
    """L⁻¹ of Hessian and gradient, [H g], where LLᵀ is the Hessian, damped."""
    credit: Float[Array, " b"]


class Opinion(NamedTuple):
    """What the area says of a motion."""

    dissent: Float[Array, ""]
    """What the middle one of the blocks would gain by a motion of its own."""
    least: Float[Array, ""]
    """The same with the motion below."""
    target_T_reference: Float[Array, "4 4"]
    """The motion that the area asks for."""
    dissenting: Bool[Array, "h w"]
    """Pixels of blocks that do not move by it."""


def has_blocks(camera: Camera) -> bool:
    """Whether an image is large enough for a block."""
    return min(_grid(camera)) > 0


def ask_area(
    here: View, there: View, target_T_here: Float[Array, "4 4"], credit: Float[Array, "h w"], camera: Camera
) -> Opinion:
    """What the area of a view says of a motion, and which one it asks for: the least median of what blocks would gain.

    Args:
        here: The view.
        there: The one that the motion leads to.
        target_T_here: The motion.
        credit: How far each pixel counts.
        camera: Of the views' level.
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
    """Return by how much each block's squared residuals, in variances, fall if it moves as it likes, not by δ:
    pᵀH⁻¹p, where p = Hδ + g.
    """
    pull = blocks.whitened[..., :6] @ delta + blocks.whitened[..., 6]
    return jnp.sum(pull**2, axis=-1)


def _steps_of_few(blocks: Blocks) -> Float[Array, "d 6"]:
    """The steps that draws of a few blocks ask for; the same draws for every image of a size."""
    of = np.random.default_rng(0).integers(0, len(blocks.credit), (DRAWS, DRAWN))
    credit = blocks.credit[of]
    hessian = jnp.einsum("db,dbij->dij", credit, blocks.hessian[of])
    gradient = jnp.einsum("db,dbi->di", credit, blocks.gradient[of])
    return -_solved(hessian + jnp.eye(6), gradient)


def _grid(camera: Camera) -> tuple[int, int]:
    """Rows and columns of blocks."""
    rows, columns = (-(-size // STRIDE) // CELL for size in (camera.height, camera.width))
    return rows, columns


def _pixels_of(blocks: Bool[Array, " b"], camera: Camera) -> Bool[Array, "h w"]:
    """The pixels of some blocks; none of what is left over beside them."""
    rows, columns = _grid(camera)
    pixels = jnp.repeat(jnp.repeat(blocks.reshape(rows, columns), CELL * STRIDE, 0), CELL * STRIDE, 1)
    pixels = pixels[: camera.height, : camera.width]  # of an odd side, a block's last pixel may lie outside
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
    """How large a surface each pixel shows, in those of the usual depth; 0 where there is no reading."""
    has = inverse_depth > 0
    depth = jnp.where(has, 1.0 / jnp.maximum(inverse_depth, 1e-3), 0.0)
    return jnp.minimum(depth / jnp.maximum(median_by_bisection(depth, has), 1e-3), FARTHER) ** 2


def block_sums(values: Float[Array, "c n"], camera: Camera) -> Float[Array, "c b"]:
    """Sum values at all pixels asked by blocks; what is left over at the right and below is left out."""
    height, width = (-(-size // STRIDE) for size in (camera.height, camera.width))
    rows, columns = _grid(camera)
    image = values.reshape(-1, height, width)[:, : rows * CELL, : columns * CELL]
    return image.reshape(-1, rows, CELL, columns, CELL).sum((2, 4)).reshape(-1, rows * columns)


def _solved(matrices: Float[Array, "b 6 6"], right: Float[Array, "b 6"]) -> Float[Array, "b 6"]:
    """Solve positive definite systems by Gauss-Jordan elimination: LAPACK's call takes ten times as long."""
    rows = jnp.moveaxis(jnp.concatenate([matrices, right[..., None]], axis=-1), 0, -1)
    for k in range(6):
        pivot = rows[k] / rows[k, k]
        rows = (rows - rows[:, k, None] * pivot).at[k].set(pivot)
    return rows[:, 6].T


def _whitened(matrices: Float[Array, "b 6 6"], right: Float[Array, "b 6 c"]) -> Float[Array, "b 6 c"]:
    """L⁻¹ of what stands to the right of positive definite matrices LLᵀ, by Gauss's elimination."""
    rows = jnp.moveaxis(jnp.concatenate([matrices, right], axis=-1), 0, -1)
    whitened = []
    for _ in range(6):  # of the rows that are left, the first column and row go
        pivot = rows[0] / jnp.sqrt(rows[0, 0])
        rows = rows[1:, 1:] - rows[1:, :1] / rows[0, 0] * rows[0, 1:]
        whitened.append(pivot[-right.shape[-1] :])
    return jnp.moveaxis(jnp.stack(whitened), -1, 0)


def median_by_bisection(values: Float[Array, " n"], counted: Bool[Array, " n"]) -> Float[Array, ""]:
    """Median of some of many values from 0 on, to a small part of their largest, by bisection: sorting takes longer
    than all else here.
    """
    half = 0.5 * jnp.sum(counted)

    def halve(_: int, limits: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = limits
        middle = 0.5 * (low + high)
        is_above = jnp.sum(counted & (values < middle)) < half
        return jnp.where(is_above, middle, low), jnp.where(is_above, high, middle)

    return jax.lax.fori_loop(0, HALVINGS, halve, (jnp.float32(0.0), jnp.max(jnp.where(counted, values, 0.0))))[1]


def weighted_median(values: Float[Array, " b"], weights: Float[Array, " b"]) -> Float[Array, ""]:
    """The least of some values from 0 on up to which half of the weight lies, by bisection of its bits: those of floats
    stand in the same order, and sorting takes twenty times as long.
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
