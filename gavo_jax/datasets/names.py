"""Parsing of image file names: which number distinguishes the frames, and whether it is a timestamp."""

import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from os.path import commonprefix
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gavo_jax.datasets.clocks import (
    DIGITS_OF_A_CLOCK,
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
"""Most digits of a frame number: floats cannot represent longer ones exactly."""

FEWEST = 10
"""Fewest images of each kind (or poses and images), numbered without gaps, for which differing ranges of numbers are
an error."""

RATES = (2, 3, 4, 5, 6)
"""Ratios of the two cameras' frame rates that are recognised in folders with all images of both."""

DATE = re.compile(
    r"(?<!\d)((?:19|20)\d\d)[-_.]?(\d\d)[-_.]?(\d\d)[-_ T.]?(\d\d)[-_:.h]?(\d\d)[-_:.m]?(\d\d)"
    r"(?:(?:[.,_-]|(?=(?:\d{3}){1,3}$))(\d{3,9}))?$"
)
"""Date and time, to the second or finer; fractions follow a separator, or directly as 3, 6 or 9 digits."""

TIME_OF_DAY = re.compile(
    r"(.*?)(?<!\d)([01]\d|2[0-3])[-_:.h]?([0-5]\d)[-_:.m]?([0-5]\d)([-_.,]?)(\d{3}|\d{6}|\d{9})", re.DOTALL
)
"""Hours, minutes and seconds without a date, an optional separator, and milliseconds or finer."""

HALF_A_DAY = 43200.0
"""Largest span of times of one day, seconds; times further apart are of two days."""

SECONDS_AND_REST = re.compile(r"(.*?)(\d+)[-_,: ](\d{9}|\d{6})", re.DOTALL)
"""Whole seconds followed by nano- or microseconds with leading zeros."""

FASTEST_COUNT = 1 / 60
"""Shortest frame interval, seconds: evenly spaced "fractions" of one second in shorter steps are frame numbers."""

REDWOOD = re.compile(r"\d{6,7}-(\d{12})$")
"""A frame number and microseconds, as in Redwood and SUN3D."""


class Found(NamedTuple):
    """Image files of a folder by the numbers in their names."""

    color: dict[int, Path]
    depth: dict[int, Path]
    others: tuple[Path, ...] = ()
    """Files without a number."""

    def unpaired(self, frames: int) -> list[str]:
        """Describe the images that are in no frame, one line per kind."""
        return unpaired((len(self.color), len(self.depth)), frames, "with the same number") + nameless(self.others)


def unpaired(images: tuple[int, int], frames: int, why: str) -> list[str]:
    """Describe how many colour and depth images are in no frame, one line per kind."""
    return [
        f"{count - frames} {one} images: no {other} image {why}"
        for count, one, other in zip(images, ("colour", "depth"), ("depth", "colour"), strict=True)
        if count > frames
    ]


def nameless(images: Sequence[Path]) -> list[str]:
    """Describe images without a number in their names, in one line if there are any."""
    return [f"{len(images)} images: no number in their names, such as {images[0].name}"] if images else []


def images_among(files: Iterable[Path], suffixes: Sequence[str]) -> list[Path]:
    """Images sorted by name; hidden files, which some systems write beside each file, are skipped."""
    return sorted(file for file in files if file.suffix.lower() in suffixes and not file.name.startswith("."))


def by_number(color: Sequence[Path], depth: Sequence[Path]) -> Found:
    """Index images by the number that distinguishes them: of those in order, the one that pairs most frames.

    Numbers are counted from the end of the names, without those that are the same in all names of a kind (the size, or
    the bits per pixel), and the last is preferred. Names without a number are left out.

    Raises:
        GavoError: no number is unique and in the order of the names, or `check_start` fails; the message names a file.
    """
    both = [[file for file in files if _numbers(file)] for files in (color, depth)]
    others = tuple(file for file in (*color, *depth) if not _numbers(file))
    places = zip(*map(_varying, both), strict=False)
    found = [Found(_at(first, both[0]), _at(second, both[1]), others) for first, second in places]
    usable = [one for one in found if all(map(_is_in_order, one[:2], both))]
    if found and not usable:
        odd = f"{both[0][0]}: more than one number in the names varies: keep one, or use timestamps as names"
        raise GavoError(next(filter(None, map(_fault, both)), odd))
    chosen = max(usable, key=lambda one: len(one.color.keys() & one.depth.keys()), default=Found({}, {}, others))
    check_start(chosen.color, chosen.depth)
    return chosen


def _varying(files: Sequence[Path]) -> list[int]:
    """Positions of numbers, counted from the end, that differ between some names; all positions if none does."""
    rows = [_numbers(file)[::-1] for file in files]
    shortest, longest = (pick(map(len, rows), default=0) for pick in (min, max))
    places = list(range(1, 1 + shortest))
    varying = [place for place in places if len({row[place - 1] for row in rows}) > 1]
    return varying if varying and shortest == longest else places


def check_start(color: Mapping[int, Path], depth: Mapping[int, Path]) -> None:
    """Refuse gapless ranges of numbers that differ at both ends, or start alike with a ratio of lengths in `RATES`.

    It is then ambiguous whether images pair by number or by order. Where just one camera started or stopped late, one
    end agrees; but the starts also agree where one camera is several times as fast. Ranges with gaps are refused, too,
    if both ends differ alike, and as many images pair with that shift. Fewer than `FEWEST` images pass.
    """
    few, many = sorted(map(len, (color, depth)))
    if few < FEWEST:
        return
    (a, b), (c, d) = ((min(images), max(images)) for images in (color, depth))
    are_whole = b - a + 1 == len(color) and d - c + 1 == len(depth)
    are_of_two_rates = a == c and any(abs(many - few * rate) <= rate for rate in RATES)
    shifted = {n - c + a for n in depth}
    is_shifted = a - c == b - d != 0 and len(color.keys() & shifted) >= len(color.keys() & depth.keys())
    if is_shifted or are_whole and (a != c and b != d or are_of_two_rates):
        raise GavoError(
            f"{color[a]}: colour images are {a} to {b}, depth images {c} to {d}: give those of one frame the "
            "same number, or remove those without a partner"
        )


def _at(place: int, files: Sequence[Path]) -> dict[int, Path]:
    """Files by the number at a position of their names, counted from the end."""
    return {_numbers(file)[-place]: file for file in files}


def _numbers(file: Path) -> list[int]:
    digits = re.findall(r"\d+", file.stem)
    return [int(some) for some in digits if len(some) <= MOST_DIGITS]


def _is_in_order(images: dict[int, Path], files: Sequence[Path]) -> bool:
    """Whether every file has a unique number, in the same order as all numbers of the names."""
    return len(images) == len(files) and [images[n] for n in sorted(images)] == sorted(files, key=_numbers)


def _fault(files: Sequence[Path]) -> str | None:
    """Describe two files with the same numbers, whose order is unknown; None if there are none."""
    first: dict[tuple[int, ...], Path] = {}
    for file in files:
        if (other := first.setdefault(tuple(_numbers(file)), file)) is not file:
            return f"{file}: has the same number as {other.name}: keep only one of them"
    return None


class Stamps(NamedTuple):
    """Timestamps read from names."""

    seconds: list[float]
    unit: float | None = None
    """Unit that the names count, seconds, where they are whole numbers."""


def stamps(names: Sequence[str], unit: float | None = None) -> Stamps | None:
    """Read names as timestamps; None unless all of them are.

    Stamps are seconds or milliseconds with decimals, date and time or time alone, seconds beside nano- or microseconds,
    or whole numbers: since 1970 in s, ms, µs or ns, since device start in ms, µs or ns, or Windows ticks. Only an index
    before the stamp, in the same order, may vary besides, and the rate has to be that of a camera.

    Args:
        names: of one kind of images, without suffixes.
        unit: unit of the other kind's stamps, seconds; tried where these names show no unit of their own.
    """
    bare = _without_tail(names)
    found = _stamps(names, unit) or _stamps(bare, unit)
    if found or (split := _without_index(bare)) is None:
        return found
    indices, rest = split
    found = _stamps(rest, unit)
    return found if found and (np.argsort(indices) == np.argsort(found.seconds, kind="stable")).all() else None


def _stamps(names: Sequence[str], unit: float | None) -> Stamps | None:
    """Read names that end in stamps, see `stamps`."""
    readers = (_redwood, _dates, _times_of_day, _pairs, _decimals)
    seconds = next((found for read in readers if (found := read(names))), None)
    return Stamps(seconds) if seconds else _counts(names, unit)


def mask_numbers(name: str) -> str:
    """A name with its numbers masked; only long ones keep their length, so that stamps of one clock have one form."""
    return re.sub(r"\d+", lambda digits: "0" * (len(digits[0]) if len(digits[0]) >= DIGITS_OF_A_CLOCK else 1), name)


def _without_tail(names: Sequence[str]) -> list[str]:
    """Remove what follows the last varying number of the names, if it is the same in all."""
    tail = commonprefix([name[::-1] for name in names])[::-1] if len(set(names)) > 1 else ""
    tail = re.sub(r"^\d*([.,]\d+)?", "", tail)  # digits belong to the number
    return [name.removesuffix(tail) for name in names]


def _without_index(names: Sequence[str]) -> tuple[list[int], list[str]] | None:
    """Split names into the first varying number and the rest; None if that number is not unique, or is a time."""
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
    """Whether apparent fractions of one second are frame numbers with a constant step.

    After a decimal point they are fractions. Those of a camera's clock have uneven steps, as in 033, 067, 100.
    """
    fractions = [date[7] or "" for date in dates]
    widths, counts = set(map(len, fractions)), sorted({int(digits or 0) for digits in fractions})
    if len(widths) > 1 or len(counts) < 2 or any(date.string[date.start(7) - 1] in ".," for date in dates):
        return False
    steps = np.diff(counts)
    usual = int(np.percentile(steps, 50, method="lower"))
    return 1 < usual == np.gcd.reduce(steps) and usual < FASTEST_COUNT * 10 ** widths.pop()


def _times_of_day(names: Sequence[str]) -> list[float] | None:
    """Read times of one day that span a change of second, or of minute if nothing separates the milliseconds.

    Without that change the last digits may be frame numbers, and None is returned.
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
    """Read seconds beside nano- or microseconds: since 1970, or in consecutive seconds at a camera's rate."""
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
    if not found or len(set(seconds)) < len(set(found)):  # 1.1 and 1.10: the second is item 10
        return None
    seconds = filled_in(found)
    unit = decimal_unit(seconds)
    return None if unit is None else [unit * number for number in seconds]


def _counts(names: Sequence[str], other: float | None) -> Stamps | None:
    counts = [int(number) for number in _at_the_end(names, r"\d+")]
    unit = unit_of(counts) or (other if other and may_count(other, counts) else None)
    return None if unit is None else Stamps(in_seconds(counts, unit), unit)


def _at_the_end(names: Sequence[str], pattern: str) -> list[str]:
    """The matching ends of the names, if the rest is the same in all; else nothing."""
    found = [re.fullmatch(rf"(.*?)({pattern})", name) for name in names]
    heads = {match[1] for match in found if match}
    return [match[2] for match in found if match] if all(found) and len(heads) == 1 else []
