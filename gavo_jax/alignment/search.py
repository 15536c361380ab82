"""Coarse to fine: the motion between two RGB-D frames (paper, section 3).

`align_views` is the whole method. On each level, from the coarsest to the finest, it takes the reference's points,
estimates brightness and noise from the data, chooses search coordinates and lets a solver minimise E there. The next
level starts from the best candidate.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Integer, PRNGKeyArray

from gavo_jax.alignment.aliases import self_motions
from gavo_jax.alignment.contest import Entry, hold_contest
from gavo_jax.alignment.evidence import evidence, evidence_and_best
from gavo_jax.alignment.fitting import comparable_objective, fit_objective, level_objective, unchanged_brightness
from gavo_jax.alignment.judgement import Part, Winner, conclude
from gavo_jax.alignment.modes import best_distinct, rival_error
from gavo_jax.alignment.result import Alignment
from gavo_jax.alignment.sway import Swaying
from gavo_jax.alignment.visits import Exchanged, Level, reach_of, stack_levels, visited_levels
from gavo_jax.camera import Camera
from gavo_jax.image.levels import Levels
from gavo_jax.image.sampling import Target
from gavo_jax.objective.error import Objective
from gavo_jax.objective.estimates import Brightness
from gavo_jax.objective.points import Reference
from gavo_jax.objective.preconditioning import preconditioner, reference_curvature, unconditioner
from gavo_jax.objective.problem import Problem
from gavo_jax.se3 import exp, log
from gavo_jax.settings import AlignmentOptions
from gavo_jax.solvers.base import Bounds, Candidates, Solver, solve
from gavo_jax.solvers.gauss_newton import GaussNewton

REFINER = GaussNewton(iterations=(8, 12, 12, 15, 20))
"""Solver that refines competing motions. Islands are small and widely spread, which finds a basin but not its
minimum: on pairs 15 frames apart their results are up to 10° from the refined ones."""
FINALISTS = 4
"""Number of islands, those with the most evidence, whose motions are refined."""
REFINED_OVERLAP = 0.1
"""Overlap that a motion must keep during refinement; the evidence decides whether so little is enough."""
SCOUT_RANGE = (0.5, 2.0)
"""Factors on the scouts' translations, from the first one to the last."""
SCOUTED_POINTS = 480
"""Number of points of a frame that a scout's evidence is taken on."""
LEAST_ERROR = 1e-6
"""Lower bound on the best error, squared grey levels, where a rival's is compared with it."""
SCOUTS_AT_ONCE = 32
"""Number of motions whose evidence is computed side by side."""


def _best_guess(objective: Objective, guesses: Float[Array, "g 4 4"]) -> Float[Array, "4 4"]:
    """Return the guess with the smallest grey residuals.

    Unscaled residuals are compared: each guess would have its own scales, in units of which E is not comparable.
    """
    if guesses.shape[0] == 1:
        return guesses[0]
    plain = replace(objective, use_depth=False, loss=jnp.sqrt, outside_cost=jnp.float32(0.0))
    return guesses[jnp.argmin(jax.vmap(lambda guess: plain.error(guess)[0])(guesses))]


class Population(NamedTuple):
    """All candidates of the levels' searches, [L], by iteration, for plots and the viewer."""

    level: Integer[Array, "..."]
    xi: Float[Array, "... iterations p 6"]
    """Twists of target_T_reference (m, rad) of all islands. NaN for iterations that were not run, because of stagnation
    or a level's smaller number of iterations."""
    error: Float[Array, "... iterations p"]
    """E, squared grey levels; +inf for an invalid candidate."""
    centre: Float[Array, "... 6"]
    """Twist at the centre of the search box; `half_widths` are the box's."""
    half_widths: Float[Array, "... 6"]

    def trimmed(self) -> "Population":
        """Return one level's candidates on the host, without the places and iterations that it left empty."""
        host = jax.device_get(self)
        rows, places = ~np.isnan(host.error).all(axis=1), ~np.isnan(host.xi[..., 0]).all(axis=0)
        return host._replace(xi=host.xi[rows][:, places], error=host.error[rows][:, places])


class Frames(NamedTuple):
    """Inputs that all searches of a pair share."""

    target: Target
    options: AlignmentOptions
    exchanged: Exchanged | None


