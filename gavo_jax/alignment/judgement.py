"""From a search's best motion to a result: final estimates, refinement, covariance and status."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Integer

from gavo_jax.alignment.evidence import Evidence, Held, evidence, is_held
from gavo_jax.alignment.information import Information, measure_information
from gavo_jax.alignment.result import MAX_ROTATION_DEVIATION, MAX_TRANSLATION_DEVIATION, Alignment
from gavo_jax.alignment.sway import LARGEST_RISE, Swayed, Swaying, refine_swaying, unswayed
from gavo_jax.alignment.visits import Level, reach_of
from gavo_jax.frame_checks import MIN_DEPTH_SHARE
from gavo_jax.objective.derivatives import Linearization
from gavo_jax.objective.error import Objective, Residuals
from gavo_jax.objective.estimates import ExplainedShare, estimate_scales, explained_share
from gavo_jax.objective.problem import Problem
from gavo_jax.se3 import departure_from_rigid, exp, log
from gavo_jax.settings import AlignmentOptions
from gavo_jax.status import AlignmentStatus, as_findings, bit, gravest

MIN_CONTRAST = 2.0
"""Standard deviation of the reference's grey levels below which a pair is `LOW_TEXTURE`."""
MIN_FINAL_OVERLAP = 0.3
"""Overlap of the result below which a pair is `LOW_OVERLAP`."""
MIN_EXPLAINED_GREY = 0.45
"""Share of grey residuals that are not large (`objective.estimates.explained_share`) below which a pair is
`HIGH_ERROR`."""
MIN_EXPLAINED_DEPTH = 0.9
"""Share of depth residuals that are not large below which a motion is `HIGH_ERROR` if its standard deviation exceeds
`DOUBTFUL_DEVIATION`."""
DOUBTFUL_DEVIATION = 0.005
"""Metres or radians: standard deviation of a motion above which disagreeing depth proves it wrong. Depth may disagree
with a well-determined motion because of disocclusions and occlusions."""
MIN_EVIDENCE, MIN_SEEN_EVIDENCE = 0.7, 1.8
"""Evidence over all readings, and over those seen, below which a motion that was chosen by it is `HIGH_ERROR`."""
MAX_RIVAL = 1.1
"""Ratio of a second mode's error to the best one's below which a pair is `AMBIGUOUS`. Only rival islands show it."""
AT_THE_EDGE = 0.98
"""Share of the search's reach beyond which a pair is `HIGH_ERROR`: a better motion may lie outside."""
MAX_DEPARTURE = 1e-4
"""Entry of RᵀR − I above which a pair is `NOT_RIGID`; rounding alone causes a hundredth of it."""
SHARED_ERRORS = 9.0
"""Factor on the covariance for errors that the whole image shares (interpolation, the choice of points, the pyramid's
rounding). The scatter between tiles does not show them; measured by `benchmarks/calibration.py`."""
UNDETERMINED = 0.5
"""Metres or radians: the standard deviation that stands for an undetermined direction."""
UNKNOWN = np.diag(np.full(6, UNDETERMINED**2, np.float32))
"""Covariance of a motion that the images do not determine at all."""
LAST_STEPS, CONVERGED = 8, 0.003
"""Maximum number of last steps, and the share by which one has to lower E for another one to follow."""
LARGEST_STEP = 0.01
"""Metres or radians: a larger last step is shortened to this, and taken only if E falls. It may follow a direction that
the images leave undetermined."""


class Part(NamedTuple):
    """The part of the image whose points take part."""

    share: Float[Array, ""]
    """Share of the image: less than 1 where the points of bodies are left out."""
    is_body: Bool[Array, ""]
    """Whether it is one body, whose outline is known in both frames."""

    @classmethod
    def whole(cls) -> "Part":
        """Return the whole image."""
        return cls(jnp.float32(1.0), jnp.array(False))


class Winner(NamedTuple):
    """Result of a search."""

    motion: Float[Array, "4 4"]
    rival: Float[Array, ""]
    """See `search.SearchState`."""
    centre: Float[Array, "4 4"] | None
    """Motion at the centre of the search; None where motions from anywhere competed."""
    history: Float[Array, " iterations"]
    judge: Objective | None = None
    """Objective that the evidence is computed on, where motions competed by it."""


