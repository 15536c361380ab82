"""What a run costs, part by part: the figures that docs/scaling.md reckons with.

Prints, for one clip: bytes a frame on disk and the processor's milliseconds to read, decode and undistort one; for each
method, a pair's milliseconds by the clock and on the processor (all cores' time added up, which a busy machine changes
little) of a run alone and of runs together on one decoded stream; and what a row of results takes.

    python benchmarks/throughput.py
    python benchmarks/throughput.py --clip fr1_desk --methods ga:fast,gauss-newton --frames 30 --together 8

Clips and methods as for the other benchmarks. The defaults take about two minutes on two cores.
"""

import tempfile
import time
from pathlib import Path
from typing import Any

import common
import numpy as np

from gavo_jax.cli.screen import number, print_table
from gavo_jax.datasets.base import Sequence
from gavo_jax.experiments.table import COLUMNS, FLAG, REAL, TEXT, Table
from gavo_jax.experiments.together import track_together
from gavo_jax.odometry import Odometry, track


def main(
    clip: str = "fr1_xyz",
    methods: str = "ga,ga:fast,gauss-newton",
    frames: int = 20,
    together: int = 4,
    json: Path | None = None,
) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clip: one clip.
        methods: METHOD or METHOD:PRESET with commas between.
        frames: how many of the clip's.
        together: runs on one decoded stream.
        json: file for the figures.
    """
    sequence = common.open_clip(clip)[:frames]
    results: dict[str, Any] = {"clip": clip, "frames": len(sequence), **_reading(sequence), **_row()}
    rows = []
    for name in common.names(methods):
        preset = common.preset_of(name)
        drivers = [
            Odometry(sequence.camera, preset.solver, preset.alignment, preset.odometry, seed)
            for seed in range(together + 1)
        ]
        drivers[0].warm_up()
        pairs = len(sequence) - 1
        start = _now()
        list(track(sequence, odometry=drivers[0]))
        alone = (_now() - start) / pairs * 1e3
        start = _now()
        track_together(sequence, drivers[1:])
        shared = (_now() - start) / pairs / together * 1e3
        results[name] = {"milliseconds_alone": alone, "milliseconds_together": shared}
        rows.append((name, *(number(value, 1) for value in (*alone, *shared))))
    print_table(f"a frame of {clip}", ("", "MB", "ms"), [_reading_row(results)])
    columns = ("ms/pair", "alone", "on cores", f"{together} together", "on cores")
    print_table(f"{len(sequence)} frames, decoding included", columns, rows)
    print_table(
        "a row of results", ("", "kB", "ms"), [("", number(results["row_kB"], 1), number(results["row_ms"], 1))]
    )
    common.record(json, "throughput", results)
    return results


def _now() -> np.ndarray:
    """Seconds by the clock and of the processor, all cores added up."""
    return np.array([time.perf_counter(), time.process_time()])


def _reading(sequence: Sequence) -> dict[str, float]:
    """Size of a frame's two files where there are files, and the time to make a `Frame` of them."""
    sequence[0]
    start = time.process_time()
    for i in range(len(sequence)):
        sequence[i]
    milliseconds = (time.process_time() - start) / len(sequence) * 1e3
    paths = [path for pair in getattr(sequence, "_paths", []) for path in pair]
    megabytes = sum(path.stat().st_size for path in paths) / len(sequence) / 1e6
    return {"frame_MB": megabytes, "frame_ms": milliseconds}


def _reading_row(results: dict[str, Any]) -> tuple[str, str, str]:
    return "read, decoded, undistorted", number(results["frame_MB"], 2), number(results["frame_ms"], 1)


def _row() -> dict[str, float]:
    """Size of a row's file and the time to append it."""
    row = {name: {TEXT: "x" * 100, REAL: 0.1, FLAG: True}.get(kind, 1) for name, kind in COLUMNS.items()}
    with tempfile.TemporaryDirectory() as folder:
        table = Table(folder)
        table.append(row | {"run": "first", "configuration": "x" * 3000})
        start = time.process_time()
        for i in range(20):
            table.append(row | {"run": str(i), "configuration": "x" * 3000})
        milliseconds = (time.process_time() - start) / 20 * 1e3
        size = (table.folder / "0.parquet").stat().st_size / 1e3
    return {"row_kB": size, "row_ms": milliseconds}


if __name__ == "__main__":
    common.command(main)
