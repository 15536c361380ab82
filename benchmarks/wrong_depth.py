"""Effect of depth that is wrong in every frame, and whether the run reports it.

If no frame was ever right, history cannot reveal it, but the change of depth (`odometry/depth_change.py`) and its edges
(`depth_edges.py`) can. Prints for each clip and fault:

- the share of the pairs that are not ok at the end of the run;
- how many pairs are off by more than 5 cm or 3 degrees, and how many of these are ok;
- drift (RPE over 1 s, RMSE; a dash where no segment is that long), also over the clean run's;
- the part of the change of depth that the motions do not explain: median and maximum over the run.

Above `MOST_LEFT` depth is reported as wrong, so the maximum on clean clips shows how far from a false alarm they are.

    python benchmarks/wrong_depth.py
    python benchmarks/wrong_depth.py --clips FOLDER --method gauss-newton --json wrong_depth.json

On 2 cores the defaults take about 10 minutes.
"""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import common
import numpy as np
from faults import Alter, every_frame, is_wrong, known_drift, late, of_depth, zoom

from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.base import Sequence as FrameSequence
from gavo_jax.odometry.depth_change import MOST_LEFT
from gavo_jax.odometry.hindsight import revised
from gavo_jax.odometry.run import trajectory_of
from gavo_jax.odometry.stream import track
from gavo_jax.output.screen import number
from gavo_jax.trajectory import Trajectory

CLEAN = "clean"


def disparity(clip: FrameSequence, index: int, frame: Frame) -> Frame:
    """Depth as a disparity: large where a point is near."""
    scale = float(clip.camera.depth_scale)
    inverse = np.minimum(1.5 * scale**2 / np.maximum(frame.depth, 1), 65535)
    return replace(frame, depth=np.where(frame.depth > 0, inverse, 0).astype(frame.depth.dtype))


FAULTS: dict[str, Alter] = {
    CLEAN: lambda clip, index, frame: frame,
    "depth mirrored": of_depth(np.fliplr),
    "depth upside down": of_depth(np.flipud),
    "grey mirrored": lambda clip, index, frame: replace(frame, grey=np.fliplr(frame.grey).copy()),
    "depth 1 frame late": late(1),
    "depth 3 frames late": late(3),
    "depth zoomed": of_depth(zoom),
    "depth shifted": of_depth(lambda depth: np.roll(depth, 60, axis=1)),
    "disparity": disparity,
}


def measure(clip: FrameSequence, truth: Trajectory, alter: Alter, contender: common.Contender) -> dict[str, Any]:
    """Figures of one run with every frame altered."""
    sequence: Any = every_frame(alter)(clip)
    odometry, steps, left = contender.make(sequence.camera, 0), [], []
    for step in track(sequence, odometry=odometry):
        steps.append(step)
        watch = odometry.progress.depth
        if watch is not None and np.isfinite(watch.change.usually_left):
            left.append(watch.change.usually_left)
    told = revised(steps)
    wrong = [step.alignment.status == 0 for step in told if is_wrong(step, sequence, truth)]
    trajectory = trajectory_of(float(sequence.timestamps[0]), steps)
    return {
        "flagged": float(np.mean([step.alignment.status != 0 for step in told])),
        "wrong": len(wrong),
        "silent": sum(wrong),
        "drift": known_drift(trajectory, sequence.timestamps, truth),
        "left": float(np.median(left)) if left else None,
        "most_left": max(left, default=None),
    }


def main(
    clips: str = common.CLIPS, method: str = "ga:fast", faults: str = ",".join(FAULTS), json: Path | None = None
) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clips: comma-separated names of clips with ground truth; see `common.open_clip`.
        method: METHOD or METHOD:PRESET.
        faults: comma-separated names; the clean clip always comes first.
        json: file for the figures.
    """
    contender, rows, cells = common.parse_methods(method)[0], [], []
    chosen = [name for name in common.names_among(FAULTS, "fault", faults) if name != CLEAN]
    for clip in common.names(clips):
        sequence, truth = common.open_true_clip(clip)
        clean = None
        for name in (CLEAN, *chosen):
            row = measure(sequence, truth, FAULTS[name], contender)
            clean = row["drift"] if name == CLEAN else clean
            ratio = row["drift"] / clean if row["drift"] and clean else None
            rows.append({"clip": clip, "fault": name, **row, "ratio": ratio})
            print(f"{clip} {name}: {row['flagged']:.0%} flagged", file=sys.stderr)
            figures = [number(rows[-1][key], digits) for key, digits in FIGURES.items()]
            cells.append([clip, name, f"{row['flagged']:.0%}", f"{row['silent']} of {row['wrong']}", *figures])
    columns = ("clip", "every frame", "flagged", "wrong and ok", "m/s", "drift / clean", "left", "most left")
    common.print_table(f"wrong from the first frame on, {contender.name}; told above {MOST_LEFT}", columns, cells)
    results = {"method": method, "faults": rows}
    common.record(json, "wrong_depth", results)
    return results


FIGURES = {"drift": 4, "ratio": 2, "left": 2, "most_left": 2}
"""Figures of a row that are printed as numbers, with their digits."""


if __name__ == "__main__":
    common.command(main)
