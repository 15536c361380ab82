"""Which kind of source lies at a path: the kinds that are known, and those that other packages bring."""

import inspect
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol

from gavo_jax.datasets.base import Sequence
from gavo_jax.datasets.files import Reading
from gavo_jax.datasets.layouts.image_folders import (
    COLOR_FOLDERS,
    DEPTH_FOLDERS,
    missing_folder,
    missing_images,
    missing_word,
)
from gavo_jax.datasets.layouts.numbered import Open3DFolder, PlainFolder, Replica, ScanNet, SevenScenes
from gavo_jax.datasets.layouts.openloris import OpenLoris
from gavo_jax.datasets.layouts.phones import ArkitScenes, Record3D, StrayScan
from gavo_jax.datasets.layouts.rtabmap import RtabMap
from gavo_jax.datasets.layouts.tartanair import TartanAir
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.recordings.bags import BagSequence
from gavo_jax.errors import GavoError, blamed

PLUGINS = "gavo_jax.datasets"
"""Group of entry points through which other packages bring kinds of sources."""

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
"""Endings of files from which a source is to be unpacked first, and by what."""

RECORDINGS = {
    ".sens": "a scan as ScanNet packs it: export it with ScanNet's SensReader, and name the folder",
    ".mkv": "a film, or a recording of Azure Kinect: write its images with Open3D's azure_kinect_mkv_reader.py",
    ".svo": "a recording of a ZED: write its images and depth with the ZED SDK's export samples",
    ".svo2": "a recording of a ZED: write its images and depth with the ZED SDK's export samples",
    ".oni": "a recording of OpenNI: write its images and depth with OpenNI's tools",
    ".r3d": "a recording of Record3D: export it in the app as EXR + RGB, and name the folder of rgb/ and depth/",
    ".klg": "a log of ElasticFusion's logger: write its images and depth first",
}
"""What holds a source in a form of its maker's alone."""

FILMS = (".mp4", ".avi", ".mov", ".webm", ".m4v", ".mpg", ".mpeg")

SHOWN = 5
"""Names that a message lists."""


class Dataset(Protocol):
    """A kind of source; the class of its sequences itself, mostly."""

    @property
    def kind(self) -> str:
        """What it is called."""
        ...

    def recognises(self, path: Path) -> bool:
        """Whether a folder or file is of this kind, by names alone: quick, and without reading images."""
        ...

    def open(self, path: Path, reading: Reading) -> Sequence:
        """Return the frames.

        Raises:
            GavoError: names the file and the fault.
        """
        ...


BUILT_IN: tuple[Dataset, ...] = (
    *(
        OpenLoris,
        TumSequence,
        SevenScenes,
        ScanNet,
        Replica,
        TartanAir,
        BagSequence,
        StrayScan,
        ArkitScenes,
        Record3D,
        RtabMap,
        Open3DFolder,
        PlainFolder,
    ),
)
"""In the order in which they are asked."""

TOPICS = {"--colour-topic", "--depth-topic"}

USELESS: dict[Dataset, set[str]] = {BagSequence: {"--rate"}}
"""Options that a kind of source, built in, has no use for; of the others `TOPICS`."""

_registered: list[Dataset] = []


def register_dataset(dataset: Dataset) -> None:
    """Add a kind of source of one's own; it is asked before those that are built in.

    A package that is installed can do without a call: an entry point of the group `gavo_jax.datasets` leads to it.

    Args:
        dataset: has `kind` (what it is called), `recognises(path) -> bool` and `open(path, reading) -> Sequence`.

    Raises:
        GavoError: it lacks one of these, or one cannot be called so.
    """
    _require_dataset(dataset)
    if dataset not in _registered:
        _registered.insert(0, dataset)


CALLS = {"recognises": ("path",), "open": ("path", "reading")}
"""What a kind of source is asked, and with what."""


def _require_dataset(dataset: Any) -> None:
    name = getattr(dataset, "__name__", type(dataset).__name__)
    if not (isinstance(kind := getattr(dataset, "kind", None), str) and kind):
        raise GavoError(f"dataset {name}: kind: what it is called is needed, a text")
    for method, arguments in CALLS.items():
        call, form = getattr(dataset, method, None), f"{method}({', '.join(arguments)})"
        if not callable(call):
            raise GavoError(f"dataset {name}: has no {form}")
        try:
            inspect.signature(call).bind(*arguments)
        except TypeError:
            hint = ": a classmethod is needed, or an object of the class" if isinstance(dataset, type) else ""
            raise GavoError(f"dataset {name}: {form} cannot be called so{hint}") from None
        except ValueError:  # nothing tells what it takes
            pass


def datasets() -> tuple[Dataset, ...]:
    """All kinds of sources, in the order in which they are asked."""
    faulty_plugins()
    return (*_registered, *BUILT_IN)


@cache
def faulty_plugins() -> tuple[str, ...]:
    """Register what installed packages bring; what is wrong with those that cannot be loaded."""
    faults = []
    for entry in entry_points(group=PLUGINS):
        try:
            with blamed(f"dataset {entry.name!r} of {entry.value}: cannot be loaded"):
                register_dataset(entry.load())
        except GavoError as error:
            faults.append(str(error))
    return tuple(faults)


