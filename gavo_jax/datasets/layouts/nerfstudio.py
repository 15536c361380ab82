"""Folders whose `transforms.json` names a depth image for each frame, as nerfstudio and instant-ngp read them."""

import re
from pathlib import Path
from typing import Any, ClassVar

from gavo_jax.camera_files.calibration import MAX_JSON_BYTES
from gavo_jax.datasets.files import Reading, resolve_folder
from gavo_jax.datasets.images import COLOR_SUFFIXES
from gavo_jax.datasets.layouts.nerf import TRANSFORMS
from gavo_jax.datasets.layouts.numbered import PlainFolder
from gavo_jax.datasets.layouts.pairing import Paired, paired_as_told
from gavo_jax.datasets.layouts.tum import path_below
from gavo_jax.datasets.names import images_among
from gavo_jax.datasets.truth import Seconds
from gavo_jax.errors import GavoError, read_json_object, read_text, shown

COLOR_KEY = "file_path"
DEPTH_KEYS = ("depth_file_path", "depth_path")
"""As nerfstudio and as instant-ngp call it."""

NAMES_DEPTH = re.compile(r'"(depth_file_path|depth_path)"\s*:\s*"')


class Nerfstudio(PlainFolder):
    """A folder whose `transforms.json` says which colour and which depth image are a frame.

    Spectacular AI and NeRFCapture write such. The names of the colour images say when, as in any folder.
    """

    kind: ClassVar[str] = "nerfstudio folder"
    depth_is_of_view: ClassVar[bool] = True

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by that file, where it names depth."""
        file = path / TRANSFORMS
        return file.is_file() and NAMES_DEPTH.search(read_text(file, MAX_JSON_BYTES)) is not None

    @classmethod
    def images(cls, path: Path) -> tuple[list[Path], list[Path], list[str]]:
        """What the file names, by the names of colour; and a line for what lies beside, and is not named with depth."""
        file, partners = path / TRANSFORMS, dict[Path, Path]()
        for place, frame in _frames(file):
            key = next((key for key in DEPTH_KEYS if frame.get(key) is not None), None)
            if key is None:
                continue
            color, depth = (_named(path, place, name, frame.get(name)) for name in (COLOR_KEY, key))
            color = _with_ending(color)
            if partners.setdefault(color, depth) != depth:
                raise GavoError(f"{place}: {color.name} is there twice, with {partners[color].name} for its depth, too")
        if not partners:
            raise GavoError(f"{file}: no frame of these names a depth image")
        colors, folders = sorted(partners), {color.parent for color in partners}
        beside, named = (child for folder in folders for child in folder.glob("*")), {*partners, *partners.values()}
        others = [image for image in images_among(beside, COLOR_SUFFIXES) if image not in named]
        why = f"not named with depth in {TRANSFORMS}"
        left_out = [f"{len(others)} images: {why}, as {others[0].name}"] if others else []
        return colors, [partners[color] for color in colors], left_out

    @classmethod
    def pair(cls, path: Path, color: list[Path], depth: list[Path], reading: Reading, seconds: Seconds) -> Paired:
        """The frames as the file has them."""
        return paired_as_told(path, color, depth, reading, seconds)


def _frames(file: Path) -> list[tuple[str, dict[str, Any]]]:
    """What is said of each frame, with its place."""
    frames = read_json_object(file, MAX_JSON_BYTES).get("frames")
    if not isinstance(frames, list):
        raise GavoError(f"{file}: frames: expected a list, found {shown(frames)}")
    for at, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise GavoError(f"{file}: frames[{at}]: expected names and values, found {shown(frame)}")
    return [(f"{file}: frames[{at}]", frame) for at, frame in enumerate(frames)]


def _named(folder: Path, place: str, key: str, value: Any) -> Path:
    """The path that a frame has by a key."""
    if not isinstance(value, str) or not value:
        raise GavoError(f"{place}: {key}: expected a path, found {shown(value)}")
    return folder / path_below(resolve_folder(folder), f"{place}: {key}", value)


def _with_ending(image: Path) -> Path:
    """An image with the ending of its file, which NeRFCapture leaves out and instant-ngp tries."""
    files = (image.with_name(image.name + ending) for ending in COLOR_SUFFIXES if not image.exists())
    return next((file for file in files if file.is_file()), image)