class SearchState(NamedTuple):
    """State passed from one level to the next."""

    islands: Float[Array, "i 4 4"]
    """Motions, the best one first."""
    box: Float[Array, " 6"]
    """Half-widths of the search box, metres and radians."""
    brightness: Brightness
    rival: Float[Array, ""]
    """How far the second-best mode is behind: the ratio of its error to the best one's or, after a contest, of the best
    one's evidence to its; +inf without one."""


class Ended(NamedTuple):
    """Result of a pair's searches."""

    search: SearchState
    centre: Float[Array, "4 4"] | None
    """Motion at the centre of the search; None where motions from anywhere competed."""
    histories: Float[Array, "l iterations"]
    populations: Population | None
    judge: Objective | None = None
    """Objective that the evidence was computed on, where motions competed by it."""


def align_views(
    views: tuple[Reference, ...],
    target: Target,
    camera: Camera,
    levels: Levels,
    solver: Solver,
    options: AlignmentOptions,
    key: PRNGKeyArray,
    guesses: Float[Array, "g 4 4"],
    *,
    record: bool = False,
    exchanged: Exchanged | None = None,
    readout: Float[Array, ""] | None = None,
    hypotheses: Float[Array, "h 4 4"] | None = None,
    swaying: Swaying | None = None,
    part: Part | None = None,
) -> tuple[Alignment, Population | None]:
    """Estimate the motion from an anchor camera to the target camera, coarse to fine; traced, not compiled by itself.

    The levels are one `lax.scan`: a level's code is compiled once and serves all of them.

    Args:
        views: From `make_references`; the first one's frame is the anchor, in whose camera all points are given.
        target: From `prepare_target`, for the same solver.
        camera: Camera of level 0.
        levels: From `levels_of`.
        solver: Any `solvers.base.Solver` with an entry per level.
        options: What is minimised.
        key: Random key.
        guesses: Motions to start from; the one with the least error leads, so that a wrong one does no harm.
        record: Whether the candidates are kept (static).
        exchanged: Data for the `symmetric` error; None if it is not used.
        readout: Readout time of the shutter as a share of the time between anchor and target; None for a global
            shutter.
        hypotheses: Motions that compete with those of a search with `refine`, wherever they lie; NaN where there is
            none.
        swaying: Under a rolling shutter, prior knowledge of the target's velocity, which is then refined with the
            motion at the end; None to assume the mean velocity since the anchor.
        part: Part of the image whose points take part; None for all of it.

    Returns:
        The alignment and, if recorded, the candidates of each level of `visited_levels`.
    """
    visits = stack_levels(views, camera, levels, options, exchanged, readout)
    first, finest = (jax.tree.map(lambda leaf, at=at: leaf[at], visits) for at in (0, -1))
    searched = visited_levels(levels.numbers, options)
    keys = jax.random.split(key, (len(searched) + 1, max(options.islands)))
    box = jnp.repeat(reach_of(options), 3)
    places = np.array([levels.numbers.index(number) for number in searched])
    rows = visits if searched == levels.numbers else jax.tree.map(lambda leaf: leaf[places], visits)
    frames = Frames(target, options, exchanged)

    def search_alone() -> Ended:
        origins = _origins(frames, first, guesses, keys[-1, 0])
        start = SearchState(origins, box, unchanged_brightness(first), jnp.float32(jnp.inf))
        search, histories, populations = _search_levels(
            frames, solver, start, rows, keys[:-1], centre=origins[0], record=record
        )
        return Ended(search, origins[0], histories, populations)

    if options.refine:
        known = guesses if hypotheses is None else jnp.concatenate([guesses, hypotheses])
        finalists = min(FINALISTS, options.islands[searched[-1]])
        ended = _search_in_contest(frames, visits, known, box, search_alone, finalists=finalists, record=record)
        # from here on a single motion is refined
        finest = finest._replace(is_first=jnp.array(False), islands=jnp.int32(1))
    else:
        ended = search_alone()
    iterations = [solver.iterations[number] for number in searched]
    history = jnp.concatenate([row[:count] for row, count in zip(ended.histories, iterations, strict=True)])
    motion, rival = ended.search.islands[0], ended.search.rival
    winner = Winner(motion, rival, centre=ended.centre, history=history, judge=ended.judge)
    objective = level_objective(finest, target, options, ended.search.brightness).merged()
    alignment = conclude(objective, winner, finest, options, swaying, part)
    return alignment._replace(brightness=ended.search.brightness), ended.populations


