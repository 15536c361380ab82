"""Images come in any numbers, grey from 0 to 255, depth in any unit; some of what looks at them wants certain types."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8, UInt16

Depth = UInt16[np.ndarray, "h w"] | Float[np.ndarray, "h w"]
"""Of 16 bits, or float32 where it came as anything else: it may be in metres."""


def is_real(kind: Any) -> bool:
    """Whether a type of NumPy's or JAX's is one of real numbers, not of truth values, text or objects."""
    return any(jnp.issubdtype(kind, family) for family in (jnp.integer, jnp.floating))


KNOWN = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))
"""What OpenCV and the programs take."""


def as_array(image: Any) -> np.ndarray:
    """An image as a plain array of one of the `KNOWN` types, other numbers as float32; what is masked is 0, as where
    there is no reading. What holds no real numbers stays as it is.
    """
    array = np.asarray(image.filled(0) if isinstance(image, np.ma.MaskedArray) else image)
    if array.dtype in KNOWN or not is_real(array.dtype):
        return array
    with np.errstate(over="ignore"):  # what is too large for 32 bits is infinite there: no reading
        return array.astype(np.uint16 if array.dtype == ">u2" else np.float32)


NO_READING = np.iinfo(np.uint16).max
"""Depth of 16 bits that stands for none, as 0 does."""


def as_depth(image: Any) -> np.ndarray:
    """The same of a depth image, with 0 where there is no reading, as `with_zeros` has it."""
    return with_zeros(as_array(image))


def with_zeros(depth: Any) -> Any:
    """Depth, an array here or on a device, with 0 where there is no reading: no finite number, or of 16 bits the
    largest one.
    """
    numbers = jnp if isinstance(depth, jax.Array) else np
    if depth.dtype == np.uint16:
        is_reading = depth < NO_READING
    elif jnp.issubdtype(depth.dtype, jnp.floating):
        is_reading = numbers.isfinite(depth)
    else:
        return depth
    if numbers is np and is_reading.all():  # most images; a copy of each would be work on every frame
        return depth
    return numbers.where(is_reading, depth, depth.dtype.type(0))


def grey_bytes(grey: Any) -> UInt8[np.ndarray, "h w"]:
    """A grey image as OpenCV's keypoints, corners and colours need it; black where it is no number."""
    image = np.ascontiguousarray(grey)
    return image if image.dtype == np.uint8 else np.nan_to_num(image.clip(0, 255)).round().astype(np.uint8)


def readings_like(depth: np.ndarray, readings: Float[np.ndarray, "*n"]) -> np.ndarray:
    """Readings in 16 bits where the depth they were made of is so (0 where they do not fit), else as float32."""
    if depth.dtype != np.uint16:
        return readings.astype(np.float32)
    return np.where(readings < NO_READING, np.round(readings), 0.0).astype(np.uint16)
