"""Removal of black bars at the sides of images: they would look like a body that moves with the camera.

Each image is treated on its own.
"""

from typing import Any

import numpy as np

DARKEST = 20
"""Grey level of the brightest bar."""
MAX_BAR_CONTRAST = 1
"""Largest difference of the pixels in a bar, grey levels."""
MIN_BAR_WIDTH = 4
"""Minimum width of a bar, pixels."""
MAX_BAR_SHARE = 0.5
"""Largest share of a side that bars may take; beyond it the image is taken for blank and left as it is."""
RIM = 4
"""Pixels beside a bar that compression or scaling has blended with it."""


def without_bars(grey: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Replace bars by the rows and columns beside them, and clear their depth, as at the rim of undistorted images.

    Returns the same objects where there are no bars.

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
    """Rows between the bars and their rims."""
    size = len(image)
    first, last = _margin(image), _margin(image[::-1])
    return slice(0, size) if first + last > MAX_BAR_SHARE * size else slice(first, size - last)


def _margin(image: Any) -> int:
    """Number of rows of a bar and its rim, from the first row on; dark rows after the rim belong to the bar."""
    searched = image[: int(MAX_BAR_SHARE * len(image)) + 1]
    end = _bar(searched)
    if end < MIN_BAR_WIDTH:
        return 0
    while more := _bar(searched[end + RIM :]):
        end += RIM + more
    return end + RIM


def _bar(image: Any) -> int:
    """Number of leading rows that are uniformly dark."""
    darkest, brightest = np.inf, -np.inf
    for count, row in enumerate(image):
        darkest, brightest = min(darkest, float(np.min(row))), max(float(np.max(row)), brightest)
        if not (brightest <= DARKEST and brightest - darkest <= MAX_BAR_CONTRAST):  # NaN is no bar
            return count
    return len(image)
