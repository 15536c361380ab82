"""The files of one run: trajectory.txt and frames.csv grow with it, config.json opens and metrics.json closes it."""

import csv
import dataclasses
import enum
import json
import math
import platform
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple, Self

import cv2
import jax
import numpy as np

from gavo_jax.alignment import AlignmentStatus
from gavo_jax.errors import GavoError, read_text
from gavo_jax.odometry import Step, no_alignment
from gavo_jax.plots import CAPTIONS as FIGURES
from gavo_jax.plots import FORMATS as FIGURE_FORMATS
from gavo_jax.trajectory import TRAJECTORY_HEADER, Trajectory, format_tum_row, inverse, write_lines
from gavo_jax.version import __version__

TRAJECTORY, FRAMES, METRICS, CONFIG = "trajectory.txt", "frames.csv", "metrics.json", "config.json"
RECORDING = "run.rrd"
"""What `--viewer save` writes."""
VIEW = "view.rrd"
"""What `gavo view --viewer save` writes."""

STAMP_TOLERANCE = 1e-6
"""Seconds: stamps of the files are rounded to microseconds."""

DEVIATIONS = tuple(f"std_{name}" for name in ("vx", "vy", "vz", "wx", "wy", "wz"))
FRAME_COLUMNS = (
    ("index", "reference_timestamp", "timestamp", "error", "overlap", "status", "lost") + DEVIATIONS + ("milliseconds",)
)
"""Of frames.csv, a row a pair: stamps in seconds, error in squared grey levels, overlap from 0 to 1, deviations of the
motion's translation (m) and rotation (rad) along the axes of the reference camera."""


