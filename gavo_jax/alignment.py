"""Coarse to fine: the motion between two RGB-D frames (paper, section 3).

`align_views` is the method in one place. From the coarsest level to the finest it takes the reference's points,
estimates what the data say about brightness and noise, chooses search coordinates, lets a solver minimise E there, and
starts the next level from its best candidate. Everything from images to `Alignment` is one compiled program.
"""

import enum
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Integer, PRNGKeyArray

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.errors import GavoError
from gavo_jax.levels import ImagePlane, Levels
from gavo_jax.objective import (
    Brightness,
    Linearization,
    Objective,
    Problem,
    Reference,
    Residuals,
    Scales,
    depth_trust,
    estimate_brightness,
    estimate_scales,
    explained_share,
    make_references,
    preconditioner,
    reference_curvature,
    unconditioner,
)
from gavo_jax.program_cache import CachedProgram
from gavo_jax.pyramid import LEVELS, Pyramid, build_pyramid, make_atlas
from gavo_jax.se3 import departure_from_rigid, exp, log, rigid, rigid_inverse
from gavo_jax.settings import AlignmentOptions, Settings, as_settings
from gavo_jax.solvers.base import Bounds, Candidates, Solver, solve
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.warp import Target, pack_target


class AlignmentStatus(enum.IntEnum):
    """What is known of a pair's result; `sentence` says it for people."""

    OK = 0
    LOW_OVERLAP = 1
    LOW_TEXTURE = 2
    AMBIGUOUS = 3
    HIGH_ERROR = 4
    NO_DEPTH = 5
    NOT_FINITE = 6
    UNREADABLE = 7
    BLANK = 8
    NOISE = 9
    FROZEN = 10
    DEPTH_UNITS = 11
    PARTIAL_DEPTH = 12
    BAD_TIMESTAMP = 13
    GAP = 14
    NO_REFERENCE = 15
    NOT_RIGID = 16

    @property
    def sentence(self) -> str:
        """One sentence for people."""
        return _SENTENCES[self]


_SENTENCES = {
    AlignmentStatus.OK: "The motion was found.",
    AlignmentStatus.LOW_OVERLAP: "Too few of the reference's pixels land inside the target.",
    AlignmentStatus.LOW_TEXTURE: "The images leave at least one direction of the motion undetermined.",
    AlignmentStatus.AMBIGUOUS: "Distinct motions explain the images about equally well.",
    AlignmentStatus.HIGH_ERROR: "The best motion found does not explain the target image.",
    AlignmentStatus.NO_DEPTH: "A frame has too few depth readings.",
    AlignmentStatus.NOT_FINITE: "The error is not a finite number.",
    AlignmentStatus.UNREADABLE: "The frame could not be read.",
    AlignmentStatus.BLANK: "The image is black, white or saturated.",
    AlignmentStatus.NOISE: "The image is noise.",
    AlignmentStatus.FROZEN: "The image is the last one once more.",
    AlignmentStatus.DEPTH_UNITS: "The depth's range is unlikely: its units may not be the camera's.",
    AlignmentStatus.PARTIAL_DEPTH: "Much of the usual depth is missing.",
    AlignmentStatus.BAD_TIMESTAMP: "The time stamp is not later than the last one, or out of order.",
    AlignmentStatus.GAP: "Frames are missing before this one.",
    AlignmentStatus.NO_REFERENCE: "There is no usable frame before this one.",
    AlignmentStatus.NOT_RIGID: "The result is no rigid motion: this machine computes wrong numbers (see gavo doctor).",
}


