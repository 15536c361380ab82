"""Pairing of colour and depth files in plain folders, and the frames' timestamps, from the file names."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gavo_jax.datasets.clocks import MOST_STEPS, NAMES, clock_unit
from gavo_jax.datasets.files import Entry, Reading
from gavo_jax.datasets.names import by_number, mask_numbers, nameless, stamps, unpaired
from gavo_jax.datasets.truth import Counted, Seconds
from gavo_jax.errors import GavoError
from gavo_jax.trajectory import associate

FEWEST_FOR_A_RATE = 3
"""Fewest images whose steps indicate a frame rate."""

MOST_ODD = 1 / 3
"""Largest ratio of images whose names have an unusual form to the others, for which the former are ignored."""


class Paired(NamedTuple):
    """Frames of a plain folder."""

    entries: list[Entry]
    left_out: list[str]
    times: dict[int, float]
    """Stamp of each depth image, by the number in its name, else by its place, from 1; NaN where unknown."""
    counted: Counted | None
    """The numbers of the frames and their times, where names are frame numbers."""
    guessed: str = ""
    """The unit guessed for names that are whole numbers without a date; empty if none was guessed."""


class _Timed(NamedTuple):
    """Images whose names are stamps."""

    files: list[Path]
    seconds: list[float]
    unit: float | None
    """Unit of stamps that are whole numbers; see `names.Stamps`."""
    others: tuple[Path, ...] = ()
    """Files whose names have another form."""


def paired_by_stamp(path: Path, color: list[Path], depth: list[Path], reading: Reading) -> Paired | None:
    """Pair images by the timestamps in their names; None if the names are no stamps, or the rate is given.

    A few names may have another form.

    Raises:
        GavoError: no stamps are near enough, or only some names are stamps.
    """
    others = [file for file in (*color, *depth) if not re.search(r"\d", file.stem)]
    color, depth = ([file for file in files if re.search(r"\d", file.stem)] for files in (color, depth))
    timed = None if reading.rate else _both_timed(path, color, depth)
    if timed is None:
        return None
    first, second = (np.array(some.seconds, float) for some in timed)
    color, depth = (some.files for some in timed)
    i, j = associate(first, second, reading.max_difference)
    if len(i) == 0:
        raise GavoError(
            f"{path}: judging by their names, no colour and depth images are within {reading.max_difference:g} s of "
            "each other: pass --rate if the names are not timestamps"
        )
    entries = [Entry(float(first[a]), color[a], depth[b], float(second[b])) for a, b in zip(i, j, strict=True)]
    left_out = unpaired((len(color), len(depth)), len(i), f"within {reading.max_difference:g} s") + nameless(others)
    if odd := [file for some in timed for file in some.others]:
        left_out.append(f"{len(odd)} images: names of another form than most, such as {odd[0].name}")
    of_frames = second.copy()
    of_frames[j] = first[i]
    times = dict(enumerate(of_frames[np.argsort(second, kind="stable")].tolist(), 1))
    units = [some.unit for some in timed if some.unit is not None and clock_unit(some.seconds) is None]
    guessed = f"names taken for {NAMES[units[0]]}" if units else ""
    return Paired(sorted(entries, key=lambda entry: entry.stamp), left_out, times, None, guessed)


def _both_timed(path: Path, color: list[Path], depth: list[Path]) -> tuple[_Timed, _Timed] | None:
    """The timestamps of both kinds; if one kind shows no unit, that of the other is tried."""
    first, second = _timed(color), _timed(depth)
    if first and not second:
        second = _timed(depth, first.unit)
    elif second and not first:
        first = _timed(color, second.unit)
    if first and second:
        return first, second
    if known := first or second:
        _check_numbers(path, known, color, depth)
    return None


def _check_numbers(path: Path, known: _Timed, color: list[Path], depth: list[Path]) -> None:
    """Refuse names that are times in one kind of images only, unless their numbers match those of the other kind."""
    fewer = min(len(color), len(depth))
    if len(known.files) < FEWEST_FOR_A_RATE or not fewer:
        return
    found = by_number(color, depth)
    if len(found.color.keys() & found.depth.keys()) >= MOST_STEPS * fewer:
        return
    ours, other = (color, depth) if known.files[0] in color else (depth, color)
    raise GavoError(
        f"{path}: names such as {ours[-1].name} are times, but those of the other images, such as {other[-1].name}, "
        "are not: name both by their times, or pass --rate if they are frame numbers"
    )


def _timed(files: list[Path], unit: float | None = None) -> _Timed | None:
    """Read the stamps of images, ignoring a few whose names have another form than most.

    Raises:
        GavoError: too many names have another form.
    """
    if found := stamps([file.stem for file in files], unit):
        return _Timed(files, *found)
    forms: dict[str, list[Path]] = {}
    for file in files:
        forms.setdefault(mask_numbers(file.stem), []).append(file)
    usual = max(forms.values(), key=len, default=[])
    if len(usual) in (len(files), *range(FEWEST_FOR_A_RATE)):
        return None
    if (found := stamps([file.stem for file in usual], unit)) is None:
        return None
    odd = [file for some in forms.values() if some is not usual for file in some]
    if len(odd) > MOST_ODD * len(usual):
        raise GavoError(
            f"{usual[0]}: its name is a time, but {len(odd)} of {len(files)} have another form, such as {odd[0].name}: "
            "name all the same way, or pass --rate if the names are frame numbers"
        )
    return _Timed(usual, *found, tuple(odd))


def paired_as_told(path: Path, color: list[Path], depth: list[Path], reading: Reading, clock: Seconds) -> Paired:
    """Pair colour and depth images at equal positions of the lists; times come from the names of the colour images.

    Raises:
        GavoError: the names give no time, or two have the same number.
    """
    found = paired_by_stamp(path, color, color, reading) or paired_by_number(path, color, color, clock)
    partners = dict(zip(color, depth, strict=True))
    told = stamps([file.stem for file in depth]) if found.counted is None else None
    of_depth = dict(zip(depth, told.seconds, strict=True)) if told else {}
    entries = []
    for stamp, image, *_ in found.entries:
        own = of_depth.get(partners[image])
        is_near = own is not None and abs(own - stamp) < reading.max_difference  # else from another clock
        entries.append(Entry(stamp, image, partners[image], own if is_near else None))
    others = sorted(partners.keys() - {entry.color for entry in entries})
    left_out = [f"{len(others)} frames: names of another form than most, such as {others[0].name}"] if others else []
    return found._replace(entries=entries, left_out=left_out)


def paired_at(color: list[Path], depth: list[Path], stamps: list[float]) -> Paired:
    """Pair colour and depth images at equal positions of the lists, with given stamps, seconds."""
    entries = sorted(Entry(*frame) for frame in zip(stamps, color, depth, strict=True))
    return Paired(entries, [], {at: entry.stamp for at, entry in enumerate(entries, 1)}, None)


def paired_by_number(path: Path, color: list[Path], depth: list[Path], clock: Seconds) -> Paired:
    """Pair images by the numbers in their names, which `clock` maps to times."""
    found = by_number(color, depth)
    numbers = sorted(found.color.keys() & found.depth.keys())
    if not numbers:
        counts = f"{len(color)} colour and {len(depth)} depth images"
        lone = "; the two files of a frame need its number in their names" if len(color) == len(depth) == 1 else ""
        raise GavoError(f"{path}: no frames: {counts}, but no two with the same number{lone}")
    times = {n: float(clock(np.array(float(n)))) for n in {*numbers, *found.depth}}
    entries = [Entry(times[n], found.color[n], found.depth[n]) for n in numbers]
    return Paired(entries, found.unpaired(len(numbers)), {n: times[n] for n in found.depth}, Counted(numbers, clock))