class RunFolder:
    """A folder that receives the files of one run; use it in a `with` block.

    Every frame's row is on disk as soon as it is added, so that a run that is cut short leaves what it had; only a run
    that came to its end has a metrics.json.
    """

    def __init__(self, folder: str | Path) -> None:
        """Make the folder where it is missing.

        Raises:
            GavoError: it is no folder or cannot be written to.
        """
        self.path = prepare_folder(folder)
        self._files = ExitStack()

    def start(self, config: Mapping[str, Any], timestamp: float) -> None:
        """Remove an earlier run's files, write config.json and the first pose, which is the world's frame.

        Args:
            config: the effective configuration.
            timestamp: of the first frame, seconds.

        Raises:
            GavoError: a file cannot be written.
        """
        remove_files(self.path, METRICS, CONFIG, TRAJECTORY, FRAMES, RECORDING, VIEW)
        remove_figures(self.path)
        write_json(self.path / CONFIG, config)
        try:
            self._trajectory = self._files.enter_context((self.path / TRAJECTORY).open("w", encoding="utf-8"))
            self._frames = self._files.enter_context((self.path / FRAMES).open("w", encoding="utf-8", newline=""))
        except OSError as error:
            raise GavoError(f"{self.path}: cannot be written to: {error.strerror or error}") from None
        self._rows = csv.writer(self._frames, lineterminator="\n")
        self._rows.writerow(FRAME_COLUMNS)
        self._trajectory.write(f"{TRAJECTORY_HEADER}\n{format_tum_row(timestamp, np.eye(4))}\n")
        self._flush()

    def add(self, step: Step) -> None:
        """Append one frame: its pose and its pair's row.

        Raises:
            GavoError: the disk is full, or the like.
        """
        self._rows.writerow(frame_row(step))
        self._trajectory.write(format_tum_row(step.timestamp, step.world_T_camera) + "\n")
        self._flush()

    def finish(self, metrics: Mapping[str, Any]) -> None:
        """Write metrics.json, whole or not at all.

        Raises:
            GavoError: it cannot be written.
        """
        write_json(self.path / METRICS, metrics)

    def _flush(self) -> None:
        try:
            self._trajectory.flush()
            self._frames.flush()
        except OSError as error:
            raise GavoError(f"{self.path}: cannot be written to: {error.strerror or error}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._files.close()


def frame_row(step: Step) -> list[Any]:
    """Return the values of `FRAME_COLUMNS` of one step; numbers in the shortest digits that read back exactly."""
    alignment = step.alignment
    deviations = np.sqrt(np.maximum(np.diag(np.asarray(alignment.covariance, np.float64)), 0.0))
    return [
        step.index,
        f"{step.reference_timestamp:.6f}",
        f"{step.timestamp:.6f}",
        _digits(alignment.error),
        _digits(alignment.overlap),
        alignment.status.name.lower(),
        int(step.lost),
        *map(_digits, deviations),
        f"{step.milliseconds:.3f}",
    ]


class RecordedRun(NamedTuple):
    """What a run folder tells of its run."""

    config: dict[str, Any]
    trajectory: Trajectory
    steps: list[Step]
    """Of each frame after the first; covariance, history and twist are not on disk and left unknown."""


def read_run(folder: str | Path) -> RecordedRun:
    """Read the files of a run, whether it came to its end or not.

    Raises:
        GavoError: a file is missing or damaged, or trajectory.txt and frames.csv are not of the same run.
    """
    folder = Path(folder)
    config = read_json(folder / CONFIG)
    if not isinstance(config, dict):
        raise GavoError(f"{folder / CONFIG}: not a configuration")
    trajectory = Trajectory.read_tum(folder / TRAJECTORY)
    rows = list(csv.DictReader(read_text(folder / FRAMES).splitlines()))[: len(trajectory) - 1]
    try:
        steps = [_read_step(row, trajectory) for row in rows]
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise GavoError(f"{folder / FRAMES}: not the frames of {TRAJECTORY}: {error}") from None
    return RecordedRun(config, trajectory, steps)


def _read_step(row: Mapping[str, str], trajectory: Trajectory) -> Step:
    index = int(row["index"])
    reference_timestamp, timestamp = float(row["reference_timestamp"]), float(row["timestamp"])
    reference = int(np.argmin(np.abs(trajectory.timestamps - reference_timestamp)))
    if abs(trajectory.timestamps[index] - timestamp) > STAMP_TOLERANCE:
        raise ValueError(f"its row {index} is of another time")
    world_T_camera = trajectory.world_T_camera[index]
    target_T_reference = inverse(world_T_camera) @ trajectory.world_T_camera[reference]
    alignment = no_alignment(AlignmentStatus[row["status"].upper()])._replace(
        target_T_reference=target_T_reference, error=float(row["error"]), overlap=float(row["overlap"])
    )
    return Step(
        index,
        reference_timestamp,
        timestamp,
        alignment,
        world_T_camera,
        float(row["milliseconds"]),
        bool(int(row["lost"])),
    )


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        GavoError: it is missing, unreadable or no JSON.
    """
    try:
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise error if isinstance(error, GavoError) else GavoError(f"{path}: not JSON: {error}") from None


def environment() -> dict[str, str]:
    """Return the versions that decide a result."""
    return {
        "gavo-jax": __version__,
        "jax": jax.__version__,
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
    }


def describe(value: Any) -> Any:
    """Return a value as JSON knows it: settings with the name of their type, arrays as lists, not-a-number as null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        entries = {field.name: describe(getattr(value, field.name)) for field in dataclasses.fields(value)}
        return {"type": type(value).__name__, **entries}
    if isinstance(value, enum.Enum):
        return value.name.lower()
    if isinstance(value, Mapping):
        return {str(key): describe(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return describe(np.asarray(value).tolist())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [describe(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    return getattr(value, "__name__", str(value))


def prepare_folder(folder: str | Path) -> Path:
    """Make a folder where it is missing, see that files can be made in it, and return it.

    Raises:
        GavoError: it is no folder or cannot be written to.
    """
    folder = Path(folder)
    try:
        if folder.exists() and not folder.is_dir():
            raise GavoError(f"{folder}: output folder is not a folder")
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise GavoError(f"{folder}: output folder cannot be written to: {error.strerror or error}") from None
    return folder


def remove_files(folder: Path, *names: str) -> None:
    """Remove files of an earlier run, where there are any.

    Raises:
        GavoError: one cannot be removed.
    """
    for name in names:
        try:
            (folder / name).unlink(missing_ok=True)
        except OSError as error:
            raise GavoError(f"{folder / name}: cannot be replaced: {error.strerror or error}") from None


def remove_figures(folder: Path) -> None:
    """Remove an earlier run's figures, where there are any.

    Raises:
        GavoError: one cannot be removed.
    """
    remove_files(folder, *(f"{name}.{suffix}" for name in FIGURES for suffix in FIGURE_FORMATS))


def write_json(path: Path, value: Any) -> None:
    """Write a value (see `describe`) as JSON, whole or not at all.

    Raises:
        GavoError: the file cannot be written.
    """
    write_lines(path, [json.dumps(describe(value), indent=2, allow_nan=False)])


def _digits(value: Any) -> str:
    return np.format_float_positional(value, unique=True) if np.isfinite(value) else str(float(value))
