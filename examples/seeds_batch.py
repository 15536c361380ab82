"""A batch of experiments in one compiled call: a pair of frames, many seeds, several settings of the genetic algorithm.

A solver is a value whose rates are ordinary inputs of the program, so a sweep over them is a `vmap` and compiles once.

Run it as `python examples/seeds_batch.py`.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

import gavo_jax as gavo
from gavo_jax.alignment.search import align_views
from gavo_jax.alignment.visits import levels_of, prepare_pair
from gavo_jax.image.pyramid import build_pyramid

SOLVER = gavo.GeneticAlgorithm(population=(0, 0, 0, 32, 64), iterations=(0, 0, 0, 10, 12))
"""One entry per pyramid level, the full image first: only 80 x 60 and 40 x 30 pixels are searched."""


def main(seeds: int = 8, decays: tuple[float, ...] = (0.6, 0.8, 1.0)) -> np.ndarray:
    """Print the final error's median and spread over seeds, for each decay of the mutation's step."""
    sequence = gavo.SyntheticSequence(frames=2)
    camera, options = sequence.camera, gavo.AlignmentOptions()
    levels = levels_of(camera, SOLVER, options)

    @jax.jit
    def final_errors(keys: jax.Array, decays: jax.Array, images: list[tuple[jax.Array, jax.Array]]) -> jax.Array:
        before, after = (build_pyramid(grey, depth, camera.depth_scale) for grey, depth in images)
        view, target, _ = prepare_pair(before, after, camera, levels, options)

        def final_error(key: jax.Array, decay: jax.Array) -> jax.Array:
            solver, still = replace(SOLVER, mutation_decay=decay), jnp.eye(4)[None]
            return align_views((view,), target, camera, levels, solver, options, key, still)[0].error

        over_seeds = jax.vmap(final_error, in_axes=(0, None))
        return jax.vmap(over_seeds, in_axes=(None, 0))(keys, decays)

    images = [(jnp.asarray(frame.grey), jnp.asarray(frame.depth)) for frame in sequence]
    errors = np.asarray(final_errors(jax.random.split(jax.random.key(0), seeds), jnp.array(decays), images))

    for decay, row in zip(decays, errors, strict=True):
        print(f"mutation_decay {decay:.2f}: median {np.median(row):.4f}, from {row.min():.4f} to {row.max():.4f}")
    return errors


if __name__ == "__main__":
    main()