class Alignment(NamedTuple):
    """The motion between two frames, with what is known about it.

    A batch holds the same fields with a leading axis, and `status` as an integer array.
    """

    target_T_reference: Float[Array, "4 4"]
    """Maps points of the reference camera into the target camera, metres. On the host it is a NumPy array of float64
    with an orthonormal rotation."""
    xi: Float[Array, " 6"]
    """Its logarithm (v, w): metres, radians."""
    error: Float[Array, ""]
    """E at the finest level, squared grey levels."""
    overlap: Float[Array, ""]
    """Share of the reference's points that land inside the target."""
    covariance: Float[Array, "6 6"]
    """Covariance of δ in target_T_reference · exp(δ), δ = (v, w) in metres and radians."""
    status: Any
    """`AlignmentStatus`."""
    history: Float[Array, " iterations"]
    """Best error after every iteration of every level, coarsest first (the levels' errors are not comparable)."""

    @property
    def undetermined(self) -> str:
        """Of a pair that is `LOW_TEXTURE` the direction of motion that the images constrain least, in the axes of the
        reference camera: one or two of ξ's six, as words. Else empty.
        """
        covariance = np.asarray(self.covariance, np.float64)
        if self.status != AlignmentStatus.LOW_TEXTURE or not np.isfinite(covariance).all():
            return ""
        tolerable = np.repeat([MAX_TRANSLATION_DEVIATION, MAX_ROTATION_DEVIATION], 3)
        _, vectors = np.linalg.eigh(covariance / np.outer(tolerable, tolerable))
        share = vectors[:, -1] ** 2
        main = [axis for axis in np.argsort(-share)[:2] if share[axis] > share.max() / 4]
        return " with ".join(f"{('translation along', 'rotation about')[axis // 3]} {'xyz'[axis % 3]}" for axis in main)

    @property
    def sentence(self) -> str:
        """What is known of the result, in one sentence for people."""
        words = self.status.sentence
        return f"{words[:-1]}, above all {self.undetermined}." if self.undetermined else words


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
MAX_TRANSLATION_DEVIATION = 0.05
"""Metres: a larger standard deviation of a translation makes a pair `LOW_TEXTURE`."""
MAX_ROTATION_DEVIATION = 0.05
"""Radians, likewise for the rotation."""
MAX_RIVAL = 1.1
"""Error of a second mode, over the best one's, below which a pair is `AMBIGUOUS`. Only rival islands can tell."""


MAX_DEPARTURE = 1e-4
"""Largest entry of RᵀR − I; rounding alone leaves a hundredth of it. Beyond, a pair is `NOT_RIGID`."""
SHARED_ERRORS = 9.0
"""Factor on the covariance for errors that the whole image shares (interpolation, the choice of points, the pyramid's
rounding), of which its scatter from tile to tile tells nothing; measured by `benchmarks/calibration.py`."""


class Exchanged(NamedTuple):
    """The two frames of a pair with their parts exchanged, for the symmetric error."""

    references: Reference
    """Points of the target frame, as of `prepare_reference`."""
    target: Target
    """The anchor's frame, as of `prepare_target`."""


def levels_of(camera: Camera, solver: Solver, options: AlignmentOptions) -> Levels:
    """The levels that a solver searches, with as many points as the options say."""
    return Levels.of(camera, solver.levels, options.points)


def prepare_reference(pyramid: Pyramid, camera: Camera, levels: Levels) -> Reference:
    """What a search needs of a reference frame: points of a solver's levels, [L, N], coarsest first."""
    return make_references(pyramid, camera, levels)


def prepare_target(pyramid: Pyramid, levels: Levels) -> Target:
    """What a search needs of a target frame: a solver's levels packed for sampling, coarsest first."""
    return pack_target(make_atlas([pyramid[number] for number in levels.numbers]))


def prepare_pair(
    reference: Pyramid, target: Pyramid, camera: Camera, levels: Levels, options: AlignmentOptions
) -> tuple[Reference, Target, Exchanged | None]:
    """What a search needs of two frames."""
    view = prepare_reference(reference, camera, levels)
    exchanged = None
    if options.symmetric:
        exchanged = Exchanged(prepare_reference(target, camera, levels), prepare_target(reference, levels))
    return view, prepare_target(target, levels), exchanged