def _search_in_contest(
    frames: Frames,
    visits: Level,
    known: Float[Array, "k 4 4"],
    box: Float[Array, " 6"],
    search_alone: Callable[[], Ended],
    *,
    finalists: int,
    record: bool,
) -> Ended:
    """Return the winner among known motions, those that islands find, and aliases of either."""
    (target, options, exchanged), count = frames, visits.number.shape[0]
    judged = jax.tree.map(lambda leaf: leaf[-min(2, count)], visits)
    judge = comparable_objective(judged, target, options, exchanged)

    def search_islands() -> tuple[jax.Array, tuple[jax.Array, Population | None]]:
        found = search_alone()
        return found.search.islands[:finalists], (found.histories, found.populations)

    def refine(motion: jax.Array, is_last: jax.Array) -> Entry:
        search = _refine_through_levels(frames, visits, motion, box, is_last)
        found = search.islands[0]
        return Entry(found, *evidence_and_best(judge, found), search.brightness)

    aliases = jnp.full((1, 4, 4), jnp.nan)
    if exchanged is not None:
        second = jax.tree.map(lambda leaf: leaf[min(1, count - 1)], visits)
        itself = comparable_objective(second, target, options, None)
        aliases = self_motions(itself, exchanged.target)
    winner, lead, (histories, populations) = hold_contest(known, search_islands, aliases, refine, record)
    search = SearchState(winner.motion[None], box, winner.brightness, lead)
    return Ended(search, None, histories, populations, judge)


def _refine_through_levels(
    frames: Frames,
    visits: Level,
    motion: Float[Array, "4 4"],
    box: Float[Array, " 6"],
    is_last: Bool[Array, ""],
) -> SearchState:
    """Refine one motion by Gauss-Newton on all levels but the finest one, or on that alone.

    No other motion competes, so that brightness can be estimated from the first level on.
    """
    count = visits.number.shape[0]
    is_finest = jnp.arange(count) == count - 1
    visited = (is_finest == is_last) | (count == 1)
    visits = visits._replace(is_first=jnp.zeros(count, bool), islands=visited.astype(jnp.int32))
    options = replace(frames.options, min_overlap=jnp.minimum(frames.options.min_overlap, REFINED_OVERLAP))
    views = visits.reference.grey.shape[1]
    start = SearchState(motion[None], box, Brightness.unchanged(views), jnp.float32(jnp.inf))
    keys = jax.random.split(jax.random.key(0), (count, 1))
    frames = frames._replace(options=options)
    search, _, _ = _search_levels(frames, REFINER, start, visits, keys, centre=motion, record=False, skips_empty=True)
    return search


def _search_levels(
    frames: Frames,
    solver: Solver,
    start: SearchState,
    visits: Level,
    keys: PRNGKeyArray,
    *,
    centre: Float[Array, "4 4"],
    record: bool,
    skips_empty: bool = False,
) -> tuple[SearchState, Float[Array, "l iterations"], Population | None]:
    """Search some levels one after the other, each from the islands of the last, about a fixed centre.

    Whether levels without islands are skipped is static: if every level has some, the test would only cost time.
    """
    # jitted, so that it is traced once for its shapes and for the scan
    search_level = jax.jit(partial(_search_level, frames, solver, centre, record))

    def visit_level(search: SearchState, visit: tuple[Level, PRNGKeyArray]) -> Any:
        blank = jax.tree.map(
            lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(search_level, search, visit)[1]
        )
        return jax.lax.cond(visit[0].islands > 0, search_level, lambda search, _: (search, blank), search, visit)

    visit_one = visit_level if skips_empty else search_level
    search, (histories, populations) = jax.lax.scan(visit_one, start, (visits, keys))
    return search, histories, populations


