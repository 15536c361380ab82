"""The scene as seen so far: one point for each small cube of space."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

CUBE = 0.03
"""Side of the cubes, metres."""
FARTHEST = 4.0
"""Largest depth shown, metres; beyond it, depth is too uncertain."""
MOST_POINTS = 300_000
"""Number of points after which no more are sent to a viewer."""
_BITS, _MIDDLE = 21, 1 << 20


class SeenCubes:
    """The cubes that already have a point."""

    def __init__(self) -> None:
        self._known: set[int] = set()

    def new(self, points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " m"]:
        """Return the indices of the first points in new cubes, and remember those; none after `MOST_POINTS` cubes."""
        if len(self._known) >= MOST_POINTS:
            return np.zeros(0, np.int64)
        cubes = np.clip(np.floor(points / CUBE).astype(np.int64) + _MIDDLE, 0, 2 * _MIDDLE - 1)
        keys = (cubes[:, 0] << 2 * _BITS) | (cubes[:, 1] << _BITS) | cubes[:, 2]
        unique, first = np.unique(keys, return_index=True)
        fresh = np.array([key not in self._known for key in unique.tolist()], bool)
        self._known.update(unique[fresh].tolist())
        return first[fresh]
