"""Recognition of the kind of source at a path: the built-in kinds, and those of other packages."""

import inspect
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol

from gavo_jax.datasets import unrecognised
from gavo_jax.datasets.base import RUN, Sequence
from gavo_jax.datasets.files import Reading
from gavo_jax.datasets.layouts.airsim import AirSim
from gavo_jax.datasets.layouts.arkit import Polycam, ScannerApp, ScanNetPlusPlus
from gavo_jax.datasets.layouts.bonn import Bonn
from gavo_jax.datasets.layouts.bop import BopScene
from gavo_jax.datasets.layouts.nerfstudio import Nerfstudio
from gavo_jax.datasets.layouts.neural import NeuralRgbd, SemanticReplica
from gavo_jax.datasets.layouts.numbered import Replica, ScanNet, SevenScenes
from gavo_jax.datasets.layouts.openloris import OpenLoris
from gavo_jax.datasets.layouts.phones import ArkitScenes, Record3D, StrayScan
from gavo_jax.datasets.layouts.plain_folder import Open3DFolder, PlainFolder
from gavo_jax.datasets.layouts.rtabmap import RtabMap
from gavo_jax.datasets.layouts.tartanair import TartanAir
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.layouts.virtual_kitti import VirtualKitti
from gavo_jax.datasets.layouts.ycb_video import YcbVideo
from gavo_jax.datasets.recordings.bags import BagSequence
from gavo_jax.errors import GavoError, as_path, blamed

PLUGINS = "gavo_jax.datasets"
"""Group of entry points by which other packages register kinds of sources."""


class Dataset(Protocol):
    """A kind of source; usually the class of its sequences."""

    @property
    def kind(self) -> str:
        """Name of the kind."""
        ...

    def recognises(self, path: Path) -> bool:
        """Whether a folder or file is of this kind; has to be fast, and must not read images."""
        ...

    def open(self, path: Path, reading: Reading) -> Sequence:
        """Open the sequence at a path.

        Raises:
            GavoError: names the file and the fault.
        """
        ...


BUILT_IN: tuple[Dataset, ...] = (
    *(
        OpenLoris,
        Bonn,
        TumSequence,
        SevenScenes,
        BopScene,
        ScanNet,
        Replica,
        TartanAir,
        VirtualKitti,
        AirSim,
        BagSequence,
        StrayScan,
        ArkitScenes,
        Record3D,
        ScanNetPlusPlus,
        ScannerApp,
        Polycam,
        SemanticReplica,
        NeuralRgbd,
        RtabMap,
        Nerfstudio,
        YcbVideo,
        Open3DFolder,
        PlainFolder,
    ),
)
"""Built-in kinds, in the order in which they are tried."""

TOPICS = {"--colour-topic", "--depth-topic"}

USELESS: dict[Dataset, set[str]] = {BagSequence: {"--rate"}}
"""Options that a built-in kind of source cannot use; for kinds not listed, `TOPICS`."""

_registered: list[Dataset] = []


def register_dataset(dataset: Dataset) -> None:
    """Register a custom kind of source; it is tried before the built-in ones.

    An installed package needs no call: an entry point in the group `gavo_jax.datasets` registers its kind.

    Args:
        dataset: has `kind` (its name), `recognises(path) -> bool` and `open(path, reading) -> Sequence`.

    Raises:
        GavoError: it lacks one of these, or a method cannot be called with these arguments.
    """
    _require_dataset(dataset)
    if dataset not in _registered:
        _registered.insert(0, dataset)


CALLS = {"recognises": ("path",), "open": ("path", "reading")}
"""Methods of a kind of source, and their arguments."""


