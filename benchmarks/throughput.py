"""Frames per second from PNG files on disk to poses, of every method and preset and of other libraries.

Prints one row per contender. End-to-end time covers reading, decoding and undistortion in a thread ahead, as in
`gavo run`, alignment, and the pose's transfer to the host. It is given as wall time and as processor time (summed over
the cores, which a busy machine changes little). Beside it are the median time of a pair of decoded frames, the time of
compilation (or loading from the cache), and the end-to-end time over that of each of `--over`.

Contenders take turns (A B C A B C ...), so that a slow spell affects all. Figures are medians over the rounds, ratios
medians of each round's ratio; a first round does not count. A second table has the cost of decoding. With
`--together N` there are also the time per pair of N runs on one decoded stream, and the cost of a row of an
experiment's table; docs/scaling.md is based on these.

    python benchmarks/throughput.py
    python benchmarks/throughput.py --methods ga:fast,opencv-rgb --frames 90 --rounds 7 --json throughput.json
    python benchmarks/throughput.py --methods ga,ga:fast,gauss-newton --together 4

Clips and methods are named as in the other benchmarks. The defaults take about three minutes on two cores,
five with Open3D.
"""

import tempfile
import time
from pathlib import Path
from typing import Any

import common
import numpy as np

from gavo_jax.datasets.base import Frame, Sequence
from gavo_jax.errors import GavoError
from gavo_jax.experiments.table import COLUMNS, FLAG, REAL, TEXT, Table
from gavo_jax.experiments.together import track_together
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.stream import track
from gavo_jax.output.screen import number

METHODS = "ga,ga:fast,ga:wide,ga:paper,pso,gauss-newton,adam"
OVER = "opencv-rgb,opencv-rgbd,open3d-color"
PARTS = ("rgb", "depth")


