"""Sequences whose frames lie as image files."""

import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, overload

import numpy as np
from jaxtyping import Float

from gavo_jax.camera import Camera, preset_for_sequence
from gavo_jax.camera_files.calibration import DEPTH_SCALE, MAX_JSON_BYTES, Calibration, Size, load_calibration
from gavo_jax.datasets.assembly import DepthImage, DepthUnit, FrameAssembler, common_white, float_unit
from gavo_jax.datasets.base import Frame, FrameError, TimestampError
from gavo_jax.datasets.depth_unit import better_scale, sample_depth
from gavo_jax.datasets.films import file_of, film_of, read_frame
from gavo_jax.datasets.images import read_bytes, read_color, read_depth
from gavo_jax.datasets.truth import icl_truth
from gavo_jax.errors import GavoError, as_number, read_json_object, read_text
from gavo_jax.image.numbers import Depth
from gavo_jax.trajectory import Trajectory

SAMPLED = 3
"""Frames, from the first to the last, that show what kind of images a sequence has."""


@dataclass(frozen=True)
class Reading:
    """How a source is to be read; what is left out, it says itself, or is found out.

    Attributes:
        camera: a camera, a calibration, what `load_calibration` takes, or "auto": what the source brings.
        depth_scale: raw depth units per metre.
        rate: frames per second, where there are no stamps.
        color: whether frames carry RGB beside grey.
        undistort: whether lens distortion is taken out.
        max_difference: colour and depth stamps at least this far apart, in seconds, are not of one frame.
        color_topic: of a recording.
        depth_topic: of a recording.
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
        """Refuse numbers that are none, or not above 0."""
        for name in ("depth_scale", "rate", "max_difference"):
            value = getattr(self, name)
            if value is None and name != "max_difference":
                continue
            if not as_number(f"Reading: {name}", value) > 0:
                raise GavoError(f"Reading: {name}: must be above 0, not {value}")

    @property
    def is_auto(self) -> bool:
        """Whether the source has to bring its camera."""
        return isinstance(self.camera, str) and self.camera == "auto"

    def given(self) -> list[str]:
        """Options of the command that say how a source is read, as far as they are given."""
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
        """The calibration that is named, else the source's own.

        Args:
            own: reads what the source brings.
            size: finds out width and height of the images, for a file that does not say it.
            depth_scale: of a kind of source, for a file that does not say it.
            is_rectified: as of `load_calibration`.

        Raises:
            GavoError: as `load_calibration`.
        """
        if self.is_auto:
            return own()
        if isinstance(self.camera, Calibration):
            return self.camera
        if isinstance(self.camera, Camera):
            # a camera always has a scale: TUM's, where nobody said one
            if self.camera.depth_scale != DEPTH_SCALE or depth_scale == DEPTH_SCALE:
                return Calibration(self.camera)
            return Calibration(replace(self.camera, depth_scale=depth_scale), states_depth_scale=False)
        return load_calibration(self.camera, size, depth_scale, is_rectified)


class Entry(NamedTuple):
    """A frame's files."""

    stamp: float
    """Stamp of the colour image, seconds."""
    color: Path
    """A file, or a frame's place in a film."""
    depth: Path | None
    depth_stamp: float | None = None
    doubt: str = ""
    """Why the frame's time cannot be trusted."""


