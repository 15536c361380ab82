"""Helpful messages for a path that holds no known source: each guess returns a message, or None to let the next try."""

import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from gavo_jax.datasets.films import FILMS
from gavo_jax.datasets.known_datasets import ARRAYS, AS_DEPTH, RECORD_3D, words_of_known
from gavo_jax.datasets.layouts.image_folders import (
    ALL_SUFFIXES,
    COLOR_FOLDERS,
    DEPTH_FOLDERS,
    missing_folder,
    missing_images,
    missing_word,
    plain_files,
    several_pairs,
)

PACKED = {
    ".tar": "tar -xf",
    ".tgz": "tar -xf",
    ".zip": "unzip",
    ".7z": "7z x",
    ".rar": "unrar x",
    ".gz": "gunzip",
    ".bz2": "bunzip2",
    ".xz": "unxz",
    ".lz4": "unlz4",
    ".zst": "zstd -d",
    ".zstd": "zstd -d",
}
"""Suffixes of archives, and the command that unpacks each."""

RECORDINGS = {
    ".sens": "a packed ScanNet scan: export it with ScanNet's SensReader, and pass the folder",
    ".mkv": "a film or an Azure Kinect recording: extract its images with Open3D's azure_kinect_mkv_reader.py",
    ".svo": "a ZED recording: extract its images and depth with the ZED SDK's export samples",
    ".svo2": "a ZED recording: extract its images and depth with the ZED SDK's export samples",
    ".oni": "an OpenNI recording: extract its images and depth with OpenNI's tools",
    ".r3d": RECORD_3D,
    ".klg": "a log of ElasticFusion's logger: extract its images and depth first",
}
"""Suffixes of proprietary recordings, and how to convert each."""

PACKED_ARRAYS = {
    **dict.fromkeys((".hdf5", ".h5"), f"arrays in HDF5: {ARRAYS} (h5py)"),
    ".mat": f"MATLAB arrays: {ARRAYS} (scipy.io.loadmat, or h5py from version 7.3 on)",
    **dict.fromkeys((".npz", ".npy", ".pkl"), f"Python arrays: {ARRAYS}"),
    **dict.fromkeys((".parquet", ".arrow", ".tfrecord"), f"a table: {ARRAYS}"),
    ".raw": f"images without a header: {ARRAYS}; after rs-convert, pass the .bag that it has read",
    ".rrd": f"a Rerun recording: {ARRAYS}",
}
"""What holds images in a form that is no image's and no recording's."""

MODELS = (".ply", ".pcd", ".obj", ".glb", ".usdz", ".e57", ".las")
"""Endings of files of points or surfaces."""

MODEL = "a model or a point cloud, without the images that it was made from"

DEPTH_IN_NAME = re.compile(r"(?<![a-z])depth", re.IGNORECASE)

WHAT_OF = re.compile(r"^(?:drive|export|recording|scan|scene) of ")
"""Beginnings of the names of kinds that are left out of lists."""

LOOKED_INTO, DEEPEST = 200, 4
"""Most folders further down that are looked into, and how far down."""

SHOWN = 5
"""Number of names that a message lists."""


class Place(NamedTuple):
    """A path that holds no source."""

    path: Path
    inside: list[Path]
    """Contents of the folder, sorted by name."""
    kinds: str
    """The known kinds of sources."""
    is_source: Callable[[Path], bool]
    """Tells whether another path holds a source."""


def describe(path: Path, kinds: Sequence[str], is_source: Callable[[Path], bool]) -> str:
    """Describe in a few words what is at a path that holds no source.

    Args:
        path: A file or folder.
        kinds: The known kinds of sources.
        is_source: Tells whether another path holds one of them.
    """
    known = f"{', '.join(WHAT_OF.sub('', kind) for kind in kinds)} (including SUN3D's)"
    if not path.is_dir():
        if path.is_file() and (source := source_around(path, is_source)):
            return f"a file inside a source: pass its folder, {source}"
        return _in_file(path) or f"a file of {path.stat().st_size} bytes, not one of: {known}"
    place = Place(path, sorted(path.iterdir()), known, is_source)
    return next(words for guess in GUESSES if (words := guess(place)) is not None)


def source_around(path: Path, is_source: Callable[[Path], bool]) -> Path | None:
    """The folder of the source that a file or folder belongs to; None if there is none."""
    return next((folder for folder in list(Path(os.path.abspath(path)).parents)[:2] if is_source(folder)), None)


def _lone_file(place: Place) -> str | None:
    if len(place.inside) != 1 or not place.inside[0].is_file():
        return None
    words = _in_file(place.inside[0])
    return words and f"{place.inside[0].name}: {words}"


def _nothing(place: Place) -> str | None:
    return None if place.inside else f"an empty folder, not one of: {place.kinds}"


def _frames_apart(place: Place) -> str | None:
    """Advice on a folder with one subfolder per frame, as in SUN RGB-D."""
    folders = list(filter(_is_open_folder, place.inside))
    if len(folders) < 2 or any(tuple(map(len, plain_files(folder))) != (1, 1) for folder in folders):
        return None
    return (
        f"{len(folders)} folders of one frame each, such as {folders[0].name[:60]}: if they belong to one recording, "
        "link their images into rgb/ and depth/, named by the numbers of the folders"
    )


def _sources(place: Place) -> str | None:
    names = [child.name for child in place.inside if not child.name.startswith(".") and place.is_source(child)]
    if not names:
        return None
    there = f"{len(names)}: pass one of {_listed(names)}" if len(names) > 1 else f"one: pass {place.path / names[0]}"
    return f"not a source itself, but a folder of {there}"


