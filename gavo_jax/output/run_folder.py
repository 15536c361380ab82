"""The files of one run: config.json comes first, trajectory.txt and frames.csv grow, metrics.json comes last.

A checkpoint beside them lets an interrupted run resume.
"""

import contextlib
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from jaxtyping import Bool

from gavo_jax.errors import GavoError, read_json_object, read_text, shown
from gavo_jax.locks import hold
from gavo_jax.odometry.driver import Step
from gavo_jax.odometry.progress import Progress
from gavo_jax.output.bodies import BODY_COLUMNS, body_rows
from gavo_jax.output.checkpoint import Checkpoint, Mark, load_checkpoint, save_checkpoint
from gavo_jax.output.files import (
    BODIES,
    CHECKPOINT,
    COMPARISON,
    CONFIG,
    FIGURE_NAMES,
    FRAMES,
    LOOPS,
    METRICS,
    MOTIONS,
    ODOMETRY,
    RECORDING,
    TRAJECTORY,
    VIEW,
    describe,
    differences,
    prepare_folder,
    refuse_foreign,
    refuse_strange,
    remove_figures,
    remove_files,
    write_json,
)
from gavo_jax.output.frames import FRAME_COLUMNS, as_line, frame_row, read_steps, recorded_stamps, with_hindsight
from gavo_jax.output.masks import MASKS, read_masks, remove_masks, write_masks
from gavo_jax.output.motions import MOTION_COLUMNS, motion_row, with_motions
from gavo_jax.output.seen_images import SeenImages
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import Trajectory, format_tum_row, write_lines
from gavo_jax.trajectory_rows import TRAJECTORY_HEADER, segment_comment

IDENTITY_KEYS = ("sequence", "solver", "alignment", "odometry", "device")
IDENTITY_OPTIONS = ("method", "preset", "seed")
IDENTITY_VERSIONS = ("gavo-jax", "jax", "numpy", "opencv")
"""Packages whose versions in config.json must be unchanged for a run to be resumed."""


IMAGES = "images_sha256"
"""Key of metrics.json: digest of the images that the run has seen."""
CAREFUL = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)


class _GrowingFile:
    """A text file that grows by whole lines: a line that cannot be written leaves the file as it was."""

    def __init__(self, path: Path, mark: Mark | None = None) -> None:
        """Create the file, or open it and truncate it to the mark; raise GavoError on failure.

        Links are not followed: their targets don't belong to this run.
        """
        self.path = path
        kind = os.O_CREAT | os.O_EXCL if mark is None else 0
        try:
            self._file = os.open(path, os.O_RDWR | kind | CAREFUL, 0o666)
            self.cut(0 if mark is None else mark.size)
        except OSError as error:
            raise (GavoError(_changed(path)) if isinstance(error, FileNotFoundError) else self._fault(error)) from None
        if mark is not None and self.mark() != mark:
            self.close()
            raise GavoError(_changed(path))

    def append(self, line: str) -> None:
        data = (line + "\n").encode("utf-8")
        try:
            written = 0
            while written < len(data):
                written += os.write(self._file, data[written:])
        except OSError as error:
            self.cut(self.size)
            raise self._fault(error) from None
        self._sha256.update(data)
        self.size += len(data)

    def mark(self) -> Mark:
        """Return the file's length and digest."""
        return Mark(self.size, self._sha256.hexdigest())

    def cut(self, size: int) -> None:
        """Truncate the file to a size in bytes."""
        if os.fstat(self._file).st_size > size:
            os.ftruncate(self._file, size)
        os.lseek(self._file, 0, os.SEEK_SET)
        kept = b""
        while len(kept) < size and (more := os.read(self._file, size - len(kept))):
            kept += more
        self.size, self._sha256 = len(kept), hashlib.sha256(kept)

    def close(self) -> None:
        os.close(self._file)

    def _fault(self, error: OSError) -> GavoError:
        return GavoError(f"{self.path}: cannot be written to: {error.strerror or error}")


