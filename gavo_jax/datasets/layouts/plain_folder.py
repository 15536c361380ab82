"""Plain folders of colour and depth images, and those of Open3D's reconstruction system."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from gavo_jax.camera_files.calibration import Calibration, load_calibration
from gavo_jax.datasets.assembly import MILLIMETRES
from gavo_jax.datasets.files import Entry, FileSequence, Reading, depth_size_of_most, resolve_folder, size_of_most
from gavo_jax.datasets.films import film_of, rate_of
from gavo_jax.datasets.layouts.image_folders import passed_over, plain_files
from gavo_jax.datasets.layouts.listed_times import FrameClock, listed_times
from gavo_jax.datasets.layouts.nerf import TRANSFORMS, read_transforms
from gavo_jax.datasets.layouts.numbered import NUMBERS, RATE
from gavo_jax.datasets.layouts.pairing import Paired, paired_by_number, paired_by_stamp
from gavo_jax.datasets.own_camera import nearest_camera_file, preset_or_export, told_in
from gavo_jax.datasets.truth import Seconds, truth_in, unread_truth
from gavo_jax.errors import GavoError
from gavo_jax.trajectory import Trajectory

SLOWEST, FASTEST = 0.1, 1000.0
"""Range of plausible frame rates, Hz."""

HOURS = 3600.0
"""Shortest interval, seconds, that consecutive frame numbers never have."""

BY_FILM = "as the film says"
"""Value of `times_guessed` for stamps from frame numbers at a film's rate."""