def main(
    clip: str = "fr1_xyz",
    methods: str = f"{METHODS},{common.installed_peers()}",
    frames: int = 30,
    rounds: int = 3,
    over: str = OVER,
    together: int = 0,
    json: Path | None = None,
) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clip: one clip.
        methods: comma-separated METHOD, METHOD:PRESET or names of peers.
        frames: first frames of the clip to use.
        rounds: measurements of each contender.
        over: comma-separated contenders whose time divides the others'; absent ones are ignored.
        together: runs on one decoded stream; 0 leaves out these and the table's row.
        json: file for the figures.

    Raises:
        GavoError: unknown method, no such clip, fewer than two frames or no round.
    """
    sequence = common.open_clip(clip)[:frames]
    contenders = common.parse_methods(methods)
    if len(sequence) < 2 or rounds < 1:
        raise GavoError("throughput needs at least two frames and one round")
    measured = measure(sequence, contenders, rounds)
    references = [name for name in common.names(over) if name in measured]
    rows = []
    for name, figures in measured.items():
        ratios = {other: _ratio(figures, measured[other]) for other in references}
        figures["over"] = ratios
        cells = [number(figures["frames_per_second"], 1)]
        cells += [number(figures[key], 1) for key in COLUMNS_OF_TIME.values()]
        rows.append((name, *cells, *(number(ratio, 2) for ratio in ratios.values())))
    columns = ("", "frames/s", *COLUMNS_OF_TIME, *(f"/ {name}" for name in references))
    common.print_table(f"{len(sequence)} frames of {clip}, from files to poses", columns, rows)
    results = {"clip": clip, "frames": len(sequence), "rounds": rounds, "contenders": measured, **_reading(sequence)}
    megabytes, milliseconds = results["frame_MB"], results["frame_ms"]
    row = ("read, decoded, undistorted", number(megabytes, 2), number(milliseconds, 1))
    common.print_table("a frame", ("", "MB", "ms on a core"), [row])
    if together:
        own = [name for name in common.names(methods) if name not in common.PEERS]
        results |= {"together": {name: _together(sequence, name, together) for name in own}, **_row()}
        rows = [(name, *(number(value, 1) for value in times.values())) for name, times in results["together"].items()]
        common.print_table(f"{together} runs together, decoding included", ("", "ms/pair", "on cores"), rows)
        row = ("", number(results["row_kB"], 1), number(results["row_ms"], 1))
        common.print_table("a row of results", ("", "kB", "ms"), [row])
    common.record(json, "throughput", results)
    return results


COLUMNS_OF_TIME = {
    "ms/frame": "milliseconds",
    "on cores": "core_milliseconds",
    "ms/pair, decoded": "milliseconds_decoded",
    "compilation, s": "compile_seconds",
}
"""Columns of the table and their names in the JSON file."""


def measure(sequence: Sequence, contenders: list[common.Contender], rounds: int) -> dict[str, dict[str, Any]]:
    """Time each contender over the sequence; the first round does not count.

    Returns:
        For each contender `seconds` of every round, and the medians.
    """
    frames = [sequence[i] for i in range(len(sequence))]
    compilation = {contender.name: contender.make(sequence.camera, 0).warm_up() for contender in contenders}
    whole = {contender.name: [] for contender in contenders}
    pair = {contender.name: [] for contender in contenders}
    for round_ in range(rounds + 1):
        for contender in contenders:
            seconds = _from_files(sequence, contender.make(sequence.camera, 0))
            milliseconds = _from_frames(frames, contender.make(sequence.camera, 0))
            if round_:
                whole[contender.name].append(seconds)
                pair[contender.name].append(milliseconds)
    measured = {}
    for name, times in whole.items():
        clock, cores = np.median(times, axis=0)
        measured[name] = {
            "seconds": [float(seconds) for seconds, _ in times],
            "frames_per_second": len(sequence) / clock,
            "milliseconds": clock / len(sequence) * 1e3,
            "core_milliseconds": cores / len(sequence) * 1e3,
            "milliseconds_decoded": float(np.median(pair[name])),
            "compile_seconds": compilation[name],
        }
    return measured


def _ratio(figures: dict[str, Any], others: dict[str, Any]) -> float:
    return float(np.median(np.array(figures["seconds"]) / np.array(others["seconds"])))


def _from_files(sequence: Sequence, odometry: Odometry) -> np.ndarray:
    """Wall and processor seconds of a run."""
    start = _now()
    for _ in track(sequence, odometry=odometry):
        pass
    return _now() - start


def _from_frames(frames: list[Frame], odometry: Odometry) -> float:
    """Median milliseconds of a pair."""
    steps = [odometry.register(frame, frame.timestamp) for frame in frames]
    return float(np.median([step.milliseconds for step in steps if step is not None]))


def _now() -> np.ndarray:
    """Wall and processor seconds, the latter summed over the cores."""
    return np.array([time.perf_counter(), time.process_time()])


def _together(sequence: Sequence, name: str, count: int) -> dict[str, float]:
    """Wall and processor milliseconds per pair of `count` runs on one decoded stream."""
    drivers = [Odometry(sequence.camera, common.preset_of(name), seed=seed) for seed in range(count)]
    start = _now()
    track_together(sequence, drivers)
    clock, cores = (_now() - start) / (len(sequence) - 1) / count * 1e3
    return {"milliseconds": clock, "core_milliseconds": cores}


def _reading(sequence: Sequence) -> dict[str, float]:
    """Size of a frame's two files, if there are files, and the processor time to make a `Frame` of them."""
    start = time.process_time()
    for i in range(len(sequence)):
        sequence[i]
    milliseconds = (time.process_time() - start) / len(sequence) * 1e3
    folder = getattr(sequence, "folder", None)
    sizes = {} if folder is None else {part: [p.stat().st_size for p in folder.glob(f"{part}/*.png")] for part in PARTS}
    return {"frame_MB": sum(float(np.mean(size)) for size in sizes.values()) / 1e6, "frame_ms": milliseconds}


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
