"""Cost of a `gavo run` process: seconds to its first pose, and memory of a short and of a long run.

The first table has the seconds from the start of a process to the first pair's pose in trajectory.txt, with an empty
and with a filled compilation cache. The second has the peak resident memory of runs over each of `--lengths` frames,
and the last over the first. Their cache is filled, because a compilation takes more memory than a run. The frames are
the clip's, rewritten without distortion, and played back and forth.

    python benchmarks/footprint.py
    python benchmarks/footprint.py --clip synthetic:40 --methods ga --lengths 100,700 --json footprint.json

Clips and our own methods are named as in the other benchmarks. The defaults take about three minutes on two cores.
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
"""Frames per second of the played clip."""


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
        methods: comma-separated METHOD or METHOD:PRESET.
        starts: processes started with an empty cache, and as many with a filled one; medians are printed.
        lengths: comma-separated frames of the runs whose memory is measured.
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
            # runs of more than two frames may compile more programs, so the first one does not count
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

    Each process runs to its end, figures included, so that the cache then holds all that a run compiles.
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
"""Script that measures a child: its peak includes the parent's memory at its start, so the parent is small."""


def peak_megabytes(scratch: Path, name: str, frames: int) -> float:
    """Peak resident memory, MB, of a run over `frames` frames with a filled cache."""
    _play(scratch / "clip", frames)
    command = [sys.executable, "-c", WEIGH, *gavo_run(scratch, name, frames)]
    done = subprocess.run(command, env=_environment(scratch), stdout=subprocess.PIPE, check=False)
    _check(done.returncode, name)
    return int(done.stdout) * (1 if sys.platform == "darwin" else 1024) / 1e6


def _environment(scratch: Path) -> dict[str, str]:
    """This process's environment, with a separate cache."""
    ours = {key: value for key, value in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
    return ours | {"GAVO_CACHE_DIR": str(scratch / "cache")}


def _check(status: int, name: str) -> None:
    if status:
        raise GavoError(f"{name}: `gavo run` ended with status {status}")


def _poses(run: Path) -> int:
    """Poses in the trajectory file so far."""
    try:
        lines = (run / "trajectory.txt").read_text().splitlines()
    except FileNotFoundError:
        return 0
    return sum(not line.startswith("#") for line in lines)


def _play(folder: Path, frames: int) -> None:
    """Rewrite a folder's lists so that its images play back and forth for `frames` frames."""
    for part in ("rgb", "depth"):
        images = sorted(path.name for path in (folder / part).iterdir())
        there = [*range(len(images)), *range(len(images) - 2, 0, -1)]
        rows = [f"{i / RATE:.6f} {part}/{images[there[i % len(there)]]}\n" for i in range(frames)]
        (folder / f"{part}.txt").write_text("".join(rows))
    (folder / "groundtruth.txt").unlink(missing_ok=True)


if __name__ == "__main__":
    common.command(main)
