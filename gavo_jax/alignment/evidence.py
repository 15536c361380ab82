"""How much two frames speak for a motion, on one scale for candidates of any origin.

E's scales are estimated at the motion that a level starts from, and what leaves the view is paid for by a share of
them. Errors of candidates that were found on different ways are therefore not comparable. The evidence is: every
candidate is asked about the same points of both frames, with the same fixed scales. Each point in view tells by how
much likelier its residuals are under "the frames match here" than under "any two pixels of these frames meet here". A
point that is out of view, or hidden behind something nearer, tells nothing.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gavo_jax.objective.error import Objective
from gavo_jax.se3 import exp, rigid_inverse

POINTS = 1200
"""Points of a frame, evenly spread, that are asked at most."""
GREY_SCALE = 15.0
"""Grey levels: what noise, a change of gain and half a pixel leave of a match."""
DEPTH_SCALE = 0.02
"""1/m, likewise: a few times the quantisation of a structured-light sensor."""
LEAST_GREY_SPREAD, LEAST_DEPTH_SPREAD = 20.0, 0.05
"""What two pixels of a frame differ by at least (grey levels, 1/m)."""
MISMATCH = 0.2
"""Chance that a point of frames that match does not itself (moving things, reflections, edges); no point can say more
against a motion than its logarithm."""
HIDDEN = 3.0
"""Depth scales by which the target must be nearer than a point for the point to be hidden."""
MAY_BE_HIDDEN = 0.3
"""What a point counts in the exposure whose target has no depth, which would tell whether it is hidden."""
LEAST_SEEN = 0.02
"""Share of the readings that count as seen at least: what a few points say is little."""


STEP = (0.05, 0.05)
"""Metres and radians: how far a motion is moved aside to ask whether the evidence holds it."""
LEAST_FALL = 0.03
"""Share of the evidence that has to be lost by a step of `STEP` for the evidence to hold the motion."""


class Evidence(NamedTuple):
    """What the frames say of a motion."""

    total: Float[Array, ""]
    """Mean logarithm of the likelihood ratio over all readings of both frames; 0 for what is not seen."""
    seen: Float[Array, ""]
    """The same over the points that are seen alone: how well the frames match where they do overlap."""


class Held(NamedTuple):
    """What the evidence says of six directions."""

    held: Bool[Array, " 6"]
    """Whether the evidence falls on both sides of the motion, by each direction."""
    steps: Float[Array, "6 6"]
    """The steps that were asked about, as columns, metres and radians."""


def evidence(objective: Objective, target_T_reference: Float[Array, "4 4"], points: int = POINTS) -> Evidence:
    """What both directions of an objective say of one motion; its scales and brightness do not count."""
    sums = _sums(objective, target_T_reference, points)
    if objective.backward is not None:
        sums = sums + _sums(objective.backward, rigid_inverse(target_T_reference), points)
    total, seen, readings = sums
    return Evidence(total / jnp.maximum(readings, 1.0), total / jnp.maximum(seen, LEAST_SEEN * readings + 1.0))


def is_held(objective: Objective, target_T_reference: Float[Array, "4 4"], directions: Float[Array, "6 6"]) -> Held:
    """Whether the evidence falls on both sides of a motion, along some directions of a step on the reference's side.

    Gradients of frames that lie far apart agree little, and a direction may seem open for that alone. What counts then
    is whether a motion that is off by `STEP` explains the frames as well.

    Args:
        objective: Of the level that the evidence is taken on.
        target_T_reference: The motion.
        directions: As columns, metres and radians, of any length.
    """
    size = jnp.repeat(jnp.stack([jnp.float32(step) for step in STEP]), 3)
    steps = directions / jnp.max(jnp.abs(directions) / size[:, None], axis=0)
    aside = target_T_reference @ exp(jnp.concatenate([steps.T, -steps.T]))
    fallen = jax.lax.map(lambda motion: evidence(objective, motion).total, aside, batch_size=12)
    here = evidence(objective, target_T_reference).total
    return Held(jnp.all(fallen.reshape(2, 6) < here - LEAST_FALL * jnp.abs(here), axis=0), steps)


def _sums(objective: Objective, motion: Float[Array, "4 4"], points: int) -> Float[Array, " 3"]:
    """Sum of the logarithms, points that tell something, and readings, of one direction."""
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
    ratio = _log_ratio(r.grey - exposure, GREY_SCALE, grey_spread) + depth * _log_ratio(
        r.depth, DEPTH_SCALE, depth_spread
    )
    logarithm = jnp.logaddexp(jnp.log(MISMATCH), jnp.log1p(-MISMATCH) + ratio)
    seen = r.inside * (1.0 - hidden)
    return jnp.stack([jnp.sum(seen * logarithm), jnp.sum(seen), jnp.sum(has_reading.astype(jnp.float32))])


def _log_ratio(residual: jax.Array, scale: float, spread: jax.Array) -> jax.Array:
    """Logarithm of the likelihood of a normal residual of one scale over that of a wider one."""
    wide = jnp.sqrt(spread**2 + scale**2)
    return jnp.log(wide / scale) - 0.5 * residual**2 * (1.0 / scale**2 - 1.0 / wide**2)
