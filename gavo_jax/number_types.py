"""Conversion of number types: images may have any, with grey from 0 to 255 and depth in any unit."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8, UInt16

Depth = UInt16[np.ndarray, "h w"] | Float[np.ndarray, "h w"]
"""Depth in 16 bits, or in float32 if it came in any other type (it may be in metres)."""


def is_real(kind: Any) -> bool:
    """Whether a NumPy or JAX type is of real numbers, not of booleans, text or objects."""
    return any(jnp.issubdtype(kind, family) for family in (jnp.integer, jnp.floating))


KNOWN = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))
"""Types that OpenCV and the compiled programs accept."""


def as_array(image: Any) -> np.ndarray:
    """Convert an image to a plain array of one of the `KNOWN` types; other numbers become float32.

    Masked pixels become 0, as without a reading. An array that does not hold real numbers stays as it is.
    """
    array = np.asarray(image.filled(0) if isinstance(image, np.ma.MaskedArray) else image)
    if array.dtype in KNOWN or not is_real(array.dtype):
        return array
    with np.errstate(over="ignore"):  # values too large for float32 become infinite: no reading
        return array.astype(np.uint16 if array.dtype == ">u2" else np.float32)


NO_READING = np.iinfo(np.uint16).max
"""Value of 16-bit depth that means no reading, as 0 does."""


def as_depth(image: Any) -> np.ndarray:
    """Convert a depth image as `as_array` does, with 0 where there is no reading (`with_zeros`)."""
    return with_zeros(as_array(image))


def with_zeros(depth: Any) -> Any:
    """Set depth, a NumPy or JAX array, to 0 where there is no reading.

    That is where it is not finite or, in 16 bits, `NO_READING`.
    """
    numbers = jnp if isinstance(depth, jax.Array) else np
    if depth.dtype == np.uint16:
        is_reading = depth < NO_READING
    elif jnp.issubdtype(depth.dtype, jnp.floating):
        is_reading = numbers.isfinite(depth)
    else:
        return depth
    if numbers is np and is_reading.all():  # most images: avoids a copy per frame
        return depth
    return numbers.where(is_reading, depth, depth.dtype.type(0))


def grey_bytes(grey: Any) -> UInt8[np.ndarray, "h w"]:
    """Convert a grey image to bytes, as OpenCV's keypoints, corners and colours need; NaN becomes black."""
    image = np.ascontiguousarray(grey)
    return image if image.dtype == np.uint8 else np.nan_to_num(image.clip(0, 255)).round().astype(np.uint8)


def readings_like(depth: np.ndarray, readings: Float[np.ndarray, "*n"]) -> np.ndarray:
    """Convert readings to 16 bits if the depth they come from is (0 where they do not fit), else to float32."""
    if depth.dtype != np.uint16:
        return readings.astype(np.float32)
    return np.where(readings < NO_READING, np.round(readings), 0.0).astype(np.uint16)
