"""A driver's progress as one file, so that a run that was cut short can go on: arrays and numbers, no code."""

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import jax
import numpy as np

from gavo_jax.errors import GavoError, write_bytes
from gavo_jax.frame_checks import History
from gavo_jax.odometry.driver import Progress
from gavo_jax.odometry.tracking import TrackerState

NUMBERS, POSES = "numbers", ("world_T_reference", "world_T_camera")


def save_checkpoint(path: Path, progress: Progress, sizes: dict[str, int]) -> None:
    """Write a driver's progress, whole or not at all.

    Args:
        path: An .npz file.
        progress: After a usable frame, so that it has a tracker.
        sizes: Bytes that the growing files had by then.

    Raises:
        GavoError: The file cannot be written.
    """
    numbers = {
        "last_index": progress.last_index,
        "reference_timestamp": progress.reference_timestamp,
        "held": progress.held,
        "history": progress.history._asdict(),
        "sizes": sizes,
    }
    arrays = {name: getattr(progress, name) for name in POSES}
    leaves = [] if progress.tracker is None else jax.device_get(jax.tree.leaves(progress.tracker))
    data = io.BytesIO()
    np.savez(data, **{NUMBERS: np.array(json.dumps(numbers))}, **arrays, **{_leaf(i): a for i, a in enumerate(leaves)})
    write_bytes(path, data.getvalue())


def load_checkpoint(path: Path, blank: TrackerState) -> tuple[Progress, dict[str, int]]:
    """Read what `save_checkpoint` wrote.

    Args:
        path: The file.
        blank: A state of the shapes and types to expect.

    Raises:
        GavoError: The file cannot be read, is damaged, or is of another camera.
    """
    expected, structure = jax.tree.flatten(blank)
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > 2**20 + sum(leaf.nbytes for leaf in expected):
                raise GavoError(f"{path}: larger than a checkpoint of this camera")
        with np.load(path, allow_pickle=False) as arrays:
            numbers = json.loads(str(arrays[NUMBERS]))
            poses = {name: arrays[name] for name in POSES}
            leaves = [arrays[_leaf(i)] for i in range(len(expected))] if _leaf(0) in arrays else None
        history: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in numbers["history"].items()}
        sizes: dict[str, int] = numbers.pop("sizes")
        progress = Progress(**{**numbers, "history": History(**history)}, **poses)
    except (
        OSError,
        EOFError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        MemoryError,
        zipfile.BadZipFile,
    ) as error:
        if isinstance(error, GavoError):
            raise
        raise GavoError(f"{path}: not a whole checkpoint: run again without --resume") from None
    if leaves is None:
        return progress, sizes
    if any((a.shape, a.dtype) != (b.shape, b.dtype) for a, b in zip(leaves, expected, strict=True)):
        raise GavoError(f"{path}: of another camera")
    return progress._replace(tracker=jax.tree.unflatten(structure, map(jax.numpy.asarray, leaves))), sizes


def _leaf(i: int) -> str:
    return f"tracker_{i}"
