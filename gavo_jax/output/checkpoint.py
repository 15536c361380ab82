"""Checkpoints: a driver's progress in one file of arrays and numbers, from which an interrupted run resumes.

A digest seals the file: an altered checkpoint is refused.
"""

import hashlib
import io
import json
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from gavo_jax.bodies.records import Numbering
from gavo_jax.camera import MAX_SIDE
from gavo_jax.depth_edges import DepthEdges
from gavo_jax.errors import GavoError, write_bytes
from gavo_jax.frame_checks import History
from gavo_jax.odometry.attached import Attached
from gavo_jax.odometry.beginnings import Beginning
from gavo_jax.odometry.depth_change import DepthChange
from gavo_jax.odometry.depth_watch import DepthWatch
from gavo_jax.odometry.leaps import Leap
from gavo_jax.odometry.misplaced import Arrival
from gavo_jax.odometry.overlays import Overlays
from gavo_jax.odometry.progress import Progress
from gavo_jax.odometry.way import Fix, Way

NUMBERS, SEAL, POSES = "numbers", "seal", ("world_T_reference", "world_T_camera")
INVERSE_DEPTH, EDGES = "inverse_depth", "depth_edges"
LAST_GREY, SAME_LEVEL, ATTACHED = "last_grey", "same_level", "attached_"
MOST_BESIDE = 2**21 + 5 * MAX_SIDE**2 // 4
"""Maximum bytes without the tracker: numbers, small images of parts in view, and a float and a count for one pixel in
four of the largest image.
"""


class Mark(NamedTuple):
    """State of a growing file."""

    size: int
    """Length of the file, bytes."""
    sha256: str
    """SHA-256 of these bytes."""


class Checkpoint(NamedTuple):
    """State of a run between two frames."""

    progress: Progress
    """The driver's state; without a tracker before the first usable frame."""
    files: dict[str, Mark]
    """Marks of the files that grow with the run, by name."""
    images: str = ""
    """Digest of the images seen so far; see `SeenImages`."""


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint atomically.

    Args:
        path: An .npz file.
        checkpoint: State of the run.

    Raises:
        GavoError: The file cannot be written.
    """
    progress, watch = checkpoint.progress, checkpoint.progress.depth
    numbers = {
        "last_index": progress.last_index,
        "reference_timestamp": progress.reference_timestamp,
        "reference_late": progress.reference_late,
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
        "numbering": progress.numbering,
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
    if progress.overlays.last is not None:
        arrays |= {LAST_GREY: progress.overlays.last, SAME_LEVEL: progress.overlays.counts}
        arrays |= {ATTACHED + name: np.asarray(part) for name, part in progress.overlays.attached._asdict().items()}
    data = io.BytesIO()
    arrays[SEAL] = np.array(_seal(arrays))
    np.savez(data, **arrays)  # pyright: ignore[reportArgumentType] (NumPy 2.0 takes allow_pickle=False for an array)
    write_bytes(path, data.getvalue())


def load_checkpoint(path: Path, blank: Any) -> Checkpoint:
    """Read what `save_checkpoint` wrote.

    Args:
        path: The file.
        blank: A tracker's state with the expected shapes and types.

    Raises:
        GavoError: The file cannot be read, is damaged or altered, or belongs to another camera.
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
    """Return the sealed arrays of a file of at most `most` bytes uncompressed; raise if they were altered."""
    with zipfile.ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > most:
            raise GavoError(f"{path}: larger than a checkpoint of this camera")
    with np.load(path, allow_pickle=False) as stored:
        arrays = dict(stored)
    if str(arrays.pop(SEAL)) != _seal(arrays):
        raise ValueError("altered")
    return arrays


def _progress_of(numbers: dict[str, Any], arrays: dict[str, np.ndarray]) -> Progress:
    """Rebuild a progress, without its tracker's state, from the stored numbers and arrays."""
    history: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in numbers["history"].items()}
    leap, came, beginning = numbers["leap"], numbers.get("arrival"), numbers.get("beginning")
    numbers |= {
        "history": History(**history),
        "leap": leap and Leap(np.array(leap[0]), *leap[1:]),
        "arrival": came and Arrival(np.array(came[0]), np.array(came[1]), *came[2:]),
        "way": Way(tuple(Fix(seconds, tuple(xi)) for seconds, xi in numbers["way"])),
        "beginning": beginning and Beginning(*beginning),
        "numbering": Numbering(*numbers.get("numbering", ())),
    }
    if depth := numbers.get("depth"):
        (delay, before, *known), seen, told = depth
        change = DepthChange(arrays[INVERSE_DEPTH], delay, tuple(map(tuple, before)), *map(tuple, known))
        numbers["depth"] = DepthWatch(change, DepthEdges(arrays[EDGES], *seen), told)
    overlays = Overlays()
    if LAST_GREY in arrays:
        parts = {name: arrays[ATTACHED + name] for name in Attached._fields}
        attached = Attached(**{**parts, "moves": int(parts["moves"])})
        overlays = Overlays(arrays[LAST_GREY], arrays[SAME_LEVEL], attached)
    poses: dict[str, Any] = {name: arrays[name] for name in POSES}
    return Progress(**numbers, **poses, overlays=overlays)


def _seal(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}\0".encode() + array.tobytes())
    return digest.hexdigest()


def _leaf(i: int) -> str:
    return f"tracker_{i}"
