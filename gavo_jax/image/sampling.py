"""Sampling the target image at warped points.

The target's 2x2 neighbourhoods are packed into one 32-bit word per pixel, so that a residual costs one gather. On a CPU
this decides the speed of the whole program (`benchmarks/kernel.py` prints by how much).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from gavo_jax.image.levels import ImagePlane
from gavo_jax.image.pyramid import Atlas
from gavo_jax.image.warp import Warped

INVERSE_DEPTH_STEP = 1.0 / 8192.0
"""Unit of packed inverse depth, 1/m: 16 bits reach 8 1/m (12.5 cm) in a twentieth of a first Kinect's steps."""
SAME_SURFACE = 0.1
"""Neighbouring readings whose inverse depths differ by less than this share are of one surface."""
SLOPE_STEP = 1.0 / 4096.0
"""Unit of packed inverse-depth slopes (signed 8 bits), 1/m per pixel."""


class Target(NamedTuple):
    """Levels of the target frame, packed for sampling with one gather per channel; laid out as an `Atlas`.

    They are not flat arrays, as XLA would divide every index into row and column to write them.
    """

    grey: UInt32[Array, "h w"]
    """Four 8-bit grey levels of the 2x2 block that starts at the pixel: (v, u), (v, u+1), (v+1, u), (v+1, u+1)."""
    depth: UInt32[Array, "h w"]
    """The same block as a plane: 16 bits of inverse depth in its middle (0 = no reading) and 8 bits for each slope."""


def pack_grey(grey: Float[Array, "h+1 w+1"]) -> UInt32[Array, "h w"]:
    """Pack the 2x2 neighbourhood of every pixel but the last ones into a word; rounding is far below the noise."""
    rounded = jnp.clip(jnp.round(grey), 0, 255).astype(jnp.uint32)
    pair = rounded[:, :-1] | (rounded[:, 1:] << 8)
    return pair[:-1] | (pair[1:] << 16)


