"""The files of one run: trajectory.txt and frames.csv grow with it, config.json opens and metrics.json closes it.

A checkpoint beside them lets a run that was cut short go on where it was.
"""

import csv
import io
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np

from gavo_jax.errors import GavoError
from gavo_jax.odometry.driver import Progress, Step
from gavo_jax.odometry.tracking import TrackerState
from gavo_jax.output.checkpoint import load_checkpoint, save_checkpoint
from gavo_jax.output.files import (
    CHECKPOINT,
    CONFIG,
    FRAMES,
    METRICS,
    RECORDING,
    TRAJECTORY,
    VIEW,
    describe,
    prepare_folder,
    read_json,
    remove_figures,
    remove_files,
    write_json,
)
from gavo_jax.output.frames import FRAME_COLUMNS, frame_row, read_steps
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import TRAJECTORY_HEADER, format_tum_row

IDENTITY_KEYS = ("sequence", "solver", "alignment", "odometry", "device")
IDENTITY_OPTIONS = ("method", "preset", "seed")
IDENTITY_VERSIONS = ("gavo-jax", "jax", "numpy", "opencv")
"""What has to be the same in config.json for a run to go on to the same end."""


class _GrowingFile:
    """A text file that grows by whole lines: each is in the file, or the file ends where it did before."""

    def __init__(self, path: Path, size: int) -> None:
        """Open it and cut it to `size` bytes; raise GavoError where that cannot be, or where it is shorter."""
        self.path = path
        try:
            self._file = path.open("r+b" if size else "wb", buffering=0)
            short = self._file.seek(0, os.SEEK_END) < size
            self.cut(size)
        except OSError as error:
            raise self._fault(error) from None
        if short:
            self._file.close()
            raise GavoError(f"{path}: shorter than it was at the checkpoint: run again without --resume")

    def append(self, line: str) -> None:
        data = (line + "\n").encode("utf-8")
        try:
            written = self._file.write(data)
            while written < len(data):
                written += self._file.write(data[written:])
        except OSError as error:
            self.cut(self.size)
            raise self._fault(error) from None
        self.size += len(data)

    def cut(self, size: int) -> None:
        self._file.truncate(size)
        self._file.seek(size)
        self.size = size

    def close(self) -> None:
        self._file.close()

    def _fault(self, error: OSError) -> GavoError:
        return GavoError(f"{self.path}: cannot be written to: {error.strerror or error}")


