"""Recordings of the simulator AirSim (Shah et al. 2017)."""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar, NamedTuple, Self

import numpy as np

from gavo_jax.camera_files.calibration import Calibration, load_calibration
from gavo_jax.datasets.assembly import METRES
from gavo_jax.datasets.files import Entry, Reading, own_camera_file, size_of_most
from gavo_jax.datasets.images import read_depth
from gavo_jax.datasets.layouts.numbered import PlainFolder
from gavo_jax.datasets.layouts.pairing import Paired, paired_at
from gavo_jax.datasets.truth import Seconds
from gavo_jax.errors import GavoError, read_text
from gavo_jax.image.numbers import Depth
from gavo_jax.trajectory import Trajectory

RECORDING = "airsim_rec.txt"

IMAGE = re.compile(r"img_([^/\\]*)_(\d+)_\d+\.\w+")
"""The name of an image: vehicle and camera, the number of its kind, and nanoseconds of the machine's clock."""

SCENE, PLANAR = "0", "1"
"""Numbers of colour and of depth along z; others are depth along rays, pictures of depth, labels and more."""

MILLISECOND = 1e-3
"""Seconds of what stamps count."""

VEHICLE, STAMP, IMAGES = "VehicleName", "TimeStamp", "ImageFile"
"""Names of columns; the first one is not in older recordings."""


class AirSim(PlainFolder):
    """A recording: `airsim_rec.txt` has a row for each moment, and names what was taken then; that lies in `images/`.

    Depth is planar, in metres, as PFM whose rows run from the top, against the format. The rows' poses are those of the
    vehicle, and settings say elsewhere how a camera lies on it and which view it has.
    """

    kind: ClassVar[str] = "recording of AirSim"
    scale_is_open: ClassVar[bool] = False

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by that file."""
        return (path / RECORDING).is_file()

    @classmethod
    def images(cls, path: Path) -> tuple[list[Path], list[Path], list[str]]:
        """Those of one camera, as the rows name them."""
        taken, left_out = _taken(path)
        return [one.color for one in taken], [one.depth for one in taken], left_out

    @classmethod
    def pair(cls, path: Path, color: list[Path], depth: list[Path], reading: Reading, seconds: Seconds) -> Paired:
        """The frames at their stamps, or row by row at a rate that is said."""
        if reading.rate:
            return paired_at(color, depth, [at / reading.rate for at in range(len(color))])
        stamps: dict[float, str] = {}
        for one in _taken(path)[0]:
            if stamps.setdefault(one.stamp, one.place) != one.place:
                raise GavoError(f"{one.place}: has the {STAMP} of {stamps[one.stamp]}: say --rate to do without them")
        return paired_at(color, depth, list(stamps))

    @classmethod
    def calibrate(cls, path: Path, entries: Sequence[Entry], reading: Reading) -> Calibration:
        """A camera file, there or one folder up."""
        file = own_camera_file(path) or own_camera_file(path.parent)
        if file is None:
            usual = "with FOV_Degrees of 90, AirSim's own, fx and fy are half the width"
            raise GavoError(f"{path}: no camera file in it: say --camera, or put a camera.toml into it; {usual}")
        return load_calibration(file, partial(size_of_most, entries), METRES)

    @classmethod
    def truth(cls, path: Path, paired: Paired) -> tuple[Trajectory | None, list[str]]:
        """Somebody's own, if one lies there."""
        found, unread = super().truth(path, paired)
        why = f"{RECORDING}: its poses are the vehicle's, and nothing says how the camera lies on it"
        return found, unread if found is not None else [*unread, why]

    @classmethod
    def depth_in(cls, file: Path) -> Depth:
        """The rows from the top."""
        return np.flipud(read_depth(file))

    @classmethod
    def open(cls, path: Path, reading: Reading) -> Self:
        """Find the files and read the camera; the unit of depth is known, and the sky tells nothing of it."""
        return super().open(path, replace(reading, depth_scale=reading.depth_scale or METRES))


class _Taken(NamedTuple):
    """What was taken at a moment by the camera that is read."""

    place: str
    stamp: float
    """Seconds."""
    color: Path
    depth: Path


class _Row(NamedTuple):
    place: str
    vehicle: str
    stamp: float
    images: dict[tuple[str, str], str]
    """Names by camera and kind."""


def _taken(path: Path) -> tuple[list[_Taken], list[str]]:
    """What the camera has taken that is the first to have both kinds; and a line for each kind of what is not read."""
    rows = _rows(path / RECORDING)
    own = [row for row in rows if row.vehicle == rows[0].vehicle]
    cameras = list(dict.fromkeys(camera for row in own for camera in _cameras(row)))
    if not cameras:
        raise GavoError(
            f"{path / RECORDING}: no camera has colour (ImageType {SCENE}) and depth of planes in floats ({PLANAR}, "
            "with PixelsAsFloat), whose PFM are read: record both"
        )
    camera, found = cameras[0], []
    for row in own:
        if camera in _cameras(row):
            color, depth = (path / "images" / row.images[camera, kind] for kind in (SCENE, PLANAR))
            found.append(_Taken(row.place, row.stamp, color, depth))
    lacking, others = len(own) - len(found), len(rows) - len(own)
    left_out = [f"images of {other}: not read, those of {camera} are" for other in cameras[1:]]
    left_out += [f"{lacking} rows: have no colour with depth of {camera}"] * (lacking > 0)
    return found, left_out + [f"{others} rows: not of {rows[0].vehicle}"] * (others > 0)


def _cameras(row: _Row) -> list[str]:
    """Those of which a row has both kinds."""
    depths = [camera for (camera, kind), name in row.images.items() if kind == PLANAR and name.endswith(".pfm")]
    return [camera for camera in depths if (camera, SCENE) in row.images]


def _rows(file: Path) -> list[_Row]:
    """The rows of a recording, one at least.

    Raises:
        GavoError: it has none, or one is torn.
    """
    text = enumerate(read_text(file).splitlines(), 1)
    lines = [(f"{file}:{at}", line.split("\t")) for at, line in text if line.strip()]
    heading = [name.strip() for name in lines[0][1]] if lines else []
    if not {STAMP, IMAGES} <= set(heading):
        raise GavoError(f"{file}: expected names of columns between tabs first, {STAMP} and {IMAGES} among them")
    if len(lines) < 2:
        raise GavoError(f"{file}: has no row: nothing was recorded")
    return [_row(place, heading, fields) for place, fields in lines[1:]]


def _row(place: str, heading: list[str], fields: list[str]) -> _Row:
    if len(fields) != len(heading):
        raise GavoError(f"{place}: expected {len(heading)} values between tabs, found {len(fields)}: remove a torn row")
    values = {name: field.strip() for name, field in zip(heading, fields, strict=True)}
    stamp = values[STAMP]
    if not re.fullmatch(r"\d{1,18}", stamp, re.ASCII):
        raise GavoError(f"{place}: {STAMP}: expected milliseconds, found {stamp[:60]!r}")
    matches = [match for name in values[IMAGES].split(";") if (match := IMAGE.fullmatch(name.strip()))]
    images = {(match[1], match[2]): match[0] for match in matches}
    return _Row(place, values.get(VEHICLE, ""), MILLISECOND * int(stamp), images)