def _require_dataset(dataset: Any) -> None:
    name = getattr(dataset, "__name__", type(dataset).__name__)
    if not (isinstance(kind := getattr(dataset, "kind", None), str) and kind):
        raise GavoError(f"dataset {name}: kind: expected its name as text")
    for method, arguments in CALLS.items():
        call, form = getattr(dataset, method, None), f"{method}({', '.join(arguments)})"
        if not callable(call):
            raise GavoError(f"dataset {name}: has no {form}")
        try:
            inspect.signature(call).bind(*arguments)
        except TypeError:
            hint = ": make it a classmethod, or register an instance of the class" if isinstance(dataset, type) else ""
            raise GavoError(f"dataset {name}: cannot be called as {form}{hint}") from None
        except ValueError:  # no signature available
            pass


def datasets() -> tuple[Dataset, ...]:
    """All kinds of sources, in the order in which they are tried."""
    faulty_plugins()
    return (*_registered, *BUILT_IN)


@cache
def faulty_plugins() -> tuple[str, ...]:
    """Register the kinds of installed packages, and return an error message for each that cannot be loaded."""
    faults = []
    for entry in entry_points(group=PLUGINS):
        try:
            with blamed(f"dataset {entry.name!r} of {entry.value}: cannot be loaded"):
                register_dataset(entry.load())
        except GavoError as error:
            faults.append(str(error))
    return tuple(faults)


def open_source(path: str | Path, reading: Reading | None = None) -> Sequence:
    """Open a folder or file of any known kind as a sequence.

    Args:
        path: a folder in the layout of a dataset, or a file.
        reading: camera, units, rate and anything else that the source does not state itself.

    Raises:
        GavoError: the path does not exist, its kind is unknown, or the source is faulty.
    """
    path, reading = as_path(path), Reading() if reading is None else reading
    if not isinstance(reading, Reading):
        raise GavoError(f"expected a Reading, got {type(reading).__name__}: use gavo.Reading(camera=…)")
    try:
        exists = path.exists()
    except (OSError, ValueError) as error:
        raise GavoError(f"{str(path)!r}: unusable: {getattr(error, 'strerror', None) or error}") from None
    if not exists:
        raise GavoError(f"{path}: no such folder or file: pass an existing one, or the word synthetic")
    dataset = recognise(path)
    if dataset in BUILT_IN and (useless := set(reading.given()) & USELESS.get(dataset, TOPICS)):
        raise GavoError(f"{path}: {min(useless)} does not apply to this kind of source ({dataset.kind})")
    return dataset.open(path, reading) if dataset in BUILT_IN else _open_others(dataset, path, reading)


def _open_others(dataset: Dataset, path: Path, reading: Reading) -> Sequence:
    """Open a source of a custom kind; an exception, or a result that is no sequence, is blamed on that kind."""
    whose = f"dataset {dataset.kind!r}: {path}"
    with blamed(whose):
        sequence = dataset.open(path, reading)
        if lacking := [name for name in RUN if not hasattr(sequence, name)]:
            raise GavoError(
                f"{whose}: open returns {type(sequence).__name__}, not a Sequence: it has no {', '.join(lacking)}"
            )
    return sequence


def recognise(path: Path) -> Dataset:
    """The kind of source at a path.

    Raises:
        GavoError: no known kind; the message says what is there instead.
    """
    dataset, faults = _asked(path)
    if dataset is not None:
        return dataset
    there = unrecognised.describe(path, [dataset.kind for dataset in datasets()], _is_source)
    raise GavoError("; ".join([f"{path}: {there}", *faults, *faulty_plugins()]))


def _asked(path: Path) -> tuple[Dataset | None, list[str]]:
    """The kind of source at a path or None, and the errors of custom kinds that failed before."""
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


def source_around(path: Path) -> Path | None:
    """The folder of the source that a file or folder belongs to; None if there is none."""
    return unrecognised.source_around(path, _is_source)


def _is_source(path: Path) -> bool:
    """Whether a path holds a source of a known kind; False if it cannot be accessed (a circular link, say)."""
    try:
        return _asked(path)[0] is not None
    except GavoError:
        return False
