"""Sequences of image files."""

import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar, NamedTuple, overload

import numpy as np
from jaxtyping import Float

from gavo_jax.camera import Camera
from gavo_jax.camera_files.calibration import DEPTH_SCALE, Calibration, Size, load_calibration
from gavo_jax.datasets.assembly import DepthImage, DepthUnit, FrameAssembler, common_white, float_unit
from gavo_jax.datasets.base import Frame, FrameError, TimestampError
from gavo_jax.datasets.depth_unit import better_scale, sample_depth
from gavo_jax.datasets.films import file_of, film_of, read_frame
from gavo_jax.datasets.images import COLOR_SUFFIXES, DEPTH_SUFFIXES, read_color, read_depth
from gavo_jax.errors import GavoError, as_number
from gavo_jax.number_types import Depth
from gavo_jax.trajectory import Trajectory

SAMPLED = 3
"""Number of frames, spread over a sequence, that are sampled to find out the kind of its images."""


@dataclass(frozen=True)
class Reading:
    """How to read a source; what is left out comes from the source itself or is detected.

    Attributes:
        camera: a camera, a calibration, what `load_calibration` takes, or "auto" for the source's own.
        depth_scale: raw depth units per metre.
        rate: frames per second, where there are no stamps.
        color: whether frames have RGB beside grey.
        undistort: whether to remove lens distortion.
        max_difference: colour and depth stamps at least this far apart, in seconds, are not of one frame.
        color_topic: colour topic of a recording.
        depth_topic: depth topic of a recording.
    """

    camera: Camera | Calibration | str = "auto"
    depth_scale: float | None = None
    rate: float | None = None
    color: bool = False
    undistort: bool = True
    max_difference: float = 0.02
    color_topic: str | None = None
    depth_topic: str | None = None

    def __post_init__(self) -> None:
        """Refuse values that are not numbers above 0."""
        for name in ("depth_scale", "rate", "max_difference"):
            value = getattr(self, name)
            if value is None and name != "max_difference":
                continue
            if not as_number(f"Reading: {name}", value) > 0:
                raise GavoError(f"Reading: {name}: must be above 0, not {value}")

    @property
    def is_auto(self) -> bool:
        """Whether the source has to provide its own camera."""
        return isinstance(self.camera, str) and self.camera == "auto"

    def given(self) -> list[str]:
        """Names of the command-line options for reading a source that are given."""
        values = {
            "--depth-scale": self.depth_scale,
            "--rate": self.rate,
            "--colour-topic": self.color_topic,
            "--depth-topic": self.depth_topic,
        }
        return [option for option, value in values.items() if value is not None]

    def calibration(
        self,
        own: Callable[[], Calibration],
        size: Callable[[], Size] | None = None,
        depth_scale: float = DEPTH_SCALE,
        is_rectified: bool = False,
    ) -> Calibration:
        """The calibration given by `camera`, else the source's own.

        Args:
            own: reads the source's own calibration.
            size: finds width and height of the images, for a file that does not state them.
            depth_scale: the source's usual depth units per metre, for a file that does not state them.
            is_rectified: as in `load_calibration`.

        Raises:
            GavoError: as `load_calibration`.
        """
        if self.is_auto:
            return own()
        if isinstance(self.camera, Calibration):
            return self.camera
        if isinstance(self.camera, Camera):
            # a Camera always has a depth scale: TUM's by default
            if self.camera.depth_scale != DEPTH_SCALE or depth_scale == DEPTH_SCALE:
                return Calibration(self.camera)
            return Calibration(replace(self.camera, depth_scale=depth_scale), states_depth_scale=False)
        return load_calibration(self.camera, size, depth_scale, is_rectified)


class Entry(NamedTuple):
    """A frame's files."""

    stamp: float
    """Stamp of the colour image, seconds."""
    color: Path
    """An image file, or a frame's path in a film."""
    depth: Path | None
    depth_stamp: float | None = None
    doubt: str = ""
    """Why the frame's timestamp cannot be trusted; empty if it can."""


