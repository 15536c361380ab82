"""What a process of `gavo run` takes: seconds to its first pose, and memory of a short and of a long run.

The first table has the seconds from the start of a process to the first pair's pose in trajectory.txt, with an empty
cache of compiled programs and with a filled one. The second has the peak of the resident memory of a process that runs
each of `--lengths` frames with a filled cache (a compilation takes more memory than a run and would hide the run's),
and the last over the first. The frames are the clip's, written anew without distortion, and played forth and back.

    python benchmarks/footprint.py
    python benchmarks/footprint.py --clip synthetic:40 --methods ga --lengths 100,700 --json footprint.json

Clips and own methods as for the other benchmarks. The defaults take about three minutes on two cores.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import common
import numpy as np

from gavo_jax.datasets.layouts.tum_writing import write_tum
from gavo_jax.errors import GavoError
from gavo_jax.output.screen import number

RATE = 30.0
"""Frames a second of what is played."""


def main(
    clip: str = "fr1_xyz:40",
    methods: str = "ga,ga:fast",
    starts: int = 3,
    lengths: str = "100,700",
    json: Path | None = None,
) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clip: one clip.
        methods: METHOD or METHOD:PRESET with commas between.
        starts: processes that are started with an empty cache, and as many with a filled one; the medians count.
        lengths: frames of the runs whose memory is measured.
        json: file for the figures.

    Raises:
        GavoError: unknown method, no such clip, or a run that fails.
    """
    counts = common.counts(lengths)
    figures: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        write_tum(common.open_clip(clip), scratch / "clip")
        for name in common.names(methods):
            common.preset_of(name)
            start = time_starts(scratch, name, starts)
            # a run of several frames may compile more than one of two does, so the first one is not counted
            peaks = [peak_megabytes(scratch, name, count) for count in (counts[0], *counts)]
            figures[name] = {"start": start, "megabytes": dict(zip(counts, peaks[1:], strict=True))}
    rows = [
        (name, *(number(float(np.median(times)), 1) for times in f["start"].values())) for name, f in figures.items()
    ]
    common.print_table(f"seconds to the first pose of {clip}", ("", "empty cache", "filled cache"), rows)
    rows = []
    for name, row in figures.items():
        peaks = list(row["megabytes"].values())
        row["ratio"] = peaks[-1] / peaks[0]
        rows.append((name, *(number(peak, 0) for peak in peaks), number(row["ratio"], 3)))
    columns = ("", *(f"{count} frames" for count in counts), "last / first")
    common.print_table(f"peak of resident memory, MB, frames of {clip}", columns, rows)
    results = {"clip": clip, "methods": figures}
    common.record(json, "footprint", results)
    return results


def gavo_run(scratch: Path, name: str, frames: int) -> list[str]:
    """The command that runs the first frames of the clip."""
    method, _, preset = name.partition(":")
    clip = scratch / "clip"
    command = [sys.executable, "-m", "gavo_jax", "run", f"{clip}", "--camera", f"{clip / 'camera.toml'}"]
    command += ["--frames", str(frames), "--method", method, "--preset", preset or "default"]
    return [*command, "--output", f"{scratch / 'run'}"]


def time_starts(scratch: Path, name: str, count: int) -> dict[str, list[float]]:
    """Seconds from the start of a process to its first pose, with an `empty` and with a `filled` cache.

    The processes end by themselves, figures drawn, so that whatever a run compiles is in the cache afterwards.
    """
    seconds: dict[str, list[float]] = {"empty": [], "filled": []}
    nowhere = subprocess.DEVNULL
    for _ in range(count):
        shutil.rmtree(scratch / "cache", ignore_errors=True)
        for times in seconds.values():
            shutil.rmtree(scratch / "run", ignore_errors=True)
            start = time.perf_counter()
            command = gavo_run(scratch, name, 2)
            with subprocess.Popen(command, env=_environment(scratch), stdout=nowhere, stderr=nowhere) as process:
                while process.poll() is None and _poses(scratch / "run") < 2:
                    time.sleep(0.005)
                times.append(time.perf_counter() - start)
            _check(process.returncode, name)
    return seconds


WEIGH = """
import resource, subprocess, sys
code = subprocess.call(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
sys.exit(code)
"""
"""A small process starts the one to be weighed, whose peak counts what its parent held when it was started."""


def peak_megabytes(scratch: Path, name: str, frames: int) -> float:
    """Largest resident memory, MB, of a process that runs so many frames; its cache is filled."""
    _play(scratch / "clip", frames)
    command = [sys.executable, "-c", WEIGH, *gavo_run(scratch, name, frames)]
    done = subprocess.run(command, env=_environment(scratch), stdout=subprocess.PIPE, check=False)
    _check(done.returncode, name)
    return int(done.stdout) * (1 if sys.platform == "darwin" else 1024) / 1e6


def _environment(scratch: Path) -> dict[str, str]:
    """Ours with a cache of its own."""
    ours = {key: value for key, value in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
    return ours | {"GAVO_CACHE_DIR": str(scratch / "cache")}


def _check(status: int, name: str) -> None:
    if status:
        raise GavoError(f"{name}: `gavo run` ended with status {status}")


def _poses(run: Path) -> int:
    """Rows of the trajectory so far."""
    try:
        lines = (run / "trajectory.txt").read_text().splitlines()
    except FileNotFoundError:
        return 0
    return sum(not line.startswith("#") for line in lines)


def _play(folder: Path, frames: int) -> None:
    """Have the lists of a folder name its first images forth and back until there are so many frames."""
    for part in ("rgb", "depth"):
        images = sorted(path.name for path in (folder / part).iterdir())
        there = [*range(len(images)), *range(len(images) - 2, 0, -1)]
        rows = [f"{i / RATE:.6f} {part}/{images[there[i % len(there)]]}\n" for i in range(frames)]
        (folder / f"{part}.txt").write_text("".join(rows))
    (folder / "groundtruth.txt").unlink(missing_ok=True)


if __name__ == "__main__":
    common.command(main)