class PlainFolder(FileSequence):
    """A folder of colour and a folder of depth images, or one folder of both, distinguished by name.

    Names that are stamps are paired by time (see `names.stamps`). Otherwise images of the same number form a frame. Its
    time is the one that a list states (see `listed_times`), else that number over the rate.
    """

    kind: ClassVar[str] = "folder of colour and depth images"
    scale_is_open: ClassVar[bool] = True
    DEPTH_SCALE: ClassVar[float] = MILLIMETRES
    """Depth units per metre, if a camera file does not state them."""
    depth_is_of_view: ClassVar[bool] = False
    """As in `NumberedFolder`; it is also assumed if there is a `transforms.json`."""
    ESTIMATES: ClassVar[str] = ""
    """Glob pattern of pose files estimated by the program that wrote the folder, which are no ground truth."""

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by the names of its subfolders or files."""
        color, depth = plain_files(path)
        return bool(color and depth)

    @classmethod
    def calibrate(cls, path: Path, entries: Sequence[Entry], reading: Reading) -> Calibration:
        """The camera file in the folder or its parent, else the preset implied by its name, else an exported camera.

        Raises:
            GavoError: there is none.
        """
        load = partial(load_calibration, size=partial(size_of_most, entries), depth_scale=cls.DEPTH_SCALE)
        file = nearest_camera_file(path)
        return preset_or_export(path, load) if file is None else load(file)

    @classmethod
    def open(cls, path: Path, reading: Reading) -> Self:
        """Find the files, pair them and read the camera.

        Raises:
            GavoError: no frames, or no camera.
        """
        root = resolve_folder(path)
        color, depth, others = cls.images(path)
        film = film_of(color[0]) if color else None
        clock = FrameClock(None) if reading.rate else cls.clock(path, color, depth)
        usual = reading.rate or (film and rate_of(film)) or RATE
        paired = cls.pair(path, color, depth, reading, clock.seconds or (lambda numbers: numbers / usual))
        own = partial(cls.calibrate, path, paired.entries, reading)
        calibration = reading.calibration(own, partial(size_of_most, paired.entries), cls.DEPTH_SCALE)
        if cls.depth_is_of_view or (path / TRANSFORMS).is_file():
            calibration = calibration.with_depth_of_size(*depth_size_of_most(paired.entries))
        truth, unread = cls.truth(path, paired)
        unread += unread_truth(path, truth, cls.ESTIMATES) + ([*clock.unread] if paired.counted else [])
        sequence = cls(root.name, paired.entries, calibration, truth, reading, paired.left_out + others + unread)
        sequence.times_guessed = cls._guess(path, paired, clock, NUMBERS if film is None else BY_FILM, reading)
        return sequence

    @classmethod
    def _guess(cls, path: Path, paired: Paired, clock: FrameClock, counted: str, reading: Reading) -> str:
        """What the times are guessed from; empty if they are known.

        Raises:
            GavoError: they are frame numbers only if frames are hours apart.
        """
        if paired.counted is None:
            return paired.guessed
        if clock.seconds or reading.rate:
            return clock.guessed
        times = [entry.stamp for entry in paired.entries]
        if len(times) > 1 and np.median(np.diff(times)) > HOURS:
            apart = round(np.median(np.diff(paired.counted.numbers)))
            raise GavoError(
                f"{path}: the numbers of images, such as {paired.entries[0].color.name}, are {apart} apart: neither "
                "frame numbers nor times of a known unit: rename them by their times in seconds, 12.345.png, or list "
                "these in a timestamps.txt"
            )
        return counted

    @classmethod
    def images(cls, path: Path) -> tuple[list[Path], list[Path], list[str]]:
        """Colour and depth images, and a line for each kind of other images that are not read.

        Raises:
            GavoError: the file that lists them cannot be read.
        """
        return *plain_files(path), passed_over(path)

    @classmethod
    def pair(cls, path: Path, color: list[Path], depth: list[Path], reading: Reading, seconds: Seconds) -> Paired:
        """Pair the images to frames; `seconds` maps frame numbers to times, if the names are no stamps.

        Raises:
            GavoError: no frames, or the pairing is ambiguous.
        """
        return paired_by_stamp(path, color, depth, reading) or paired_by_number(path, color, depth, seconds)

    @classmethod
    def clock(cls, path: Path, color: list[Path], depth: list[Path]) -> FrameClock:
        """Mapping from frame numbers to times from a file in the folder; see `listed_times`."""
        return listed_times(path, color, depth)

    @classmethod
    def truth(cls, path: Path, paired: Paired) -> tuple[Trajectory | None, list[str]]:
        """The ground truth in the folder, if any, and a line for each file of poses that is not used, with the reason.

        Raises:
            GavoError: it cannot be read.
        """
        found = truth_in(path, [entry.stamp for entry in paired.entries], paired.counted, paired.times)
        if found is not None or not (path / TRANSFORMS).is_file():
            return found, []
        return read_transforms(path / TRANSFORMS, {entry.color: entry.stamp for entry in paired.entries})


class Open3DFolder(PlainFolder):
    """A folder of Open3D's reconstruction system, or of Redwood: `color/` or `image/`, `depth/`, an intrinsics file."""

    kind: ClassVar[str] = "Open3D reconstruction folder"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by the intrinsics file beside the images."""
        return cls._intrinsics(path) is not None and super().recognises(path)

    @classmethod
    def calibrate(cls, path: Path, entries: Sequence[Entry], reading: Reading) -> Calibration:
        """The camera of the intrinsics file; depth is in millimetres unless stated otherwise."""
        file = cls._intrinsics(path)
        assert file is not None
        return load_calibration(file, partial(size_of_most, entries), MILLIMETRES)

    @classmethod
    def clock(cls, path: Path, color: list[Path], depth: list[Path]) -> FrameClock:
        """Times from a list, else at the rate that Open3D's RealSense reader writes into the intrinsics file."""
        file = cls._intrinsics(path)
        assert file is not None
        listed = super().clock(path, color, depth)
        return listed if listed.seconds else listed._replace(seconds=by_rate(told_in(file).get("fps")))

    @classmethod
    def _intrinsics(cls, path: Path) -> Path | None:
        names = ("camera_intrinsic.json", "camera_intrinsics.json", "intrinsic.json")
        return next((path / name for name in names if (path / name).is_file()), None)


def by_rate(rate: Any) -> Seconds | None:
    """Mapping from frame numbers to times at a rate, frames per second; None if it is no plausible rate."""
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not SLOWEST <= rate <= FASTEST:
        return None
    return lambda numbers: numbers / rate
