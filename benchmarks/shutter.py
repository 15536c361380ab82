"""Readout time of a camera's rolling shutter, from the first row to the last, by the photometric error E.

Runs Gauss-Newton frame to frame with each readout time. It uses the mean velocity since the last frame, because one
estimated for each frame would compensate for a wrong readout. Prints, for each clip, one row per readout: E relative to
the first readout's, by default a global shutter (geometric mean over the pairs; below 1 the images agree better). Where
the clip has ground truth, it also prints the drift. The readout with the least E is the camera's, as far as the clip
can tell; slow motion and blurred images tell little.

    python benchmarks/shutter.py
    python benchmarks/shutter.py --clips FOLDER --readouts 0,10,20,30 --json shutter.json

On 2 cores the defaults take about 3 minutes.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import common
import numpy as np

from gavo_jax import presets
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.metrics import DRIFT, ROTATION_DRIFT
from gavo_jax.output.screen import number
from gavo_jax.output.tracked import track_visibly


def measure(clip: str, readouts: list[int]) -> list[dict[str, Any]]:
    """E, relative to the first readout's, and drift of a clip for each readout in milliseconds."""
    sequence = common.open_clip(clip)
    settings = presets.preset("gauss-newton")
    alone = replace(settings.odometry, reference="previous", relight=False, recover=False, sway=False)
    settings = replace(settings, odometry=alone)
    rows, first = [], None
    for milliseconds in readouts:
        camera = replace(sequence.camera, readout=milliseconds / 1000)
        odometry = Odometry(camera, settings)
        tracked = track_visibly(f"{clip}, {milliseconds} ms", sequence, odometry).outcome(sequence)
        errors = np.array([float(step.alignment.error) for step in tracked.steps])
        first = errors if first is None else first
        both = np.isfinite(first) & np.isfinite(errors)
        rows.append(
            {
                "readout_ms": milliseconds,
                "error": common.geometric_mean(list(errors[both] / first[both])),
                "translation": tracked.figures[DRIFT],
                "rotation": tracked.figures[ROTATION_DRIFT],
            }
        )
    return rows


def main(clips: str = common.CLIPS, readouts: str = "0,12,16,20,24,28,32", json: Path | None = None) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clips: comma-separated names; see `common.open_clip`.
        readouts: comma-separated milliseconds; the others are compared with the first.
        json: file for the figures.
    """
    found = {clip: measure(clip, common.counts(readouts)) for clip in common.names(clips)}
    for clip, rows in found.items():
        cells = [
            [str(row["readout_ms"]), number(row["error"], 3), number(row["translation"], 4), number(row["rotation"], 2)]
            for row in rows
        ]
        common.print_table(f"rolling shutter of {clip}", ("readout, ms", "E", "m/s", "deg/s"), cells)
    results = {"clips": found}
    common.record(json, "shutter", results)
    return results


if __name__ == "__main__":
    common.command(main)