def inverse_depth_slopes(
    inverse_depth: Float[Array, "h+2 w+2"],
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Return ∂(1/z)/∂u and ∂(1/z)/∂v, 1/m per pixel, from neighbours on the same surface; 0 where there are none.

    Args:
        inverse_depth: 1/m, 0 = no reading, with a margin of one pixel.
    """
    q = inverse_depth[1:-1, 1:-1]

    def along(last: jax.Array, following: jax.Array) -> jax.Array:
        ahead, behind = following - q, q - last
        near_ahead = (following > 0) & (jnp.abs(ahead) < SAME_SURFACE * q)
        near_behind = (last > 0) & (jnp.abs(behind) < SAME_SURFACE * q)
        total = jnp.where(near_ahead, ahead, 0.0) + jnp.where(near_behind, behind, 0.0)
        count = near_ahead.astype(jnp.float32) + near_behind.astype(jnp.float32)
        return total / jnp.maximum(count, 1.0)

    along_u = along(inverse_depth[1:-1, :-2], inverse_depth[1:-1, 2:])
    return along_u, along(inverse_depth[:-2, 1:-1], inverse_depth[2:, 1:-1])


def pack_depth(inverse_depth: Float[Array, "h+3 w+3"]) -> UInt32[Array, "h w"]:
    """Pack inverse depth and its slopes into a word: a plane about the middle of the 2x2 block that starts at a pixel.

    Sampling between pixels then needs no neighbours. Each of the four readings is extrapolated to the middle by its own
    slopes; those on the nearest surface are averaged.

    Args:
        inverse_depth: 1/m, 0 = no reading, with the margin of an `Atlas`.
    """
    planes = (inverse_depth[1:-1, 1:-1], *inverse_depth_slopes(inverse_depth))
    height, width = (size - 3 for size in inverse_depth.shape)
    values, along_u, along_v = (
        [plane[i : i + height, j : j + width] for i in (0, 1) for j in (0, 1)] for plane in planes
    )
    nearest = jnp.max(jnp.stack(values), axis=0)
    keep = [(value > 0) & (value > nearest * (1.0 - SAME_SURFACE)) for value in values]
    count = jnp.maximum(sum(k.astype(jnp.float32) for k in keep), 1.0)

    def mean(images: list[jax.Array]) -> jax.Array:
        return sum(jnp.where(k, image, 0.0) for k, image in zip(keep, images, strict=True)) / count

    places = [(i, j) for i in (0.5, -0.5) for j in (0.5, -0.5)]
    middle = mean([q + j * u + i * v for q, u, v, (i, j) in zip(values, along_u, along_v, places, strict=True)])
    value = jnp.clip(jnp.round(middle / INVERSE_DEPTH_STEP), 0, 65535).astype(jnp.uint32)

    def slope(s: jax.Array) -> jax.Array:
        return (jnp.clip(jnp.round(s / SLOPE_STEP), -127, 127) + 128).astype(jnp.uint32)

    return value | (slope(mean(along_u)) << 16) | (slope(mean(along_v)) << 24)


def pack_target(atlas: Atlas) -> Target:
    """Pack levels of a frame for sampling."""
    return Target(pack_grey(atlas.grey[1:-1, 1:-1]), pack_depth(atlas.inverse_depth))


class Words(NamedTuple):
    """Packed words of the target at the warped points' pixels, one per channel, [*n]."""

    grey: UInt32[Array, "*n"]
    depth: UInt32[Array, "*n"]


def look_up(target: Target, warped: Warped, plane: ImagePlane) -> Words:
    """Read the target at the pixel left of and above each warped point; pixel 0 for those that land outside.

    The barrier keeps XLA from reading a word anew for each of its bytes (`benchmarks/kernel.py`).
    """
    pixel = plane.offset + warped.v.astype(jnp.int32) * plane.stride + warped.u.astype(jnp.int32)
    pixel = jnp.where(warped.inside > 0, pixel, 0)
    words = (jnp.asarray(channel).reshape(-1).at[pixel].get(mode="promise_in_bounds") for channel in target)
    return jax.lax.optimization_barrier(Words(*words))


class GreySample(NamedTuple):
    """Bilinear intensity at the warped points and its exact derivative along u and v (grey levels per pixel)."""

    value: Float[Array, "*n"]
    along_u: Float[Array, "*n"]
    along_v: Float[Array, "*n"]


def _byte(word: jax.Array, shift: int) -> jax.Array:
    return ((word >> shift) & 255).astype(jnp.int32).astype(jnp.float32)


def sample_grey(words: Words, warped: Warped) -> GreySample:
    """I_{t+1}(ω(ξ, p)), bilinear; values outside the image are meaningless and must be masked by `inside`."""
    a, b = warped.u - jnp.floor(warped.u), warped.v - jnp.floor(warped.v)
    top_left, top_right, low_left, low_right = (_byte(words.grey, shift) for shift in (0, 8, 16, 24))
    top = top_left + a * (top_right - top_left)
    low = low_left + a * (low_right - low_left)
    along_u = (top_right - top_left) + b * ((low_right - low_left) - (top_right - top_left))
    return GreySample(top + b * (low - top), along_u, low - top)


class DepthSample(NamedTuple):
    """Inverse depth at the warped points (1/m), its slopes (1/m per pixel), and whether there is a reading (0 or 1)."""

    value: Float[Array, "*n"]
    along_u: Float[Array, "*n"]
    along_v: Float[Array, "*n"]
    valid: Float[Array, "*n"]


def sample_depth(words: Words, warped: Warped) -> DepthSample:
    """Inverse depth of the target's surface at the warped points, from the plane of each point's block."""
    value = (words.depth & 65535).astype(jnp.int32).astype(jnp.float32) * INVERSE_DEPTH_STEP
    along_u = (_byte(words.depth, 16) - 128.0) * SLOPE_STEP
    along_v = (_byte(words.depth, 24) - 128.0) * SLOPE_STEP
    a, b = warped.u - jnp.floor(warped.u), warped.v - jnp.floor(warped.v)
    return DepthSample(
        value + along_u * (a - 0.5) + along_v * (b - 0.5), along_u, along_v, (value > 0).astype(jnp.float32)
    )
