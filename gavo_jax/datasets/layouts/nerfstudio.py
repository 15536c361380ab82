"""Folders whose `transforms.json` names each frame's depth image, as read by nerfstudio and instant-ngp."""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

from gavo_jax.camera_files.calibration import MAX_JSON_BYTES
from gavo_jax.datasets.clocks import in_seconds, told_stamp, told_unit
from gavo_jax.datasets.files import Reading, resolve_folder
from gavo_jax.datasets.images import COLOR_SUFFIXES
from gavo_jax.datasets.layouts.nerf import TRANSFORMS
from gavo_jax.datasets.layouts.pairing import Paired, paired_as_told, paired_at
from gavo_jax.datasets.layouts.plain_folder import PlainFolder
from gavo_jax.datasets.layouts.tum import path_below
from gavo_jax.datasets.names import images_among
from gavo_jax.datasets.truth import Seconds
from gavo_jax.errors import GavoError, read_json_object, read_text, shown

COLOR_KEY = "file_path"
DEPTH_KEYS = ("depth_file_path", "depth_path")
"""Keys of the depth image in nerfstudio and in instant-ngp."""

STAMP_KEY = "timestamp"
"""Key of the stamp in NeRFCapture."""

NAMES_DEPTH = re.compile(r'"(depth_file_path|depth_path)"\s*:\s*"')


class Nerfstudio(PlainFolder):
    """A folder whose `transforms.json` names the colour and depth image of each frame.

    Spectacular AI and NeRFCapture write such folders. Times are the frames' stamps, if they have any, else they come
    from the names of the colour images, as in a plain folder.
    """

    kind: ClassVar[str] = "nerfstudio folder"
    depth_is_of_view: ClassVar[bool] = True

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by a `transforms.json` that names depth images."""
        file = path / TRANSFORMS
        return file.is_file() and NAMES_DEPTH.search(read_text(file, MAX_JSON_BYTES)) is not None

    @classmethod
    def images(cls, path: Path) -> tuple[list[Path], list[Path], list[str]]:
        """The images in the file, sorted by the names of colour; and a line about others not listed with depth."""
        file, partners = path / TRANSFORMS, dict[Path, Path]()
        for place, color, depth, _ in _pairs(path):
            if partners.setdefault(color, depth) != depth:
                raise GavoError(f"{place}: {color.name} appears twice, also with {partners[color].name} as its depth")
        if not partners:
            raise GavoError(f"{file}: none of its frames names a depth image")
        colors, folders = sorted(partners), {color.parent for color in partners}
        beside, named = (child for folder in folders for child in folder.glob("*")), {*partners, *partners.values()}
        others = [image for image in images_among(beside, COLOR_SUFFIXES) if image not in named]
        why = f"not listed with depth in {TRANSFORMS}"
        left_out = [f"{len(others)} images: {why}, such as {others[0].name}"] if others else []
        return colors, [partners[color] for color in colors], left_out

    @classmethod
    def pair(cls, path: Path, color: list[Path], depth: list[Path], reading: Reading, seconds: Seconds) -> Paired:
        """Pair the images as in the file, with its stamps if it has usable ones."""
        stamps = {} if reading.rate else _stamps(path)
        if stamps and (unit := told_unit([*stamps.values()])) is not None:
            times = dict(zip(stamps, in_seconds([*stamps.values()], unit), strict=True))
            return paired_at(color, depth, [times[image] for image in color])
        paired = paired_as_told(path, color, depth, reading, seconds)
        unused = [f"timestamps in {TRANSFORMS}: whole numbers that cannot be times of a camera"] if stamps else []
        return paired._replace(left_out=paired.left_out + unused)


def _pairs(path: Path) -> Iterator[tuple[str, Path, Path, dict[str, Any]]]:
    """Location in the file, colour, depth and entry of each frame that names a depth image."""
    for place, frame in _frames(path / TRANSFORMS):
        key = next((key for key in DEPTH_KEYS if frame.get(key) is not None), None)
        if key is not None:
            color, depth = (_named(path, place, name, frame.get(name)) for name in (COLOR_KEY, key))
            yield place, _with_ending(color), depth, frame


def _stamps(path: Path) -> dict[Path, float]:
    """Stamps of the images as in the file; empty where it has none.

    Raises:
        GavoError: a stamp is invalid, missing or shared by two images, or an image has two.
    """
    told = [(place, color, frame.get(STAMP_KEY)) for place, color, _, frame in _pairs(path)]
    if all(stamp is None for _, _, stamp in told):
        return {}
    stamps: dict[Path, float] = {}
    images: dict[float, Path] = {}
    for place, color, value in told:
        stamp = told_stamp(place, value)
        if (other := images.setdefault(stamp, color)) != color:
            raise GavoError(f"{place}: timestamp: {stamp} is also {other.name}'s: pass --rate to ignore timestamps")
        if stamps.setdefault(color, stamp) != stamp:
            raise GavoError(f"{place}: timestamp: {color.name} appears twice, also with {stamps[color]}")
    return stamps


def _frames(file: Path) -> list[tuple[str, dict[str, Any]]]:
    """The entry of each frame, with its location in the file."""
    frames = read_json_object(file, MAX_JSON_BYTES).get("frames")
    if not isinstance(frames, list):
        raise GavoError(f"{file}: frames: expected a list, found {shown(frames)}")
    for at, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise GavoError(f"{file}: frames[{at}]: expected names and values, found {shown(frame)}")
    return [(f"{file}: frames[{at}]", frame) for at, frame in enumerate(frames)]


def _named(folder: Path, place: str, key: str, value: Any) -> Path:
    """The path under a key of a frame's entry."""
    if not isinstance(value, str) or not value:
        raise GavoError(f"{place}: {key}: expected a path, found {shown(value)}")
    return folder / path_below(resolve_folder(folder), f"{place}: {key}", value)


def _with_ending(image: Path) -> Path:
    """Complete a path with the suffix of its file, which NeRFCapture omits (instant-ngp also tries suffixes)."""
    files = (image.with_name(image.name + ending) for ending in COLOR_SUFFIXES if not os.path.exists(image))
    return next((file for file in files if os.path.isfile(file)), image)
