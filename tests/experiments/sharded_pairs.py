"""Align pairs over all devices and write what came of it: `python sharded_pairs.py OUT [ADDRESS PROCESSES PROCESS]`."""

import sys

import jax
import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.datasets.synthetic import KINECT, SyntheticSequence
from gavo_jax.experiments.sharding import align_batch_sharded
from gavo_jax.presets import get_preset

PAIRS = 11
"""Neither eight devices nor two divide it."""
METHOD = "gauss-newton"
"""Without randomness, so that rounding stays rounding."""


def pairs() -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray], Camera, jax.Array]:
    """Frames of 160 x 120 and the ones after them, their camera and a key for each."""
    camera = Camera(131.0, 131.0, 79.5, 59.5, 160, 120)
    frames = list(SyntheticSequence(PAIRS + 1, noise=KINECT, camera=camera))
    grey, depth = np.stack([frame.grey for frame in frames]), np.stack([frame.depth for frame in frames])
    keys = jax.random.split(jax.random.key(5), PAIRS)
    return (grey[:-1], depth[:-1]), (grey[1:], depth[1:]), camera, keys


def main(out: str, *distributed: str) -> None:
    """Write xi and error of every pair by both methods."""
    if distributed:
        address, processes, process = distributed
        jax.distributed.initialize(address, int(processes), int(process))
    references, targets, camera, keys = pairs()
    preset = get_preset(METHOD)
    found = align_batch_sharded(references, targets, camera, preset.solver, keys, options=preset.alignment)
    devices = np.array([jax.device_count(), jax.local_device_count()])
    np.savez(out, devices=devices, xi=found.xi, error=found.error, covariance=found.covariance)


if __name__ == "__main__":
    main(*sys.argv[1:])