def _search_level(
    frames: Frames,
    solver: Solver,
    centre: Float[Array, "4 4"],
    record: bool,
    search: SearchState,
    visit: tuple[Level, PRNGKeyArray],
) -> tuple[SearchState, tuple[Float[Array, " iterations"], Population | None]]:
    """Search one level, from the islands of the last one, in the paper's five steps.

    Take the reference's points (given by the visit), estimate brightness and noise, and choose search coordinates. Then
    let the solver minimise E on every island, and pass the best distinct motions on to the next level.
    """
    (target, options, exchanged), places = frames, search.islands.shape[0]
    level, keys = visit
    objective, brightness = fit_objective(level, target, options, search.islands[0], exchanged)
    basis = jnp.eye(6)
    if options.precondition:
        basis = preconditioner(reference_curvature(objective.sample(options.estimation_points).merged()))
    problem = Problem(objective=objective, origin=search.islands[0], basis=basis, centre=centre)
    island = partial(_search_island, problem, solver.at_level(level.number), options, search.box, record)
    inhabited = jnp.arange(places) < level.islands
    if places == 1:
        results = jax.tree.map(lambda leaf: leaf[None], island(keys[0], search.islands[0], inhabited[0]))
    else:
        results = jax.vmap(island)(keys, search.islands, inhabited)
    found, errors, history, trail = results
    population = None
    if trail is not None:
        about, box = search.islands[0], search.box
        if options.precondition:
            about, box = centre, jnp.repeat(reach_of(options), 3)
        motions, error = (jnp.concatenate(jnp.unstack(leaf), axis=1) for leaf in trail)
        population = Population(level.number, log(motions), error, log(about), box)
    if options.refine and places > 1:
        judge = comparable_objective(level, target, options, exchanged)
        total = jax.vmap(lambda motion: evidence(judge, motion).total)(found)
        errors = jnp.where(jnp.isfinite(errors), -total, jnp.inf)
    order = best_distinct(found, errors, places)
    rival = search.rival
    if places > 1 and not options.refine:  # with `refine` the contest measures it
        ratio = rival_error(found, errors, order[0]) / jnp.maximum(errors[order[0]], LEAST_ERROR)
        rival = jnp.where(level.islands > 1, ratio, rival)
    search = SearchState(found[order], search.box * options.bounds_factor, brightness, rival)
    return search, (history[order[0]], population)


def _search_island(
    problem: Problem,
    solver: Solver,
    options: AlignmentOptions,
    box: Float[Array, " 6"],
    record: bool,
    key: PRNGKeyArray,
    origin: Float[Array, "4 4"],
    inhabited: Bool[Array, ""],
) -> tuple[Float[Array, "4 4"], Float[Array, ""], Float[Array, " iterations"], Candidates | None]:
    """Search one level from one origin; with `record`, also return the candidates, [iterations, P, 4, 4]."""
    if options.precondition:
        problem = replace(problem, origin=origin, reach=reach_of(options), searched=inhabited)
        reach = jnp.abs(unconditioner(problem.basis)) @ box
        bounds = Bounds(-reach, reach)
        guess = jnp.zeros((1, 6))
    else:
        problem = replace(problem, origin=jnp.eye(4), searched=inhabited)
        bounds = Bounds(log(origin) - box, log(origin) + box)
        guess = log(origin)[None]
    solution = solve(key, solver, problem, guess, bounds, record)
    trail = solution.trail
    if trail is not None:
        trail = trail._replace(x=problem.transform(trail.x))
    return problem.transform(solution.x), solution.error, solution.history, trail


def _origins(frames: Frames, level: Level, guesses: Float[Array, "g 4 4"], key: PRNGKeyArray) -> Float[Array, "i 4 4"]:
    """Return the motions where the coarsest level's islands start.

    These are the best guess or, with scouts, the best distinct ones of many motions drawn about it.
    """
    target, options, exchanged = frames
    places = max(options.islands)
    if options.refine:
        judge = comparable_objective(level, target, options, exchanged)

        def errors_of(motions: jax.Array) -> jax.Array:
            return -jax.lax.map(
                lambda motion: evidence(judge, motion, SCOUTED_POINTS).total, motions, batch_size=SCOUTS_AT_ONCE
            )

        leader = guesses[jnp.argmin(errors_of(guesses))] if len(guesses) > 1 else guesses[0]
    else:
        objective = level_objective(level, target, options, unchanged_brightness(level))
        leader = _best_guess(objective, guesses)
        if options.scouts:
            objective, _ = fit_objective(level, target, options, leader, exchanged)

        def errors_of(motions: jax.Array) -> jax.Array:
            return objective.score(motions)[0]

    if not options.scouts:
        return jnp.repeat(leader[None], places, axis=0)
    spread = jnp.repeat(jnp.stack([jnp.float32(s) for s in options.scout_spread]), 3)
    twists = spread * jax.random.normal(key, (options.scouts, 6))
    if options.refine:  # the translations vary in scale
        farther = jnp.linspace(*SCOUT_RANGE, options.scouts)[:, None]
        twists *= jnp.concatenate([jnp.repeat(farther, 3, axis=1), jnp.ones((options.scouts, 3))], axis=1)
    scouts = leader @ exp(twists.at[0].set(0.0))
    return scouts[best_distinct(scouts, errors_of(scouts), places)]
