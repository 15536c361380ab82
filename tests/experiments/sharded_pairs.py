"""Align pairs over all devices and write what came of it.

Run it as `python sharded_pairs.py OUT METHODS [ADDRESS PROCESSES PROCESS]`.
"""

import sys
from collections.abc import Callable, Iterable
from dataclasses import replace

import jax
import numpy as np
from small import CAMERA, NEWTON

from gavo_jax.alignment.result import Alignment
from gavo_jax.camera import Camera
from gavo_jax.datasets.rendered.sensor_noise import KINECT
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.experiments.sharding import align_batch_sharded
from gavo_jax.solvers.genetic import GeneticAlgorithm

PAIRS = 11
"""Eight devices do not divide it."""
GUESS = 0.1
"""Metres to the side: no search ends where it starts."""
FIGURES = ("xi", "error", "covariance")
METHODS = {
    "gauss-newton": NEWTON,
    "ga": replace(NEWTON, solver=GeneticAlgorithm(population=64, iterations=(0, 0, 0, 0, 2))),
}


def pairs(seed: int) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray], Camera, jax.Array]:
    """Frames of 160 x 120 and the ones after them, their camera and a key for each."""
    frames = list(SyntheticSequence(PAIRS + 1, noise=KINECT, camera=CAMERA))
    grey, depth = np.stack([frame.grey for frame in frames]), np.stack([frame.depth for frame in frames])
    keys = jax.random.split(jax.random.key(seed), PAIRS)
    return (grey[:-1], depth[:-1]), (grey[1:], depth[1:]), CAMERA, keys


def figures_of(align: Callable[..., Alignment], seed: int = 5, names: Iterable[str] = METHODS) -> dict[str, np.ndarray]:
    """The figures of every pair by methods."""
    references, targets, camera, keys = pairs(seed)
    guesses = np.tile(np.eye(4, dtype=np.float32), (PAIRS, 1, 1))
    guesses[:, 0, 3] = GUESS
    figures = {}
    for name in names:
        found = align(references, targets, camera, METHODS[name], keys=keys, guesses=guesses)
        figures |= {f"{name}_{figure}": np.asarray(getattr(found, figure)) for figure in FIGURES}
    return figures


def main(out: str, names: str, *distributed: str) -> None:
    """Write the figures, and how many devices there are and how many of this process."""
    if distributed:
        address, processes, process = distributed
        jax.distributed.initialize(address, int(processes), int(process))
    figures = figures_of(align_batch_sharded, names=names.split(","))
    figures["devices"] = np.array([jax.device_count(), jax.local_device_count()])
    np.savez(out, **figures)  # pyright: ignore[reportArgumentType]


if __name__ == "__main__":
    main(*sys.argv[1:])
