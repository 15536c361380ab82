"""Speeds and accelerations of the cameras of real clips, by the ground truth.

Prints one row per clip and interval: the largest speed and acceleration of translation and rotation, which
`odometry.plausibility` allows for. A second table has what `alignment.sway` expects, as RMS per axis: the change of the
mean velocity from interval to interval, and the difference between the velocity at an interval's end and its mean.

    python benchmarks/acceleration.py
"""

from pathlib import Path
from typing import Any

import common
import jax
import jax.numpy as jnp
import numpy as np

from gavo_jax import se3
from gavo_jax.trajectory import Trajectory, inverse

INTERVALS = (1 / 30, 2 / 30, 4 / 30)
"""Seconds from frame to frame."""
MOMENT = 0.016
"""Seconds over which the mean velocity counts as instantaneous: motion capture comes every 10 ms."""
PARTS = (slice(3), slice(3, 6))
"""Slices of a twist: translation, rotation."""


def velocities(truth: Trajectory, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Mean velocities [n, 6] of the points in the camera between moments [n], m/s and rad/s; NaN where unknown."""
    (first, known_first), (last, known_last) = truth.interpolate(begin), truth.interpolate(end)
    twists = np.asarray(jax.vmap(se3.log)(jnp.asarray(inverse(last) @ first)), float) / (end - begin)[:, None]
    return np.where((known_first & known_last)[:, None], twists, np.nan)


def largest(twists: np.ndarray) -> list[float]:
    """Return the largest length of the translations, and of the rotations."""
    return [float(np.nanmax(np.linalg.norm(twists[:, part], axis=1))) for part in PARTS]


def typical(twists: np.ndarray) -> list[float]:
    """RMS per axis of the translations, and of the rotations."""
    return [float(np.sqrt(np.nanmean(np.square(twists[:, part])))) for part in PARTS]


def main(clips: str = common.CLIPS, json: Path | None = None) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clips: comma-separated names.
        json: file for the figures.
    """
    rows, sways = [], []
    for clip in common.names(clips):
        _, truth = common.open_true_clip(clip)
        for interval in INTERVALS:
            moments = np.arange(truth.timestamps[0], truth.timestamps[-1], interval)
            mean = velocities(truth, moments[:-1], moments[1:])
            changes = np.diff(mean, axis=0)
            rows.append((clip, interval, *largest(mean), *largest(changes / interval)))
            own = velocities(truth, moments[1:] - MOMENT / 2, moments[1:] + MOMENT / 2)
            sways.append((clip, interval, *typical(changes), *typical(own - mean)))
    columns = ("clip", "interval, s", "m/s", "rad/s", "m/s²", "rad/s²")
    cells = [[row[0], f"{row[1]:.3f}", *(f"{value:.2f}" for value in row[2:])] for row in rows]
    common.print_table("largest speeds and accelerations", columns, cells)
    of_sways = ("clip", "interval, s", "change, m/s", "change, rad/s", "sway, m/s", "sway, rad/s")
    cells = [[row[0], *(f"{value:.3f}" for value in row[1:])] for row in sways]
    common.print_table("changes of the mean velocity, and how far that of a moment is from it", of_sways, cells)
    results = {
        "rows": [dict(zip(columns, row, strict=True)) for row in rows],
        "sways": [dict(zip(of_sways, row, strict=True)) for row in sways],
    }
    common.record(json, "acceleration", results)
    return results


if __name__ == "__main__":
    common.command(main)
