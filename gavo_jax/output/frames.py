"""frames.csv: steps as rows, and the steps of a run read back."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gavo_jax.alignment.result import no_alignment
from gavo_jax.errors import GavoError, read_json_object, read_text, shown
from gavo_jax.odometry.driver import Step
from gavo_jax.odometry.hindsight import revised
from gavo_jax.output.files import CONFIG, FRAMES, METRICS, ODOMETRY, TRAJECTORY
from gavo_jax.status import AlignmentStatus, bit
from gavo_jax.trajectory import Trajectory, inverse, stamp_name

DEVIATIONS = tuple(f"std_{name}" for name in ("vx", "vy", "vz", "wx", "wy", "wz"))
FRAME_COLUMNS = (
    ("index", "reference_timestamp", "timestamp", "error", "overlap", "status", "undetermined", "lost", "on_lost")
    + DEVIATIONS
    + ("milliseconds", "segment", "statuses", "origin", "revises")
)
"""Columns of frames.csv, one row per pair.

Timestamps are in seconds, `error` is E in squared grey levels, `overlap` a share from 0 to 1. `undetermined` names the
directions that a `low_texture` pair leaves open, `on_lost` what was recorded for a lost pair. The deviations are those
of the translation (m) and rotation (rad) along the axes of the reference camera. Segments count from 0; `statuses` are
all that hold, separated by spaces. `origin` is `tracked`, `relocalised` (the reference is a keyframe of the map) or
`guessed` (a lost pair, or a motion extrapolated behind a body). `revises` is the number of preceding pairs that turn
out to be wrong; their statuses change when the run ends.
"""


def read_steps(folder: Path, trajectory: Trajectory | None = None) -> list[Step]:
    """Read the steps of a run from its trajectory.txt and frames.csv.

    Motions are those between the poses as tracked: from odometry.txt if it exists, as loops have corrected
    trajectory.txt. Off-diagonal covariances and histories are not in the files: they are zero and empty. A frame whose
    timestamp is in doubt has no pose and gets the preceding one.

    Args:
        folder: Folder of the run.
        trajectory: Contents of trajectory.txt, if read already.

    Raises:
        GavoError: A file cannot be read or is damaged, or the poses belong to another run.
    """
    poses = Trajectory.read_tum(folder / TRAJECTORY) if trajectory is None else trajectory
    found = Trajectory.read_tum(folder / ODOMETRY) if (folder / ODOMETRY).exists() else poses
    by_stamp, found_at = ({stamp_name(t): i for i, t in enumerate(one.timestamps)} for one in (poses, found))
    steps: list[Step] = []
    place = now = 0
    rows = _rows_of(folder / FRAMES)
    while len(rows) > 1 and len(rows) >= len(poses) and _lacks_pose(rows[-1], {**by_stamp, **found_at}):
        rows.pop()  # its pose was not written yet
    for number, row in enumerate(rows, start=1):
        try:
            stamp = float(row["timestamp"])
            if int(row["index"]) != number:
                raise ValueError("a row is missing")
            for name, stamps in ((TRAJECTORY, by_stamp), (ODOMETRY, found_at)):
                if _lacks_pose(row, stamps):
                    of = f"{name} and {FRAMES} are not from the same run"
                    raise GavoError(f"{folder}: {of}: no pose at {row['timestamp']}")
            if row["timestamp"] in by_stamp:
                place = by_stamp[row["timestamp"]]
                stamp = float(poses.timestamps[place])
            now = found_at.get(row["timestamp"], now)
            reference = float(row["reference_timestamp"])
            before = found_at.get(row["reference_timestamp"], now)
            if row["reference_timestamp"] in found_at:  # with all digits, by which consecutive steps are recognised
                reference = float(found.timestamps[before])
            target_T_reference = inverse(found.world_T_camera[now]) @ found.world_T_camera[before]
            steps.append(_read_step(row, reference, stamp, poses.world_T_camera[place], target_T_reference))
        except GavoError:
            raise
        except (KeyError, TypeError, ValueError):
            raise GavoError(f"{folder / FRAMES}:{number + 1}: not row {number} of a run") from None
    return steps


def recorded_stamps(path: Path) -> set[str]:
    """Return the timestamps in a frames.csv, as they stand there.

    Raises:
        GavoError: It cannot be read.
    """
    return {row.get("timestamp", "") for row in _rows_of(path)}


def _rows_of(path: Path) -> list[dict[str, str]]:
    try:
        return list(csv.DictReader(read_text(path).splitlines()))
    except csv.Error as error:
        raise GavoError(f"{path}: not a table of frames: {error}") from None


def _lacks_pose(row: Mapping[str, str], stamps: Mapping[str, int]) -> bool:
    """Whether a frame should have a pose, and has none."""
    return row.get("timestamp") not in stamps and row.get("status") != str(AlignmentStatus.BAD_TIMESTAMP)


def _read_step(
    row: Mapping[str, str],
    reference_timestamp: float,
    timestamp: float,
    world_T_camera: np.ndarray,
    target_T_reference: np.ndarray,
) -> Step:
    deviations = np.array([float(row[name]) for name in DEVIATIONS])
    statuses = (row.get("statuses") or row["status"]).upper().split()
    alignment = no_alignment(AlignmentStatus[row["status"].upper()])._replace(
        findings=sum({bit(AlignmentStatus[name]) for name in statuses} - {bit(AlignmentStatus.OK)}),
        target_T_reference=target_T_reference,
        error=np.float32(row["error"]),
        overlap=np.float32(row["overlap"]),
        covariance=np.diag(deviations**2),
    )
    return Step(
        index=int(row["index"]),
        reference_timestamp=reference_timestamp,
        timestamp=timestamp,
        alignment=alignment,
        world_T_camera=world_T_camera,
        milliseconds=float(row["milliseconds"]),
        lost=row["lost"] == "1",
        policy=row["on_lost"],  # pyright: ignore[reportArgumentType]
        segment=int(row.get("segment") or 0),
        origin=row.get("origin") or ("guessed" if row["lost"] == "1" else "tracked"),  # pyright: ignore[reportArgumentType]
        revises=int(row.get("revises") or 0),
    )


def with_hindsight(lines: Sequence[str], steps: Sequence[Step]) -> list[str]:
    """Return the lines of frames.csv with new statuses and deviations of the pairs that later ones revise.

    Args:
        lines: Lines of the file, the header included.
        steps: The driver's steps, one per row.
    """
    lines = list(lines)
    for place, (step, after) in enumerate(zip(steps, revised(steps), strict=True), start=1):
        if after is not step:
            said = next(csv.reader([lines[place]]))
            known = dict(zip(FRAME_COLUMNS, frame_row(after), strict=True))
            for name in ("status", "statuses", *DEVIATIONS):
                said[FRAME_COLUMNS.index(name)] = str(known[name])
            lines[place] = as_line(said)
    return lines


def as_line(values: Iterable[Any]) -> str:
    """Return values as a line of CSV."""
    row = io.StringIO()
    csv.writer(row, lineterminator="").writerow(values)
    return row.getvalue()


def frame_row(step: Step) -> list[Any]:
    """Return a step's values of `FRAME_COLUMNS`; error, overlap and deviations read back exactly."""
    alignment = step.alignment
    deviations = np.sqrt(np.maximum(np.diag(np.asarray(alignment.covariance, np.float64)), 0.0))
    return [
        step.index,
        stamp_name(step.reference_timestamp),
        stamp_name(step.timestamp),
        _digits(alignment.error),
        _digits(alignment.overlap),
        str(alignment.status),
        alignment.undetermined,
        int(step.lost),
        step.policy,
        *map(_digits, deviations),
        f"{step.milliseconds:.3f}",
        step.segment,
        " ".join(str(status) for status in alignment.statuses),
        step.origin,
        step.revises,
    ]


