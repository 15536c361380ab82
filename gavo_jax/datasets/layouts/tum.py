"""Sequences in the folder layout of the TUM RGB-D benchmark (Sturm et al. 2012): lists of timestamped images."""

import bisect
import itertools
import math
import os
import re
from collections import Counter
from collections.abc import Iterable
from functools import partial
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import ClassVar, NamedTuple, Self

import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.camera_files.calibration import DEPTH_SCALE, Calibration, load_calibration
from gavo_jax.datasets.clocks import in_seconds
from gavo_jax.datasets.files import Entry, FileSequence, Reading, resolve_folder, size_of_most
from gavo_jax.datasets.names import check_start, decimal_unit, filled_in, unit_of, unpaired
from gavo_jax.datasets.own_camera import own_camera_file, preset_or_export
from gavo_jax.datasets.truth import Counted, truth_in, unread_truth
from gavo_jax.errors import GavoError, as_path, data_rows, number, without_heading
from gavo_jax.trajectory import Trajectory, associate

MAX_DIFFERENCE = 0.02
"""Colour and depth stamps at least this far apart, in seconds, are not of one frame."""

MAX_LIST_BYTES = 16 * 2**20
"""Largest list, bytes: enough for hours of frames."""

MAX_PATH = 1000
"""Longest path in a list, characters."""

MAX_STAMP = 1e10
"""Largest stamp, seconds: three centuries after 1970; anything larger is in another unit."""

COLOR = "color.txt"
"""Alternative name of the colour list."""

ASSOCIATIONS = tuple(f"{name}.txt" for name in ("associations", "association", "associated", "associate", "assoc"))
"""Names of a combined list `stamp path stamp path`, as in ICL-NUIM and printed by `associate.py`."""

INDEX_RATE = 30.0
"""Frames per second where stamps are just frame numbers."""

MAX_MISPLACED = 0.25
"""Largest share of a list's rows whose stamps are out of order; a list with more is considered unsorted."""


