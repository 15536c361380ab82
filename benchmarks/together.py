"""Cost of 64 runs of one program that go through a sequence together, against 64 single runs.

The runs differ in their seeds and in a rate of the solver (`ga`: mutation_decay, `pso`: constriction, `gauss-newton`:
damping, `adam`: decay). Prints for each method:

- programs compiled for one run, and then for all the others;
- seconds of the 64 runs as 64 calls of `run_odometry`, as bare loops over the frames (without its warm-up and figures),
  and together; and the ratios of these times;
- processor milliseconds per pair (summed over the cores), bare and together;
- how many of the trajectories are the same bit for bit.

    python benchmarks/together.py
    python benchmarks/together.py --clip fr1_xyz:10 --methods ga --runs 8

Frames are small by default: a rendered room of 160 x 120 pixels, written as PNG. Every single run reads them; the runs
together read them once. All variants run in turn `--repeats` times, and medians are printed. The defaults take
about two minutes on two cores.
"""

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import common
import jax
import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Sequence
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.layouts.tum_writing import write_tum
from gavo_jax.datasets.rendered.sensor_noise import KINECT
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.experiments.together import track_together
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.run import run_odometry
from gavo_jax.odometry.stream import track
from gavo_jax.output.screen import number
from gavo_jax.settings import Settings

CAMERA = Camera(131.0, 131.0, 79.5, 59.5, 160, 120)
SMALL = "small"
WAYS = ("run_odometry", "bare", "together")
RATES = {"ga": "mutation_decay", "pso": "constriction", "gauss-newton": "damping", "adam": "decay"}


def main(
    clip: str = SMALL,
    methods: str = "ga,gauss-newton",
    runs: int = 64,
    frames: int = 8,
    repeats: int = 2,
    json: Path | None = None,
) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clip: one clip, or the word small.
        methods: comma-separated METHOD or METHOD:PRESET.
        runs: number of runs.
        frames: number of frames of the small clip.
        repeats: measurements of each variant, in turn.
        json: file for the figures.
    """
    results: dict[str, Any] = {"clip": clip, "runs": runs}
    with tempfile.TemporaryDirectory() as folder:
        sequence = _small(Path(folder), frames) if clip == SMALL else common.open_clip(clip)
        for name in common.names(methods):
            results[name] = _measure(sequence, _settings(name, runs), repeats)
    rows = [_row(name, results[name]) for name in common.names(methods)]
    columns = ("", "programs", "more", "run_odometry, s", "bare, s", "together, s", "ratio", "to bare")
    columns += ("bare, core-ms", "together, core-ms", "equal")
    common.print_table(f"{runs} runs over {len(sequence)} frames of {clip}", columns, rows)
    common.record(json, "together", results)
    return results


def _small(folder: Path, frames: int) -> TumSequence:
    write_tum(SyntheticSequence(frames, noise=KINECT, camera=CAMERA), folder)
    return TumSequence(folder, CAMERA)


def _settings(name: str, runs: int) -> list[Settings]:
    """Settings of each run: its own value of a rate, from 0.9 to 1.1 of the preset's."""
    preset, field = common.preset_of(name), RATES[name.partition(":")[0]]
    rate = getattr(preset.solver, field)
    return [
        replace(preset, solver=replace(preset.solver, **{field: float(rate * factor)}))
        for factor in np.linspace(0.9, 1.1, runs)
    ]


def _measure(sequence: Sequence, settings: list[Settings], repeats: int) -> dict[str, Any]:
    def drivers() -> list[Odometry]:
        return [Odometry(sequence.camera, own, seed=seed) for seed, own in enumerate(settings)]

    def single() -> list[list[Step]]:
        return [run_odometry(sequence, own, seed=seed).steps for seed, own in enumerate(settings)]

    def bare() -> list[list[Step]]:
        return [list(track(sequence, odometry=driver)) for driver in drivers()]

    def together() -> list[list[Step]]:
        return track_together(sequence, drivers())

    with _compilations() as first:
        run_odometry(sequence, settings[0])
    with _compilations() as others:
        found = [[_timed(way) for way in (single, bare, together)] for _ in range(repeats)]
    clock, cores = np.median([[times for times, _ in ways] for ways in found], axis=0).T.tolist()
    pairs = len(settings) * (len(sequence) - 1)
    equal = sum(_same(a, b) for a, b in zip(found[0][0][1], found[0][2][1], strict=True))
    return {
        "programs": len(first),
        "more_programs": len(others),
        "seconds": dict(zip(WAYS, clock, strict=True)),
        "core_milliseconds_a_pair": {way: 1e3 * time / pairs for way, time in zip(WAYS, cores, strict=True)},
        "ratio": clock[2] / clock[0],
        "ratio_to_bare": clock[2] / clock[1],
        "equal": equal,
    }


def _timed(run: Callable[[], list[list[Step]]]) -> tuple[tuple[float, float], list[list[Step]]]:
    """Wall and processor seconds of a call, and its result."""
    start = time.perf_counter(), time.process_time()
    steps = run()
    return (time.perf_counter() - start[0], time.process_time() - start[1]), steps


def _same(first: list[Step], second: list[Step]) -> bool:
    return all(np.array_equal(a.world_T_camera, b.world_T_camera) for a, b in zip(first, second, strict=True))


@contextmanager
def _compilations() -> Iterator[list[str]]:
    """Collect the programs that XLA compiles (or loads from the cache) meanwhile."""
    events: list[str] = []
    counting = True

    def listen(event: str, duration_secs: float, **kwargs: str | int) -> None:
        if counting and event == "/jax/core/compile/backend_compile_duration":
            events.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield events
    finally:
        counting = False


def _row(name: str, found: dict[str, Any]) -> tuple[Any, ...]:
    cores = found["core_milliseconds_a_pair"]
    figures = (*found["seconds"].values(), found["ratio"], found["ratio_to_bare"], cores["bare"], cores["together"])
    return name, found["programs"], found["more_programs"], *(number(f, 2) for f in figures), found["equal"]


if __name__ == "__main__":
    common.command(main)