class Level(NamedTuple):
    """What changes from level to level; with a leading axis L the input of the scan over the levels."""

    number: Integer[Array, ""]
    """In the pyramid; 0 is the full image."""
    is_first: Bool[Array, ""]
    plane: ImagePlane
    reference: Reference
    """[V, N]: the points of all views as rays of the anchor camera."""
    points: Integer[Array, ""]
    """Points a view on this level; places from there on are empty."""
    columns: Integer[Array, ""]
    """Points a row."""
    views: Integer[Array, ""]
    """Views that count; the points of the others have lost their readings."""
    islands: Integer[Array, ""]
    """Independent populations."""
    depth_weight: Float[Array, ""]
    """Of the depth cost."""
    exchanged: Reference | None = None
    """[1, N]: the target's points, where the error is symmetric."""
    readout: Float[Array, ""] | None = None
    """Of a rolling shutter; see `Objective`."""

    @property
    def is_undecided(self) -> Bool[Array, ""]:
        """Whether the motion that the level starts from may be far off: nothing is aligned yet, or several compete."""
        return self.is_first | (self.islands > 1)


def stack_levels(
    views: tuple[Reference, ...],
    camera: Camera,
    levels: Levels,
    options: AlignmentOptions,
    exchanged: Exchanged | None = None,
    readout: Float[Array, ""] | None = None,
) -> Level:
    """The visits of a search to the levels, [L], coarsest first."""
    numbers, count = levels.numbers, len(levels.numbers)
    rows, columns = np.array(levels.grids).T
    counted = jnp.array([min(options.views[number], len(views)) for number in numbers])
    reference: Reference = jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=1), *views)
    left_out = jnp.arange(len(views))[:, None] >= counted[:, None, None]
    points = reference.points._replace(q=jnp.where(left_out, 0.0, reference.points.q))
    return Level(
        number=jnp.array(numbers),
        is_first=jnp.arange(count) == 0,
        plane=levels.planes(camera),
        reference=reference._replace(points=points),
        points=jnp.array(rows * columns),
        columns=jnp.array(columns),
        views=counted,
        islands=jnp.array([options.islands[number] for number in numbers]),
        depth_weight=jnp.stack([jnp.float32(options.depth_weight[number]) for number in numbers]),
        exchanged=None if exchanged is None else jax.tree.map(lambda leaf: leaf[:, None], exchanged.references),
        readout=None if readout is None else jnp.full(count, readout),
    )


def visited_levels(numbers: tuple[int, ...], options: AlignmentOptions) -> tuple[int, ...]:
    """The levels that a solver searches, coarsest first; with `refine` those on which islands compete."""
    competing = tuple(number for number in numbers if options.islands[number] > 1)
    return competing if options.refine and competing else numbers


def level_objective(level: Level, target: Target, options: AlignmentOptions, brightness: Brightness) -> Objective:
    """E of one level under a brightness model, its scales still those of the paper's error."""
    reference = level.reference._replace(grey=brightness.seen(level.reference.grey))
    charge = 0.0 if options.outside_cost is None else jnp.where(level.islands > 1, options.outside_cost, 0.0)
    return Objective(
        reference=reference,
        target=target,
        plane=level.plane,
        scales=Scales.unit(),
        min_overlap=jnp.float32(options.min_overlap),
        outside_cost=jnp.float32(charge),
        count=level.points,
        views=level.views,
        columns=level.columns,
        centred=level.is_undecided if options.centred else None,
        readout=level.readout,
        loss=options.loss,
        use_depth=options.depth,
    )


