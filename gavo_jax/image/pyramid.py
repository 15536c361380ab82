"""Image pyramids of the grey and depth images, on the device (paper, section 3.4).

Level 0 is the full image; each level halves the last. Pixel centres are integers, so a pixel of level k + 1 sits in
the middle of a 2x2 block of level k (`Camera.level` holds the same convention).
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Integer

from gavo_jax.image.levels import atlas_layout

LEVELS = 5

# Inverse depths that differ by more than this share are of two surfaces and are not averaged: a 2x2 block across an
# edge keeps the nearer one.
EDGE_TOLERANCE = 0.03

STEEPEST = 20.0
"""Relative change of inverse depth from a pixel to the next above which the two are of two surfaces, times the pixels
of the image's longer side. One surface changes as much if it is seen at about 4 degrees. The change is at least
`EDGE_TOLERANCE`."""


class PyramidLevel(NamedTuple):
    """One level of one frame."""

    grey: Float[Array, "h w"]
    """Intensity in grey levels, 0 to 255."""
    inverse_depth: Float[Array, "h w"]
    """1/z in 1/m; 0 where there is no reading."""


Pyramid = tuple[PyramidLevel, ...]


def halve_grey(grey: Float[Array, "h w"]) -> Float[Array, "h2 w2"]:
    """Halve an image with the binomial kernel [1 3 3 1]/8, which is centred on the 2x2 block; borders replicate."""
    height, width = (size // 2 * 2 for size in grey.shape)
    padded = jnp.pad(grey[:height, :width], 1)
    along_v = _halve([padded[k : k + height : 2] for k in range(4)], axis=0)
    return _halve([along_v[:, k : k + width : 2] for k in range(4)], axis=1)


def _halve(taps: Sequence[jax.Array], axis: int) -> jax.Array:
    """Apply [1 3 3 1]/8 to four taps; at the ends of the axis the tap outside is replicated."""
    place = jax.lax.broadcasted_iota(jnp.int32, taps[0].shape, axis)
    before = jnp.where(place == 0, taps[1], taps[0])
    after = jnp.where(place == taps[0].shape[axis] - 1, taps[2], taps[3])
    return 0.375 * (taps[1] + taps[2]) + 0.125 * (before + after)


def halve_inverse_depth(inverse_depth: Float[Array, "h w"]) -> Float[Array, "h2 w2"]:
    """Halve an image of inverse depth: the mean reading on each 2x2 block's nearest surface; 0 where there is none.

    Inverse depth is averaged because it is affine in the pixel coordinates on a plane, and because the sensor's noise
    is uniform in it.
    """
    height, width = inverse_depth.shape
    rows = inverse_depth[: height // 2 * 2, : width // 2 * 2]
    taps = [rows[i::2, j::2] for i in (0, 1) for j in (0, 1)]
    nearest = jnp.maximum(jnp.maximum(taps[0], taps[1]), jnp.maximum(taps[2], taps[3]))
    floor = nearest * (1.0 - EDGE_TOLERANCE)
    keep = [(tap >= floor) & (tap > 0) for tap in taps]
    count = sum(k.astype(jnp.float32) for k in keep)
    total = sum(jnp.where(k, tap, 0.0) for k, tap in zip(keep, taps, strict=True))
    return total / jnp.maximum(count, 1.0)


def without_mixed_readings(inverse_depth: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """Drop readings between two surfaces, or between one and no reading: both neighbours along u or v are unlike them.

    A time-of-flight camera mixes what a pixel sees at a boundary ("flying pixels"); so does interpolation, when depth
    is resized or undistorted. The search would prefer such points, which lie where nothing is but at the image's edges.
    """
    tolerance = max(EDGE_TOLERANCE, STEEPEST / max(inverse_depth.shape))
    around = jnp.pad(inverse_depth, 1)

    def is_between(before: jax.Array, after: jax.Array) -> jax.Array:
        unlike = [
            jnp.abs(beside - inverse_depth) > tolerance * jnp.maximum(beside, inverse_depth)
            for beside in (before, after)
        ]
        return unlike[0] & unlike[1] & (jnp.maximum(before, after) > 0)

    mixed = is_between(around[1:-1, :-2], around[1:-1, 2:]) | is_between(around[:-2, 1:-1], around[2:, 1:-1])
    return jnp.where(mixed, 0.0, inverse_depth)


def build_pyramid(
    grey: Integer[Array, "h w"] | Float[Array, "h w"],
    depth: Integer[Array, "h w"] | Float[Array, "h w"],
    depth_scale: Float[Array, ""] | float,
    levels: int = LEVELS,
) -> Pyramid:
    """Build the pyramid of a frame from its raw images.

    Args:
        grey: [H, W] intensity, 0 to 255, of any number type.
        depth: [H, W]; z = depth / depth_scale in metres. 0, negative or non-finite means no reading.
        depth_scale: Units of `depth` per metre (5000 for TUM's PNG files, 1 for metres).
        levels: Number of levels, the full image included.

    Returns:
        A tuple of `PyramidLevel`, level 0 (the full image) first.
    """
    z = depth.astype(jnp.float32)
    inverse = jnp.where((z > 0) & jnp.isfinite(z), depth_scale / jnp.where(z > 0, z, 1.0), 0.0)
    grey = jnp.nan_to_num(grey.astype(jnp.float32))
    pyramid = [PyramidLevel(grey, without_mixed_readings(inverse))]
    for _ in range(levels - 1):
        pyramid.append(PyramidLevel(halve_grey(pyramid[-1].grey), halve_inverse_depth(pyramid[-1].inverse_depth)))
    return tuple(pyramid)


class Atlas(NamedTuple):
    """Levels of a frame in one image, so that each step processes all of them in one operation.

    The layout is surrounded by an empty margin, one row and column before it and two behind, so that a pixel's
    neighbours are slices of the image.
    """

    grey: Float[Array, "h+3 w+3"]
    """Grey levels; `NO_PIXEL` in the margin and between the levels."""
    inverse_depth: Float[Array, "h+3 w+3"]
    """Inverse depth, 1/m; 0 in the margin and between the levels."""


NO_PIXEL = -1.0
"""Grey value of places that are not pixels."""


def make_atlas(levels: Sequence[PyramidLevel]) -> Atlas:
    """Make the atlas of some levels, with the layout of `levels.atlas_layout`."""
    layout = atlas_layout([(level.grey.shape[0], level.grey.shape[1]) for level in levels])
    size = (layout.height + 3, layout.width + 3)
    grey, inverse_depth = jnp.full(size, NO_PIXEL), jnp.zeros(size)
    for level, (row, column) in zip(levels, layout.corners, strict=True):
        corner = (row + 1, column + 1)
        grey = jax.lax.dynamic_update_slice(grey, jnp.maximum(level.grey, 0.0), corner)
        inverse_depth = jax.lax.dynamic_update_slice(inverse_depth, level.inverse_depth, corner)
    return Atlas(grey, inverse_depth)