class FileSequence:
    """Frames that lie as pairs of image files, decoded one by one when asked for; nothing of them is kept.

    Attributes:
        name: of the folder.
        ground_truth: the true trajectory, or None.
        entries: files of each frame, in the order of their stamps.
        calibration: the cameras as they record.
        times_guessed: what the frames' times are taken from, where that is a guess; else empty.
    """

    kind: ClassVar[str] = "image files"
    times_guessed: str = ""
    scale_is_open: ClassVar[bool] = False
    """Whether the kind of source leaves the unit of depth open: what depth looks like decides, if nobody says it."""

    def __init__(
        self,
        name: str,
        entries: Sequence[Entry],
        calibration: Calibration,
        ground_truth: Trajectory | None = None,
        reading: Reading = Reading(),
        left_out: Sequence[str] = (),
    ) -> None:
        """Take note of the files; none is read yet.

        Args:
            name: for tables and folders.
            entries: in the order of their stamps.
            calibration: the cameras as they record.
            ground_truth: with its own stamps.
            reading: `depth_scale`, `color` and `undistort` count.
            left_out: what lies there and is not used, and why, a line each.
        """
        self.name, self.ground_truth, self.left_out = name, ground_truth, tuple(left_out)
        self.entries = list(entries)
        if reading.depth_scale is not None:
            calibration = calibration.with_depth_scale(reading.depth_scale)
        self.calibration = calibration
        self._timestamps = np.array([entry.stamp for entry in self.entries])
        self._images = _Images(self.entries, calibration, reading, self.scale_is_open)

    @property
    def timestamps(self) -> Float[np.ndarray, " frames"]:
        """Colour stamp of each frame, seconds."""
        return self._timestamps

    @property
    def camera(self) -> Camera:
        """Camera of the frames as they come: without distortion when they are undistorted, else as recorded."""
        return self._images.assembler.camera

    @property
    def depth_unit(self) -> DepthUnit:
        """Units of depth in the files, and in frames."""
        return self._images.assembler.unit

    @property
    def unit_is_assumed(self) -> bool:
        """Whether nothing says the unit of depth, so that it is the usual one that depth looks most like."""
        return self.scale_is_open and not self.calibration.states_depth_scale

    @property
    def files(self) -> list[tuple[Path, ...]]:
        """Images of each frame."""
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
            DepthImage(self.depth_in(entry.depth), str(entry.depth)),
            str(entry.color),
            entry.stamp,
            entry.depth_stamp,
        )

    def raw_depth(self, index: int) -> np.ndarray:
        """The depth image of a frame as it is stored; raises `FrameError` as reading the frame does."""
        entry = self.entries[index]
        if entry.depth is None:
            raise TimestampError(entry.doubt)
        return self.depth_in(entry.depth)

    @classmethod
    def depth_in(cls, file: Path) -> Depth:
        """`read_depth`, as this kind of source has its files."""
        return read_depth(file)

    def __iter__(self) -> Iterator[Frame]:
        """Decode frame after frame; raises `FrameError` at one that cannot be read."""
        return (self[index] for index in range(len(self)))

    def check(self) -> None:
        """Refuse what can be known before a run: a missing image among these frames, an unusable first frame.

        Raises:
            GavoError: names the image and the fault.
        """
        if len(self) == 0:
            raise GavoError(f"{self.name}: no frames in the chosen range")
        for entry in self.entries:
            for path in (entry.color, entry.depth):
                if path is not None and not os.path.isfile(file_of(path)):
                    raise GavoError(f"{path}: {_instead(path)}: restore it, or leave its frame out")
        self[0]


CAMERA_FILES = (
    *(f"{name}{ending}" for name in ("camera", "calibration", "camera_info") for ending in (".toml", ".yaml", ".yml")),
    *("camera_intrinsic.json", "camera_intrinsics.json", "camera.json", "cam_params.json", "camera.xml"),
    *("camera-intrinsics.txt", "camera_intrinsics.txt", "camera_intrinsic.txt", "intrinsics.txt", "calibration.txt"),
    *("intrinsics_color.txt", "intrinsic_color.txt", "intrinsic/intrinsic_color.txt", "colorIntrinsics.txt"),
)
"""Names by which a camera file in a folder, or in the one above, is known."""

SCANS, OF_A_SCAN = ("info.txt", "_info.txt"), b"m_calibrationColorIntrinsic"
"""Names of the file that comes with a scan, and what stands in it: others call theirs so, too."""

EXPORTED_CAMERA_FILES = (
    *(f"intrinsics{ending}" for ending in (".toml", ".yaml", ".yml", ".json")),
    *("calibration.json", "camera_matrix.csv", "transforms.json", "metadata.json"),
)
"""Names that other programs give their cameras, which may be estimates: asked where nothing else tells the camera."""


def told_in(file: Path) -> dict[str, Any]:
    """The names and values that a file of JSON beside the images holds; none where it is something else."""
    try:
        return read_json_object(file, MAX_JSON_BYTES)
    except GavoError:
        return {}


def own_camera_file(folder: Path) -> Path | None:
    """The camera file that lies in a folder, if one does.

    Raises:
        GavoError: it is that of colour, and the one of depth beside it says something else.
    """
    file = next((folder / name for name in CAMERA_FILES if (folder / name).is_file()), None)
    if file is None:
        return info_of_scan(folder)
    other = file.with_name(re.sub("(_|^)color", r"\1depth", file.name))
    if other.is_file() and read_text(other).split() != read_text(file).split():
        raise GavoError(
            f"{file}: {other.name} beside it is of another camera: say --camera with a file of both cameras "
            "([depth], colour_T_depth), or of one if depth is registered to colour"
        )
    return file