class FileSequence:
    """Frames stored as pairs of image files, decoded one by one on access and not cached.

    Attributes:
        name: name of the folder.
        ground_truth: the true trajectory, or None.
        entries: files of each frame, in the order of their stamps.
        calibration: the cameras as they record.
        times_guessed: what the frames' times are guessed from; empty if they are known.
    """

    kind: ClassVar[str] = "image files"
    times_guessed: str = ""
    scale_is_open: ClassVar[bool] = False
    """Whether this kind of source has no fixed depth unit, so that it is guessed from the depth unless it is given."""

    def __init__(
        self,
        name: str,
        entries: Sequence[Entry],
        calibration: Calibration,
        ground_truth: Trajectory | None = None,
        reading: Reading = Reading(),
        left_out: Sequence[str] = (),
        depth_in: Callable[[Path], Depth] | None = None,
    ) -> None:
        """Store the paths of the files; none is read yet.

        Args:
            name: for tables and folders.
            entries: files of each frame, in the order of their stamps.
            calibration: the cameras as they record.
            ground_truth: the true trajectory, with its own stamps.
            reading: only `depth_scale`, `color` and `undistort` are used.
            left_out: files that are not used, and why, one line each.
            depth_in: reads a depth file, in place of the method of that name.
        """
        self.name, self.ground_truth, self.left_out = name, ground_truth, tuple(left_out)
        self.entries = list(entries)
        if reading.depth_scale is not None:
            calibration = calibration.with_depth_scale(reading.depth_scale)
        self.calibration = calibration
        self._timestamps = np.array([entry.stamp for entry in self.entries])
        self._depth_in = depth_in or self.depth_in
        self._images = _Images(self.entries, calibration, reading, self.scale_is_open, self._depth_in)

    @property
    def timestamps(self) -> Float[np.ndarray, " frames"]:
        """Colour stamp of each frame, seconds."""
        return self._timestamps

    @property
    def camera(self) -> Camera:
        """Camera of the returned frames: without distortion when they are undistorted, else as recorded."""
        return self._images.assembler.camera

    @property
    def depth_unit(self) -> DepthUnit:
        """Units of depth in the files, and in frames."""
        return self._images.assembler.unit

    @property
    def unit_is_assumed(self) -> bool:
        """Whether the depth unit is not stated anywhere, but guessed from the depth."""
        return self.scale_is_open and not self.calibration.states_depth_scale

    @property
    def files(self) -> list[tuple[Path, ...]]:
        """Files of each frame's images."""
        return [(file_of(entry.color), *filter(None, (entry.depth,))) for entry in self.entries]

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.entries)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> "FileSequence": ...
    def __getitem__(self, index: int | slice) -> "Frame | FileSequence":
        """Decode frame `index`, or return the sequence of a slice.

        Raises:
            IndexError: no such frame.
            FrameError: one of its two images is missing, torn, or of the wrong size or kind, or its stamp is in doubt.
        """
        if isinstance(index, slice):
            part = copy(self)
            part._timestamps, part.entries = self._timestamps[index], self.entries[index]
            return part
        entry = self.entries[index]
        if entry.doubt:
            raise TimestampError(entry.doubt)
        assert entry.depth is not None
        return self._images.assembler.frame(
            _color(entry.color),
            DepthImage(self._depth_in(entry.depth), str(entry.depth)),
            str(entry.color),
            entry.stamp,
            entry.depth_stamp,
        )

    def raw_depth(self, index: int) -> np.ndarray:
        """The depth image of a frame as stored; raises `FrameError` where the frame cannot be read."""
        entry = self.entries[index]
        if entry.depth is None:
            raise TimestampError(entry.doubt)
        return self._depth_in(entry.depth)

    @classmethod
    def depth_in(cls, file: Path) -> Depth:
        """Read a depth file the way this kind of source stores it, see `read_depth`."""
        return read_depth(file)

    def __iter__(self) -> Iterator[Frame]:
        """Decode frame after frame; raises `FrameError` at one that cannot be read."""
        return (self[index] for index in range(len(self)))

    def check(self) -> None:
        """Refuse faults that can be found before a run: a missing image, or an unusable first frame.

        Raises:
            GavoError: names the image and the fault.
        """
        if len(self) == 0:
            raise GavoError(f"{self.name}: no frames in the chosen range")
        for entry in self.entries:
            for path in (entry.color, entry.depth):
                if path is not None and not os.path.isfile(file_of(path)):
                    raise GavoError(f"{path}: {_instead(path)}")
        self[0]


def size_of_most(entries: Sequence[Entry]) -> Size:
    """The most common width and height of a few colour images, sampled over the sequence.

    Raises:
        FrameError: none of them can be read; the message is that of the first.
    """
    images = [entry.color for entry in entries]
    is_film = bool(images) and film_of(images[0]) is not None
    return _size_of_most(images[:1] if is_film else images, _color)


def depth_size_of_most(entries: Sequence[Entry]) -> Size:
    """The most common width and height of a few depth images, see `size_of_most`."""
    return _size_of_most([entry.depth for entry in entries if entry.depth is not None], read_depth)


