"""The evidence of two frames for a motion, on one scale for candidates of any origin.

E's scales are estimated at the motion that a level starts from, and points that leave the view cost a share of them.
Errors of candidates from different searches are therefore not comparable, but their evidence is: it is taken on the
same points of both frames, with the same fixed scales. Each point in view contributes the log-likelihood ratio of its
residuals under "the frames match here" and "two random pixels of these frames meet here". A point that is out of view
or occluded contributes nothing.

Wide scales let a search see a motion from afar. Before plain walls they also let a motion that is off by decimetres
pass for the true one, and a larger overlap then outweighs a better match. Motions that were refined are therefore
compared under the noise that explains each of them best: the profile likelihood over both scales.
"""

from dataclasses import replace
from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gavo_jax.objective.error import Objective
from gavo_jax.se3 import exp, rigid_inverse

POINTS = 1200
"""Largest number of points of a frame, evenly spread, that the evidence is taken on."""
GREY_SCALE = 15.0
"""Grey residual of a match, grey levels: from noise, a change of gain and an error of half a pixel."""
DEPTH_SCALE = 0.02
"""Inverse-depth residual of a match, 1/m: a few times the quantisation of a structured-light sensor."""
NOISES = tuple(product((2.0, 4.0, 8.0, GREY_SCALE), (0.003, 0.006, 0.01, DEPTH_SCALE)))
"""Pairs of scales (grey, inverse depth) of the noise that may explain a refined motion. The widest one comes last."""
LEAST_GREY_SPREAD, LEAST_DEPTH_SPREAD = 20.0, 0.05
"""Lower bounds on the difference of two random pixels of a frame (grey levels, 1/m)."""
MISMATCH = 0.2
"""Probability that a point does not match although the frames do (moving things, reflections, edges). Its logarithm
bounds what a point can say against a motion."""
HIDDEN = 3.0
"""Number of depth scales by which the target must be nearer than a point for the point to be occluded."""
MAY_BE_HIDDEN = 0.3
"""Weight, in the estimate of exposure, of a point where the target has no depth to show whether it is occluded."""
LEAST_SEEN = 0.02
"""Smallest share of the readings that counts as seen, so that a few points have little say."""


STEP = (0.05, 0.05)
"""Metres and radians by which a motion is displaced to test whether the evidence holds it."""
LEAST_FALL = 0.03
"""Share of the evidence that a displacement by `STEP` must lose for the evidence to hold the motion."""


class Evidence(NamedTuple):
    """Evidence of the frames for a motion."""

    total: Float[Array, ""]
    """Mean log-likelihood ratio over all readings of both frames; points that are not seen contribute 0."""
    seen: Float[Array, ""]
    """Mean over only the points that are seen: how well the frames match where they overlap."""


class Held(NamedTuple):
    """Whether the evidence holds a motion in six directions."""

    held: Bool[Array, " 6"]
    """Whether the evidence falls on both sides of the motion, for each direction."""
    steps: Float[Array, "6 6"]
    """The displacements that were tested, as columns, metres and radians."""


def evidence(objective: Objective, target_T_reference: Float[Array, "4 4"], points: int = POINTS) -> Evidence:
    """Return the evidence for one motion from both directions of an objective, ignoring its scales and brightness."""
    by_noise = _evidence(objective, target_T_reference, points, ((GREY_SCALE, DEPTH_SCALE),))
    return Evidence(*(of[0] for of in by_noise))


def evidence_and_best(objective: Objective, target_T_reference: Float[Array, "4 4"]) -> tuple[Evidence, Evidence]:
    """Return the evidence for one refined motion, and that under the noise that explains it best."""
    by_noise = _evidence(objective, target_T_reference, POINTS, NOISES)
    return Evidence(*(of[-1] for of in by_noise)), Evidence(*map(jnp.max, by_noise))


