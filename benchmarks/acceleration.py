"""How fast the cameras of real clips change their motion, by the ground truth: what `odometry.plausibility` allows for.

Prints one row per clip and interval: largest speed and largest change of speed a second, of translation and rotation.

    python benchmarks/acceleration.py
"""

from pathlib import Path
from typing import Any

import common
import jax
import jax.numpy as jnp
import numpy as np

from gavo_jax import se3
from gavo_jax.errors import GavoError
from gavo_jax.trajectory import inverse

INTERVALS = (1 / 30, 2 / 30, 4 / 30)
"""Seconds from frame to frame."""


def main(clips: str = common.CLIPS, json: Path | None = None) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clips: names with commas between.
        json: file for the figures.
    """
    rows = []
    for clip in common.names(clips):
        truth = common.open_clip(clip).ground_truth
        if truth is None:
            raise GavoError(f"{clip}: no ground truth")
        for interval in INTERVALS:
            poses, valid = truth.interpolate(np.arange(truth.timestamps[0], truth.timestamps[-1], interval))
            poses = poses[valid]
            twists = np.asarray(jax.vmap(se3.log)(jnp.asarray(inverse(poses[1:]) @ poses[:-1])), float) / interval
            changes = np.diff(twists, axis=0) / interval
            speeds = [float(np.linalg.norm(twists[:, part], axis=1).max()) for part in (slice(3), slice(3, 6))]
            largest = [float(np.linalg.norm(changes[:, part], axis=1).max()) for part in (slice(3), slice(3, 6))]
            rows.append((clip, interval, *speeds, *largest))
    columns = ("clip", "interval, s", "m/s", "rad/s", "m/s²", "rad/s²")
    cells = [[row[0], f"{row[1]:.3f}", *(f"{value:.2f}" for value in row[2:])] for row in rows]
    common.print_table("largest speeds and accelerations", columns, cells)
    results = {"rows": [dict(zip(columns, row, strict=True)) for row in rows]}
    common.record(json, "acceleration", results)
    return results


if __name__ == "__main__":
    common.command(main)
