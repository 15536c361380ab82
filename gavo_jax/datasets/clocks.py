"""Guessing what the numbers of frames count: time since 1970, time since device start, or frames."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from gavo_jax.errors import GavoError, shown

UNITS = (1.0, 1e-3, 1e-6, 1e-9)
"""Units that whole numbers may count, seconds."""

NAMES = dict(zip(UNITS, ("seconds", "milliseconds", "microseconds", "nanoseconds"), strict=True))
"""Names of the units."""

TICK = 1e-7
"""Windows' unit of time, seconds: 100 ns, see `TICKS_BEFORE`."""

TICKS_BEFORE = (116444736000000000, 621355968000000000)
"""Ticks from the start of the clock to 1970: Windows counts from the year 1601, .NET from the year 1."""

USUAL = (0.008, 0.21)
"""Frame interval of nearly every camera, seconds: 120 to 5 Hz."""

EPOCH = (946684800.0, 4102444800.0)
"""Range of stamps since 1970 that are accepted, seconds: the years 2000 to 2100."""

INTERVALS = (2e-3, 10.0)
"""Range of possible frame intervals, seconds."""

DEVICE_INTERVALS = (2e-3, 1.0)
"""Range of frame intervals of stamps since device start, seconds, where only the steps indicate the unit. Longer ones
are accepted in numbers with the digits of a clock, shorter ones than those of nearly every camera only in poses."""

DIGITS_OF_A_CLOCK = 10
"""Fewest digits of a clock: those of seconds since 1970; finer units have more."""

MILLISECONDS, JITTER = (5, 200), 0.3
"""Range of steps that may be milliseconds, and the deviation from their median, relative to it, that is jitter. The
steps must have no common factor, as those of every n-th frame have; those of hand-picked frames vary more."""

MOST_STEPS = 0.7
"""Share of the steps that counts as most of them."""

FEWEST_OF_A_CLOCK = 6
"""Fewest stamps whose even spacing is no coincidence."""


def clock_unit(stamps: Sequence[float]) -> float | None:
    """The unit of calendar timestamps, seconds; None if they are no such stamps."""
    low, high = min(stamps), max(stamps)
    known = next((unit for unit in (*UNITS, TICK) if EPOCH[0] < unit * low and unit * high < EPOCH[1]), None)
    return known or (TICK if _ticks_before(stamps) else None)


def in_seconds(counts: Sequence[float], unit: float) -> list[float]:
    """Convert counts to seconds; ticks of Windows or .NET become seconds since 1970."""
    before = _ticks_before(counts) if unit == TICK else 0
    return [unit * (count - before) for count in counts]


def _ticks_before(counts: Sequence[float]) -> int:
    """Ticks before 1970 in counts that start in the year 1601 or 1; else 0."""
    low, high = min(counts), max(counts)
    starts = (start for start in TICKS_BEFORE if EPOCH[0] < TICK * (low - start) and TICK * (high - start) < EPOCH[1])
    return next(starts, 0)


def unit_of(counts: Sequence[float], shortest: float = USUAL[0]) -> float | None:
    """The unit of whole numbers, seconds, if they count time; None if they seem to be frame numbers.

    Ticks of 100 ns are recognised in calendar times only: since device start they look like microseconds of every
    tenth frame.

    Args:
        counts: The numbers.
        shortest: Shortest interval, seconds, of nanoseconds since device start: shorter ones are slow microseconds.
    """
    if not counts or len(set(map(float, counts))) < len(set(counts)):
        return None
    of_clock = clock_unit(counts)
    if of_clock and is_between([of_clock * count for count in counts], INTERVALS):
        return of_clock
    readings = ((UNITS[2], DEVICE_INTERVALS), (UNITS[3], (shortest, DEVICE_INTERVALS[1])), (UNITS[2], INTERVALS))
    are_long = min(counts) >= 10 ** (DIGITS_OF_A_CLOCK - 1)
    device = [unit for unit, bounds in readings[: 3 if are_long else 2] if _steps_are(bounds, unit, counts)]
    if _are_milliseconds(np.diff(sorted(counts))):
        device.append(UNITS[1])
    return device[0] if device else of_clock


