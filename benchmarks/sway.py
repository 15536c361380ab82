"""Gain from estimating the camera's velocity at each frame, under a rolling shutter.

Runs a method with the mean velocity since the last frame, and with one estimated at each frame. Prints, for each clip,
one row for each of the two: the error of a pair (RMSE in mm and degrees, largest in mm), and the drift over a second.

    python benchmarks/sway.py
    python benchmarks/sway.py --clips FOLDER --method gauss-newton --json sway.json

On 2 cores the defaults take about 2 minutes.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import common
import numpy as np

from gavo_jax.evaluation import rotation_angle
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.metrics import DRIFT, ROTATION_DRIFT
from gavo_jax.output.screen import number
from gavo_jax.output.tracked import track_visibly
from gavo_jax.trajectory import Trajectory, inverse

VELOCITIES = {"the mean since the last frame": False, "each frame's own": True}


def pair_errors(found: Trajectory, truth: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Error of the motion between each two consecutive frames, metres and radians."""
    true, known = truth.interpolate(found.timestamps)
    pairs = np.flatnonzero(known[1:] & known[:-1])
    between, true_between = (inverse(path[pairs]) @ path[pairs + 1] for path in (found.world_T_camera, true))
    off = inverse(true_between) @ between
    return np.linalg.norm(off[:, :3, 3], axis=1), rotation_angle(off[:, :3, :3])


def measure(clip: str, method: str) -> list[dict[str, Any]]:
    """Errors on a clip with either velocity.

    Raises:
        GavoError: a clip without ground truth.
    """
    (sequence, truth), settings, rows = common.open_true_clip(clip), common.preset_of(method), []
    for name, sway in VELOCITIES.items():
        odometry = Odometry(sequence.camera, replace(settings, odometry=replace(settings.odometry, sway=sway)))
        run = track_visibly(f"{clip}, {name}", sequence, odometry).outcome(sequence)
        metres, radians = pair_errors(run.trajectory, truth)
        rows.append(
            {
                "velocity": name,
                "pair_m": float(np.sqrt(np.mean(metres**2))),
                "worst_m": float(metres.max()),
                "pair_rad": float(np.sqrt(np.mean(radians**2))),
                "translation": run.figures[DRIFT],
                "rotation": run.figures[ROTATION_DRIFT],
            }
        )
    return rows


def main(clips: str = common.CLIPS, method: str = "ga:fast", json: Path | None = None) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clips: comma-separated names of clips with ground truth; see `common.open_clip`.
        method: METHOD or METHOD:PRESET.
        json: file for the figures.
    """
    found = {clip: measure(clip, method) for clip in common.names(clips)}
    columns = ("velocity", "pair, mm", "worst, mm", "pair, deg", "m/s", "deg/s")
    for clip, rows in found.items():
        cells = [
            [
                row["velocity"],
                number(1e3 * row["pair_m"], 2),
                number(1e3 * row["worst_m"], 1),
                number(np.degrees(row["pair_rad"]), 3),
                number(row["translation"], 4),
                number(row["rotation"], 2),
            ]
            for row in rows
        ]
        common.print_table(f"velocity under the rolling shutter, {clip}, {method}", columns, cells)
    results = {"method": method, "clips": found}
    common.record(json, "sway", results)
    return results


if __name__ == "__main__":
    common.command(main)
