"""What the names of image files say: which number tells the frames apart, and whether it is a time."""

import re
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from os.path import commonprefix
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gavo_jax.datasets.clocks import (
    INTERVALS,
    UNITS,
    USUAL,
    clock_unit,
    decimal_unit,
    filled_in,
    in_seconds,
    is_between,
    may_count,
    unit_of,
)
from gavo_jax.errors import GavoError

MOST_DIGITS = 15
"""What is longer is no number of a frame: floats do not tell it from its neighbours."""

DIGITS_OF_A_CLOCK = 10
"""Those of seconds since 1970; finer ones have more."""

FEWEST = 10
"""Images of each kind, or poses and images, numbered without a gap, of which it is told that the two do not count
alike."""

RATES = (2, 3, 4, 5, 6)
"""How many images of one kind may come for each of the other, where both are of all that their cameras took."""

DATE = re.compile(
    r"(?<!\d)((?:19|20)\d\d)[-_.]?(\d\d)[-_.]?(\d\d)[-_ T.]?(\d\d)[-_:.h]?(\d\d)[-_:.m]?(\d\d)"
    r"(?:(?:[.,_-]|(?=(?:\d{3}){1,3}$))(\d{3,9}))?$"
)
"""Day and time of day, to the second or finer; what is finer follows a mark, or in 3, 6 or 9 digits at once."""

TIME_OF_DAY = re.compile(
    r"(.*?)(?<!\d)([01]\d|2[0-3])[-_:.h]?([0-5]\d)[-_:.m]?([0-5]\d)([-_.,]?)(\d{3}|\d{6}|\d{9})", re.DOTALL
)
"""Hours, minutes and seconds without a day, a mark if there is one, and the milliseconds or finer."""

HALF_A_DAY = 43200.0
"""Seconds: times of a day further apart are of two."""

SECONDS_AND_REST = re.compile(r"(.*?)(\d+)[-_,: ](\d{9}|\d{6})", re.DOTALL)
"""Whole seconds and, with their zeros, the nano- or microseconds beside them."""

FASTEST_COUNT = 1 / 60
"""Seconds: even fractions of one second in shorter steps are the numbers of every so many frames, and no camera's."""

REDWOOD = re.compile(r"\d{6,7}-(\d{12})$")
"""A number and microseconds, as Redwood and SUN3D have it."""


class Found(NamedTuple):
    """Image files of a folder by the numbers in their names."""

    color: dict[int, Path]
    depth: dict[int, Path]
    others: tuple[Path, ...] = ()
    """Without a number."""

    def unpaired(self, frames: int) -> list[str]:
        """What makes no frame, a line each."""
        return unpaired((len(self.color), len(self.depth)), frames, "of the same number") + nameless(self.others)


def unpaired(images: tuple[int, int], frames: int, why: str) -> list[str]:
    """What of the colour and depth images makes no frame, a line each."""
    return [
        f"{count - frames} {one} images: no {other} image {why}"
        for count, one, other in zip(images, ("colour", "depth"), ("depth", "colour"), strict=True)
        if count > frames
    ]


def nameless(images: Sequence[Path]) -> list[str]:
    """A line for images without a number in their names, if there are any."""
    return [f"{len(images)} images: no number in their names, as {images[0].name}"] if images else []


def images_among(files: Iterable[Path], suffixes: Sequence[str]) -> list[Path]:
    """Images in the order of their names; hidden files, which some systems leave beside each file, are none."""
    return sorted(file for file in files if file.suffix.lower() in suffixes and not file.name.startswith("."))


def by_number(color: Sequence[Path], depth: Sequence[Path]) -> Found:
    """Images by the number that tells them apart: the last in their names, or one before it that more frames share.

    Names without a number are left out.

    Raises:
        GavoError: no number does, or it goes another way than the names; the message names a file.
    """
    both = [[file for file in files if _numbers(file)] for files in (color, depth)]
    others = tuple(file for file in (*color, *depth) if not _numbers(file))
    places = range(1, 1 + min((len(_numbers(file)) for files in both for file in files), default=0))
    found = [Found(_at(place, both[0]), _at(place, both[1]), others) for place in places]
    usable = [one for one in found if all(map(_is_in_order, one[:2], both))]
    if found and not usable:
        odd = f"{both[0][0]}: more than one number of the names changes: leave one, or say the frames' stamps"
        raise GavoError(next(filter(None, map(_fault, both)), odd))
    chosen = max(usable, key=lambda one: len(one.color.keys() & one.depth.keys()), default=Found({}, {}, others))
    _check_start(chosen)
    return chosen


