"""Okabe and Ito's colours, which are safe for colour-blind readers, and a scale between two of them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8, UInt32

BLUE, WHITE, VERMILION, GREEN = (86, 180, 233), (245, 245, 245), (213, 94, 0), (0, 158, 115)
GREY, DARK = (120, 120, 120), (24, 26, 32)
"""RGB of scales, paths and backgrounds; blue, vermilion and green are Okabe and Ito's."""


BODIES = ((230, 159, 0), (204, 121, 167), (240, 228, 66), (0, 114, 178))
"""RGB of bodies, in turn."""


def color_of_body(number: int) -> tuple[int, int, int]:
    """Return the RGB in which a body of that number, from 1, is shown."""
    return BODIES[(number - 1) % len(BODIES)]


def blend(place: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape 3"]:
    """Return RGB on a scale from blue (−1) through white (0) to vermilion (1)."""
    channels = [np.interp(place, (-1.0, 0.0, 1.0), values) for values in zip(BLUE, WHITE, VERMILION, strict=True)]
    return np.stack(channels, axis=-1).astype(np.uint8)


def packed(rgb: UInt8[np.ndarray, "n 3"]) -> UInt32[np.ndarray, " n"]:
    """Pack colours as Rerun stores them: opaque RGBA, one byte per channel."""
    return (rgb.astype(np.uint32) << np.array([24, 16, 8], np.uint32)).sum(axis=1, dtype=np.uint32) | np.uint32(255)


SCALE = blend(np.linspace(-1, 1, 256))
PARTICLE_COLORS = packed(SCALE)
"""Packed colours from the best error, blue, to the worst, vermilion."""
RESIDUAL_COLORS = np.ascontiguousarray(SCALE[:, None, ::-1])
"""BGR from a residual of −RESIDUAL_RANGE, blue, to RESIDUAL_RANGE, vermilion."""
GREYS = packed(np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1))
