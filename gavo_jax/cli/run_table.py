"""The table `gavo run` prints at the end, with the reason if the drift is missing."""

from collections import Counter, defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gavo_jax.evaluation import rotation_angle
from gavo_jax.odometry.driver import Step
from gavo_jax.odometry.metrics import (
    ABSOLUTE_ERROR,
    COMPILE_SECONDS,
    DRIFT,
    DRIFT_PER_FRAME,
    FINAL_DISTANCE,
    FRAMES_PER_SECOND,
    MILLISECONDS,
    ROTATION_DRIFT,
)
from gavo_jax.output.bodies import read_bodies
from gavo_jax.output.files import BODIES
from gavo_jax.output.frames import read_steps
from gavo_jax.output.screen import number, print_table, say
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import Trajectory

ERRORS = (
    ("drift: RPE over 1 s, translation, RMSE", DRIFT, 6, "m/s"),
    ("drift: RPE over 1 s, rotation, RMSE", ROTATION_DRIFT, 6, "deg/s"),
    ("RPE over 1 frame, translation, RMSE", DRIFT_PER_FRAME, 6, "m/frame"),
    ("absolute error after alignment, RMSE", ABSOLUTE_ERROR, 6, "m"),
    ("distance error at the end", FINAL_DISTANCE, 6, "m"),
)
"""Rows of the table: label, key in metrics.json, decimals, unit. Rows without a value are left out."""

BEFORE_LOOPS = (
    ("drift of the odometry alone, translation", f"odometry_{DRIFT}", 6, "m/s"),
    ("absolute error of the odometry alone", f"odometry_{ABSOLUTE_ERROR}", 6, "m"),
)
"""Additional rows for a run with loop closure."""

COUNTS = (
    ("frames", "frames", 0, ""),
    ("lost pairs", "lost_pairs", 0, ""),
    ("compilation", COMPILE_SECONDS, 1, "s"),
    ("time per pair, decoded images, median", MILLISECONDS, 1, "ms"),
    ("speed, reading and decoding included", FRAMES_PER_SECOND, 1, "frames/s"),
)
OF_RENDERED = {FRAMES_PER_SECOND: "speed, rendering included"}
"""Labels that differ if frames are rendered instead of read."""

Row = tuple[str, str, str]


def print_run(
    name: str,
    metrics: Mapping[str, Any],
    folder: Path,
    trajectory: Trajectory,
    *,
    truth: Trajectory | None,
    is_rendered: bool = False,
) -> None:
    """Print the table of a run and where its files are.

    Args:
        name: name of the run.
        metrics: contents of metrics.json.
        folder: output folder of the run.
        trajectory: the trajectory as read from its file.
        truth: ground truth of the sequence, if it has any.
        is_rendered: whether the frames are of the synthetic room.
    """
    known = [row for row in ERRORS + BEFORE_LOOPS if metrics.get(row[1]) is not None]
    rows: list[Row] = [(what, number(metrics[key], digits), unit) for what, key, digits, unit in known]
    if not known:
        rows += _of_trajectory(trajectory, metrics)
    names = OF_RENDERED if is_rendered else {}
    rows += [(names.get(key, what), number(metrics.get(key), digits), unit) for what, key, digits, unit in COUNTS]
    for status, count in metrics.get("statuses", {}).items():
        if status == "frozen":
            rows += _of_frozen(read_steps(folder, trajectory))
        elif status != "ok":
            rows.append((f"pairs: {status}", str(count), ""))
    if "loops" in metrics:
        rows += [("loops that count", str(metrics["loops"]), ""), ("loops refused", str(metrics["loops_refused"]), "")]
    if metrics.get("guessed_pairs"):
        rows.append(("pairs whose motion is a guess", str(metrics["guessed_pairs"]), ""))
    if metrics.get("unknown_motions"):
        rows.append(("segments, the motion between them unknown", str(metrics["segments"]), ""))
    rows += _of_bodies(folder / BODIES)
    print_table(name, ("", "", "unit"), rows)
    if reason := why_no_drift(metrics, trajectory, truth is not None):
        say(reason if known else f"{reason} The table shows what the trajectory alone tells.")
    if known and (part := covered_in_part(trajectory, truth)):
        say(part)
    say(f"files in {folder}")


