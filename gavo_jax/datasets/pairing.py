"""Frames of a folder whose images are nothing but files: which colour and which depth image are one, and when."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gavo_jax.datasets.files import Entry, Reading
from gavo_jax.datasets.names import by_number, nameless, stamps, unpaired
from gavo_jax.datasets.truth import Seconds
from gavo_jax.errors import GavoError
from gavo_jax.trajectory import associate


class Paired(NamedTuple):
    """Frames of a plain folder."""

    entries: list[Entry]
    left_out: list[str]
    times: dict[int, float]
    """Of each depth image, by the number in its name, else by its place, from 1."""
    seconds: Seconds | None
    """Times by numbers, where the names are those."""


def paired_by_stamp(path: Path, color: list[Path], depth: list[Path], reading: Reading) -> Paired | None:
    """Frames by the stamps that all names are; None where they are none, or the rate is said."""
    others = [file for file in (*color, *depth) if not re.search(r"\d", file.stem)]
    color, depth = ([file for file in files if re.search(r"\d", file.stem)] for files in (color, depth))
    found = [None if reading.rate else stamps([file.stem for file in files]) for files in (color, depth)]
    if found[0] is None or found[1] is None:
        return None
    first, second = (np.array(some, float) for some in found)
    i, j = associate(first, second, reading.max_difference)
    if len(i) == 0:
        raise GavoError(
            f"{path}: by their names no colour and depth image lie within {reading.max_difference:g} s of each other: "
            "say --rate if the names are no stamps"
        )
    entries = [Entry(float(first[a]), color[a], depth[b], float(second[b])) for a, b in zip(i, j, strict=True)]
    left_out = unpaired((len(color), len(depth)), len(i), f"within {reading.max_difference:g} s") + nameless(others)
    of_frames = second.copy()
    of_frames[j] = first[i]
    times = dict(enumerate(of_frames[np.argsort(second, kind="stable")].tolist(), 1))
    return Paired(sorted(entries, key=lambda entry: entry.stamp), left_out, times, None)


def paired_by_number(path: Path, color: list[Path], depth: list[Path], clock: Seconds) -> Paired:
    """Frames by the numbers in the names, whose times a clock says."""
    found = by_number(color, depth)
    numbers = sorted(found.color.keys() & found.depth.keys())
    if not numbers:
        counts = f"{len(color)} colour and {len(depth)} depth images"
        raise GavoError(f"{path}: no frame: {counts}, of which no two have the same number")
    times = {n: float(clock(np.array(float(n)))) for n in {*numbers, *found.depth}}
    entries = [Entry(times[n], found.color[n], found.depth[n]) for n in numbers]
    return Paired(entries, found.unpaired(len(numbers)), {n: times[n] for n in found.depth}, clock)