class RunFolder:
    """A folder that receives the files of one run; use it in a `with` block.

    Every frame's row is on disk as soon as it is added, so that a run that is cut short leaves what it had; only a run
    that came to its end has a metrics.json and no checkpoint.
    """

    def __init__(self, folder: str | Path) -> None:
        """Make the folder where it is missing.

        Raises:
            GavoError: it is no folder or cannot be written to.
        """
        self.path = prepare_folder(folder)
        self._files: dict[str, _GrowingFile] = {}
        self._whole: tuple[dict[str, int], Progress | None] = ({}, None)
        """Sizes of the growing files after the last frame that is in both, and the driver's progress then."""

    def start(self, config: Mapping[str, Any], timestamp: float) -> None:
        """Remove an earlier run's files, write config.json and the first pose, which is the world's frame.

        Args:
            config: the effective configuration.
            timestamp: of the first frame, seconds.

        Raises:
            GavoError: a file cannot be written.
        """
        remove_files(self.path, METRICS, CHECKPOINT, CONFIG, TRAJECTORY, FRAMES, RECORDING, VIEW)
        remove_figures(self.path)
        write_json(self.path / CONFIG, config)
        self._open({TRAJECTORY: 0, FRAMES: 0})
        self._files[FRAMES].append(",".join(FRAME_COLUMNS))
        self._files[TRAJECTORY].append(TRAJECTORY_HEADER)
        self._files[TRAJECTORY].append(format_tum_row(timestamp, np.eye(4)))
        self._whole = (self._sizes(), None)

    def resume(self, config: Mapping[str, Any], blank: TrackerState) -> Progress | None:
        """Open the files of a run that was cut short, without what came after its last checkpoint.

        Args:
            config: the effective configuration, which has to be the earlier run's.
            blank: a tracker's state of the shapes to expect.

        Returns:
            Where the run stood; None where there is nothing to go on from: then `start`.

        Raises:
            GavoError: the earlier run is another one, or its files are damaged.
        """
        if (self.path / CONFIG).exists():
            _refuse_another(self.path / CONFIG, config)
        if not (self.path / CHECKPOINT).exists():
            return None
        progress, sizes = load_checkpoint(self.path / CHECKPOINT, blank)
        if set(sizes) != {TRAJECTORY, FRAMES} or not all(isinstance(size, int) and size > 0 for size in sizes.values()):
            raise GavoError(f"{self.path / CHECKPOINT}: not a whole checkpoint: run again without --resume")
        remove_files(self.path, METRICS)
        remove_figures(self.path)
        self._open(sizes)
        self._whole = (sizes, progress)
        return progress

    def finished(self) -> dict[str, Any] | None:
        """The metrics of an earlier run in this folder that came to its end; None where there is none.

        Raises:
            GavoError: they cannot be read.
        """
        path = self.path / METRICS
        if not path.exists() or (self.path / CHECKPOINT).exists():
            return None
        return read_json(path)

    def add(self, step: Step, progress: Progress | None = None) -> None:
        """Append one frame: its pair's row, and its pose unless its stamp is in doubt.

        Args:
            step: what the driver says of it.
            progress: where the driver stands now, for a checkpoint.

        Raises:
            GavoError: the disk is full, or the like; the files then end with the last whole row.
        """
        row = io.StringIO()
        csv.writer(row, lineterminator="").writerow(frame_row(step))
        self._files[FRAMES].append(row.getvalue())
        if step.alignment.status != AlignmentStatus.BAD_TIMESTAMP:
            self._files[TRAJECTORY].append(format_tum_row(step.timestamp, step.world_T_camera))
        self._whole = (self._sizes(), progress)

    def save_checkpoint(self) -> None:
        """Write where the run stands, so that it can be resumed from here.

        Raises:
            GavoError: it cannot be written.
        """
        sizes, progress = self._whole
        if progress is not None:
            save_checkpoint(self.path / CHECKPOINT, progress, sizes)

    def steps(self) -> list[Step]:
        """The steps of the run so far, as the files tell them; see `read_steps`."""
        self._cut()
        return read_steps(self.path)

    def finish(self, metrics: Mapping[str, Any], complete: bool = True) -> None:
        """Write metrics.json, whole or not at all; after it a run that is complete needs no checkpoint any more.

        Raises:
            GavoError: it cannot be written.
        """
        write_json(self.path / METRICS, metrics)
        if complete:
            remove_files(self.path, CHECKPOINT)

    def _open(self, sizes: Mapping[str, int]) -> None:
        for name, size in sizes.items():
            self._files[name] = _GrowingFile(self.path / name, size)

    def _sizes(self) -> dict[str, int]:
        return {name: file.size for name, file in self._files.items()}

    def _cut(self) -> None:
        """Take away the part of a frame that an interruption left."""
        for name, size in self._whole[0].items():
            if self._files[name].size != size:
                self._files[name].cut(size)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._cut()
        for file in self._files.values():
            file.close()


def _refuse_another(path: Path, config: Mapping[str, Any]) -> None:
    """Raise GavoError where a config.json is not of the run that `config` describes; it names the first difference."""
    earlier = read_json(path)
    now = json.loads(json.dumps(describe(config), allow_nan=False))
    for name, before, after in _differences(_identity(earlier), _identity(now), ""):
        raise GavoError(
            f"{path}: is of another run, which --resume cannot go on with: {name} {before} there, {after} now"
        )


def _identity(config: dict[str, Any]) -> dict[str, Any]:
    def part(name: str, keys: tuple[str, ...]) -> dict[str, Any]:
        values = config.get(name)
        return {key: values.get(key) for key in keys} if isinstance(values, dict) else {}

    whole = {key: config.get(key) for key in IDENTITY_KEYS}
    return {**whole, **part("options", IDENTITY_OPTIONS), **part("versions", IDENTITY_VERSIONS)}


def _differences(before: Any, after: Any, name: str) -> Iterator[tuple[str, str, str]]:
    """The places where two JSON values differ: name, one value, the other."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in dict.fromkeys([*after, *before]):
            yield from _differences(before.get(key), after.get(key), f"{name}.{key}".lstrip("."))
    elif before != after:
        yield name, json.dumps(before)[:60], json.dumps(after)[:60]