def fit_objective(
    level: Level,
    target: Target,
    options: AlignmentOptions,
    guess: Float[Array, "4 4"],
    exchanged: Exchanged | None = None,
) -> tuple[Objective, Brightness]:
    """E of one level with everything that is estimated from the data at the motion that it starts from.

    On the first level nothing is aligned yet, and while several islands compete the leader may be wrong. A regression
    of one image on the other would only tell that they differ, its gain would fall towards 0 and reward motions that
    hide contrast; and residuals of a wrong motion say nothing of how much depth is worth. So brightness is left alone
    there (`Objective.centred` takes care of exposure), and depth has its largest weight on the first level.
    """
    brightness = unchanged_brightness(level)
    objective = level_objective(level, target, options, brightness)
    few = objective.sample(options.estimation_points)
    residuals = few.residuals(guess)
    if options.brightness:
        grey = few.reference.grey
        estimated = estimate_brightness(grey, residuals)
        brightness = jax.tree.map(lambda a, b: jnp.where(level.is_undecided, a, b), brightness, estimated)
        objective = level_objective(level, target, options, brightness)
        relit = residuals.grey + residuals.inside * (grey - brightness.seen(grey))
        residuals = residuals._replace(grey=relit)
    if options.robust_scale:
        scales = estimate_scales(residuals, level.depth_weight)
        if options.doubt_depth:
            trust = jnp.where(level.is_first, 1.0, depth_trust(objective, guess, scales))
            scales = scales._replace(depth_weight=trust * scales.depth_weight)
        objective = replace(objective, scales=scales)
    if exchanged is not None and level.exchanged is not None:
        readout = None if level.readout is None else -level.readout
        swapped = level._replace(reference=level.exchanged, exchanged=None, readout=readout)
        backward, _ = fit_objective(swapped, exchanged.target, options, rigid_inverse(guess))
        objective = replace(objective, backward=replace(backward, scales=objective.scales))
    return objective, brightness


def objectives_of(
    reference: Pyramid,
    target: Pyramid,
    camera: Camera,
    numbers: tuple[int, ...],
    options: AlignmentOptions,
    target_T_reference: Float[Array, "4 4"],
) -> list[Objective]:
    """E of some levels of a pair, each as a search that starts its level at one motion would minimise it."""
    levels = Levels.of(camera, numbers, options.points)
    view, packed, exchanged = prepare_pair(reference, target, camera, levels, options)
    stacked = stack_levels((view,), camera, levels, options, exchanged)
    rows = [jax.tree.map(lambda leaf, place=place: leaf[place], stacked) for place in range(len(numbers))]
    return [fit_objective(level, packed, options, target_T_reference, exchanged)[0] for level in rows]


def unchanged_brightness(level: Level) -> Brightness:
    """Every view as bright as the target."""
    return Brightness.unchanged(level.reference.grey.shape[0])


def _best_guess(objective: Objective, guesses: Float[Array, "g 4 4"]) -> Float[Array, "4 4"]:
    """The guess with the smallest grey residuals.

    Unscaled residuals are compared: each guess would have its own scales, and E in units of them says nothing.
    """
    if guesses.shape[0] == 1:
        return guesses[0]
    plain = replace(objective, use_depth=False, loss=jnp.sqrt, outside_cost=jnp.float32(0.0))
    return guesses[jnp.argmin(jax.vmap(lambda guess: plain.error(guess)[0])(guesses))]


class Population(NamedTuple):
    """The candidates of the levels' searches, [L], iteration after iteration, for people to look at."""

    level: Integer[Array, "..."]
    xi: Float[Array, "... iterations p 6"]
    """Twists of target_T_reference (m, rad); those of all islands. NaN from the iteration that stagnation, or a level's
    smaller number of iterations, left out."""
    error: Float[Array, "... iterations p"]
    """E, squared grey levels; +inf where a candidate is worthless."""
    centre: Float[Array, "... 6"]
    """Twist that the search is held about, and `half_widths` of the box it is held in."""
    half_widths: Float[Array, "... 6"]

    def trimmed(self) -> "Population":
        """One level's candidates on the host, without the places and iterations that the level left empty."""
        host = jax.device_get(self)
        rows, places = ~np.isnan(host.error).all(axis=1), ~np.isnan(host.xi[..., 0]).all(axis=0)
        return host._replace(xi=host.xi[rows][:, places], error=host.error[rows][:, places])


class Search(NamedTuple):
    """What one level hands on to the next."""

    islands: Float[Array, "i 4 4"]
    """Motions, the best one first."""
    box: Float[Array, " 6"]
    """Half-widths of the search box, metres and radians."""
    brightness: Brightness
    rival: Float[Array, ""]
    """Error of the second-best mode over the best one's, where several islands competed last; +inf without one."""


