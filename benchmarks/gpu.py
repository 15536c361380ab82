"""Performance of an accelerator: pairs per second, latency, share of the memory bandwidth, agreement with the CPU.

Prints four tables:

- `align_batch` by batch size, from arrays on the host to results on the host;
- latency of a single pair, by `align` and by the driver, from decoded images;
- scoring against the limit set by memory bandwidth;
- distance of the motions of some pairs from those of the same program on the CPU, in a second process.

The limit assumes that every candidate reads five float32 numbers of every reference point (x, y, inverse depth, grey,
facing) and one 32-bit word of each of the grey and depth targets. That is 28 bytes per pixel and candidate, at the
bandwidth of copying 256 MB (read and written). Caches that serve several candidates from one read can raise the share
above 1.

    python benchmarks/gpu.py
    python benchmarks/gpu.py --batches 64,256,1024 --rounds 9 --json gpu.json

It also runs on a CPU, for tests: the tables are then the CPU's, and the last one compares it with itself.
"""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import common
import jax
import jax.numpy as jnp
import numpy as np
from scaling import time_batches, time_in_turn, time_scoring

from gavo_jax.alignment.pairs import align, align_batch
from gavo_jax.camera import Camera
from gavo_jax.compilation.cache import enable_compilation_cache
from gavo_jax.datasets.base import Frame, Sequence
from gavo_jax.evaluation import rotation_angle
from gavo_jax.odometry.driver import Odometry
from gavo_jax.output.screen import number
from gavo_jax.trajectory import inverse

BYTES = 7 * 4
"""Bytes read per pixel and candidate; see the module's docstring."""
KEYS_OF_MEMORY = ("milliseconds", "limit_milliseconds", "share")
COPIED = 2**26
"""Floats copied to measure the memory bandwidth: 256 MB."""


def main(
    clip: str = "synthetic:9",
    methods: str = "ga,ga:fast,gauss-newton",
    batches: str = "1,4",
    populations: str = "64,256",
    rounds: int = 3,
    json: Path | None = None,
) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clip: clip that the pairs come from.
        methods: comma-separated METHOD or METHOD:PRESET.
        batches: comma-separated numbers of pairs per call; the clip's pairs are repeated.
        populations: comma-separated numbers of candidates per call.
        rounds: measurements of each.
        json: file for the figures.

    Raises:
        GavoError: unknown method, no such clip.
    """
    device = jax.devices()[0].device_kind
    if jax.default_backend() == "cpu":
        common.tell("no GPU here: the figures are this CPU's, and the agreement is its own with itself")
    sequence = common.open_clip(clip)
    frames, camera = [sequence[i] for i in range(len(sequence))], sequence.camera
    results: dict[str, Any] = {"clip": clip, "batches": {}, "latency": {}, "agreement": {}}
    for name in common.names(methods):
        batch = partial(align_batch, camera=camera, settings=common.preset_of(name))
        results["batches"][name] = time_batches(batch, sequence, common.counts(batches), rounds)
        results["latency"][name] = latency(frames, camera, name, rounds)
        results["agreement"][name] = agreement(frames, camera, name)
    results["memory"] = memory_share(sequence, common.counts(populations), rounds)
    rows = [
        (name, row["pairs"], number(row["milliseconds"], 1), number(row["per_second"], 1))
        for name, measured in results["batches"].items()
        for row in measured
    ]
    common.print_table(f"align_batch, {device}", ("", "pairs", "ms", "pairs/s"), rows)
    rows = [(name, *(number(value, 2) for value in row.values())) for name, row in results["latency"].items()]
    common.print_table(f"ms of a pair alone, {device}", ("", "align", "driver"), rows)
    rows = [
        (f"{row['size']}, {row['candidates']} candidates", *(number(row[key], 3) for key in KEYS_OF_MEMORY))
        for row in results["memory"]["scoring"]
    ]
    gigabytes = number(results["memory"]["gigabytes_per_second"], 0)
    columns = ("", "ms", "limit, ms", "share of the limit")
    common.print_table(f"scoring at {BYTES} bytes a pixel and candidate and {gigabytes} GB/s, {device}", columns, rows)
    rows = [(name, *(number(value, 4) for value in row.values())) for name, row in results["agreement"].items()]
    columns = ("", "mm, median", "mm, largest", "deg, median", "deg, largest")
    common.print_table(f"{len(frames) - 1} pairs: distance from the CPU's result, {device}", columns, rows)
    common.record(json, "gpu", results)
    return results


def latency(frames: list[Frame], camera: Camera, name: str, rounds: int) -> dict[str, float]:
    """Median milliseconds of one pair: by `align`, and by the driver that holds the reference on the device."""
    settings = common.preset_of(name)
    one = partial(align, frames[0], frames[1], camera, settings)
    [milliseconds] = time_in_turn([one], rounds)
    odometry = Odometry(camera, settings)
    odometry.warm_up()
    steps = [odometry.register(frame, frame.timestamp) for frame in frames]
    driver = [step.milliseconds for step in steps if step is not None]
    return {"align_milliseconds": milliseconds, "driver_milliseconds": float(np.median(driver))}


def memory_share(sequence: Sequence, populations: list[int], rounds: int) -> dict[str, Any]:
    """Time to score at 640x480, and its limit by memory bandwidth."""
    bandwidth = copy_bandwidth(rounds)
    rows = time_scoring(sequence, [0], populations, rounds)
    for row in rows:
        row["limit_milliseconds"] = BYTES * row["pixels"] * row["candidates"] / bandwidth * 1e3
        row["share"] = row["limit_milliseconds"] / row["milliseconds"]
    return {"gigabytes_per_second": bandwidth / 1e9, "scoring": rows}


def copy_bandwidth(rounds: int) -> float:
    """Bytes per second that the device reads and writes while copying a large array."""
    array = jnp.zeros(COPIED, jnp.float32)
    copy = jax.jit(lambda a: a + 1.0)
    [milliseconds] = time_in_turn([lambda: copy(array).block_until_ready()[0]], rounds)
    return 2 * array.nbytes / milliseconds * 1e3


def agreement(frames: list[Frame], camera: Camera, name: str) -> dict[str, float]:
    """Distance of this device's motions from those of a process on the CPU, millimetres and degrees."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, spawn, initializer=_on_cpu) as process:
        theirs = process.submit(motions, frames, camera, name).result()
    between = inverse(theirs) @ motions(frames, camera, name)
    millimetres = np.linalg.norm(between[:, :3, 3], axis=1) * 1e3
    degrees = np.degrees(rotation_angle(between[:, :3, :3]))
    return {
        f"{unit}_{kind}": float(of(values))
        for unit, values in (("mm", millimetres), ("deg", degrees))
        for kind, of in (("median", np.median), ("largest", np.max))
    }


def motions(frames: list[Frame], camera: Camera, name: str) -> np.ndarray:
    """Motions target_T_reference [B, 4, 4] of consecutive frames."""
    settings = common.preset_of(name)
    return np.stack(
        [align(*pair, camera, settings).target_T_reference for pair in zip(frames[:-1], frames[1:], strict=True)]
    )


def _on_cpu() -> None:
    jax.config.update("jax_platforms", "cpu")
    enable_compilation_cache()


if __name__ == "__main__":
    common.command(main)
