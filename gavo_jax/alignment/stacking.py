"""Stacking of frames, given in various forms, into undistorted arrays for the compiled program."""

from contextlib import suppress
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import PRNGKeyArray

from gavo_jax.camera import Camera
from gavo_jax.camera_check import require_camera
from gavo_jax.datasets.bars import without_bars
from gavo_jax.datasets.base import TRACED, Frame, require_grey_levels, require_image
from gavo_jax.errors import GavoError, shown
from gavo_jax.number_types import as_array, with_zeros


class Images(NamedTuple):
    """Grey [H, W] and depth [H, W] of one frame, or of a batch with a leading axis."""

    grey: Any
    depth: Any


def require_untraced(*values: Any) -> None:
    """Refuse to run inside `jax.jit`, or on values traced by it, `jax.vmap` or `jax.grad`.

    Raises:
        GavoError: One of the values, or an array made here, is a tracer.
    """
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((values, jnp.zeros(())))):
        raise GavoError(TRACED)


def stacked_pairs(
    references: Any, targets: Any, camera: Camera, keys: PRNGKeyArray | None
) -> tuple[list[Images], PRNGKeyArray]:
    """Stack both sides of B pairs as `stacked_sides` does, and check or make their keys.

    Raises:
        GavoError: As `stacked_images`, or the two sides differ in number.
    """
    sides = stacked_sides(references, targets, camera)
    count, others = (len(side.grey) for side in sides)
    if others != count:
        raise GavoError(f"{count} references but {others} targets")
    return sides, jax.random.split(jax.random.key(0), count) if keys is None else typed_keys(keys, (count,))


def typed_keys(keys: Any, shape: tuple[int, ...]) -> PRNGKeyArray:
    """Return random keys of a given shape, () for one, in the type that `jax.random.key` makes.

    Keys of `jax.random.PRNGKey` are converted, as their type would make the search recompile.

    Raises:
        GavoError: They are not keys, or of another shape.
    """
    if isinstance(keys, jax.Array) and keys.dtype == np.uint32:
        with suppress(TypeError, ValueError):  # numbers of another shape are not keys
            keys = jax.random.wrap_key_data(keys)
    if not isinstance(keys, jax.Array) or not jnp.issubdtype(keys.dtype, jax.dtypes.prng_key):
        raise GavoError(f"expected a key, jax.random.key(seed), got {shown(keys)}")
    if keys.shape != shape:
        example = f"expected one per pair, jax.random.split(key, {shape[0]})" if shape else "expected a single key"
        raise GavoError(f"keys have shape {keys.shape}: {example}")
    return keys


def _plain(image: Any) -> Any:
    """Return an array that a program accepts; one that is on a device stays there."""
    return image if isinstance(image, jax.Array) else as_array(image)


def _without_bars(pairs: list[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
    """Remove bars from pairs of NumPy or JAX images; where there are none, return the same list."""
    seen = [(np.asarray(grey), np.asarray(depth)) for grey, depth in pairs]
    without = [without_bars(*pair) for pair in seen]
    return pairs if all(new[0] is old[0] for new, old in zip(without, seen, strict=True)) else without


def _rectified_images(frame: Frame | tuple[Any, Any], camera: Camera) -> Images:
    if not isinstance(frame, Frame) and (not isinstance(frame, tuple | list) or len(frame) != 2):
        raise GavoError(f"expected a Frame or a pair (grey, depth), got {type(frame).__name__}")
    grey, depth = map(_plain, (frame.grey, frame.depth) if isinstance(frame, Frame) else frame)
    for name, image in (("grey", grey), ("depth", depth)):
        require_image(name, image, (camera.height, camera.width))
    require_grey_levels(grey)
    depth = with_zeros(depth)
    [(grey, depth)] = _without_bars([(grey, depth)])
    if not camera.is_rectified:
        grey, depth = camera.undistort(np.asarray(grey), np.asarray(depth))
    return Images(grey, depth)


def stacked_sides(references: Any, targets: Any, camera: Camera) -> list[Images]:
    """Stack both sides as `stacked_images` does, in bytes and 16 bits, or in float32 throughout.

    Any other combination of types would make the search recompile.
    """
    sides = [stacked_images(side, camera) for side in (references, targets)]
    if all((side.grey.dtype, side.depth.dtype) == (np.uint8, np.uint16) for side in sides):
        return sides
    return [Images(*(jnp.asarray(image, jnp.float32) for image in side)) for side in sides]


def stacked_images(side: Any, camera: Camera) -> Images:
    """Stack B frames, in any form that `align_batch` accepts, without lens distortion.

    Raises:
        GavoError: They are not frames, too small, or not of the camera's size.
    """
    require_camera(camera)
    if not hasattr(side, "__len__"):
        raise GavoError(f"expected lists of frames or pairs of arrays, got {type(side).__name__}")
    if isinstance(side, tuple) and len(side) == 2 and all(isinstance(part, list) for part in side):
        raise GavoError("a tuple of two lists: expected a list of pairs (grey, depth), or stack each with np.stack")
    is_stacked = isinstance(side, tuple) and len(side) == 2 and not isinstance(side[0], tuple) and np.ndim(side[0]) == 3
    if not len(side[0] if is_stacked else side):
        raise GavoError("a batch of no frames: expected at least one pair")
    if is_stacked:
        side = tuple(map(_plain, side))
        if len(side[0]) != len(side[1]):
            raise GavoError(f"{len(side[0])} grey images but {len(side[1])} of depth")
        if not camera.is_rectified:
            return stacked_images(list(zip(*side, strict=True)), camera)
        for name, images in zip(("grey", "depth"), side, strict=True):
            require_image(name, images, (len(side[0]), camera.height, camera.width))
        require_grey_levels(side[0])
        pairs = list(zip(*map(np.asarray, side), strict=True))
        if (without := _without_bars(pairs)) is not pairs:
            side = tuple(map(np.stack, zip(*without, strict=True)))
        return Images(jnp.asarray(side[0]), jnp.asarray(with_zeros(side[1])))
    images = [_rectified_images(frame, camera) for frame in side]
    return Images(*(jnp.stack([jnp.asarray(image) for image in images]) for images in zip(*images, strict=True)))