def _changed(path: Path) -> str:
    return f"{path}: changed since the checkpoint: run again without --resume"


def _other_images(path: Path) -> str:
    return f"{path}: the images differ from those that the run has seen: run again without --resume"


GROWING = (TRAJECTORY, ODOMETRY, FRAMES, BODIES, MOTIONS)
"""Files that grow with a run, if it has them."""
AT_ITS_END = (METRICS, LOOPS, RECORDING, VIEW)
"""Files that a run writes at its end, besides its figures."""
REPLACED = ("trajectory.*", CONFIG, CHECKPOINT, *GROWING, *AT_ITS_END, MASKS, *FIGURE_NAMES)
"""What a run replaces, which is the user's own if the folder holds no run's configuration."""


class RunFolder:
    """A folder that receives the files of one run; a `with` block locks it against other processes.

    Every frame's row is written as soon as it is added, so that an interrupted run leaves what it had. Only a complete
    run has a metrics.json and no checkpoint.
    """

    def __init__(self, folder: str | Path, images: Sequence[Sequence[Path]] = (), trajectory: str = TRAJECTORY) -> None:
        """Create the folder if it is missing.

        Args:
            folder: The folder; `start` and `resume` decide what happens to its files.
            images: Image files of each frame, if any; a run is not resumed if those it saw have changed.
            trajectory: Name of the file that receives the poses as tracked.

        Raises:
            GavoError: It is not a folder or cannot be written to.
        """
        self.path = prepare_folder(folder)
        self._held = contextlib.ExitStack()
        self._seen = SeenImages(images)
        self._poses = trajectory
        self._files: dict[str, _GrowingFile] = {}
        self._segment, self._last_pose = 0, 0.0
        self._whole: tuple[dict[str, Mark], str, Progress | None] = ({}, "", None)
        """After the last complete frame: marks of the growing files, digest of the images seen, driver's progress."""

    def has_run(self) -> bool:
        """Whether an earlier run left its configuration here."""
        return (self.path / CONFIG).exists()

    def _refuse_foreign(self) -> None:
        """Refuse a folder with a comparison, or with files that this run would replace and no earlier run wrote."""
        refuse_foreign(self.path, COMPARISON)
        try:
            is_of_run = "odometry" in read_json_object(self.path / CONFIG)
        except GavoError:
            is_of_run = False
        if not is_of_run:
            refuse_strange(self.path, REPLACED, "a run")

    def start(self, config: Mapping[str, Any], timestamp: float) -> None:
        """Remove an earlier run's files, and write config.json and the first pose, the identity.

        Args:
            config: The effective configuration.
            timestamp: Timestamp of the first frame, seconds.

        Raises:
            GavoError: The folder holds files of another kind, or a file cannot be written.
        """
        self._refuse_foreign()
        remove_files(self.path, CONFIG, CHECKPOINT, *AT_ITS_END, *GROWING)
        remove_figures(self.path)
        remove_masks(self.path)
        write_json(self.path / CONFIG, config)
        self._open(dict.fromkeys(self._growing(config)))
        self._files[FRAMES].append(",".join(FRAME_COLUMNS))
        if BODIES in self._files:
            self._files[BODIES].append(",".join(BODY_COLUMNS))
        if MOTIONS in self._files:
            self._files[MOTIONS].append(",".join(MOTION_COLUMNS))
        self._files[self._poses].append(TRAJECTORY_HEADER)
        self._files[self._poses].append(format_tum_row(timestamp, np.eye(4)))
        self._last_pose = timestamp
        self._whole = (self._marks(), self._seen.up_to(0), None)

    def resume(self, config: Mapping[str, Any], blank: Any) -> Progress | None:
        """Open the files of an interrupted run, truncated to its last checkpoint.

        Args:
            config: The effective configuration, which must be the earlier run's.
            blank: A tracker's state with the expected shapes.

        Returns:
            The driver's progress; None if there is no checkpoint: then call `start`.

        Raises:
            GavoError: The earlier run is a different one, its images have changed, or its files are damaged.
        """
        kept = self.path / CHECKPOINT
        if (self.path / CONFIG).exists():
            _refuse_another(self.path / CONFIG, config)
        elif kept.exists() or (self.path / METRICS).exists():
            raise GavoError(
                f"{self.path / CONFIG}: no such file, so the other files cannot be matched to a run: choose another "
                "folder"
            )
        if not kept.exists():
            return None
        progress, files, images = load_checkpoint(kept, blank)
        if set(files) != set(self._growing(config)):
            raise GavoError(f"{kept}: damaged or incomplete checkpoint: run again without --resume")
        if self._seen.up_to(progress.last_index) != images:
            raise GavoError(_other_images(kept))
        self._open(files)
        remove_files(self.path, *AT_ITS_END, *({TRAJECTORY} - {self._poses}))
        frames = config.get("sequence", {}).get("frames")
        if frames is None or progress.last_index < frames - 1:  # else they show the last pairs, and nothing is left
            remove_figures(self.path)
        self._whole, self._segment = (files, images, progress), progress.segment
        self._last_pose = _last_stamp(self.path / self._poses)
        remove_masks(self.path, kept=recorded_stamps(self.path / FRAMES))
        return progress

    def _growing(self, config: Mapping[str, Any]) -> tuple[str, ...]:
        """Names of the files that grow with a run."""
        odometry = config.get("odometry")
        bodies = (BODIES,) if getattr(odometry, "bodies", "off") != "off" else ()
        motions = (MOTIONS,) if getattr(odometry, "loops", False) else ()
        return (self._poses, FRAMES, *bodies, *motions)

    def finished(self) -> dict[str, Any] | None:
        """Return the metrics of a complete earlier run in this folder, whose rows are revised; None if there is none.

        Raises:
            GavoError: They cannot be read, or the images have changed.
        """
        path = self.path / METRICS
        if not path.exists() or (self.path / CHECKPOINT).exists():
            return None
        metrics = read_json_object(path)
        pairs = metrics.get("pairs", 0)
        if not isinstance(pairs, int):
            raise GavoError(f"{path}: pairs: expected a whole number, got {shown(pairs)}")
        if metrics.get(IMAGES, unchanged := self._seen.up_to(pairs)) != unchanged:
            raise GavoError(_other_images(path))
        self._revise()  # it may have been killed before that
        return metrics

    def add(self, step: Step, progress: Progress | None = None) -> None:
        """Append one frame: its rows and masks, and its pose unless its timestamp is in doubt.

        Args:
            step: The driver's record of the frame.
            progress: The driver's state after it, for a checkpoint.

        Raises:
            GavoError: A file cannot be written, as on a full disk; it then ends with the last whole row.
        """
        write_masks(self.path, step)
        self._files[FRAMES].append(as_line(frame_row(step)))
        if BODIES in self._files:
            for body in body_rows(step):
                self._files[BODIES].append(as_line(body))
        if MOTIONS in self._files:
            self._files[MOTIONS].append(as_line(motion_row(step)))
        if step.alignment.status != AlignmentStatus.BAD_TIMESTAMP:
            if step.segment != self._segment:
                comment = segment_comment(step.segment, self._last_pose, step.timestamp)
                self._files[self._poses].append(comment)
                self._segment = step.segment
            self._files[self._poses].append(format_tum_row(step.timestamp, step.world_T_camera))
            self._last_pose = step.timestamp
        images = self._whole[1] if progress is None else self._seen.up_to(progress.last_index)
        self._whole = (self._marks(), images, progress)

    def save_checkpoint(self) -> None:
        """Write a checkpoint of the last frame, if its progress is known, from which the run can be resumed.

        Raises:
            GavoError: It cannot be written.
        """
        files, images, progress = self._whole
        if progress is not None:
            save_checkpoint(self.path / CHECKPOINT, Checkpoint(progress, files, images))

    def steps(self) -> list[Step]:
        """Read the steps of the run so far from its files; see `read_steps`. With loops they have all digits."""
        steps = self._recorded_steps()
        return with_motions(steps, self.path / MOTIONS) if MOTIONS in self._files else steps

    def moving(self, step: Step) -> Bool[np.ndarray, "height width"] | None:
        """Read the pixels of a step's frame that move on their own; None if the run saw nothing move."""
        return read_masks(self.path, step.timestamp)

    def _recorded_steps(self) -> list[Step]:
        """Read the steps from frames.csv and the poses, without an incomplete one left by an interruption."""
        self._cut()
        return read_steps(self.path, Trajectory.read_tum(self.path / self._poses))

    def finish(self, metrics: Mapping[str, Any], complete: bool = True) -> None:
        """Write metrics.json atomically.

        A complete run then loses its checkpoint, and its rows are revised in hindsight.

        Raises:
            GavoError: It cannot be written.
        """
        write_json(self.path / METRICS, {**metrics, IMAGES: self._whole[1]})
        if complete:
            remove_files(self.path, CHECKPOINT)
            self._revise()

    def _revise(self) -> None:
        """Rewrite frames.csv if later pairs revise earlier ones; it does not grow after that."""
        steps = self._recorded_steps()
        rows = read_text(self.path / FRAMES).splitlines()
        known = with_hindsight(rows, steps)
        if known != rows:
            marks, images, progress = self._whole
            self._whole = ({name: mark for name, mark in marks.items() if name != FRAMES}, images, progress)
            if FRAMES in self._files:
                self._files.pop(FRAMES).close()
            write_lines(self.path / FRAMES, known)

    def _open(self, files: Mapping[str, Mark | None]) -> None:
        for name, mark in files.items():
            self._files[name] = _GrowingFile(self.path / name, mark)

    def _marks(self) -> dict[str, Mark]:
        return {name: file.mark() for name, file in self._files.items()}

    def _cut(self) -> None:
        """Remove an incomplete frame left by an interruption."""
        for name, mark in self._whole[0].items():
            self._files[name].cut(mark.size)

    def __enter__(self) -> Self:
        """Lock the folder.

        Raises:
            GavoError: Another process writes to it.
        """
        self._held.enter_context(hold(self.path))
        return self

    def __exit__(self, *exception: object) -> None:
        with self._held:
            self._cut()
            for file in self._files.values():
                file.close()