def _of_frozen(steps: list[Step]) -> list[Row]:
    """Return rows that count the frozen pairs whose image repeats, and those whose depth does."""
    frozen = (step.alignment.frozen for step in steps if step.alignment.status is AlignmentStatus.FROZEN)
    counted = sorted(Counter(frozen).items(), reverse=True)  # the image first
    return [(f"pairs: frozen, the {what} repeats", str(count), "") for what, count in counted]


def _of_bodies(path: Path) -> list[Row]:
    """Return rows that summarise bodies.csv; none if nothing was seen to move."""
    seen = read_bodies(path)
    if not seen:
        return []
    covered: dict[float, float] = defaultdict(float)
    for row in seen:
        covered[row.timestamp] += row.share
    return [
        ("bodies that moved", str(len({row.body for row in seen})), ""),
        ("frames that show one", str(len(covered)), ""),
        ("largest share of an image", number(100 * max(covered.values()), 0), "%"),
    ]


def path_and_end(trajectory: Trajectory) -> tuple[float, str | None]:
    """Return a path's length and end position in metres; the end is None if some motion before it is unknown."""
    places = trajectory.world_T_camera[:, :3, 3]
    known = np.diff(trajectory.segments) == 0
    path = float(np.linalg.norm(np.diff(places, axis=0), axis=1)[known].sum())
    is_known = trajectory.segments[0] == trajectory.segments[-1]
    return path, " ".join(f"{value:+.4f}" for value in places[-1]) if is_known else None


def _of_trajectory(trajectory: Trajectory, metrics: Mapping[str, Any]) -> list[Row]:
    """Return rows that describe a trajectory without ground truth."""
    path, end = path_and_end(trajectory)
    angle = float(np.degrees(rotation_angle(trajectory.world_T_camera[-1:, :3, :3])[0]))
    share = metrics.get("statuses", {}).get("ok", 0) / max(1, metrics.get("pairs", 0))
    rows = [("length of the path", number(path), "m")]
    if end is not None:
        rows += [("end: x right, y down, z forward", end, "m"), ("end: turned by", number(angle, 2), "deg")]
    return [*rows, ("pairs that are ok", number(100 * share, 1), "%")]


def why_no_drift(metrics: Mapping[str, Any], trajectory: Trajectory, has_truth: bool) -> str | None:
    """Explain in a sentence why there is no drift over a second; None if there is one."""
    if metrics.get(DRIFT) is not None:
        return None
    if not has_truth:
        return "No ground truth, so no errors."
    if metrics.get(DRIFT_PER_FRAME) is None:
        return "The ground truth covers fewer than two of these frames, so no errors."
    lasts = float(np.ptp(trajectory.timestamps))
    if lasts < 1:
        return f"No drift over 1 s: the frames last {lasts:.2f} s; see the errors per frame and of the whole run."
    apart = float(np.median(np.diff(np.sort(trajectory.timestamps))))
    if apart > 1:
        return f"No drift over 1 s: the frames are {apart:.2f} s apart; see the errors per frame and of the whole run."
    if metrics.get("segments", 1) > 1:
        return "No drift over 1 s: no segment of the trajectory lasts 1 s; see the other errors."
    return "No drift over 1 s: no two frames that the ground truth covers are 1 s apart; see the other errors."


def covered_in_part(trajectory: Trajectory, truth: Trajectory | None) -> str | None:
    """Return a sentence if the ground truth covers only some of the poses, as errors ignore the others; else None."""
    if truth is None:
        return None
    covered = int(np.count_nonzero(truth.interpolate(trajectory.timestamps)[1]))
    if covered in (0, len(trajectory)):
        return None
    return (
        f"The ground truth covers {covered} of {len(trajectory)} poses: errors are for these, up to the last of them."
    )