def align_views(
    views: tuple[Reference, ...],
    target: Target,
    camera: Camera,
    levels: Levels,
    solver: Solver,
    options: AlignmentOptions,
    key: PRNGKeyArray,
    guesses: Float[Array, "g 4 4"],
    record: bool = False,
    exchanged: Exchanged | None = None,
    readout: Float[Array, ""] | None = None,
) -> tuple[Alignment, Population | None]:
    """Motion from an anchor camera to the target camera, coarse to fine; traced, not compiled by itself.

    The levels are one `lax.scan`: what a level does is compiled once and serves all of them.

    Args:
        views: Of `prepare_reference`; the first one's frame is the anchor, in whose camera the others' points are too.
        target: Of `prepare_target`, for the same solver.
        camera: Camera of level 0.
        levels: Of `levels_of`.
        solver: Any `solvers.base.Solver` with an entry a level.
        options: What is minimised.
        key: Random key.
        guesses: Motions to start from; the best by error leads, so that a wrong one costs nothing.
        record: Whether the candidates are kept (static).
        exchanged: What the `symmetric` error needs; None where it is not asked for.
        readout: Time that the shutter takes from the first to the last row, over the time between anchor and target;
            None where all rows are exposed at once.

    Returns:
        The alignment and, where they were recorded, the candidates of each level of `visited_levels`.
    """
    visits = stack_levels(views, camera, levels, options, exchanged, readout)
    first, finest = (jax.tree.map(lambda leaf, at=at: leaf[at], visits) for at in (0, -1))
    searched = visited_levels(levels.numbers, options)
    keys = jax.random.split(key, (len(searched) + 1, max(options.islands)))
    origins = _origins(first, target, options, guesses, keys[-1, 0], exchanged)
    start = Search(
        islands=origins,
        box=jnp.repeat(jnp.stack([jnp.float32(half) for half in options.bounds]), 3),
        brightness=unchanged_brightness(first),
        rival=jnp.float32(jnp.inf),
    )
    of_levels = partial(_search_levels, target=target, options=options, exchanged=exchanged, centre=origins[0])
    places = np.array([levels.numbers.index(number) for number in searched])
    rows = visits if searched == levels.numbers else jax.tree.map(lambda leaf: leaf[places], visits)
    search, histories, populations = of_levels(solver, start, rows, keys[:-1], record=record)
    if options.refine:
        # nothing competes any more, and the brightness can be told from the first level on
        visits = visits._replace(is_first=jnp.zeros_like(visits.is_first), islands=jnp.ones_like(visits.islands))
        finest = jax.tree.map(lambda leaf: leaf[-1], visits)
        winner = search._replace(islands=search.islands[:1], box=start.box)
        search, *_ = of_levels(REFINER, winner, visits, jax.random.split(key, (len(levels.numbers), 1)), record=False)
    iterations = [solver.iterations[number] for number in searched]
    history = jnp.concatenate([row[:count] for row, count in zip(histories, iterations, strict=True)])
    objective = level_objective(finest, target, options, search.brightness).merged()
    return _conclude(objective, search, finest, options, history, origins[0]), populations


REFINER = GaussNewton(iterations=(8, 12, 12, 15, 20))
"""What refines the winner of many islands. These are small and widely spread, which finds the basin, not its middle: on
pairs 15 frames apart such a population ends up to 10° from where this method goes on from it."""


def _search_levels(
    solver: Solver,
    start: Search,
    visits: Level,
    keys: PRNGKeyArray,
    *,
    target: Target,
    options: AlignmentOptions,
    exchanged: Exchanged | None,
    centre: Float[Array, "4 4"],
    record: bool,
) -> tuple[Search, Float[Array, "l iterations"], Population | None]:
    """Search some levels, one after the other, each from the islands of the last; held about a centre."""
    places = start.islands.shape[0]

    def search_level(
        search: Search, visit: tuple[Level, PRNGKeyArray]
    ) -> tuple[Search, tuple[jax.Array, Population | None]]:
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
            about = centre if options.precondition else search.islands[0]
            motions, error = (jnp.concatenate(jnp.unstack(leaf), axis=1) for leaf in trail)
            population = Population(level.number, log(motions), error, log(about), search.box)
        order = _best_distinct(found, errors, places)
        rival = search.rival if places == 1 else jnp.where(level.islands > 1, _rival(found, errors), search.rival)
        search = Search(found[order], search.box * options.bounds_factor, brightness, rival)
        return search, (history[order[0]], population)

    search, (histories, populations) = jax.lax.scan(search_level, start, (visits, keys))
    return search, histories, populations


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
    """Search one level from one origin; with `record` also the candidates, as motions [iterations, P, 4, 4]."""
    if options.precondition:
        problem = replace(problem, origin=origin, reach=jnp.stack([box[0], box[3]]), searched=inhabited)
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