class RecordedRun(NamedTuple):
    """A run as read from its folder."""

    config: dict[str, Any]
    trajectory: Trajectory
    steps: list[Step]
    """Step of each frame after the first, revised in hindsight; see `read_steps`."""


def read_run(folder: str | Path) -> RecordedRun:
    """Read the files of a run, finished or not.

    Raises:
        GavoError: A file is missing, damaged or cut off, or trajectory.txt and frames.csv are from different runs.
    """
    folder = Path(folder)
    if not folder.is_dir():
        fault = "not a folder" if folder.exists() else "no such folder"
        raise GavoError(f"{folder}: {fault}: pass the output folder of a run")
    if not (folder / CONFIG).exists():
        raise GavoError(f"{folder}: not an output folder of `gavo run`: it contains no {CONFIG}")
    config = read_json_object(folder / CONFIG)
    # a killed run with loops has only the poses as tracked
    is_cut_short = not (folder / TRAJECTORY).exists() and (folder / ODOMETRY).exists()
    trajectory = Trajectory.read_tum(folder / (ODOMETRY if is_cut_short else TRAJECTORY))
    steps = read_steps(folder, trajectory)
    pairs = read_json_object(folder / METRICS).get("pairs") if (folder / METRICS).exists() else None
    if pairs not in (None, len(steps)):  # metrics.json is written last
        told = f"{len(steps)} pairs in {TRAJECTORY} and {FRAMES}, and {shown(pairs)} in {METRICS}"
        raise GavoError(f"{folder}: {told}: files are cut off, or belong to another run")
    return RecordedRun(config, trajectory, revised(steps))


def _digits(value: Any) -> str:
    return np.format_float_positional(value, unique=True) if np.isfinite(value) else str(float(value))
