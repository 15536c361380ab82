"""A driver's progress as one file, so that a run that was cut short can go on: arrays and numbers, no code.

A digest seals it: an altered checkpoint is refused.
"""

import hashlib
import io
import json
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from gavo_jax.camera import MAX_SIDE
from gavo_jax.depth_edges import DepthEdges
from gavo_jax.errors import GavoError, write_bytes
from gavo_jax.frame_checks import History
from gavo_jax.odometry.beginnings import Beginning
from gavo_jax.odometry.depth_change import DepthChange
from gavo_jax.odometry.depth_watch import DepthWatch
from gavo_jax.odometry.drawn import Drawn
from gavo_jax.odometry.leaps import Leap
from gavo_jax.odometry.misplaced import Arrival
from gavo_jax.odometry.progress import Progress
from gavo_jax.odometry.way import Fix, Way

NUMBERS, SEAL, POSES = "numbers", "seal", ("world_T_reference", "world_T_camera")
INVERSE_DEPTH, EDGES = "inverse_depth", "depth_edges"
LAST_GREY, SAME_LEVEL = "last_grey", "same_level"
MOST_BESIDE = 2**20 + 5 * MAX_SIDE**2 // 4
"""Bytes at most beside the tracker: a float and a count for every fourth pixel of the largest image, and numbers."""


class Mark(NamedTuple):
    """How far a growing file was."""

    size: int
    """Length of the file, bytes."""
    sha256: str
    """SHA-256 of these bytes."""


class Checkpoint(NamedTuple):
    """Where a run stood."""

    progress: Progress
    """All that the driver knows; without a tracker where no usable frame was seen yet."""
    files: dict[str, Mark]
    """The files that grow with the run, by name."""
    images: str = ""
    """Digest of the images that were seen; see `SeenImages`."""


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write where a run stands, whole or not at all.

    Args:
        path: An .npz file.
        checkpoint: What it holds.

    Raises:
        GavoError: The file cannot be written.
    """
    progress, watch = checkpoint.progress, checkpoint.progress.depth
    numbers = {
        "last_index": progress.last_index,
        "reference_timestamp": progress.reference_timestamp,
        "held": progress.held,
        "way": progress.way.fixes,
        "segment": progress.segment,
        "last_segment": progress.last_segment,
        "adrift": progress.adrift,
        "doubted": progress.doubted,
        "unknown": progress.unknown,
        "leap": progress.leap and [progress.leap.target_T_reference.tolist(), *progress.leap[1:]],
        "arrival": progress.arrival and [np.asarray(part).tolist() for part in progress.arrival],
        "beginning": progress.beginning,
        "depth": watch and [watch.change[1:], watch.edges[1:], watch.found_wrong],
        "history": progress.history._asdict(),
        "files": checkpoint.files,
        "images": checkpoint.images,
    }
    leaves = [] if progress.tracker is None else jax.device_get(jax.tree.leaves(progress.tracker))
    arrays = {NUMBERS: np.array(json.dumps(numbers))}
    arrays |= {name: np.asarray(getattr(progress, name)) for name in POSES}
    arrays |= {_leaf(i): np.asarray(leaf) for i, leaf in enumerate(leaves)}
    if watch is not None:
        arrays |= {INVERSE_DEPTH: watch.change.inverse, EDGES: watch.edges.sums}
    if progress.drawn.last is not None:
        arrays |= {LAST_GREY: progress.drawn.last, SAME_LEVEL: progress.drawn.counts}
    data = io.BytesIO()
    arrays[SEAL] = np.array(_seal(arrays))
    np.savez(data, **arrays)  # pyright: ignore[reportArgumentType] (NumPy 2.0 takes allow_pickle=False for an array)
    write_bytes(path, data.getvalue())


def load_checkpoint(path: Path, blank: Any) -> Checkpoint:
    """Read what `save_checkpoint` wrote.

    Args:
        path: The file.
        blank: A state of the shapes and types to expect.

    Raises:
        GavoError: The file cannot be read, is damaged or altered, or is of another camera.
    """
    expected, structure = jax.tree.flatten(blank)
    try:
        arrays = _sealed_arrays(path, most=MOST_BESIDE + sum(leaf.nbytes for leaf in expected))
        numbers = json.loads(str(arrays[NUMBERS]))
        files = {name: Mark(*mark) for name, mark in numbers.pop("files").items()}
        images = numbers.pop("images")
        leaves = [arrays[_leaf(i)] for i in range(len(expected))] if _leaf(0) in arrays else None
        progress = _progress_of(numbers, arrays)
    except GavoError:
        raise
    except Exception:  # reading damaged archives may raise almost anything
        raise GavoError(f"{path}: damaged or incomplete checkpoint: run again without --resume") from None
    if leaves is None:
        return Checkpoint(progress, files, images)
    if any((a.shape, a.dtype) != (b.shape, b.dtype) for a, b in zip(leaves, expected, strict=True)):
        raise GavoError(f"{path}: belongs to another camera")
    progress = progress._replace(tracker=jax.tree.unflatten(structure, map(jax.numpy.asarray, leaves)))
    return Checkpoint(progress, files, images)


def _sealed_arrays(path: Path, most: int) -> dict[str, np.ndarray]:
    """Return the sealed arrays of a file of at most `most` bytes, uncompressed; raise if they were altered."""
    with zipfile.ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > most:
            raise GavoError(f"{path}: larger than a checkpoint of this camera")
    with np.load(path, allow_pickle=False) as stored:
        arrays = dict(stored)
    if str(arrays.pop(SEAL)) != _seal(arrays):
        raise ValueError("altered")
    return arrays


def _progress_of(numbers: dict[str, Any], arrays: dict[str, np.ndarray]) -> Progress:
    """A progress without its tracker's state: the records in `numbers` become what they were written from."""
    history: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in numbers["history"].items()}
    leap, came, beginning = numbers["leap"], numbers.get("arrival"), numbers.get("beginning")
    numbers |= {
        "history": History(**history),
        "leap": leap and Leap(np.array(leap[0]), *leap[1:]),
        "arrival": came and Arrival(np.array(came[0]), np.array(came[1]), *came[2:]),
        "way": Way(tuple(Fix(seconds, tuple(xi)) for seconds, xi in numbers["way"])),
        "beginning": beginning and Beginning(*beginning),
    }
    if depth := numbers.get("depth"):
        (delay, *known), seen, told = depth
        change = DepthChange(arrays[INVERSE_DEPTH], delay, *map(tuple, known))
        numbers["depth"] = DepthWatch(change, DepthEdges(arrays[EDGES], *seen), told)
    drawn = Drawn(arrays[LAST_GREY], arrays[SAME_LEVEL]) if LAST_GREY in arrays else Drawn()
    poses: dict[str, Any] = {name: arrays[name] for name in POSES}
    return Progress(**numbers, **poses, drawn=drawn)


def _seal(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}\0".encode() + array.tobytes())
    return digest.hexdigest()


def _leaf(i: int) -> str:
    return f"tracker_{i}"