def _origins(
    level: Level,
    target: Target,
    options: AlignmentOptions,
    guesses: Float[Array, "g 4 4"],
    key: PRNGKeyArray,
    exchanged: Exchanged | None,
) -> Float[Array, "i 4 4"]:
    """Where the coarsest level's islands start: at the best guess, or at the best distinct ones of many motions drawn
    about it.
    """
    objective = level_objective(level, target, options, unchanged_brightness(level))
    leader = _best_guess(objective, guesses)
    places = max(options.islands)
    if not options.scouts:
        return jnp.repeat(leader[None], places, axis=0)
    objective, _ = fit_objective(level, target, options, leader, exchanged)
    spread = jnp.repeat(jnp.stack([jnp.float32(s) for s in options.scout_spread]), 3)
    twists = spread * jax.random.normal(key, (options.scouts, 6))
    scouts = leader @ exp(twists.at[0].set(0.0))
    errors, _ = objective.score(scouts)
    return scouts[_best_distinct(scouts, errors, places)]


NICHE = (0.08, 0.08)
"""Metres and radians of ξ within which two motions count as one mode."""


def _niches(motions: Float[Array, "n 4 4"]) -> Float[Array, "n 6"]:
    """ξ in units of `NICHE`: what lies less than 1 apart counts as one mode."""
    return log(motions) / jnp.repeat(jnp.stack([jnp.float32(radius) for radius in NICHE]), 3)


def _near(places: Float[Array, "n 6"], index: Integer[Array, ""]) -> Bool[Array, " n"]:
    """Which motions share the mode of one of them."""
    return jnp.sum((places - places[index]) ** 2, axis=1) < 1.0