def _images_missing(place: Place) -> str | None:
    return missing_images(place.path)


def _stereo(place: Place) -> str | None:
    folders = (place.path / "mav0", place.path)
    stereo = next((folder for folder in folders if (folder / "cam0" / "data").is_dir()), None)
    if stereo is None:
        return None
    if (stereo / "depth0" / "data").is_dir():
        return (
            f"{stereo / 'depth0'}: link its images as depth/, beside rgb/; InteriorNet's are ray lengths, and "
            f"have to be written there {AS_DEPTH}"
        )
    return f"{stereo / 'cam0'}: a recording in the layout of EuRoC: stereo images without depth, which is required"


def _known(place: Place) -> str | None:
    return words_of_known(place.path)


def _rays(place: Place) -> str | None:
    rays = f"have to be written into depth/, beside rgb/, {AS_DEPTH}"
    names = {child.name for child in place.inside}
    if {"photo", "depth", "instance"} <= names:
        return f"depth/: SceneNet RGB-D stores ray lengths, which {rays}; link photo/ as rgb/"
    if (found := next((name for name in sorted(names) if name.startswith("distance_to_camera")), None)) is None:
        return None
    return f"{found[:60]}: ray lengths from Replicator: have it write distance_to_image_plane, or they {rays}"


def _recording(place: Place) -> str | None:
    known = (*FILMS, *RECORDINGS, *PACKED)
    found = next((child for child in place.inside if child.is_file() and child.suffix.lower() in known), None)
    return None if found is None else f"{found.name[:60]}: {_in_file(found)}"


def _part_of_source(place: Place) -> str | None:
    source = source_around(place.path, place.is_source)
    return source and f"a folder inside a source: pass the source, {source}"


def _further_down(place: Place) -> str | None:
    found = next((inner for inner in islice(_further(place), LOOKED_INTO) if place.is_source(inner)), None)
    return found and f"not a source itself, but contains one: pass {found}"


def _further(place: Place) -> Iterator[Path]:
    """The folders inside those inside, level by level, hidden ones left out."""
    level = list(filter(_is_open_folder, place.inside))
    for _ in range(2, DEEPEST + 1):
        found: list[Path] = []
        for folder in level[:LOOKED_INTO]:
            with suppress(OSError):  # nobody may look
                found += filter(_is_open_folder, sorted(folder.iterdir()))
        yield from found
        level = found


def _is_open_folder(path: Path) -> bool:
    return path.is_dir() and not path.name.startswith(".")


def _twins(place: Place) -> str | None:
    """Advice on images of two kinds that differ in their endings alone."""
    images = [child for child in place.inside if child.suffix.lower() in ALL_SUFFIXES and child.is_file()]
    by_stem = {image.stem: image for image in reversed(images)}
    twins = next(((by_stem[image.stem], image) for image in images if by_stem[image.stem] != image), None)
    if twins is None:
        return None
    return f"{twins[0].name[:60]} beside {twins[1].name[:60]}: put depth into depth/, and colour into rgb/"


def _folder(place: Place) -> str:
    there = f"a folder of {_listed([child.name + '/' * child.is_dir() for child in place.inside])}"
    if (words := missing_folder(place.path) or missing_word(place.path) or several_pairs(place.path)) is not None:
        return f"{there}, and {words}"
    known = PACKED_ARRAYS if any(child.is_dir() for child in place.inside) else (*PACKED_ARRAYS, *MODELS)
    if (found := next((child for child in place.inside if child.suffix.lower() in known), None)) is not None:
        return f"{there}; {found.name[:60]}: {_in_file(found)}"
    here = f"{there}: not one of: {place.kinds}"
    if not any(child.is_dir() for child in place.inside):
        return here
    return f"{here}; colour is looked for in {', '.join(COLOR_FOLDERS)}, depth in {', '.join(DEPTH_FOLDERS)}"


GUESSES: tuple[Callable[[Place], str | None], ...] = (
    _lone_file,
    _nothing,
    _frames_apart,
    _sources,
    _images_missing,
    _stereo,
    _known,
    _rays,
    _recording,
    _part_of_source,
    _further_down,
    _twins,
    _folder,
)
"""Guesses about a folder, in the order in which they are tried; the last one always returns a message."""


def _in_file(file: Path) -> str | None:
    """Describe how to turn a file into a source, judged by its name; None where the name tells nothing."""
    before, last = ["", "", *(suffix.lower() for suffix in file.suffixes)][-2:]
    if (before, last) == (".bag", ".active"):
        return "a recording that was never closed: repair it with rosbag reindex, and rename it to .bag"
    if last in FILMS and DEPTH_IN_NAME.search(file.name):
        return (
            "a film of depth: if it has 16 bits, write its frames as images into depth/, beside rgb.mp4 or rgb/ "
            "(ffmpeg -i FILM -start_number 0 depth/%06d.png); one of 8 bits is only a picture of depth, and useless"
        )
    if last in RECORDINGS:
        return RECORDINGS[last]
    if last in FILMS:
        return (
            "a film: write its frames as images, into rgb/ beside depth/ (ffmpeg -i FILM -start_number 0 rgb/%06d.png)"
        )
    if last in PACKED_ARRAYS or last in MODELS:
        return PACKED_ARRAYS.get(last, MODEL)
    how = PACKED.get(last)
    return f"packed: unpack it first ({'tar -xf' if before == '.tar' else how})" if how else None


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(name[:60] for name in names[:SHOWN]) + more