def conclude(
    objective: Objective,
    winner: Winner,
    finest: Level,
    options: AlignmentOptions,
    swaying: Swaying | None = None,
    part: Part | None = None,
) -> Alignment:
    """Make a result of a search's winner on a part of the image: estimate scales, refine, and judge."""
    part = Part.whole() if part is None else part
    residuals = objective.residuals(winner.motion)
    if options.robust_scale:
        # once more, at the motion found, so that errors of different solvers can be compared
        objective = replace(objective, scales=estimate_scales(residuals, finest.depth_weight))
    points = finest.points * finest.views  # the arrays may be longer
    reach = reach_of(options)
    centre = winner.motion if winner.centre is None else winner.centre
    problem = Problem(objective=objective, origin=winner.motion, basis=jnp.eye(6), centre=centre, reach=reach)
    added = jnp.zeros((6, 6))
    if options.last_step:
        problem, residuals, added = _last_step(problem, residuals, swaying, points, is_symmetric=options.symmetric)
        objective = problem.objective
    motion = problem.origin
    examination, covariance, chosen_by = _weigh(_examine(problem, residuals, part), objective, winner.judge, added)
    against = find_against(examination, covariance, objective, winner.rival, part.share * points, chosen_by)
    if options.precondition and winner.centre is not None:
        edge = replace(problem, origin=motion, reach=AT_THE_EDGE * reach)
        # in an undetermined direction any motion is as good, even one at the edge
        is_told = ~against[AlignmentStatus.LOW_TEXTURE]
        against[AlignmentStatus.HIGH_ERROR] |= is_told & edge.is_out_of_reach(motion)
    findings = as_findings(against)
    known = ~(findings & bit(AlignmentStatus.NO_DEPTH)).astype(bool) & jnp.all(jnp.isfinite(covariance))
    return Alignment(
        target_T_reference=motion,
        xi=log(motion),
        error=examination.model.error,
        overlap=examination.model.overlap,
        covariance=jnp.where(known, covariance, jnp.nan),
        status=gravest(findings),
        history=winner.history,
        findings=findings,
        explained=examination.explained,
        depth_scale=jnp.asarray(objective.scales.depth, jnp.float32),
        sway=jnp.zeros(6) if objective.sway is None else objective.sway,
    )


def _last_step(
    problem: Problem, residuals: Residuals, swaying: Swaying | None, points: Integer[Array, ""], *, is_symmetric: bool
) -> tuple[Problem, Residuals, Float[Array, "6 6"]]:
    """Refine the motion and, under a rolling shutter, the target's sway.

    A motion of the symmetric error is refined only for the sake of the sway: the derivatives cover one direction.

    Returns:
        The problem about the refined motion, its residuals, and the sway's contribution to the covariance.
    """

    def without_sway() -> Swayed:
        if is_symmetric:
            return unswayed(problem.origin, residuals)
        return unswayed(*_newton_steps(problem, residuals))

    if swaying is None or problem.objective.readout is None:
        found = without_sway()
        return replace(problem, origin=found.motion), found.residuals, found.covariance
    rolls = problem.objective.readout != 0.0
    found = jax.lax.cond(rolls, lambda: refine_swaying(problem, residuals, swaying, points), without_sway)
    return replace(problem.with_sway(found.twist), origin=found.motion), found.residuals, found.covariance


def _newton_steps(problem: Problem, residuals: Residuals) -> tuple[Float[Array, "4 4"], Residuals]:
    """Return the motion some Newton steps from the problem's origin, given its residuals, and those of that motion.

    A single step is enough near the minimum. A search may end far from it where E hardly depends on a direction, so
    steps follow each other as long as E falls.
    """

    def step_on(now: tuple[jax.Array, Residuals, jax.Array]) -> tuple[jax.Array, Residuals, jax.Array]:
        motion, residuals, left = now
        here = replace(problem, origin=motion)
        model = here.linearize_residuals(residuals)
        step = -jnp.linalg.solve(_regular(model.hessian), model.gradient)
        shortened = jnp.minimum(LARGEST_STEP / jnp.max(jnp.abs(step)), 1.0)
        stepped = motion @ exp(shortened * step)
        after = problem.objective.residuals(stepped)
        error, _ = problem.objective.error_of(after)
        falls = error < model.error * (1.0 - CONVERGED)
        better = falls | ((shortened == 1.0) & (error < model.error * (1.0 + LARGEST_RISE)))
        better &= ~problem.is_out_of_reach(stepped)
        kept = jax.tree.map(lambda new, old: jnp.where(better, new, old), (stepped, after), (motion, residuals))
        return *kept, jnp.where(better & falls, left - 1, 0)

    start = problem.origin, residuals, jnp.int32(LAST_STEPS)
    motion, residuals, _ = jax.lax.while_loop(lambda now: now[2] > 0, step_on, start)
    return motion, residuals


class Examination(NamedTuple):
    """Statistics of one motion at the finest level."""

    motion: Float[Array, "4 4"]
    inside: Float[Array, ""]
    """Number of points that both frames see."""
    model: Linearization
    """E and its derivatives with respect to a step on the reference's side."""
    scatter: Float[Array, "6 6"]
    """Covariance of E's gradient."""
    information: Information
    explained: ExplainedShare


def _examine(problem: Problem, r: Residuals, part: Part) -> Examination:
    """Examine the problem's origin on a part of the images, given its residuals."""
    model, scatter, terms = problem.examine(r)
    return Examination(
        motion=problem.origin,
        inside=jnp.sum(r.inside),
        model=model,
        scatter=scatter,
        information=measure_information(problem, r, terms, part.is_body),
        explained=explained_share(r),
    )


