"""Cost of the viewer: runs with the viewer that saves to a file against runs without, in turn.

Prints, for each method, the median time per frame without and with `--viewer save`, their ratio, the processor time
per frame that the viewer adds (summed over the cores), and the recording's size per frame.

    python benchmarks/viewer.py
    python benchmarks/viewer.py --clip synthetic:20 --methods gauss-newton --rounds 2 --json viewer.json

Clips and methods are named as in the other benchmarks. The defaults take about two minutes on two cores.
"""

import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import common
import numpy as np

from gavo_jax.datasets.base import Sequence
from gavo_jax.odometry.driver import Odometry
from gavo_jax.output.files import RECORDING
from gavo_jax.output.screen import number
from gavo_jax.output.tracked import track_visibly
from gavo_jax.viewer.base import ViewerMode
from gavo_jax.viewer.live import make_viewer

MODES: tuple[ViewerMode, ...] = ("none", "save")


class Cost(NamedTuple):
    """Cost of one run, per frame."""

    milliseconds: float
    """Wall time, from the first frame until the viewer has finished."""
    processor_milliseconds: float
    """Processor time, summed over the cores."""
    megabytes: float
    """Size of the recording."""


def watch(sequence: Sequence, name: str, mode: ViewerMode, folder: Path) -> Cost:
    """Track a sequence with a viewer."""
    recording = folder / RECORDING
    viewer = make_viewer(mode, recording)
    odometry = Odometry(sequence.camera, common.preset_of(name), record=viewer.wants_populations)
    odometry.warm_up()
    viewer.open(name, sequence.camera, sequence.timestamps, sequence.ground_truth)
    start = time.perf_counter(), time.process_time()
    with viewer:
        track_visibly(f"{name}, viewer {mode}", sequence, odometry, viewer=viewer)
    wall, processor = time.perf_counter() - start[0], time.process_time() - start[1]
    size = recording.stat().st_size if mode == "save" else 0
    return Cost(*(value / len(sequence) for value in (wall * 1e3, processor * 1e3, size / 1e6)))


def main(
    clip: str = "fr1_xyz", methods: str = "ga,ga:fast", rounds: int = 5, json: Path | None = None
) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clip: one clip.
        methods: comma-separated METHOD or METHOD:PRESET.
        rounds: runs without and with the viewer, in turn.
        json: file for the cost of every run.
    """
    sequence = common.open_clip(clip)
    sequence.check()
    results: dict[str, Any] = {"clip": clip, "frames": len(sequence), "methods": {}}
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in common.names(methods):
            costs: dict[str, list[Cost]] = {mode: [] for mode in MODES}
            for _ in range(rounds):
                for mode in MODES:
                    costs[mode].append(watch(sequence, name, mode, Path(folder)))
            without, saved = (np.median(costs[mode], axis=0) for mode in MODES)
            ratio = float(saved[0] / without[0])
            added = float(saved[1] - without[1])
            results["methods"][name] = {
                "runs": {mode: [cost._asdict() for cost in own] for mode, own in costs.items()},
                "ratio": ratio,
                "added_processor_milliseconds": added,
                "megabytes": float(saved[2]),
            }
            rows.append(
                (
                    name,
                    number(without[0], 1),
                    number(saved[0], 1),
                    number(ratio, 3),
                    number(added, 1),
                    number(saved[2], 2),
                )
            )
    columns = ("method", "ms/frame without", "with", "ratio", "on cores, ms/frame more", "MB/frame")
    common.print_table(f"{len(sequence)} frames of {clip}, median of {rounds}", columns, rows)
    common.record(json, "viewer", results)
    return results


if __name__ == "__main__":
    common.command(main)
