"""Sequences in the folder layout of the TUM RGB-D benchmark (Sturm et al. 2012)."""

import bisect
import itertools
import math
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, overload

import cv2
import numpy as np
from jaxtyping import Float

from gavo_jax.camera import Camera, camera_for_sequence, load_camera
from gavo_jax.datasets.base import Frame, FrameError, TimestampError
from gavo_jax.errors import GavoError, data_rows
from gavo_jax.trajectory import Trajectory, associate

MAX_DIFFERENCE = 0.02
"""Colour and depth stamps at least this far apart, in seconds, are not of one frame."""

MAX_LIST_BYTES = 16 * 2**20
"""Hours of frames; what is larger is no list of them."""

MAX_PATH = 1000
"""Characters of a path in a list."""

MAX_STAMP = 1e15
"""Seconds; beyond, microseconds are lost in double precision anyway."""

MAX_MISPLACED = 0.25
"""Share of a list's rows whose stamps may be out of order; a list with more is merely unsorted."""

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
GREYSCALE = 0
"""PNG colour type of images with one channel and no palette."""


class TumSequence:
    """A folder with `rgb.txt`, `depth.txt`, the PNG images they list and, where known, `groundtruth.txt`.

    Colour and depth are paired by time (`associate`: greedy, one to one, |Δt| < `max_difference`); frames come in the
    order of their colour stamps and carry them. Images are decoded one by one when asked for, and nothing of them is
    kept.

    Lists need not be sorted. But where all but a few stamps of a list increase (`MAX_MISPLACED`), those few are in
    doubt: a frame of such a colour or depth stamp has its place by it, but reading it raises `TimestampError`. In an
    unsorted list the first of rows with equal stamps is kept.

    Attributes:
        name: the folder's name, unless given.
        camera: of the frames as they come: without distortion when they are undistorted, else as recorded.
        ground_truth: `groundtruth.txt` as it stands, or None where there is no such file.
    """

    def __init__(
        self,
        folder: str | Path,
        camera: Camera | str | None = "auto",
        color: bool = False,
        undistort: bool = True,
        max_difference: float = MAX_DIFFERENCE,
        name: str | None = None,
    ) -> None:
        """Read the lists and the ground truth; no image yet (see `check`).

        Args:
            folder: holds the lists.
            camera: a camera, what `load_camera` takes, or "auto" (or None): the preset the folder's name speaks of.
            color: whether frames carry RGB beside grey.
            undistort: whether lens distortion is taken out of the frames.
            max_difference: seconds.
            name: overrides the folder's name.

        Raises:
            GavoError: missing folder or list, malformed row (file:line), a path that leaves the folder (through a link,
                too), no pair of stamps near enough, unusable ground truth, unknown camera.
        """
        self.folder = Path(folder)
        try:
            resolved = self.folder.resolve()
            if not resolved.is_dir():
                raise GavoError(f"{self.folder}: no such folder")
        except (OSError, RuntimeError, ValueError) as error:
            raise error if isinstance(error, GavoError) else GavoError(f"{str(folder)!r}: unusable: {error}") from None
        self.name = name or resolved.name
        if camera is None or camera == "auto":
            camera = camera_for_sequence(resolved.name)
        self._recorded = camera if isinstance(camera, Camera) else load_camera(camera)
        self._undistort, self._color = undistort, color
        self.camera = self._recorded.rectified() if undistort else self._recorded
        color_rows, depth_rows = (_read_list(resolved, self.folder / name) for name in ("rgb.txt", "depth.txt"))
        entries = _associate_lists(color_rows, depth_rows, max_difference)
        if not entries:
            raise GavoError(
                f"{self.folder}: no stamps of rgb.txt and depth.txt within {max_difference:g} s of each other"
            )
        self._timestamps = np.array([entry.color.stamp for entry in entries])
        self._entries = entries
        truth = self.folder / "groundtruth.txt"
        self.ground_truth = Trajectory.read_tum(truth) if truth.exists() else None

    @property
    def timestamps(self) -> Float[np.ndarray, " frames"]:
        """Colour stamp of each frame, seconds."""
        return self._timestamps

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._entries)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> "TumSequence": ...
    def __getitem__(self, index: int | slice) -> "Frame | TumSequence":
        """Decode frame `index`, or return the sequence of a slice.

        Raises:
            IndexError: no such frame.
            FrameError: one of its two images is missing, torn, or of the wrong size or kind, or its stamp is in doubt.
        """
        if isinstance(index, slice):
            part = copy(self)
            part._timestamps, part._entries = self._timestamps[index], self._entries[index]
            return part
        color, depth = self._entries[index]
        for row in (color, depth):
            if row is not None and row.misplaced:
                raise TimestampError(f"{row.place}: stamp {row.stamp:.6f} is out of order or given twice")
        assert depth is not None
        frame = read_frame(color.path, depth.path, self._recorded, color.stamp, self._color, self._undistort)
        return replace(frame, depth_timestamp=depth.stamp)

    def __iter__(self) -> Iterator[Frame]:
        """Decode frame after frame; raises `FrameError` at one that cannot be read."""
        return (self[index] for index in range(len(self)))

    def check(self) -> None:
        """Refuse what can be known before a run: a missing image among these frames, an unusable first frame.

        Raises:
            GavoError: names the image and the fault.
        """
        if len(self) == 0:
            raise GavoError(f"{self.folder}: no frames in the chosen range")
        for entry in self._entries:
            for row in entry:
                if row is not None and not os.path.isfile(row.path):
                    raise GavoError(f"{row.path}: listed image is missing")
        self[0]