def may_count(unit: float, counts: Sequence[float]) -> bool:
    """Whether whole numbers of unknown meaning may count time in `unit`, as the other images' names do."""
    return len(set(counts)) > 1 and _steps_are((USUAL[0], DEVICE_INTERVALS[1]), unit, counts)


def _steps_are(bounds: tuple[float, float], unit: float, counts: Sequence[float]) -> bool:
    return is_between([unit * count for count in counts], bounds)


def _are_milliseconds(steps: np.ndarray) -> bool:
    if len(steps) < 2:
        return False
    usual = steps[_are_usual(steps)]
    is_rate = MILLISECONDS[0] <= steps.min() <= np.median(steps) <= MILLISECONDS[1]
    if len(usual) < MOST_STEPS * len(steps) or not is_rate:
        return False
    return np.gcd.reduce(usual.astype(np.int64)) == 1


def told_unit(stamps: Sequence[float]) -> float | None:
    """The unit of the stamps in a file, seconds; None if they are whole and seem to be frame numbers."""
    if all(float(stamp).is_integer() for stamp in stamps):
        return unit_of(stamps)
    return decimal_unit(stamps) or UNITS[0]


LATEST = 1e20
"""Upper bound of the stamps of any clock."""


def told_stamp(place: str, stamp: Any) -> float:
    """Check a stamp from a JSON file.

    Raises:
        GavoError: it is not a number, or too large.
    """
    is_number = isinstance(stamp, int | float) and not isinstance(stamp, bool)
    if not (is_number and abs(stamp) < LATEST):  # NaN isn't less either
        raise GavoError(f"{place}: timestamp: expected seconds, found {shown(stamp)}: pass --rate to ignore timestamps")
    return stamp


def decimal_unit(numbers: Sequence[float]) -> float | None:
    """The unit of numbers with decimals: 1 s, or 1 ms as in RealSense's tools; None if neither gives a frame rate."""
    if is_between(numbers, INTERVALS):
        return UNITS[0]
    is_thousandth = clock_unit(numbers) != UNITS[0] and is_between([UNITS[1] * n for n in numbers], DEVICE_INTERVALS)
    return UNITS[1] if is_thousandth else None


def filled_in(numbers: Sequence[str]) -> list[float]:
    """Parse decimal numbers as seconds, and restore zeros missing after the point, see `_with_zeros`.

    Zeros are restored where that makes enough stamps evenly spaced, and some end in 0: otherwise the missing zeros are
    just trailing ones.
    """
    seconds, filled = [float(number) for number in numbers], _with_zeros(numbers)
    if len(numbers) < FEWEST_OF_A_CLOCK or not any(re.search(r"\.\d+0$", number) for number in numbers):
        return seconds
    return filled if _even_share(filled) > max(MOST_STEPS, _even_share(seconds)) else seconds


def _with_zeros(numbers: Sequence[str]) -> list[float]:
    """Parse seconds whose fraction is an integer printed without leading zeros.

    Programs that print whole seconds and nanoseconds separately write 5.021 s as 5.21000000.
    """
    parts = [number.split(".") for number in numbers]
    width = max(len(decimals) for _, decimals in parts)
    return [float(f"{whole}.{decimals.zfill(width)}") for whole, decimals in parts]


def _even_share(seconds: Sequence[float]) -> float:
    """Share of the steps between stamps that are close to their median."""
    steps = np.diff(sorted(seconds))
    return float(np.mean(_are_usual(steps))) if len(steps) else 0.0


def _are_usual(steps: np.ndarray) -> np.ndarray:
    """Which steps are close to their median."""
    middle = np.median(steps)
    return np.abs(steps - middle) <= JITTER * middle


def is_between(seconds: Sequence[float], bounds: tuple[float, float]) -> bool:
    """Whether the median step between stamps is within bounds; True if there is no step."""
    steps = np.diff(sorted(set(seconds)))
    return not len(steps) or bool(bounds[0] <= np.percentile(steps, 50, method="lower") <= bounds[1])