def _color(place: Path) -> np.ndarray:
    """Read a colour image from a file or a film."""
    return read_color(place) if film_of(place) is None else read_frame(place)


def _size_of_most(images: Sequence[Path], read: Callable[[Path], np.ndarray]) -> Size:
    fault: FrameError | None = None
    sizes: Counter[Size] = Counter()
    for at in places_of_a_few(len(images)):
        try:
            height, width = read(images[at]).shape[:2]
            sizes[width, height] += 1
        except FrameError as error:
            fault = fault or error
    if not sizes:
        raise fault or FrameError("no frames")
    return sizes.most_common(1)[0][0]


def places_of_a_few(count: int) -> list[int]:
    """Indices of a few frames spread over a sequence; samples of its images are taken there."""
    return sorted({round(share * (count - 1)) for share in np.linspace(0, 1, SAMPLED)}) if count else []


def _instead(path: Path) -> str:
    """Describe what is at the path of an image that is not a file, and what helps."""
    endings = {*COLOR_SUFFIXES, *DEPTH_SUFFIXES}
    stem = path.stem if path.suffix.lower() in endings else path.name
    other = next((name for ending in sorted(endings) if os.path.isfile(path.parent / (name := stem + ending))), None)
    if os.path.islink(path):  # False, without raising, for a name that is too long
        there = f"a link to {os.readlink(path)[:200]}, which is missing"
    elif other is not None:
        return f"image is missing, but {other[:200]} is there: correct the list, or leave its frame out"
    else:
        there = "not a file" if os.path.exists(path) else "image is missing"
    return f"{there}: restore it, or omit its frame"


def resolve_folder(folder: Path) -> Path:
    """The folder's resolved path.

    Raises:
        GavoError: there is no such folder, or its path is unusable.
    """
    try:
        resolved = folder.resolve()
        if not resolved.is_dir():
            raise GavoError(f"{folder}: no such folder")
        return resolved
    except (OSError, RuntimeError, ValueError) as error:
        raise error if isinstance(error, GavoError) else GavoError(f"{str(folder)!r}: unusable: {error}") from None


class _Images:
    """The kind of a sequence's images, found once from a few of them and shared by its slices."""

    def __init__(
        self,
        entries: list[Entry],
        calibration: Calibration,
        reading: Reading,
        scale_is_open: bool,
        depth_in: Callable[[Path], Depth],
    ):
        self._entries, self._calibration, self._reading = entries, calibration, reading
        self._scale_is_open, self._depth_in = scale_is_open, depth_in

    @cached_property
    def assembler(self) -> FrameAssembler:
        colors, depths = [], []
        for at in places_of_a_few(len(self._entries)):
            entry = self._entries[at]
            try:
                if film_of(entry.color) is None:  # a film's have 8 bits
                    colors.append(read_color(entry.color))
                if entry.depth is not None:
                    depths.append(DepthImage(self._depth_in(entry.depth), str(entry.depth)))
            except FrameError:
                continue  # raised when the frame itself is read
        scale = self._calibration.color.depth_scale
        if self._scale_is_open and not self._calibration.states_depth_scale:
            sample = sample_depth([depth.raw for depth in depths])
            scale = sample and better_scale(sample, scale, self._calibration.color) or scale
        unit = DepthUnit(scale, scale, False if self._reading.depth_scale is None else None)
        if any(depth.raw.dtype != np.uint16 for depth in depths):
            unit = float_unit(depths, self._calibration, self._reading.depth_scale)
        return FrameAssembler(
            self._calibration, unit, common_white(colors), self._reading.color, self._reading.undistort
        )


def open_pair(
    images: Sequence[tuple[str | Path, str | Path]],
    calibration: Calibration,
    reading: Reading = Reading(),
    depth_in: Callable[[Path], Depth] = read_depth,
) -> FileSequence:
    """Open a few frames given as pairs of a colour and a depth image.

    Args:
        images: paths of colour and depth for each frame.
        calibration: the cameras of all frames.
        reading: as in `FileSequence`.
        depth_in: reads a depth file the way their source stores it.

    Raises:
        GavoError: one file is given as both colour and depth.
    """
    for color, depth in images:
        if Path(color) == Path(depth):
            raise GavoError(f"{color}: given as both colour and depth")
    entries = [Entry(0.0, Path(color), Path(depth)) for color, depth in images]
    return FileSequence("pair", entries, calibration, reading=reading, depth_in=depth_in)