def _check_start(found: Found) -> None:
    """Refuse enough images of both kinds, each without a gap, that begin with other numbers and end with others, or of
    which there are `RATES` times as many of one kind.

    Whether one number or one place in the order is one frame is open then. Of a camera that started, or stopped, later
    than the other one, the other ends are alike; but of one that is so many times as fast, too.
    """
    color, depth, _ = found
    few, many = sorted(map(len, (color, depth)))
    if few < FEWEST:
        return
    (a, b), (c, d) = ((min(images), max(images)) for images in (color, depth))
    are_whole = b - a + 1 == len(color) and d - c + 1 == len(depth)
    are_of_two_rates = a == c and any(abs(many - few * rate) <= rate for rate in RATES)
    if are_whole and (a != c and b != d or are_of_two_rates):
        raise GavoError(
            f"{color[a]}: colour images are {a} to {b}, depth images {c} to {d}: give those of one frame one "
            "number, or leave those without a partner out"
        )


def _at(place: int, files: Sequence[Path]) -> dict[int, Path]:
    """Files by the number at a place of their names, from the end."""
    return {_numbers(file)[-place]: file for file in files}


def _numbers(file: Path) -> list[int]:
    digits = re.findall(r"\d+", file.stem)
    return [int(some) for some in digits if len(some) <= MOST_DIGITS]


def _is_in_order(images: dict[int, Path], files: Sequence[Path]) -> bool:
    """Whether every file has a number of its own, which grows with all numbers of the names."""
    return len(images) == len(files) and [images[n] for n in sorted(images)] == sorted(files, key=_numbers)


def _fault(files: Sequence[Path]) -> str | None:
    """Two files of which nothing tells which comes first."""
    first: dict[tuple[int, ...], Path] = {}
    for file in files:
        if (other := first.setdefault(tuple(_numbers(file)), file)) is not file:
            return f"{file}: has the same number as {other.name}: leave one of them there"
    return None


class Stamps(NamedTuple):
    """What names say of time."""

    seconds: list[float]
    unit: float | None = None
    """Seconds of what they count, where they are whole numbers."""


def stamps(names: Sequence[str], unit: float | None = None) -> Stamps | None:
    """Times, where all names are stamps; None where they are not.

    Stamps are seconds or milliseconds with decimals, day and time or time alone, seconds beside nano- or microseconds,
    or whole numbers: since 1970 in s, ms, µs or ns, since a device was switched on in ms, µs or ns, or Windows' ticks.
    Nothing else may change from name to name but an index before them that grows with them, and the rate has to be that
    of a camera.

    Args:
        names: of one kind of images, without their endings.
        unit: seconds of what the other kind's names count: these may count it, too, where nothing else is seen in them.
    """
    bare = _without_tail(names)
    found = _stamps(names, unit) or _stamps(bare, unit)
    if found or (split := _without_index(bare)) is None:
        return found
    indices, rest = split
    found = _stamps(rest, unit)
    return found if found and (np.argsort(indices) == np.argsort(found.seconds, kind="stable")).all() else None


def _stamps(names: Sequence[str], unit: float | None) -> Stamps | None:
    """The same of names that stamps end."""
    readers = (_redwood, _dates, _times_of_day, _pairs, _decimals)
    seconds = next((found for read in readers if (found := read(names))), None)
    return Stamps(seconds) if seconds else _counts(names, unit)


def form(name: str) -> str:
    """What a name has beside its numbers, of which long ones count by their length: stamps of a clock have one form."""
    return re.sub(r"\d+", lambda digits: "0" * (len(digits[0]) if len(digits[0]) >= DIGITS_OF_A_CLOCK else 1), name)


def _without_tail(names: Sequence[str]) -> list[str]:
    """Names without what follows the last number that changes, if that is the same in all."""
    tail = commonprefix([name[::-1] for name in names])[::-1] if len(set(names)) > 1 else ""
    tail = re.sub(r"^\d*([.,]\d+)?", "", tail)  # digits belong to the number
    return [name.removesuffix(tail) for name in names]


def _without_index(names: Sequence[str]) -> tuple[list[int], list[str]] | None:
    """The first number that changes, and what follows it; None where it tells no frames apart, or is a time."""
    head = re.sub(r"\d*$", "", commonprefix(names))
    found = [match for name in names if (match := re.match(r"(\d+)(\D.*)", name.removeprefix(head), re.DOTALL))]
    indices = [int(match[1]) for match in found]
    if len(set(indices)) < len(names) or max(indices, default=0) >= 10**MOST_DIGITS or unit_of(indices) is not None:
        return None
    return indices, [match[2] for match in found]


