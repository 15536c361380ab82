"""Black bars at the sides of images: they stay put as the scene moves, as a body would that goes with the camera.

Each image is judged by itself.
"""

from typing import Any

import numpy as np

DARKEST = 20
"""Grey levels of the brightest bar."""
ALIKE = 1
"""Grey levels by which the pixels of a bar differ at most."""
LEAST = 4
"""Pixels of the width of a bar."""
MOST = 0.5
"""Share of a side that bars may take: beyond, the image is blank."""
RIM = 4
"""Pixels beside a bar that coding or scaling has mixed with it."""


def without_bars(grey: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Replace bars by the rows and columns beside them, as the rim of an image without distortion is, without depth.

    The same objects come back where there are none.

    Args:
        grey: [h, w], grey levels.
        depth: [h, w], of the same view; 0 is no reading.
    """
    height, width = grey.shape
    rows, columns = _inside(grey), _inside(grey.T)
    if (rows.start, rows.stop, columns.start, columns.stop) == (0, height, 0, width):
        return grey, depth
    margins = [(side.start, size - side.stop) for side, size in ((rows, height), (columns, width))]
    kept = np.zeros_like(depth)
    kept[rows, columns] = depth[rows, columns]
    return np.pad(grey[rows, columns], margins, mode="edge"), kept


def _inside(image: Any) -> slice:
    """Rows that lie between bars, and off their rims."""
    size = len(image)
    first, last = _margin(image), _margin(image[::-1])
    return slice(0, size) if first + last > MOST * size else slice(first, size - last)


def _margin(image: Any) -> int:
    """How many rows are a bar and its rim, from the first one on; what is dark behind the rim belongs to it."""
    searched = image[: int(MOST * len(image)) + 1]
    end = _bar(searched)
    if end < LEAST:
        return 0
    while more := _bar(searched[end + RIM :]):
        end += RIM + more
    return end + RIM


def _bar(image: Any) -> int:
    """How many rows, from the first one on, are all of one dark level."""
    darkest, brightest = np.inf, -np.inf
    for count, row in enumerate(image):
        darkest, brightest = min(darkest, float(np.min(row))), max(float(np.max(row)), brightest)
        if not (brightest <= DARKEST and brightest - darkest <= ALIKE):  # not-a-number is no bar
            return count
    return len(image)
