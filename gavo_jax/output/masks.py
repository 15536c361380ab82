"""masks/: one image for each frame that shows a body, named by the colour timestamp.

Each pixel holds the number of the body that covers it, 0 for the background.
"""

from collections.abc import Set
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Integer

from gavo_jax.errors import PARTIAL, GavoError, write_bytes
from gavo_jax.odometry.driver import Step
from gavo_jax.trajectory import stamp_name

MASKS = "masks"
"""Name of the folder inside that of a run."""


def write_masks(folder: Path, step: Step) -> None:
    """Write the masks of a step's bodies, if there are any.

    Args:
        folder: Folder of the run.
        step: Step of the frame.

    Raises:
        GavoError: It cannot be written.
    """
    if not step.bodies:
        return
    most = max(body.number for body in step.bodies)
    labels = np.zeros(step.bodies[0].size, np.uint8 if most <= np.iinfo(np.uint8).max else np.uint16)
    for body in step.bodies:
        labels[body.mask] = body.number
    path = _path(folder, step.timestamp)
    try:
        if path.parent.is_symlink():
            raise GavoError(f"{path.parent}: is a link: its target does not belong to this run")
        path.parent.mkdir(exist_ok=True)
    except OSError as error:
        raise GavoError(f"{path.parent}: cannot be created: {error.strerror or error}") from None
    write_bytes(path, cv2.imencode(".png", labels)[1].tobytes())


def read_masks(folder: Path, timestamp: float) -> Bool[np.ndarray, "height width"] | None:
    """Return the pixels that any body covers in a frame; see `read_labels`."""
    labels = read_labels(folder, timestamp)
    return None if labels is None else labels > 0


def read_labels(folder: Path, timestamp: float) -> Integer[np.ndarray, "height width"] | None:
    """Return the number of the body at each pixel of a frame, 0 for background; None if the run saw no body.

    Args:
        folder: Folder of the run.
        timestamp: The frame's colour timestamp, seconds.

    Raises:
        GavoError: It cannot be read.
    """
    path = _path(folder, timestamp)
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise GavoError(f"{path}: {error.strerror or error}") from None
    labels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if labels is None or labels.ndim != 2:
        raise GavoError(f"{path}: not an image of bodies")
    return labels


def remove_masks(folder: Path, kept: Set[str] = frozenset()) -> None:
    """Remove a run's images of other frames than some, and the folder if it is empty then.

    Args:
        folder: Folder of the run.
        kept: Timestamps of those frames, as `stamp_name` writes them.

    Raises:
        GavoError: One cannot be removed.
    """
    inside = folder / MASKS
    if inside.is_symlink() or not inside.is_dir():
        return
    try:
        for path in (*inside.glob("*.png"), *inside.glob(f"*.png.*{PARTIAL}")):  # also partial files of a killed run
            stamp = _stamp(path)
            if not (np.isnan(stamp) or stamp_name(stamp) in kept):
                path.unlink()
        if not any(inside.iterdir()):
            inside.rmdir()
    except OSError as error:
        raise GavoError(f"{inside}: cannot be replaced: {error.strerror or error}") from None


def _path(folder: Path, timestamp: float) -> Path:
    return folder / MASKS / f"{stamp_name(timestamp)}.png"


def _stamp(path: Path) -> float:
    """Return the timestamp in a file's name, seconds; NaN if the file is not from a run."""
    try:
        return float(path.name.partition(".png")[0])
    except ValueError:
        return float("nan")