def _redwood(names: Sequence[str]) -> list[float] | None:
    found = [REDWOOD.search(name) for name in names]
    return [1e-6 * int(match[1]) for match in found if match] if all(found) else None


def _dates(names: Sequence[str]) -> list[float] | None:
    found = [match for name in names if (match := DATE.search(name))]
    try:
        seconds = [
            datetime(*(int(part) for part in match.groups()[:6]), tzinfo=UTC).timestamp() + float(f"0.{match[7] or 0}")
            for match in found
        ]
    except ValueError:
        return None
    if len(found) < len(names) or not is_between(seconds, INTERVALS):
        return None
    are_of_one_second = len({match.groups()[:6] for match in found}) == 1
    return None if are_of_one_second and _are_frames(found) else seconds


def _are_frames(dates: Sequence[re.Match[str]]) -> bool:
    """Whether what seem to be fractions of one second are the numbers of every so many frames.

    After a point they are fractions. Those of a camera's clock are uneven in their last place, as 033, 067, 100 are.
    """
    fractions = [date[7] or "" for date in dates]
    widths, counts = set(map(len, fractions)), sorted({int(digits or 0) for digits in fractions})
    if len(widths) > 1 or len(counts) < 2 or any(date.string[date.start(7) - 1] in ".," for date in dates):
        return False
    steps = np.diff(counts)
    usual = int(np.percentile(steps, 50, method="lower"))
    return 1 < usual == np.gcd.reduce(steps) and usual < FASTEST_COUNT * 10 ** widths.pop()


def _times_of_day(names: Sequence[str]) -> list[float] | None:
    """Times of one day in which a second ends, or a minute where nothing parts milliseconds from the rest.

    Before that the digits at the end count as any others: they may be the numbers of frames.
    """
    found = [match for name in names if (match := TIME_OF_DAY.fullmatch(name))]
    if len(found) < len(names) or len({(match[1], match[5], len(match[6])) for match in found}) != 1:
        return None
    ending = slice(1, 4) if found[0][5] else slice(1, 3)
    seconds = [
        3600.0 * int(hours) + 60 * int(minutes) + int(second) + float(f"0.{rest}")
        for _, hours, minutes, second, _, rest in map(re.Match.groups, found)
    ]
    if len({match.groups()[ending] for match in found}) < 2 or max(seconds) - min(seconds) > HALF_A_DAY:
        return None
    return seconds if unit_of([round(second / UNITS[1]) for second in seconds]) == UNITS[1] else None


def _pairs(names: Sequence[str]) -> list[float] | None:
    """Seconds beside nano- or microseconds: since 1970, or in steps from one second to the next at a camera's rate."""
    found = [match for name in names if (match := SECONDS_AND_REST.fullmatch(name))]
    forms = {(match[1], len(match[3])) for match in found}
    if not found or len(found) < len(names) or len(forms) > 1 or max(len(match[2]) for match in found) > MOST_DIGITS:
        return None
    whole = [int(match[2]) for match in found]
    seconds = [second + float(f"0.{match[3]}") for second, match in zip(whole, found, strict=True)]
    if clock_unit(whole) == UNITS[0]:
        is_rate = is_between(seconds, INTERVALS)
    else:
        is_rate = len(set(whole)) > 1 and set(np.diff(sorted(whole))) <= {0, 1} and is_between(seconds, USUAL)
    return seconds if is_rate else None


def _decimals(names: Sequence[str]) -> list[float] | None:
    found = [number.replace(",", ".") for number in _at_the_end(names, r"\d+[.,]\d+")]
    seconds = [float(number) for number in found]
    if not found or len(set(seconds)) < len(set(found)):  # of 1.1 and 1.10 the second is the tenth of something
        return None
    seconds = filled_in(found)
    unit = decimal_unit(seconds)
    return None if unit is None else [unit * number for number in seconds]


def _counts(names: Sequence[str], other: float | None) -> Stamps | None:
    counts = [int(number) for number in _at_the_end(names, r"\d+")]
    unit = unit_of(counts) or (other if other and may_count(other, counts) else None)
    return None if unit is None else Stamps(in_seconds(counts, unit), unit)


def _at_the_end(names: Sequence[str], pattern: str) -> list[str]:
    """What ends the names, where all else in them is the same; else nothing."""
    found = [re.fullmatch(rf"(.*?)({pattern})", name) for name in names]
    heads = {match[1] for match in found if match}
    return [match[2] for match in found if match] if all(found) and len(heads) == 1 else []
