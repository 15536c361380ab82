"""From what a search ended with to a result: estimate, refine, judge."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Integer

from gavo_jax.alignment.result import MAX_ROTATION_DEVIATION, MAX_TRANSLATION_DEVIATION, Alignment
from gavo_jax.alignment.visits import Level, Search
from gavo_jax.objective.derivatives import Linearization
from gavo_jax.objective.error import Objective, Residuals
from gavo_jax.objective.estimates import estimate_scales, explained_share
from gavo_jax.objective.problem import Problem
from gavo_jax.se3 import departure_from_rigid, exp, log
from gavo_jax.settings import AlignmentOptions
from gavo_jax.status import AlignmentStatus

MIN_DEPTH_SHARE = 0.05
"""Share of the reference's points with a reading below which a pair is `NO_DEPTH`."""
MIN_CONTRAST = 2.0
"""Grey levels: a smaller standard deviation over the reference makes a pair `LOW_TEXTURE`."""
MIN_FINAL_OVERLAP = 0.3
"""Overlap of the result below which a pair is `LOW_OVERLAP`."""
MIN_EXPLAINED_GREY = 0.45
"""Share of the grey residuals that must not be large (`objective.explained_share`); below, a pair is `HIGH_ERROR`."""
MIN_EXPLAINED_DEPTH = 0.9
"""The same of the depth residuals, for a motion of which the images leave a standard deviation above"""
DOUBTFUL_DEVIATION = 0.005
"""metres or radians. A well-determined motion may move much of the depth (surfaces come into view, others are hidden);
where it is not, depth that disagrees says that it is wrong."""
MAX_RIVAL = 1.1
"""Error of a second mode, over the best one's, below which a pair is `AMBIGUOUS`. Only rival islands can tell."""
MAX_DEPARTURE = 1e-4
"""Largest entry of RᵀR − I; rounding alone leaves a hundredth of it. Beyond, a pair is `NOT_RIGID`."""
SHARED_ERRORS = 9.0
"""Factor on the covariance for errors that the whole image shares (interpolation, the choice of points, the pyramid's
rounding), of which its scatter from tile to tile tells nothing; measured by `benchmarks/calibration.py`."""


def conclude(
    objective: Objective,
    search: Search,
    finest: Level,
    options: AlignmentOptions,
    history: jax.Array,
    centre: Float[Array, "4 4"],
) -> Alignment:
    """From what the search, held about a centre, ended with to the result: estimate, refine, judge."""
    found = search.islands[0]
    residuals = objective.residuals(found)
    if options.robust_scale:
        # once more, at the motion found, so that errors of different solvers can be compared
        objective = replace(objective, scales=estimate_scales(residuals, finest.depth_weight))
    reach = jnp.stack([search.box[0], search.box[3]])
    problem = Problem(objective=objective, origin=found, basis=jnp.eye(6), centre=centre, reach=reach)
    if options.last_step and not options.symmetric:
        problem = replace(problem, origin=_refine(problem, residuals))
        residuals = objective.residuals(problem.origin)
    model, scatter = problem.examine(residuals)
    motion = problem.origin
    covariance, status = _judge(Evidence(motion, residuals, model, scatter), objective, search.rival)
    return Alignment(motion, log(motion), model.error, model.overlap, covariance, status, history)


def _refine(problem: Problem, residuals: Residuals) -> Float[Array, "4 4"]:
    """The motion one Newton step from the problem's origin, of which these are the residuals, if that is no worse."""
    model = problem.linearize_residuals(residuals)
    step = -jnp.linalg.solve(_regular(model.hessian), model.gradient)
    stepped = problem.origin @ exp(step)
    error, _ = problem.objective.error(stepped)
    better = (error < model.error * (1.0 + LARGEST_RISE)) & jnp.all(jnp.abs(step) < LARGEST_STEP)
    better &= ~problem.is_out_of_reach(stepped)
    # held back, or XLA would carry both motions through all that follows
    return jax.lax.optimization_barrier(jnp.where(better, stepped, problem.origin))


class Evidence(NamedTuple):
    """What the images say of one motion at the finest level."""

    motion: Float[Array, "4 4"]
    residuals: Residuals
    model: Linearization
    """E and its derivatives by a step on the reference's side."""
    scatter: Float[Array, "6 6"]
    """Covariance of E's gradient."""


def _regular(hessian: Float[Array, "6 6"]) -> Float[Array, "6 6"]:
    """A Hessian that can be inverted, hardly changed."""
    return hessian + 1e-6 * jnp.diag(jnp.diag(hessian)) + 1e-9 * jnp.eye(6)


def _judge(
    evidence: Evidence, objective: Objective, rival: Float[Array, ""]
) -> tuple[Float[Array, "6 6"], Integer[Array, ""]]:
    """Covariance and status of a motion."""
    motion, model = evidence.motion, evidence.model
    inverse = jnp.linalg.inv(_regular(model.hessian))
    # the scatter tells nothing of a direction in which the images happen to agree, or say nothing: what independent
    # residuals would leave of it stays
    least = 2.0 * objective.scales.grey**2 / jnp.maximum(jnp.sum(evidence.residuals.inside), 1.0) * inverse
    covariance = SHARED_ERRORS * inverse @ evidence.scatter @ inverse.T + least
    covariance = 0.5 * (covariance + covariance.T)
    deviation = jnp.sqrt(jnp.maximum(jnp.diag(covariance), 0.0))
    has_reading = objective.reference.points.q > 0
    finite = jnp.isfinite(model.error) & jnp.all(jnp.isfinite(motion)) & jnp.all(jnp.isfinite(covariance))
    wide = (jnp.max(deviation[:3]) > MAX_TRANSLATION_DEVIATION) | (jnp.max(deviation[3:]) > MAX_ROTATION_DEVIATION)
    explained = explained_share(evidence.residuals)
    doubtful = jnp.max(deviation) > DOUBTFUL_DEVIATION
    unexplained = (explained.grey < MIN_EXPLAINED_GREY) | (doubtful & (explained.depth < MIN_EXPLAINED_DEPTH))
    contrast = jnp.std(objective.reference.grey, where=has_reading)
    status = jnp.int32(AlignmentStatus.OK)
    for found, value in (
        (rival < MAX_RIVAL, AlignmentStatus.AMBIGUOUS),
        (wide | (contrast < MIN_CONTRAST), AlignmentStatus.LOW_TEXTURE),
        (unexplained, AlignmentStatus.HIGH_ERROR),
        (model.overlap < MIN_FINAL_OVERLAP, AlignmentStatus.LOW_OVERLAP),
        (~finite, AlignmentStatus.NOT_FINITE),
        (jnp.mean(has_reading) < MIN_DEPTH_SHARE, AlignmentStatus.NO_DEPTH),
        (departure_from_rigid(motion) > MAX_DEPARTURE, AlignmentStatus.NOT_RIGID),
    ):
        status = jnp.where(found, jnp.int32(value), status)
    return covariance, status


LARGEST_STEP = 0.01
"""Metres or radians: a last step beyond this leaves the basin that the search ended in, or follows a direction that the
images leave open; it is not taken."""
LARGEST_RISE = 0.003
"""Share by which the last step may raise E: between pixels E is rough, by about that much, and the step's aim is the
middle of its basin."""
