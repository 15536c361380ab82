"""Names of a run's files, and helpers for JSON and folders."""

import dataclasses
import enum
import json
import math
import platform
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np

from gavo_jax.errors import PARTIAL, GavoError, as_path
from gavo_jax.output.plots import CAPTIONS as FIGURES
from gavo_jax.output.plots import FORMATS as FIGURE_FORMATS
from gavo_jax.settings import Settings
from gavo_jax.settings_file import name_of
from gavo_jax.trajectory import write_lines
from gavo_jax.version import __version__

TRAJECTORY, FRAMES, METRICS, CONFIG = "trajectory.txt", "frames.csv", "metrics.json", "config.json"
ODOMETRY, LOOPS = "odometry.txt", "loops.csv"
"""Files that a run with loops adds: the trajectory before loop closure, and the loops."""
BODIES = "bodies.csv"
MOTIONS = "motions.csv"
CHECKPOINT = "checkpoint.npz"
COMPARISON = "comparison.json"
EXPERIMENT = "experiment.json"
"""File that `gavo compare` writes."""
RECORDING = "run.rrd"
"""File that `--viewer save` writes."""
VIEW = "view.rrd"
"""File that `gavo view --viewer save` writes."""


def environment() -> dict[str, str]:
    """Return the versions of software that affect a result, and the platform."""
    return {
        "gavo-jax": __version__,
        "jax": jax.__version__,
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
    }


def circumstances(settings: Settings) -> dict[str, Any]:
    """Return what config.json holds besides the sequence and the options: settings, device and versions."""
    return {
        "solver": settings.solver,
        "alignment": settings.alignment,
        "odometry": settings.odometry,
        "device": jax.devices()[0].device_kind,
        "versions": environment(),
    }


def describe(value: Any) -> Any:
    """Convert a value for JSON: settings become objects with their type, arrays lists, non-finite numbers null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        shown = [field.name for field in dataclasses.fields(value) if field.repr]
        entries = {name: describe(getattr(value, name)) for name in shown}
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
    return name_of(value) or getattr(value, "__name__", str(value))


ROW = re.compile(r'\[\n\s*([^][{}"]*?)\n\s*\]')
"""A list of numbers as `json` writes it, one per line. Strings do not match, as their line breaks are escaped."""


def json_text(value: Any, ensure_ascii: bool = True) -> str:
    """Format a value (see `describe`) as readable JSON; each list of numbers, such as a matrix row, is one line."""
    text = json.dumps(describe(value), indent=2, allow_nan=False, ensure_ascii=ensure_ascii)
    return ROW.sub(lambda row: f"[{' '.join(row[1].split())}]", text)


def differences(before: Any, after: Any, name: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield where two JSON values differ: the dotted name and both values, abridged."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in dict.fromkeys([*after, *before]):
            yield from differences(before.get(key), after.get(key), f"{name}.{key}".lstrip("."))
    elif before != after:
        yield name, json.dumps(before)[:60], json.dumps(after)[:60]


def prepare_folder(folder: str | Path) -> Path:
    """Create a folder if it is missing, check that it is writable, and return it.

    Raises:
        GavoError: It is not a folder or cannot be written to.
    """
    folder = as_path(folder)
    try:
        if folder.exists() and not folder.is_dir():
            raise GavoError(f"{folder}: output folder is not a folder")
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise GavoError(f"{folder}: output folder cannot be written to: {error.strerror or error}") from None
    return folder


KINDS = {FRAMES: "a run", COMPARISON: "a comparison", EXPERIMENT: "an experiment"}
"""Kinds of results, by a file that identifies them."""


def refuse_foreign(folder: Path, *files: str) -> None:
    """Refuse a folder that holds results of another kind, as their figures have the same names.

    Args:
        folder: The folder.
        files: Which of `KINDS` are refused.

    Raises:
        GavoError: One of the files exists.
    """
    for file in files:
        if (folder / file).exists():
            raise GavoError(f"{folder}: contains {KINDS[file]} ({file}): choose another folder")


def refuse_strange(folder: Path, patterns: Iterable[str], what: str) -> None:
    """Refuse a folder with files that would be replaced, unless they are known to be of earlier results.

    Args:
        folder: The folder, which holds no earlier results of the kind that are to be written.
        patterns: What their files are called.
        what: Their kind, for the message: a run.

    Raises:
        GavoError: There is such a file.
    """
    found = next((path for pattern in patterns for path in sorted(folder.glob(pattern))), None)
    if found is not None:
        raise GavoError(f"{found}: is not from {what}, which would replace it: choose another folder")


def remove_files(folder: Path, *names: str) -> None:
    """Remove files of an earlier run, and partial ones left by a killed process.

    Raises:
        GavoError: One cannot be removed.
    """
    for path in (path for name in names for path in (folder / name, *folder.glob(f"{name}.*{PARTIAL}"))):
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise GavoError(f"{path}: cannot be replaced: {error.strerror or error}") from None


FIGURE_NAMES = tuple(f"{name}.{suffix}" for name in FIGURES for suffix in FIGURE_FORMATS)
"""Names of all files with figures that a run may leave."""


def remove_figures(folder: Path) -> None:
    """Remove an earlier run's figures, if there are any.

    Raises:
        GavoError: One cannot be removed.
    """
    remove_files(folder, *FIGURE_NAMES)


def write_json(path: Path, value: Any) -> None:
    """Write a value (see `describe`) as JSON, atomically.

    Raises:
        GavoError: The file cannot be written.
    """
    write_lines(path, [json_text(value)])