def info_of_scan(folder: Path) -> Path | None:
    """The file that comes with a scan and holds both cameras, if it lies in a folder."""
    files = (folder / name for name in SCANS)
    return next((file for file in files if file.is_file() and OF_A_SCAN in read_bytes(file)), None)


def preset_or_export(folder: Path, load: Callable[[Path], Calibration]) -> Calibration:
    """The preset that a folder's name speaks of, else a camera that another program has exported to it.

    Raises:
        GavoError: there is neither, or the file cannot be read.
    """
    try:
        return preset_by_name(folder)
    except GavoError:
        files = (folder / name for name in EXPORTED_CAMERA_FILES if (folder / name).is_file())
        file = next((file for file in files if file.stem != "metadata" or "K" in told_in(file)), None)
        if file is None:
            raise
    return load(file)


def preset_by_name(folder: Path) -> Calibration:
    """The preset that a folder's name speaks of, or the trajectory in it.

    Raises:
        GavoError: it speaks of none; the message says what would help.
    """
    try:
        return load_calibration(preset_for_sequence(folder.resolve().name))
    except GavoError as error:
        if icl_truth(folder) is not None:
            return load_calibration("icl")
        raise GavoError(f"{folder}: no camera file in it, and {error}") from None


def size_of_most(entries: Sequence[Entry]) -> Size:
    """Width and height of most of the few colour images that are looked at, from the first to the last.

    Raises:
        FrameError: why the first of them cannot be read, where none can.
    """
    images = [entry.color for entry in entries]
    is_film = bool(images) and film_of(images[0]) is not None
    return _size_of_most(images[:1] if is_film else images, _color)


def depth_size_of_most(entries: Sequence[Entry]) -> Size:
    """The same of depth."""
    return _size_of_most([entry.depth for entry in entries if entry.depth is not None], read_depth)


def _color(place: Path) -> np.ndarray:
    """`read_color`, also of a frame in a film."""
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
    """Numbers of a few frames of a sequence, from the first to the last: by them its images are scaled."""
    return sorted({round(share * (count - 1)) for share in np.linspace(0, 1, SAMPLED)}) if count else []


def _instead(path: Path) -> str:
    """What is there in the place of an image, which is no file."""
    if os.path.islink(path):  # which a name that is too long is not, nor does it raise here
        return f"a link to {os.readlink(path)[:200]}, which is missing"
    return "not a file" if os.path.exists(path) else "image is missing"


def resolve_folder(folder: Path) -> Path:
    """The folder's true place.

    Raises:
        GavoError: there is none.
    """
    try:
        resolved = folder.resolve()
        if not resolved.is_dir():
            raise GavoError(f"{folder}: no such folder")
        return resolved
    except (OSError, RuntimeError, ValueError) as error:
        raise error if isinstance(error, GavoError) else GavoError(f"{str(folder)!r}: unusable: {error}") from None


class _Images:
    """What kind of images a whole sequence has, found out from a few of them once; its slices share it."""

    def __init__(self, entries: list[Entry], calibration: Calibration, reading: Reading, scale_is_open: bool):
        self._entries, self._calibration, self._reading = entries, calibration, reading
        self._scale_is_open = scale_is_open

    @cached_property
    def assembler(self) -> FrameAssembler:
        colors, depths = [], []
        for at in places_of_a_few(len(self._entries)):
            entry = self._entries[at]
            try:
                if film_of(entry.color) is None:  # those of a film have 8 bits
                    colors.append(read_color(entry.color))
                if entry.depth is not None:
                    depths.append(DepthImage(read_depth(entry.depth), str(entry.depth)))
            except FrameError:
                continue  # told of when the frame itself is read
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
    images: Sequence[tuple[str | Path, str | Path]], calibration: Calibration, reading: Reading = Reading()
) -> FileSequence:
    """A few frames that belong together, each of a colour and a depth image.

    Args:
        images: paths of colour and depth, for each frame.
        calibration: of all of them.
        reading: as of `FileSequence`.

    Raises:
        GavoError: one file is given as colour and as depth.
    """
    for color, depth in images:
        if Path(color) == Path(depth):
            raise GavoError(f"{color}: given as colour and as depth alike")
    entries = [Entry(0.0, Path(color), Path(depth)) for color, depth in images]
    return FileSequence("pair", entries, calibration, reading=reading)
