"""Times of numbered frames, from a list beside the images with one row per frame."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gavo_jax.datasets.clocks import NAMES, clock_unit, in_seconds, told_unit
from gavo_jax.datasets.names import by_number, stamps
from gavo_jax.datasets.truth import Seconds
from gavo_jax.errors import GavoError, data_rows, number

LISTS = ("timestamps.txt", "timestamp.txt", "times.txt", "timestamps.csv")
"""Names under which programs list the times of frames."""

LONGEST = 40
"""Most characters of a time."""


class FrameClock(NamedTuple):
    """When the frames of a folder were taken."""

    seconds: Seconds | None
    """Maps frame numbers to times, NaN before the first and after the last; None where nothing states times."""
    unread: Sequence[str] = ()
    """A line for a list that is not read, with the reason."""
    guessed: str = ""
    """The unit guessed for times that are whole numbers without a date; empty if none was guessed."""


def listed_times(path: Path, color: Sequence[Path], depth: Sequence[Path]) -> FrameClock:
    """Read the list of times in the folder, or in that of the colour images.

    A row holds a time, or a time and the name or number of a colour image, in either order. Without names, the rows are
    those of all colour images in order. Times have any form that `names.stamps` reads, or are decimal numbers.
    """
    folders = dict.fromkeys((path, *(image.parent for image in color[:1])))
    file = next((folder / name for folder in folders for name in LISTS if (folder / name).is_file()), None)
    if file is None:
        return FrameClock(None)
    try:
        images = by_number(color, depth).color
    except GavoError:  # names that are times; any other fault is raised when they are paired
        return FrameClock(None)
    try:
        times, unit = _times_of(images, data_rows(file))
    except GavoError as fault:
        why = str(fault).removeprefix(f"{file}: ")
        line = f"{file.name}: times are not read from it ({why}): name the images by them, or pass --rate"
        return FrameClock(None, [line])
    numbers, seconds = list(times), list(times.values())
    guessed = "" if unit is None else f"{file.name} taken for {NAMES[unit]}"
    return FrameClock(lambda wanted: np.interp(wanted, numbers, seconds, np.nan, np.nan), guessed=guessed)


def _times_of(images: dict[int, Path], rows: list[tuple[str, list[str]]]) -> tuple[dict[int, float], float | None]:
    """The time of each image, seconds, by its number, in order; and their unit if it was guessed.

    Raises:
        GavoError: the rows do not give one, or the times do not increase.
    """
    fields = [row for _, row in rows]
    if fields and not any(re.search(r"\d", field) for field in fields[0]):  # a heading
        fields = fields[1:]
    numbers, texts = _columns(images, fields)
    seconds, unit = _seconds(texts)
    times = dict(zip(numbers, seconds, strict=True))
    if len(times) < len(numbers):
        raise GavoError("more than one row for an image")
    if missing := images.keys() - times.keys():
        raise GavoError(f"no row for {images[min(missing)].name}")
    times = {n: times[n] for n in sorted(images)}
    if not (np.diff(list(times.values())) > 0).all():
        raise GavoError("they do not increase from frame to frame")
    return times, unit


def _columns(images: dict[int, Path], fields: list[list[str]]) -> tuple[list[int], list[str]]:
    """Split rows into the numbers of images and the texts of their times.

    Raises:
        GavoError: the rows name no images, and are not as many.
    """
    known = {name: n for n, image in images.items() for name in (str(n), image.stem, image.name)}

    def named(at: int) -> list[tuple[int, str]]:
        last = [(row[at].rsplit("/", 1)[-1], row[1 - at]) for row in fields]
        found = [(known.get(name.lstrip("0") or "0" if name.isdecimal() else name), text) for name, text in last]
        return [(n, text) for n, text in found if n is not None]

    best = max(named(0), named(1), key=len) if all(len(row) > 1 for row in fields) else []
    if best:
        return [n for n, _ in best], [text for _, text in best]
    if len(fields) != len(images):
        raise GavoError(f"{len(fields)} rows, but {len(images)} colour images")
    return sorted(images), [" ".join(row) for row in fields]


def _seconds(texts: list[str]) -> tuple[list[float], float | None]:
    """Convert times to seconds, and return their unit if it was guessed.

    Raises:
        GavoError: they are no times, or whole numbers that may count frames.
    """
    try:
        numbers = [number(text) for text in texts]
    except ValueError:
        found = stamps(texts) if max(map(len, texts)) <= LONGEST else None
        if found is None:
            raise GavoError("its rows are no times") from None
        return found.seconds, None
    unit = told_unit(numbers) if np.isfinite(numbers).all() else None
    if unit is None:
        raise GavoError("its rows are no times of a known unit")
    seconds = in_seconds(numbers, unit)
    is_guess = clock_unit(seconds) is None and all(stamp.is_integer() for stamp in numbers)
    return seconds, unit if is_guess else None