def read_frame(
    color_path: str | Path,
    depth_path: str | Path,
    camera: Camera,
    timestamp: float = 0.0,
    color: bool = False,
    undistort: bool = True,
) -> Frame:
    """Read one RGB-D frame from two PNG files: 8-bit colour (or grey) and 16-bit single-channel depth.

    Args:
        color_path: the colour image.
        depth_path: the depth image, registered to it.
        camera: as recorded; both images must have its size.
        timestamp: seconds.
        color: whether the frame carries RGB beside grey. Grey is the same either way.
        undistort: whether the camera's distortion is taken out; the frame is then of `camera.rectified()`.

    Raises:
        FrameError: an image is missing, torn, or of the wrong size or kind; the message names it.
    """
    bgr = _decode(Path(color_path), camera, depth=False)
    depth = _decode(Path(depth_path), camera, depth=True)
    grey = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)
    rgb = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB) if color else None
    if undistort:
        grey, depth = camera.undistort(grey, depth)
        rgb = None if rgb is None else camera.undistort_image(rgb)
    return Frame(grey=grey, depth=depth, timestamp=timestamp, color=rgb)


class _PngHeader(NamedTuple):
    width: int
    height: int
    bits: int
    color_type: int


class _Row(NamedTuple):
    """A row of a list."""

    stamp: float
    path: Path
    place: str
    """file:line"""
    misplaced: bool = False


class _Entry(NamedTuple):
    """A frame: its colour row, and its depth row unless the colour stamp is in doubt."""

    color: _Row
    depth: _Row | None


def _read_list(root: Path, path: Path) -> list[_Row]:
    """Read `timestamp path` rows, in the order of their stamps; the images' paths stay below `root`."""
    rows: list[_Row] = []
    for place, fields in data_rows(path, MAX_LIST_BYTES):
        if len(fields) != 2:
            raise GavoError(f"{place}: expected `timestamp path`, found {len(fields)} fields")
        try:
            stamp = float(fields[0])
        except ValueError:
            stamp = math.nan
        if not abs(stamp) < MAX_STAMP:
            raise GavoError(f"{place}: not a time stamp: {fields[0][:60]!r}")
        try:
            image = (root / fields[1]).resolve()
            if len(fields[1]) > MAX_PATH:
                raise ValueError("too long")
        except (OSError, RuntimeError, ValueError):
            raise GavoError(f"{place}: not a usable path: {fields[1][:60]!r}") from None
        if not image.is_relative_to(root):
            raise GavoError(f"{place}: path leaves the sequence's folder: {fields[1][:200]!r}")
        rows.append(_Row(stamp, path.parent / fields[1], place))
    if not rows:
        raise GavoError(f"{path}: lists no images")
    trusted = _in_order([row.stamp for row in rows])
    if trusted.count(False) > MAX_MISPLACED * len(rows):
        first = {row.stamp: row for row in reversed(rows)}
        return [first[stamp] for stamp in sorted(first)]
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


def _associate_lists(color: list[_Row], depth: list[_Row], max_difference: float) -> list[_Entry]:
    """Frames in the order of their colour stamps, from the first one that is in no doubt.

    Rows in no doubt are associated first; of the others, depth goes to what is left of the colour rows, and a colour
    row stands alone.
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

    def in_doubt(entry: _Entry) -> bool:
        return entry.depth is None or entry.depth.misplaced

    return list(itertools.dropwhile(in_doubt, entries))


def _decode(path: Path, camera: Camera, depth: bool) -> np.ndarray:
    """Return depth as uint16 [height, width] or colour as uint8 BGR [height, width, 3] of a file that is whole."""
    data = _read_bytes(path, limit=2**20 + 16 * camera.width * camera.height)
    header = _png_header(path, data)
    if (header.width, header.height) != (camera.width, camera.height):
        size = f"{header.width}x{header.height}"
        raise FrameError(f"{path}: is {size} pixels, the camera's images are {camera.width}x{camera.height}")
    if depth and (header.bits, header.color_type) != (16, GREYSCALE):
        raise FrameError(f"{path}: not a depth image: expected one channel of 16 bits")
    if not depth and header.bits > 8:
        raise FrameError(f"{path}: not a colour image of 8 bits but of {header.bits}")
    flags = cv2.IMREAD_UNCHANGED if depth else cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    shape = (camera.height, camera.width) if depth else (camera.height, camera.width, 3)
    if image is None or image.shape != shape or image.dtype != (np.uint16 if depth else np.uint8):
        raise FrameError(f"{path}: cannot be decoded")
    return image


def _read_bytes(path: Path, limit: int) -> bytes:
    try:
        if path.exists() and not path.is_file():
            raise FrameError(f"{path}: not a file")
        if path.stat().st_size > limit:
            raise FrameError(f"{path}: too large for an image of this camera")
        return path.read_bytes()
    except FileNotFoundError:
        raise FrameError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        if isinstance(error, FrameError):
            raise
        raise FrameError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


def _png_header(path: Path, data: bytes) -> _PngHeader:
    """Return the header of a PNG whose chunks are all whole (OpenCV decodes a torn one in part, silently)."""
    if not data.startswith(PNG_SIGNATURE):
        raise FrameError(f"{path}: not a PNG image")
    header, at = None, len(PNG_SIGNATURE)
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(memoryview(data)[at + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise FrameError(f"{path}: damaged PNG image (checksum)")
        if header is None:
            if kind != b"IHDR" or length != 13:
                break
            header = _PngHeader(*struct.unpack_from(">IIBB", data, at + 8))
        if kind == b"IEND":
            return header
        at = end + 4
    raise FrameError(f"{path}: torn PNG image (no end)")