def _weigh(
    examination: Examination, objective: Objective, judge: Objective | None, added: Float[Array, "6 6"]
) -> tuple[Examination, Float[Array, "6 6"], Evidence | None]:
    """Return the examination, the covariance, and the evidence where motions competed by it.

    A direction also counts as determined if the evidence holds it.

    Args:
        examination: Statistics of the motion at the finest level.
        objective: Objective of that level.
        judge: Objective that the evidence is computed on; None if nothing competed.
        added: Added to the covariance.
    """
    if judge is None:
        return examination, _covariance(examination, objective, None) + added, None
    chosen_by = evidence(judge, examination.motion)
    held = is_held(judge, examination.motion, chosen_by, examination.information.directions)
    covariance = _covariance(examination, objective, held) + added
    determined = examination.information.determined | held.held
    examination = examination._replace(information=examination.information._replace(determined=determined))
    return examination, covariance, chosen_by


def _regular(hessian: Float[Array, "6 6"]) -> Float[Array, "6 6"]:
    """Regularise a Hessian slightly, so that it can be inverted."""
    return hessian + 1e-6 * jnp.diag(jnp.diag(hessian)) + 1e-9 * jnp.eye(6)


def _covariance(examination: Examination, objective: Objective, held: Held | None) -> Float[Array, "6 6"]:
    """Covariance of the motion, from the scatter of E's gradient along determined directions.

    The covariance of independent residuals is added, as the scatter vanishes where the images happen to agree. An
    undetermined direction has half the step within which the evidence holds it as its deviation, else `UNDETERMINED`.
    """
    information, known_within = examination.information, jnp.zeros((6, 6))
    if held is not None:
        # the gradients of frames far apart may constrain a direction less than the evidence does
        ways = information.directions
        spread = jnp.sqrt(SHARED_ERRORS * jnp.sum(ways * (examination.scatter @ ways), axis=0))
        half = 0.5 * jnp.max(jnp.abs(held.steps), axis=0) / jnp.max(jnp.abs(ways), axis=0)
        vague = held.held & (~information.determined | (spread > half * jnp.abs(information.curvature)))
        information = information._replace(determined=information.determined & ~vague)
        known_within = jnp.where(vague, 0.5 * held.steps, 0.0)
    inverse = information.inverse()
    least = 2.0 * objective.scales.grey**2 / jnp.maximum(examination.inside, 1.0) * inverse
    covariance = SHARED_ERRORS * inverse @ examination.scatter @ inverse.T + least
    is_open = ~information.determined & jnp.all(known_within == 0.0, axis=0)
    open_ways = jnp.where(is_open, information.directions, 0.0)
    open_ways *= UNDETERMINED / jnp.maximum(jnp.max(jnp.abs(open_ways), axis=0), 1e-12)
    open_ways += known_within
    covariance += open_ways @ open_ways.T
    return 0.5 * (covariance + covariance.T)


def find_against(
    examination: Examination,
    covariance: Float[Array, "6 6"],
    objective: Objective,
    rival: Float[Array, ""],
    points: Float[Array, ""],
    chosen_by: Evidence | None = None,
) -> dict[AlignmentStatus, Bool[Array, ""]]:
    """Test a motion for every status that speaks against it; docs/status.md gives the reasons.

    `points` is the number of points that were used for it.
    """
    motion, model, explained = examination.motion, examination.model, examination.explained
    deviation = jnp.sqrt(jnp.maximum(jnp.diag(covariance), 0.0))
    has_reading = objective.reference.points.q > 0
    out_of_view = objective.is_out_of_view(model.overlap)  # E is infinite by definition
    has_error = jnp.isfinite(model.error) | (out_of_view & ~jnp.isnan(model.error))
    finite = has_error & jnp.all(jnp.isfinite(motion)) & jnp.all(jnp.isfinite(covariance))
    wide = (jnp.max(deviation[:3]) > MAX_TRANSLATION_DEVIATION) | (jnp.max(deviation[3:]) > MAX_ROTATION_DEVIATION)
    doubtful = jnp.max(deviation) > DOUBTFUL_DEVIATION
    unexplained = (explained.grey < MIN_EXPLAINED_GREY) | (doubtful & (explained.depth < MIN_EXPLAINED_DEPTH))
    if chosen_by is not None:
        unexplained = (chosen_by.seen < MIN_SEEN_EVIDENCE) | (chosen_by.total < MIN_EVIDENCE)
    contrast = jnp.std(objective.reference.grey, where=has_reading)
    return {
        AlignmentStatus.AMBIGUOUS: rival < MAX_RIVAL,
        AlignmentStatus.LOW_TEXTURE: wide | (contrast < MIN_CONTRAST) | ~jnp.all(examination.information.determined),
        AlignmentStatus.HIGH_ERROR: unexplained,
        AlignmentStatus.LOW_OVERLAP: out_of_view | (model.overlap < MIN_FINAL_OVERLAP),
        AlignmentStatus.NOT_FINITE: ~finite,
        AlignmentStatus.NO_DEPTH: jnp.sum(has_reading) < MIN_DEPTH_SHARE * points,
        AlignmentStatus.NOT_RIGID: departure_from_rigid(motion) > MAX_DEPARTURE,
    }


def is_unknown(result: Alignment) -> bool:
    """Whether a result, on the host, has the covariance of a motion that images do not determine at all."""
    return bool(np.all(np.diagonal(result.covariance) >= UNDETERMINED**2))
