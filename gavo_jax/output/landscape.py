"""The error E around the motion found, along its worst- and best-conditioned directions."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gavo_jax.alignment.fitting import objectives_of
from gavo_jax.alignment.result import Alignment
from gavo_jax.camera import Camera
from gavo_jax.compilation.programs import CachedProgram
from gavo_jax.datasets.base import Frame
from gavo_jax.image.pyramid import LEVELS, build_pyramid
from gavo_jax.se3 import exp
from gavo_jax.settings import AlignmentOptions

REACH, STEPS = 0.1, 81
"""Reach to either side, metres or radians, and number of motions scored along a direction."""


class Landscape(NamedTuple):
    """E around a motion, along two directions of δ in target_T_reference · exp(δ)."""

    steps: Float[np.ndarray, " n"]
    """Lengths along unit vectors of δ (m, rad)."""
    directions: Float[np.ndarray, "2 6"]
    """Unit vectors of the worst- and the best-conditioned direction."""
    errors: Mapping[int, Float[np.ndarray, "2 n"]]
    """E by level, squared grey levels; +inf for an invalid motion."""


def error_landscape(
    reference: Frame,
    target: Frame,
    camera: Camera,
    alignment: Alignment,
    options: AlignmentOptions,
    levels: Sequence[int],
) -> Landscape:
    """Score motions around an alignment, along the eigenvectors of largest and smallest variance of its covariance.

    Args:
        reference: The reference frame.
        target: The target frame.
        camera: Camera of both, without distortion.
        alignment: Alignment of the two, on the host.
        options: Definition of E.
        levels: Pyramid levels to score.
    """
    _, vectors = np.linalg.eigh(np.asarray(alignment.covariance, np.float64))
    directions = vectors.T[[-1, 0]]
    steps = np.linspace(-REACH, REACH, STEPS)
    images = (reference.grey, reference.depth, target.grey, target.depth)
    motion = jnp.asarray(alignment.target_T_reference, jnp.float32)
    errors = _score(images, camera, motion, jnp.float32(directions), jnp.float32(steps), options, levels=tuple(levels))
    return Landscape(steps, directions, {k: np.asarray(e) for k, e in zip(levels, errors, strict=True)})


@partial(CachedProgram, static=("levels",))
def _score(
    images: tuple[Array, ...],
    camera: Camera,
    target_T_reference: Float[Array, "4 4"],
    directions: Float[Array, "2 6"],
    steps: Float[Array, " n"],
    options: AlignmentOptions,
    *,
    levels: tuple[int, ...],
) -> list[Float[Array, "2 n"]]:
    reference, target = (build_pyramid(images[i], images[i + 1], camera.depth_scale, LEVELS) for i in (0, 2))
    motions = target_T_reference @ exp(steps[:, None] * directions[:, None, :])
    objectives = objectives_of(reference, target, camera, levels, options, target_T_reference)
    return [e.score(motions.reshape(-1, 4, 4))[0].reshape(len(directions), -1) for e in objectives]