def _refuse_another(path: Path, config: Mapping[str, Any]) -> None:
    """Raise GavoError, with the first difference, if a config.json is not of the run that `config` describes."""
    earlier = read_json_object(path)
    now = json.loads(json.dumps(describe(config), allow_nan=False))
    for name, before, after in differences(_identity(earlier), _identity(now)):
        raise GavoError(
            f"{path}: belongs to another run, which --resume cannot continue: {name} was {before}, now {after}"
        )


def _identity(config: dict[str, Any]) -> dict[str, Any]:
    def part(name: str, keys: tuple[str, ...]) -> dict[str, Any]:
        values = config.get(name)
        return {key: values.get(key) for key in keys} if isinstance(values, dict) else {}

    whole = {key: config.get(key) for key in IDENTITY_KEYS}
    return {**whole, **part("options", IDENTITY_OPTIONS), **part("versions", IDENTITY_VERSIONS)}


def _last_stamp(path: Path) -> float:
    """Return the stamp of a trajectory's last row, which is not the latest one if a clock was set back."""
    rows = [line for line in read_text(path).splitlines() if line and not line.startswith("#")]
    try:
        return float(rows[-1].split()[0])
    except (IndexError, ValueError):
        raise GavoError(f"{path}: its last row is not a pose") from None