class TumSequence(FileSequence):
    """A folder with `rgb.txt`, `depth.txt`, the images they list and, where known, `groundtruth.txt`.

    Colour and depth are paired by time (`associate`: greedy, one to one, |Δt| < `max_difference`), or by the rows of a
    combined list (`ASSOCIATIONS`) in place of the two. Frames are in the order of their colour stamps, which become
    theirs. Images are decoded one by one on access and not cached.

    Lists need not be sorted. But where all but a few stamps of a list increase (`MAX_MISPLACED`), those few are in
    doubt: a frame with such a colour or depth stamp is placed by it, but reading it raises `TimestampError`. In an
    unsorted list, of rows with equal stamps only the first is kept.

    Attributes:
        name: the folder's name, unless given.
        camera: camera of the returned frames: without distortion when they are undistorted, else as recorded.
        ground_truth: the true trajectory in the folder, or None if there is none.
    """

    kind: ClassVar[str] = "TUM RGB-D folder"
    LISTS: ClassVar[tuple[str, str]] = ("rgb.txt", "depth.txt")
    """Lists of colour and depth."""
    DEPTH_SCALE: ClassVar[float] = DEPTH_SCALE
    """Depth units per metre, if a camera file does not state them."""

    def __init__(
        self,
        folder: str | Path,
        camera: Camera | Calibration | str | None = "auto",
        color: bool = False,
        undistort: bool = True,
        max_difference: float = MAX_DIFFERENCE,
        name: str | None = None,
        depth_scale: float | None = None,
        rate: float | None = None,
    ) -> None:
        """Read the lists and the ground truth; no image yet (see `check`).

        Args:
            folder: folder of the lists.
            camera: a camera, what `load_camera` takes, or "auto" (or None): the camera file in the folder, else the
                preset implied by the folder's name.
            color: whether frames have RGB beside grey.
            undistort: whether to remove lens distortion.
            max_difference: colour and depth stamps at least this far apart, in seconds, are not of one frame.
            name: overrides the folder's name.
            depth_scale: raw depth units per metre; the camera's if None.
            rate: frames per second, if stamps are frame numbers.

        Raises:
            GavoError: missing folder or list, malformed row (file:line), a path that leaves the folder, no pair
                of stamps near enough, unusable ground truth, or unknown camera.
        """
        self.folder = as_path(folder)
        resolved = resolve_folder(self.folder)
        reading = Reading("auto" if camera is None else camera, depth_scale, rate, color, undistort, max_difference)
        lists = _read_lists(resolved, self.folder, self.LISTS, rate)
        if lists.are_paired:
            entries, why = _by_place(lists.color, lists.depth), "with a stamp of its own in their row"
        else:
            entries = _associate_lists(lists.color, lists.depth, max_difference)
            why = f"within {max_difference:g} s that is not paired with another"
        if not entries:
            names = " and ".join(self.LISTS)
            raise GavoError(f"{self.folder}: no stamps of {names} within {max_difference:g} s of each other")
        files = [_files(entry, max_difference) for entry in entries]
        stamps = [entry.stamp for entry in files]
        numbers = [float(entry.color.written) for entry in entries]
        counted = None if lists.unit == 1 else Counted(numbers, lambda counts: lists.unit * counts)
        truth, unread = self.truth(self.folder, stamps, counted)
        super().__init__(
            name or resolved.name,
            files,
            reading.calibration(
                partial(self.calibrate, self.folder, files), partial(size_of_most, files), self.DEPTH_SCALE
            ),
            truth,
            reading,
            unpaired((len(lists.color), len(lists.depth)), len(entries), why) + lists.repeated + unread,
        )
        self.times_guessed = "stamps are numbers" if rate is None and lists.unit == 1 / INDEX_RATE else ""

    @property
    def unit_is_assumed(self) -> bool:
        """Whether the depth unit is not stated anywhere, but assumed to be the benchmark's."""
        return not self.calibration.states_depth_scale

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by any of its lists."""
        return any((path / name).exists() for name in (*cls.LISTS, *ASSOCIATIONS))

    @classmethod
    def calibrate(cls, folder: Path, entries: list[Entry]) -> Calibration:
        """The camera file in the folder, else the preset implied by its name, else an exported camera.

        Raises:
            GavoError: there is none, or it cannot be read.
        """
        load = partial(load_calibration, size=partial(size_of_most, entries))
        file = own_camera_file(folder)
        return preset_or_export(folder, load) if file is None else load(file)

    @classmethod
    def truth(cls, folder: Path, stamps: list[float], counted: Counted | None) -> tuple[Trajectory | None, list[str]]:
        """The ground truth in the folder, if any, and a line for each file of poses that is not used, with the reason.

        Raises:
            GavoError: it cannot be read.
        """
        found = truth_in(folder, stamps, counted)
        return found, unread_truth(folder, found)

    @classmethod
    def open(cls, path: Path, reading: Reading) -> Self:
        """Open the folder as specified by `reading`."""
        return cls(
            path,
            reading.camera,
            reading.color,
            reading.undistort,
            reading.max_difference,
            depth_scale=reading.depth_scale,
            rate=reading.rate,
        )


class _Row(NamedTuple):
    """A row of a list."""

    stamp: float
    path: Path
    place: str
    """file:line"""
    written: str
    """The stamp as written in the file."""
    misplaced: bool = False
    repeated: bool = False
    """Whether another image has the same stamp and is used instead."""


class _Entry(NamedTuple):
    """A frame: its colour row, and its depth row unless the colour stamp is in doubt."""

    color: _Row
    depth: _Row | None


def _files(entry: _Entry, max_difference: float) -> Entry:
    """Paths, stamps and doubt of a frame; a depth stamp `max_difference` or more off (of another clock) is dropped."""
    misplaced = next((row for row in entry if row is not None and row.misplaced), None)
    doubt = f"{misplaced.place}: stamp {misplaced.stamp:.6f} is out of order or given twice" if misplaced else ""
    color, depth = entry
    is_near = depth is not None and abs(depth.stamp - color.stamp) < max_difference
    return Entry(color.stamp, color.path, depth and depth.path, depth.stamp if depth and is_near else None, doubt)


class _Lists(NamedTuple):
    """Contents of a folder's lists."""

    color: list[_Row]
    depth: list[_Row]
    unit: float
    """Unit of the stamps as written, seconds; those of the rows are converted to seconds."""
    are_paired: bool
    """Whether a combined list has both images of a frame in one row."""
    repeated: list[str]
    """Number of images left out because of a repeated stamp, one line per kind."""


