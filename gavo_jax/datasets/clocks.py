"""What numbers of frames count: seconds since 1970 or since a device was switched on, or the frames themselves."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from gavo_jax.errors import GavoError, shown

UNITS = (1.0, 1e-3, 1e-6, 1e-9)
"""Seconds of what whole numbers may count."""

NAMES = dict(zip(UNITS, ("seconds", "milliseconds", "microseconds", "nanoseconds"), strict=True))
"""What they are called."""

TICK = 1e-7
"""Seconds of what Windows counts: 100 ns, see `TICKS_BEFORE`."""

TICKS_BEFORE = (116444736000000000, 621355968000000000)
"""Ticks up to 1970, where a clock of Windows counts from the year 1601, or of .NET from the year 1."""

USUAL = (0.008, 0.21)
"""Seconds between two frames of nearly every camera: 120 to 5 a second."""

EPOCH = (946684800.0, 4102444800.0)
"""Seconds since 1970 of the years 2000 to 2100, from which stamps of a clock are."""

INTERVALS = (2e-3, 10.0)
"""Seconds between two frames."""

DEVICE_INTERVALS = (2e-3, 1.0)
"""The same, where nothing but the steps speaks for a unit: of stamps since a device was switched on."""

MILLISECONDS, JITTER = (5, 200), 0.3
"""Steps between whole numbers that may be milliseconds, if they have no common factor and most lie within this share
of the median: of every so many frames the numbers have one, and of frames that somebody chose the steps differ more."""

MOST_STEPS = 0.7
"""Share of the steps that are most of them."""

FEWEST_OF_A_CLOCK = 6
"""Stamps that can be even by more than chance."""


def clock_unit(stamps: Sequence[float]) -> float | None:
    """Seconds of what stamps of a calendar's clock count; None where they are no such stamps."""
    low, high = min(stamps), max(stamps)
    known = next((unit for unit in (*UNITS, TICK) if EPOCH[0] < unit * low and unit * high < EPOCH[1]), None)
    return known or (TICK if _ticks_before(stamps) else None)


def in_seconds(counts: Sequence[float], unit: float) -> list[float]:
    """Seconds, of a calendar's clock since 1970, by what whole numbers count."""
    before = _ticks_before(counts) if unit == TICK else 0
    return [unit * (count - before) for count in counts]


def _ticks_before(counts: Sequence[float]) -> int:
    """Ticks up to 1970 in numbers that count them from an earlier year; else 0."""
    low, high = min(counts), max(counts)
    starts = (start for start in TICKS_BEFORE if EPOCH[0] < TICK * (low - start) and TICK * (high - start) < EPOCH[1])
    return next(starts, 0)


def unit_of(counts: Sequence[float]) -> float | None:
    """Seconds of what whole numbers count, if that is time; None where they seem to be the numbers of frames.

    Ticks of 100 ns are known by the year that they begin with, and not since a device was switched on: there nothing
    tells them from microseconds of every tenth frame.
    """
    if not counts or len(set(map(float, counts))) < len(set(counts)):
        return None
    of_clock = clock_unit(counts)
    if of_clock and is_between([of_clock * count for count in counts], INTERVALS):
        return of_clock
    device = [unit for unit in UNITS[2:] if _steps_are(DEVICE_INTERVALS, unit, counts)]
    if _are_milliseconds(np.diff(sorted(counts))):
        device.append(UNITS[1])
    return device[0] if device else of_clock


def may_count(unit: float, counts: Sequence[float]) -> bool:
    """Whether whole numbers, of which nothing else tells it, may count what other images' do."""
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
    """Seconds of what the stamps of a file count; None where they are whole and seem to be the numbers of frames."""
    if all(float(stamp).is_integer() for stamp in stamps):
        return unit_of(stamps)
    return decimal_unit(stamps) or UNITS[0]


LATEST = 1e20
"""No clock counts further."""


def told_stamp(place: str, stamp: Any) -> float:
    """A stamp that a file of JSON says.

    Raises:
        GavoError: it is no number of a clock.
    """
    is_number = isinstance(stamp, int | float) and not isinstance(stamp, bool)
    if not (is_number and abs(stamp) < LATEST):  # nor is not-a-number less
        raise GavoError(f"{place}: timestamp: expected seconds, found {shown(stamp)}: say --rate to do without them")
    return stamp


def decimal_unit(numbers: Sequence[float]) -> float | None:
    """Seconds of what numbers with decimals count: one, or a thousandth, as RealSense's tools have it; else None."""
    if is_between(numbers, INTERVALS):
        return UNITS[0]
    is_thousandth = clock_unit(numbers) != UNITS[0] and is_between([UNITS[1] * n for n in numbers], DEVICE_INTERVALS)
    return UNITS[1] if is_thousandth else None


def filled_in(numbers: Sequence[str]) -> list[float]:
    """Numbers with decimals as seconds, with zeros filled in where they are missing after the point, see `_with_zeros`.

    They are where this makes a clock of enough numbers and, as elsewhere zeros are missing at the end, some of them end
    in one.
    """
    seconds, filled = [float(number) for number in numbers], _with_zeros(numbers)
    if len(numbers) < FEWEST_OF_A_CLOCK or not any(re.search(r"\.\d+0$", number) for number in numbers):
        return seconds
    return filled if _even_share(filled) > max(MOST_STEPS, _even_share(seconds)) else seconds


def _with_zeros(numbers: Sequence[str]) -> list[float]:
    """Seconds, where what follows the point counts its last place, and zeros are missing before it.

    Programs that print whole seconds and nanoseconds one after the other write 5.021 s as 5.21000000.
    """
    parts = [number.split(".") for number in numbers]
    width = max(len(decimals) for _, decimals in parts)
    return [float(f"{whole}.{decimals.zfill(width)}") for whole, decimals in parts]


def _even_share(seconds: Sequence[float]) -> float:
    """How many of the steps from stamp to stamp are about as long as their median."""
    steps = np.diff(sorted(seconds))
    return float(np.mean(_are_usual(steps))) if len(steps) else 0.0


def _are_usual(steps: np.ndarray) -> np.ndarray:
    """Which steps are about as long as their median."""
    middle = np.median(steps)
    return np.abs(steps - middle) <= JITTER * middle


def is_between(seconds: Sequence[float], bounds: tuple[float, float]) -> bool:
    """Whether most stamps lie so far apart."""
    steps = np.diff(sorted(set(seconds)))
    return not len(steps) or bool(bounds[0] <= np.percentile(steps, 50, method="lower") <= bounds[1])
