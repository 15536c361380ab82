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
from gavo_jax.datasets.files import Entry, Reading, size_of_most
from gavo_jax.datasets.images import read_depth
from gavo_jax.datasets.layouts.pairing import Paired, paired_at
from gavo_jax.datasets.layouts.plain_folder import PlainFolder
from gavo_jax.datasets.own_camera import nearest_camera_file
from gavo_jax.datasets.truth import Seconds
from gavo_jax.errors import GavoError, read_text
from gavo_jax.number_types import Depth
from gavo_jax.trajectory import Trajectory

RECORDING = "airsim_rec.txt"

IMAGE = re.compile(r"img_([^/\\]*)_(\d+)_\d+\.\w+")
"""Name of an image: vehicle and camera, image type, and nanoseconds of the machine's clock."""

SCENE, PLANAR = "0", "1"
"""Image types of colour and of depth along z; others are depth along rays, visualised depth, labels and more."""

MILLISECOND = 1e-3
"""Unit of the stamps, seconds."""

VEHICLE, STAMP, IMAGES = "VehicleName", "TimeStamp", "ImageFile"
"""Names of columns; older recordings lack the first one."""


class AirSim(PlainFolder):
    """A recording: each row of `airsim_rec.txt` has a stamp and the names of the images taken then, in `images/`.

    Depth is along z, in metres, in PFM files whose rows run from the top, contrary to the format. The rows' poses are
    the vehicle's; the camera's mounting and field of view are only in AirSim's settings.
    """

    kind: ClassVar[str] = "recording of AirSim"
    scale_is_open: ClassVar[bool] = False

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by `airsim_rec.txt`."""
        return (path / RECORDING).is_file()

    @classmethod
    def images(cls, path: Path) -> tuple[list[Path], list[Path], list[str]]:
        """The images of one camera, as named in the rows."""
        taken, left_out = _taken(path)
        return [one.color for one in taken], [one.depth for one in taken], left_out

    @classmethod
    def pair(cls, path: Path, color: list[Path], depth: list[Path], reading: Reading, seconds: Seconds) -> Paired:
        """Pair the images by row, at their stamps or at the given rate."""
        if reading.rate:
            return paired_at(color, depth, [at / reading.rate for at in range(len(color))])
        stamps: dict[float, str] = {}
        for one in _taken(path)[0]:
            if stamps.setdefault(one.stamp, one.place) != one.place:
                raise GavoError(
                    f"{one.place}: has the same {STAMP} as {stamps[one.stamp]}: pass --rate to ignore timestamps"
                )
        return paired_at(color, depth, list(stamps))

    @classmethod
    def calibrate(cls, path: Path, entries: Sequence[Entry], reading: Reading) -> Calibration:
        """The camera file in the folder or in its parent."""
        file = nearest_camera_file(path)
        if file is None:
            usual = "with AirSim's default FOV_Degrees of 90, fx and fy are half the width"
            raise GavoError(f"{path}: no camera file in it: pass --camera, or put a camera.toml into it; {usual}")
        return load_calibration(file, partial(size_of_most, entries), METRES)

    @classmethod
    def truth(cls, path: Path, paired: Paired) -> tuple[Trajectory | None, list[str]]:
        """A custom ground truth, if the folder has one."""
        found, unread = super().truth(path, paired)
        why = f"{RECORDING}: its poses are the vehicle's, and the camera's place on it is unknown"
        return found, unread if found is not None else [*unread, why]

    @classmethod
    def depth_in(cls, file: Path) -> Depth:
        """Read depth, undoing the flip of PFM, since AirSim writes rows from the top."""
        return np.flipud(read_depth(file))

    @classmethod
    def open(cls, path: Path, reading: Reading) -> Self:
        """Open the folder; its depth unit is known (the sky would mislead a guess)."""
        return super().open(path, replace(reading, depth_scale=reading.depth_scale or METRES))


class _Taken(NamedTuple):
    """The images of one row by the camera that is read."""

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
    """Names by camera and image type."""


def _taken(path: Path) -> tuple[list[_Taken], list[str]]:
    """The images of the first camera that has colour and depth, and lines about what is not read."""
    rows = _rows(path / RECORDING)
    own = [row for row in rows if row.vehicle == rows[0].vehicle]
    cameras = list(dict.fromkeys(camera for row in own for camera in _cameras(row)))
    if not cameras:
        raise GavoError(
            f"{path / RECORDING}: no camera has both colour (ImageType {SCENE}) and planar depth in floats ({PLANAR}, "
            "with PixelsAsFloat, as PFM): record both"
        )
    camera, found = cameras[0], []
    for row in own:
        if camera in _cameras(row):
            color, depth = (path / "images" / row.images[camera, kind] for kind in (SCENE, PLANAR))
            found.append(_Taken(row.place, row.stamp, color, depth))
    lacking, others = len(own) - len(found), len(rows) - len(own)
    left_out = [f"images of {other}: not read, those of {camera} are" for other in cameras[1:]]
    left_out += [f"{lacking} rows: no colour with depth of {camera}"] * (lacking > 0)
    return found, left_out + [f"{others} rows: not of {rows[0].vehicle}"] * (others > 0)


def _cameras(row: _Row) -> list[str]:
    """The cameras of which a row has colour and depth."""
    depths = [camera for (camera, kind), name in row.images.items() if kind == PLANAR and name.endswith(".pfm")]
    return [camera for camera in depths if (camera, SCENE) in row.images]


def _rows(file: Path) -> list[_Row]:
    """Read the rows of a recording, at least one.

    Raises:
        GavoError: it has none, or one is incomplete.
    """
    text = enumerate(read_text(file).splitlines(), 1)
    lines = [(f"{file}:{at}", line.split("\t")) for at, line in text if line.strip()]
    heading = [name.strip() for name in lines[0][1]] if lines else []
    if not {STAMP, IMAGES} <= set(heading):
        raise GavoError(f"{file}: expected tab-separated column names first, including {STAMP} and {IMAGES}")
    if len(lines) < 2:
        raise GavoError(f"{file}: contains no rows: nothing was recorded")
    return [_row(place, heading, fields) for place, fields in lines[1:]]


def _row(place: str, heading: list[str], fields: list[str]) -> _Row:
    if len(fields) != len(heading):
        raise GavoError(
            f"{place}: expected {len(heading)} tab-separated values, found {len(fields)}: remove an incomplete row"
        )
    values = {name: field.strip() for name, field in zip(heading, fields, strict=True)}
    stamp = values[STAMP]
    if not re.fullmatch(r"\d{1,18}", stamp, re.ASCII):
        raise GavoError(f"{place}: {STAMP}: expected milliseconds, found {stamp[:60]!r}")
    matches = [match for name in values[IMAGES].split(";") if (match := IMAGE.fullmatch(name.strip()))]
    images = {(match[1], match[2]): match[0] for match in matches}
    return _Row(place, values.get(VEHICLE, ""), MILLISECOND * int(stamp), images)