def _read_lists(root: Path, folder: Path, names: tuple[str, str], rate: float | None) -> _Lists:
    """Read both lists, or a combined one in their place."""
    both = next((folder / name for name in ASSOCIATIONS if (folder / name).exists()), None)
    if not (folder / names[0]).exists() and (folder / COLOR).exists():
        names = (COLOR, names[1])
    if any((folder / name).exists() for name in names):
        both = None
    if both is None:
        color, depth = (_read_list(root, folder / name) for name in names)
    else:
        color, depth = _read_pairs(root, both)
    counts = (sum(row.repeated for row in rows) for rows in (color, depth))
    repeated = [
        f"{count} {kind} images: the same stamp as another one"
        for count, kind in zip(counts, ("colour", "depth"), strict=True)
        if count
    ]
    color, depth = ([row for row in rows if not row.repeated] for rows in (color, depth))
    are_whole = all(WHOLE.fullmatch(row.written) for row in (*color, *depth))
    if rate and not are_whole:
        raise GavoError(f"{folder}: --rate applies to numbered frames, but these have timestamps")
    stamps = [row.stamp for row in color]
    of_clock = None if rate else unit_of(stamps) if are_whole else decimal_unit(stamps) or 1.0
    unit = of_clock or 1 / (rate or INDEX_RATE)
    counts = [row.stamp for row in (*color, *depth)]
    seconds = dict(zip(counts, in_seconds(counts, unit), strict=True))
    for row in (*color, *depth):
        if not abs(seconds[row.stamp]) < MAX_STAMP:
            raise GavoError(f"{row.place}: not a time stamp: {row.stamp:.15g}: expected seconds")
    if both is None and of_clock is None:  # frame numbers
        check_start(*({int(row.written): row.path for row in rows} for rows in (color, depth)))
    color, depth = ([row._replace(stamp=seconds[row.stamp]) for row in rows] for rows in (color, depth))
    return _Lists(color, depth, unit, are_paired=both is not None, repeated=repeated)


WHOLE = re.compile(r"-?\d+")
"""A stamp that may be in any unit or a frame number; 2.000000 is in seconds."""


def _read_pairs(root: Path, path: Path) -> tuple[list[_Row], list[_Row]]:
    """Read rows of `stamp path stamp path`, with depth first or last."""
    pairs = []
    for place, fields in without_heading(data_rows(path, MAX_LIST_BYTES))[1]:
        if len(fields) != 4:
            aside = "; without this file, images are paired by their names" if len(fields) == 2 else ""
            raise GavoError(f"{place}: expected `stamp path stamp path`, {_found(fields)}{aside}")
        pair = [_row(root, path, place, *fields[at : at + 2]) for at in (0, 2)]
        pairs.append(pair[::-1] if fields[1].count("depth") > fields[3].count("depth") else pair)
    color, depth = (_in_time(path, [pair[at] for pair in pairs]) for at in (0, 1))
    return color, depth


def _read_list(root: Path, path: Path) -> list[_Row]:
    """Read rows of `timestamp path`, sorted by stamp; the images' paths must stay below `root`."""
    rows: list[_Row] = []
    for place, fields in without_heading(data_rows(path, MAX_LIST_BYTES))[1]:
        if len(fields) != 2:
            raise GavoError(f"{place}: expected `timestamp path`, with no blanks in the path, {_found(fields)}")
        rows.append(_row(root, path, place, *fields))
    return _in_time(path, rows)


def _found(fields: list[str]) -> str:
    """Say what a row holds: the file may be of something else."""
    return f"found {len(fields)} field{'s' * (len(fields) != 1)}: {' '.join(fields)[:60]!r}"


def _row(root: Path, path: Path, place: str, time: str, image: str) -> _Row:
    """Check the stamp and path of a row."""
    try:
        stamp = number(time)
    except ValueError:
        stamp = math.nan
    if not math.isfinite(stamp):
        raise GavoError(f"{place}: not a time stamp: {time[:60]!r}")
    return _Row(stamp, path.parent / path_below(root, place, image), place, time)


