"""What stamps of a clock count, which only their size says."""

from collections.abc import Sequence

import numpy as np

UNITS = (1.0, 1e-3, 1e-6, 1e-9)
"""Seconds of what stamps may count."""

EPOCH = (946684800.0, 4102444800.0)
"""Seconds since 1970 of the years 2000 to 2100, from which stamps of a clock are."""


def clock_unit(stamps: Sequence[float] | np.ndarray) -> float | None:
    """Seconds of what stamps since 1970 count; None where they are no such stamps."""
    low, high = min(stamps), max(stamps)
    return next((unit for unit in UNITS if EPOCH[0] < unit * low and unit * high < EPOCH[1]), None)
