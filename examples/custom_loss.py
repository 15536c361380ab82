"""Any callable is a loss: the population methods evaluate it and need no derivative of it.

Run it as `python examples/custom_loss.py`.
"""

import jax
import jax.numpy as jnp
import numpy as np

import gavo_jax as gavo

SOLVER = gavo.GeneticAlgorithm(population=(0, 0, 24, 32, 64), iterations=(0, 0, 10, 10, 12))
"""Three levels of the pyramid; `gavo.ParticleSwarm` would do as well."""


def counted(s: jax.Array) -> jax.Array:
    """Cost of a squared residual in units of the noise: rises in steps of 1/8 up to 3 σ, constant beyond.

    It is flat nearly everywhere, so its derivative is useless.
    """
    return jnp.minimum(jnp.ceil(8.0 * s) / 8.0, 9.0)


def main() -> gavo.Alignment:
    """Align two frames by the genetic algorithm with a custom loss."""
    sequence = gavo.SyntheticSequence(frames=2)
    settings = gavo.Settings(SOLVER, gavo.AlignmentOptions(loss=counted))
    pair = gavo.align(sequence[0], sequence[1], sequence.camera, settings)

    first, second = sequence.ground_truth.world_T_camera
    exact = np.linalg.inv(second) @ first
    off = 1e3 * np.linalg.norm(pair.target_T_reference[:3, 3] - exact[:3, 3])
    print(f"{pair.status}: {off:.2f} mm off the exact motion, error {float(pair.error):.2f}")
    return pair


if __name__ == "__main__":
    main()