def path_below(root: Path, place: str, image: str) -> str:
    """Check that a path listed at `place` stays below `root`, as written or with links resolved; return it.

    Raises:
        GavoError: it leaves the folder, or is unusable.
    """
    try:
        if "\\" in image and not (root / image).exists():
            image = image.replace("\\", "/")  # a Windows path
        places = (root / image).resolve(), Path(os.path.normpath(root / image))
        if len(image) > MAX_PATH:
            raise ValueError("too long")
    except (OSError, RuntimeError, ValueError):
        raise GavoError(f"{place}: not a usable path: {image[:60]!r}") from None
    if not any(found.is_relative_to(root) for found in places) or PureWindowsPath(image).drive:
        raise GavoError(f"{place}: path leaves the sequence's folder: {image[:200]!r}; {_back(root, image)}")
    return image


def _back(root: Path, image: str) -> str:
    """Suggest a fix for a path outside the folder: its last parts may exist in this folder."""
    parts = PurePosixPath(image).parts
    ends = ("/".join(parts[at:]) for at in range(1, len(parts)) if ".." not in parts[at:])
    end = next((end for end in ends if (root / end).is_file()), None)
    if end is None:
        return "link the images' folder into this one (ln -s), and use that path in the list"
    return f"it exists here as {end[:200]}: remove the prefix {image.removesuffix(end)[:200]!r} in the list"


def _in_time(path: Path, rows: list[_Row]) -> list[_Row]:
    """Sort rows by stamp, drop duplicates, and mark those whose stamp is in doubt or repeated."""
    if not rows:
        raise GavoError(f"{path}: lists no images")
    if all(re.fullmatch(r"\d+\.\d+", row.written) for row in rows):
        rows = [row._replace(stamp=at) for row, at in zip(rows, filled_in([row.written for row in rows]), strict=True)]
    trusted = _in_order([row.stamp for row in rows])
    if trusted.count(False) > MAX_MISPLACED * len(rows):
        first = {row.stamp: row for row in reversed(rows)}
        others = [row._replace(repeated=True) for row in rows if row.path != first[row.stamp].path]
        once = {(row.stamp, row.path): row for row in (*others, *first.values())}
        return sorted(once.values(), key=lambda row: row.stamp)
    rows = [row._replace(misplaced=not good) for row, good in zip(rows, trusted, strict=True)]
    return sorted(rows, key=lambda row: row.stamp)


def _in_order(stamps: list[float]) -> list[bool]:
    """Whether each stamp belongs to every longest increasing run of stamps (rows may be left out of a run)."""

    def lengths(values: Iterable[float]) -> list[int]:
        tails: list[float] = []
        result = []
        for value in values:
            at = bisect.bisect_left(tails, value)
            tails[at : at + 1] = [value]
            result.append(at + 1)
        return result

    before, after = lengths(stamps), lengths(-stamp for stamp in reversed(stamps))[::-1]
    longest = max(before)
    on_a_longest = [i + j - 1 == longest for i, j in zip(before, after, strict=True)]
    rivals = Counter(i for i, used in zip(before, on_a_longest, strict=True) if used)
    return [used and rivals[i] == 1 for i, used in zip(before, on_a_longest, strict=True)]


def _by_place(color: list[_Row], depth: list[_Row]) -> list[_Entry]:
    """Frames from the rows of a combined list, starting with the first that is not in doubt."""
    partners = {row.place: row for row in depth}
    paired = [_Entry(row, None if row.misplaced else partners[row.place]) for row in color if row.place in partners]
    return list(itertools.dropwhile(_is_in_doubt, paired))


def _associate_lists(color: list[_Row], depth: list[_Row], max_difference: float) -> list[_Entry]:
    """Frames in the order of their colour stamps, starting with the first that is not in doubt.

    Rows not in doubt are associated first. Doubtful depth rows are then associated with the remaining colour rows, and
    doubtful colour rows become frames without depth.
    """
    good = [row for row in color if not row.misplaced]
    entries = [_Entry(row, None) for row in color if row.misplaced]
    for misplaced in (False, True):
        some = [row for row in depth if row.misplaced == misplaced]
        i, j = associate(np.array([r.stamp for r in good]), np.array([r.stamp for r in some]), max_difference)
        entries += [_Entry(good[a], some[b]) for a, b in zip(i, j, strict=True)]
        taken = set(i.tolist())
        good = [row for at, row in enumerate(good) if at not in taken]
    entries.sort(key=lambda entry: entry.color.stamp)
    return list(itertools.dropwhile(_is_in_doubt, entries))


def _is_in_doubt(entry: _Entry) -> bool:
    return entry.depth is None or entry.depth.misplaced
