"""Align pairs over all devices and write what came of it: `python sharded_pairs.py OUT [ADDRESS PROCESSES PROCESS]`."""

import sys
from collections.abc import Callable

import jax
import numpy as np

from gavo_jax import presets
from gavo_jax.alignment.result import Alignment
from gavo_jax.camera import Camera
from gavo_jax.datasets.synthetic import KINECT, SyntheticSequence
from gavo_jax.experiments.sharding import align_batch_sharded
from gavo_jax.settings import Settings
from gavo_jax.settings_file import override

PAIRS = 11
"""Eight devices do not divide it."""
GUESS = 0.1
"""Metres to the side: no search ends where it starts."""
FIGURES = ("xi", "error", "covariance")


def methods() -> dict[str, Settings]:
    """Gauss-Newton, and two generations of the genetic algorithm."""
    generations = override(presets.preset("ga"), {"solver.iterations": [0, 0, 0, 0, 2]})
    return {"gauss-newton": presets.preset("gauss-newton"), "ga": generations}


def pairs(seed: int) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray], Camera, jax.Array]:
    """Frames of 160 x 120 and the ones after them, their camera and a key for each."""
    camera = Camera(131.0, 131.0, 79.5, 59.5, 160, 120)
    frames = list(SyntheticSequence(PAIRS + 1, noise=KINECT, camera=camera))
    grey, depth = np.stack([frame.grey for frame in frames]), np.stack([frame.depth for frame in frames])
    keys = jax.random.split(jax.random.key(seed), PAIRS)
    return (grey[:-1], depth[:-1]), (grey[1:], depth[1:]), camera, keys


def figures_of(align: Callable[..., Alignment], seed: int = 5) -> dict[str, np.ndarray]:
    """The figures of every pair by every method."""
    references, targets, camera, keys = pairs(seed)
    guesses = np.tile(np.eye(4, dtype=np.float32), (PAIRS, 1, 1))
    guesses[:, 0, 3] = GUESS
    figures = {}
    for name, settings in methods().items():
        found = align(references, targets, camera, settings, keys=keys, guesses=guesses)
        figures |= {f"{name}_{figure}": np.asarray(getattr(found, figure)) for figure in FIGURES}
    return figures


def main(out: str, *distributed: str) -> None:
    """Write the figures, and how many devices there are and how many of this process."""
    if distributed:
        address, processes, process = distributed
        jax.distributed.initialize(address, int(processes), int(process))
    figures = figures_of(align_batch_sharded)
    figures["devices"] = np.array([jax.device_count(), jax.local_device_count()])
    np.savez(out, **figures)  # pyright: ignore[reportArgumentType]


if __name__ == "__main__":
    main(*sys.argv[1:])