def _best_distinct(motions: Float[Array, "n 4 4"], errors: Float[Array, " n"], count: int) -> Integer[Array, " k"]:
    """Indices of the `count` best motions with no two of one mode, best first (clearing, Petrowski 1996).

    Where there are fewer modes than that, the last places go to the best motions that are left over.
    """
    if count == 1:
        return jnp.argmin(errors)[None]
    places = _niches(motions)

    def pick(cleared: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        best = jnp.argmin(cleared)
        return jnp.where(_near(places, best), cleared + CLEARED, cleared).at[best].set(jnp.inf), best

    worthless = jnp.where(jnp.isfinite(errors), jnp.minimum(errors, CLEARED / 2), 10 * CLEARED)
    return jax.lax.scan(pick, worthless, length=count)[1]


def _rival(motions: Float[Array, "n 4 4"], errors: Float[Array, " n"]) -> Float[Array, ""]:
    """Error of the best motion outside the winner's mode, over the winner's; +inf where there is none."""
    best = jnp.argmin(errors)
    others = jnp.where(_near(_niches(motions), best), jnp.inf, errors)
    return jnp.min(others) / jnp.maximum(errors[best], 1e-6)


CLEARED = 1e9
"""Added to the error of a motion whose mode is taken; above any error."""


def _conclude(
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


class Images(NamedTuple):
    """Grey [H, W] and depth [H, W] of one frame, or of a batch with a leading axis."""

    grey: Any
    depth: Any


def _align_images(
    reference: Images,
    target: Images,
    camera: Camera,
    solver: Solver,
    options: AlignmentOptions,
    key: PRNGKeyArray,
    guess: Float[Array, "4 4"],
) -> Alignment:
    before, after = (
        build_pyramid(frame.grey, frame.depth, camera.depth_scale, LEVELS) for frame in (reference, target)
    )
    levels = levels_of(camera, solver, options)
    view, packed, exchanged = prepare_pair(before, after, camera, levels, options)
    return align_views((view,), packed, camera, levels, solver, options, key, guess[None], exchanged=exchanged)[0]


POINTS_SIDE_BY_SIDE = 2**20
"""Points a level of the pairs that an accelerator aligns at once, some 200 pairs by most presets: each takes memory for
its images' pyramids (some 10 MB) and its candidates' residuals. Reckoned, not measured."""


@partial(CachedProgram, returns=(Alignment,))
def _align_pairs(count, references, targets, camera, solver, options, keys, guesses):
    """The first `count` of B pairs: one after the other on a CPU, which one pair already fills; side by side elsewhere,
    `POINTS_SIDE_BY_SIDE` at a time.

    The count is an input, so that XLA compiles one and the same loop body for one pair and for many, whose results then
    agree to the last bit; unrolled, a single pair would round differently.
    """

    def one(i):
        reference, target, key, guess = jax.tree.map(lambda leaf: leaf[i], (references, targets, keys, guesses))
        return _align_images(reference, target, camera, solver, options, key, guess)

    if jax.default_backend() != "cpu":
        at_once = max(1, POINTS_SIDE_BY_SIDE // levels_of(camera, solver, options).most_points)
        return jax.lax.map(one, jnp.arange(keys.shape[0]), batch_size=at_once)
    empty = jax.tree.map(lambda leaf: jnp.zeros((keys.shape[0], *leaf.shape), leaf.dtype), jax.eval_shape(one, 0))
    return jax.lax.fori_loop(
        0, count, lambda i, results: jax.tree.map(lambda all, new: all.at[i].set(new), results, one(i)), empty
    )


def align_rows(sides, camera, settings, keys, guesses) -> Alignment:
    """`align_batch` of images that are stacked already, its results on the device."""
    count = len(guesses)
    if count == 1:  # padded to two rows, of which one is computed
        sides, keys, guesses = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), (sides, keys, guesses))
    result = _align_pairs(
        jnp.int32(count),
        *sides,
        camera.rectified(),
        settings.solver,
        settings.alignment,
        keys,
        guesses,
    )
    return jax.tree.map(lambda leaf: leaf[:count], result)


def align(
    reference: Frame | tuple[Any, Any],
    target: Frame | tuple[Any, Any],
    camera: Camera,
    settings: Settings | Solver | None = None,
    *,
    key: PRNGKeyArray | None = None,
    guess: Float[Array | np.ndarray, "4 4"] | None = None,
    solver: Solver | None = None,
    options: AlignmentOptions | None = None,
) -> Alignment:
    """Estimate the motion of the camera between two RGB-D frames.

    Args:
        reference: Frame t: a `Frame`, or a pair of arrays (grey, depth) of [H, W]; depth in units of
            `camera.depth_scale` a metre, 0 = no reading.
        target: Frame t + 1.
        camera: Their camera. Lens distortion, where it has any, is taken out first.
        settings: What searches and what is minimised; a solver stands for the default settings with that solver.
        key: Random key; `jax.random.key(0)` by default. The same key gives the same result, bit for bit.
        guess: A motion target_T_reference to start from; the identity by default.
        solver: Takes the place of the settings' solver.
        options: Deprecated: `alignment` of the settings.

    Returns:
        `Alignment`; the camera's own motion is the inverse of its `target_T_reference`.

    Raises:
        GavoError: The images are not of the camera's size, or of a wrong shape.
    """
    settings = as_settings(settings, solver, alignment=options)
    sides = [stacked_images([frame], camera) for frame in (reference, target)]
    keys = (jax.random.key(0) if key is None else key)[None]
    guesses = (jnp.eye(4) if guess is None else jnp.asarray(guess, jnp.float32))[None]
    result = align_rows(sides, camera, settings, keys, guesses)
    return on_host(jax.tree.map(lambda leaf: leaf[0], result))


def align_batch(
    references: Any,
    targets: Any,
    camera: Camera,
    settings: Settings | Solver | None = None,
    *,
    keys: PRNGKeyArray | None = None,
    guesses: Float[Array | np.ndarray, "b 4 4"] | None = None,
    solver: Solver | None = None,
    options: AlignmentOptions | None = None,
) -> Alignment:
    """Align B pairs in one compiled call; what it takes of memory beside the images does not grow with a large B.

    Args:
        references: B frames: a list of `Frame` or of (grey, depth), or a pair of arrays of [B, H, W] from a camera
            without distortion.
        targets: The other B frames, alike.
        camera: Their camera.
        settings: As in `align`.
        keys: [B] random keys; `jax.random.split(jax.random.key(0), B)` by default.
        guesses: [B, 4, 4] motions to start from; the identity by default.
        solver: As in `align`.
        options: As in `align`.

    Returns:
        An `Alignment` of NumPy arrays with a leading axis B; `status` is an integer array.

    Raises:
        GavoError: The images are not of the camera's size, or the two sides differ in number.
    """
    settings = as_settings(settings, solver, alignment=options)
    sides = [stacked_images(side, camera) for side in (references, targets)]
    count = len(sides[0].grey)
    if len(sides[1].grey) != count:
        raise GavoError(f"align_batch: {count} references but {len(sides[1].grey)} targets")
    keys = jax.random.split(jax.random.key(0), count) if keys is None else keys
    guesses = jnp.tile(jnp.eye(4), (count, 1, 1)) if guesses is None else jnp.asarray(guesses, jnp.float32)
    return on_host(align_rows(sides, camera, settings, keys, guesses))


def on_host(alignment: Alignment) -> Alignment:
    """The same result, or batch of results, as NumPy arrays: motions rigid in double precision, and the status of a
    single result an `AlignmentStatus`.
    """
    host = jax.device_get(alignment)
    status = host.status if np.ndim(host.status) else AlignmentStatus(int(host.status))
    return host._replace(target_T_reference=rigid(host.target_T_reference), status=status)


def no_alignment(status: AlignmentStatus) -> Alignment:
    """The result of a pair that could not be aligned at all: no motion, nothing known."""
    nothing: dict[str, Any] = {
        "target_T_reference": np.eye(4),
        "xi": np.zeros(6, np.float32),
        "error": np.float32(np.nan),
        "overlap": np.float32(0.0),
        "covariance": np.full((6, 6), np.nan, np.float32),
        "history": np.zeros(0, np.float32),
    }
    return Alignment(**nothing, status=status)


def _rectified_images(frame: Frame | tuple[Any, Any], camera: Camera) -> Images:
    grey, depth = (frame.grey, frame.depth) if isinstance(frame, Frame) else frame
    expected = (camera.height, camera.width)
    for name, image in (("grey", grey), ("depth", depth)):
        if np.shape(image) != expected:
            raise GavoError(f"{name} image is of shape {np.shape(image)}, the camera's is {expected}")
    if camera.is_distorted:
        grey, depth = camera.undistort(np.asarray(grey), np.asarray(depth))
    return Images(grey, depth)


def stacked_images(side: Any, camera: Camera) -> Images:
    """B frames as `align_batch` takes them, stacked and free of lens distortion."""
    if isinstance(side, tuple) and len(side) == 2 and np.ndim(side[0]) == 3:
        if camera.is_distorted:
            return stacked_images(list(zip(*side, strict=True)), camera)
        if np.shape(side[0])[1:] != (camera.height, camera.width) or np.shape(side[0]) != np.shape(side[1]):
            raise GavoError(f"images are of shape {np.shape(side[0])} and {np.shape(side[1])}, not [B, H, W] alike")
        return Images(jnp.asarray(side[0]), jnp.asarray(side[1]))
    images = [_rectified_images(frame, camera) for frame in side]
    return Images(jnp.stack([i.grey for i in images]), jnp.stack([i.depth for i in images]))