def _evidence(
    objective: Objective, motion: Float[Array, "4 4"], points: int, noises: tuple[tuple[float, float], ...]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return total and seen evidence of a motion under each noise."""
    scales = jnp.array(noises)
    sums = _sums(objective, motion, points, scales)
    if objective.backward is not None:
        sums = jax.tree.map(jnp.add, sums, _sums(objective.backward, rigid_inverse(motion), points, scales))
    totals, seen, readings = sums
    return totals / jnp.maximum(readings, 1.0), totals / jnp.maximum(seen, LEAST_SEEN * readings + 1.0)


def is_held(
    objective: Objective, target_T_reference: Float[Array, "4 4"], here: Evidence, directions: Float[Array, "6 6"]
) -> Held:
    """Test whether the evidence falls on both sides of a motion, along directions of a step on the reference's side.

    Gradients of frames far apart agree little, which alone can make a direction seem undetermined. The test is then
    whether a motion that is off by `STEP` explains the frames as well.

    Args:
        objective: Objective of the level that the evidence is taken on.
        target_T_reference: The motion.
        here: The evidence for it.
        directions: Directions as columns, metres and radians, of any length.
    """
    size = jnp.repeat(jnp.stack([jnp.float32(step) for step in STEP]), 3)
    steps = directions / jnp.max(jnp.abs(directions) / size[:, None], axis=0)
    aside = target_T_reference @ exp(jnp.concatenate([steps.T, -steps.T]))
    fallen = jax.lax.map(lambda motion: evidence(objective, motion).total, aside, batch_size=12)
    least = here.total - LEAST_FALL * jnp.abs(here.total)
    return Held(jnp.all(fallen.reshape(2, 6) < least, axis=0), steps)


def _sums(
    objective: Objective, motion: Float[Array, "4 4"], points: int, scales: Float[Array, "s 2"]
) -> tuple[Float[Array, " s"], Float[Array, ""], Float[Array, ""]]:
    """Sums of the log-likelihood ratios under some scales, number of points seen, and number of readings, one way."""
    few = replace(objective.sample(points), backward=None, centred=None)
    reference = few.reference
    has_reading = reference.points.q > 0
    r = few.residuals(motion)
    # a frame without any reading has no spread
    of_two = [
        jnp.sqrt(2.0) * jnp.nan_to_num(jnp.std(values, where=has_reading))
        for values in (reference.grey, reference.points.q)
    ]
    grey_spread, depth_spread = map(jnp.maximum, of_two, (LEAST_GREY_SPREAD, LEAST_DEPTH_SPREAD))
    depth = jnp.where(few.use_depth, r.depth_valid, 0.0)
    hidden = depth * (r.depth > HIDDEN * DEPTH_SCALE)
    fits = r.inside * jnp.where(depth > 0, jnp.abs(r.depth) < HIDDEN * DEPTH_SCALE, MAY_BE_HIDDEN)
    exposure = jnp.sum(fits * r.grey) / jnp.maximum(jnp.sum(fits), 1.0)
    seen = r.inside * (1.0 - hidden)

    def total(scale: jax.Array) -> jax.Array:
        ratio = _log_ratio(r.grey - exposure, scale[0], grey_spread)
        ratio += depth * _log_ratio(r.depth, scale[1], depth_spread)
        return jnp.sum(seen * jnp.logaddexp(jnp.log(MISMATCH), jnp.log1p(-MISMATCH) + ratio))

    return jax.vmap(total)(scales), jnp.sum(seen), jnp.sum(has_reading.astype(jnp.float32))


def _log_ratio(residual: jax.Array, scale: jax.Array, spread: jax.Array) -> jax.Array:
    """Log-likelihood ratio of a residual under a normal distribution of one scale and under a wider one."""
    wide = jnp.sqrt(spread**2 + scale**2)
    return jnp.log(wide / scale) - 0.5 * residual**2 * (1.0 / scale**2 - 1.0 / wide**2)
