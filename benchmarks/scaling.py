"""How cost scales: time to score a population over pixels and candidates, and time of a batch over its pairs.

The first table has the milliseconds of one call of `Objective.score` (robust grey and depth error, every pixel a
point), one row per image size and one column per population. Below it is the exponent of (pixels x candidates) fitted
to all calls with more than a million of them: 1 is linear. The second has the milliseconds of `align_batch`, from
arrays on the host to results on the host, and the pairs per second. Each figure is the median of calls in turn.

    python benchmarks/scaling.py
    python benchmarks/scaling.py --populations 64,256,1024,4096 --batches 16,64,256,1024 --json scaling.json

On 2 cores the defaults take about four minutes, compilation included: each batch size is a program of its own.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import common
import jax
import jax.numpy as jnp
import numpy as np
from kernel import make_objective, pyramid_of, random_motions

from gavo_jax.alignment.pairs import align_batch
from gavo_jax.alignment.result import Alignment
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.base import Sequence as FrameSequence
from gavo_jax.objective.error import Objective
from gavo_jax.output.screen import number
from gavo_jax.settings import AlignmentOptions

LARGE = 1e6
"""Pixels x candidates above which a call's fixed cost is small."""


def main(
    levels: str = "0,1,2,3,4",
    populations: str = "8,16,32,64,128,256",
    batches: str = "1,2,4,8",
    methods: str = "ga,ga:fast",
    rounds: int = 15,
    json: Path | None = None,
) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        levels: comma-separated pyramid levels of 640x480.
        populations: comma-separated numbers of candidates per call.
        batches: comma-separated numbers of pairs per call; no batches if empty.
        methods: comma-separated METHOD or METHOD:PRESET of the batches.
        rounds: measurements of each.
        json: file for the figures.

    Raises:
        GavoError: unknown method, or something that is not a number.
    """
    sequence = common.open_clip("synthetic:9")
    scoring = time_scoring(sequence, common.counts(levels), common.counts(populations), rounds)
    sizes = dict.fromkeys(row["size"] for row in scoring)
    rows = [[size, *(number(row["milliseconds"], 3) for row in scoring if row["size"] == size)] for size in sizes]
    columns = ("", *(f"{count} candidates" for count in common.counts(populations)))
    common.print_table(f"ms of a call of score, {jax.devices()[0].device_kind}", columns, rows)
    slope = exponent(scoring)
    common.tell(f"exponent above {LARGE:.0e} pixels x candidates: {number(slope, 3)}")
    results = {"scoring": scoring, "exponent": slope, "batches": {}}
    for name in common.names(methods) if batches else ():
        settings = partial(align_batch, camera=sequence.camera, settings=common.preset_of(name))
        results["batches"][name] = time_batches(settings, sequence, common.counts(batches), rounds)
    rows = []
    for name, measured in results["batches"].items():
        rows += [(name, row["pairs"], number(row["milliseconds"], 1), number(row["per_second"], 1)) for row in measured]
    if rows:
        common.print_table("align_batch", ("", "pairs", "ms", "pairs/s"), rows)
    common.record(json, "scaling", results)
    return results


def time_scoring(
    sequence: FrameSequence, levels: Sequence[int], populations: Sequence[int], rounds: int
) -> list[dict[str, Any]]:
    """One row per image size and population: `size`, `pixels`, `candidates`, `milliseconds`."""
    camera = sequence.camera
    pyramids = (pyramid_of(sequence[0], camera), pyramid_of(sequence[1], camera))
    score, rows, calls = jax.jit(Objective.score), [], []
    for level in levels:
        objective = make_objective(pyramids, camera, level, AlignmentOptions(points=None, min_overlap=0.0))
        width, height = camera.level(level).width, camera.level(level).height
        for count in populations:
            rows.append({"size": f"{width}x{height}", "pixels": width * height, "candidates": count})
            calls.append(partial(score, objective, jnp.asarray(random_motions(count))))
    for row, milliseconds in zip(rows, time_in_turn(calls, rounds), strict=True):
        row["milliseconds"] = milliseconds
    return rows


def time_batches(
    align: Callable[..., Alignment], sequence: FrameSequence, batches: Sequence[int], rounds: int
) -> list[dict[str, Any]]:
    """One row per batch size: `pairs`, `milliseconds`, `per_second`; batches repeat the sequence's pairs."""
    frames = [sequence[i] for i in range(len(sequence))]
    calls = [partial(align, *_pairs(frames, count)) for count in batches]
    return [
        {"pairs": count, "milliseconds": milliseconds, "per_second": count / milliseconds * 1e3}
        for count, milliseconds in zip(batches, time_in_turn(calls, rounds), strict=True)
    ]


def _pairs(frames: Sequence[Frame], count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """References and targets, each the grey and the depth images [count, H, W]."""
    first = [i % (len(frames) - 1) for i in range(count)]
    grey, depth = (np.stack(images) for images in zip(*((f.grey, f.depth) for f in frames), strict=True))
    return [(grey[places], depth[places]) for places in (np.array(first), np.array(first) + 1)]


def time_in_turn(calls: Sequence[Callable[[], Any]], rounds: int) -> list[float]:
    """Median milliseconds of each call, transfer to the host included; a first call, which compiles, is not timed."""
    times = []
    for call in calls:
        jax.device_get(call())
    for _ in range(rounds):
        for call in calls:
            start = time.perf_counter()
            jax.device_get(call())
            times.append((time.perf_counter() - start) * 1e3)
    return [float(milliseconds) for milliseconds in np.median(np.reshape(times, (rounds, len(calls))), axis=0)]


def exponent(rows: Sequence[dict[str, Any]]) -> float | None:
    """Exponent of pixels x candidates that fits the large calls' times best; None for fewer than two of them."""
    work = np.array([row["pixels"] * row["candidates"] for row in rows], float)
    times = np.array([row["milliseconds"] for row in rows])
    large = work > LARGE
    if len(set(work[large])) < 2:
        return None
    return float(np.polyfit(np.log(work[large]), np.log(times[large]), 1)[0])


if __name__ == "__main__":
    common.command(main)