def open_source(path: str | Path, reading: Reading | None = None) -> Sequence:
    """Return the frames of a folder or file, whatever kind of source it is.

    Args:
        path: a folder in the layout of a dataset, or a file.
        reading: camera, units, rate and what else the source does not say itself.

    Raises:
        GavoError: there is nothing, nothing that is known, or the source is faulty.
    """
    path, reading = Path(path), reading or Reading()
    try:
        exists = path.exists()
    except (OSError, ValueError) as error:
        raise GavoError(f"{str(path)!r}: unusable: {getattr(error, 'strerror', None) or error}") from None
    if not exists:
        raise GavoError(f"{path}: no such folder or file: name one, or the word synthetic")
    dataset = recognise(path)
    if dataset in BUILT_IN and (useless := set(reading.given()) & USELESS.get(dataset, TOPICS)):
        raise GavoError(f"{path}: {min(useless)} says nothing of a {dataset.kind}")
    return dataset.open(path, reading)


def recognise(path: Path) -> Dataset:
    """The kind of source that lies at a path.

    Raises:
        GavoError: none that is known; the message says what is there instead.
    """
    dataset, faults = _asked(path)
    if dataset is not None:
        return dataset
    raise GavoError("; ".join([f"{path}: {_contents(path)}", *faults, *faulty_plugins()]))


def _kind_of(path: Path) -> Dataset | None:
    return _asked(path)[0]


def _asked(path: Path) -> tuple[Dataset | None, list[str]]:
    """The kind of source that lies at a path, and what is wrong with those of packages that were passed over."""
    faults: list[str] = []
    for dataset in datasets():
        try:
            with blamed(f"dataset {dataset.kind!r}: {path}"):
                if dataset.recognises(path):
                    return dataset, faults
        except GavoError as error:
            if dataset in BUILT_IN:
                raise
            faults.append(str(error))
    return None, faults


def _contents(path: Path) -> str:
    """What lies at a path where no source is, in a few words; folders in it that are sources are named."""
    known = f"{', '.join(dataset.kind for dataset in datasets())} (SUN3D's, too)"
    if not path.is_dir():
        if path.is_file() and (source := source_around(path)):
            return f"a file of a source: name its folder, {source}"
        return _inside(path) or f"a file of {path.stat().st_size} bytes, not one of: {known}"
    inside = sorted(path.iterdir())
    if len(inside) == 1 and inside[0].is_file() and (words := _inside(inside[0])):
        return f"{inside[0].name}: {words}"
    if not inside:
        return f"an empty folder, not one of: {known}"
    sources = [child.name for child in inside if not child.name.startswith(".") and _kind_of(child) is not None]
    if sources:
        names = (
            f"{len(sources)}: name one of {_listed(sources)}" if len(sources) > 1 else f"one: name {sources[0][:60]}"
        )
        return f"no source itself, but a folder of {names}"
    if (words := missing_images(path)) is not None:
        return words
    if stereo := next((folder for folder in (path / "mav0", path) if (folder / "cam0" / "data").is_dir()), None):
        return f"{stereo / 'cam0'}: a recording as EuRoC has it, of stereo images without depth, which this needs"
    if any(path.glob("d-*.pgm")) and any(path.glob("r-*.ppm")):
        return (
            "the raw recording of NYU Depth, whose depth is in units of disparity: write rgb/ and depth/ with the "
            "dataset's toolbox first"
        )
    if film := next((child for child in inside if child.suffix.lower() in (*FILMS, *RECORDINGS)), None):
        return f"{film.name}: {_inside(film)}"
    if source := source_around(path):
        return f"a folder inside a source: name the source, {source}"
    there = f"a folder of {_listed([child.name + '/' * child.is_dir() for child in inside])}"
    if (words := missing_folder(path) or missing_word(path)) is not None:
        return f"{there}, and {words}"
    here = f"{there}: not one of: {known}"
    if not any(child.is_dir() for child in inside):
        return here
    return f"{here}; colour is looked for in {', '.join(COLOR_FOLDERS)}, depth in {', '.join(DEPTH_FOLDERS)}"


def source_around(path: Path) -> Path | None:
    """The folder of the source that a file or folder is a part of; None where it is of none."""
    return next((folder for folder in list(path.absolute().parents)[:2] if _kind_of(folder) is not None), None)


def _inside(file: Path) -> str | None:
    """How what a file holds becomes a source, where its name tells."""
    endings = [suffix.lower() for suffix in file.suffixes]
    if endings[-2:] == [".bag", ".active"]:
        return "a recording that was never closed: mend it with rosbag reindex, and name it .bag"
    if endings and endings[-1] in RECORDINGS:
        return RECORDINGS[endings[-1]]
    if endings[-1:] and endings[-1] in FILMS:
        return (
            "a film: write its frames as images, into rgb/ beside depth/ (ffmpeg -i FILM -start_number 0 rgb/%06d.png)"
        )
    how = PACKED.get(endings[-1]) if endings else None
    return f"packed: unpack it first ({'tar -xf' if endings[-2:-1] == ['.tar'] else how})" if how else None


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(name[:60] for name in names[:SHOWN]) + more
