"""Checks of the compiled kernels, one each, against `equations` at the sizes in use.

Does JAX compute correct numbers on this machine? A compiler may be right for small arrays and wrong for large ones, or
wrong only where it fuses two operations. So each check compiles a kernel as the presets call it, with as many rows, and
compares it with float64.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gavo_jax import se3
from gavo_jax.alignment import modes
from gavo_jax.camera import Camera
from gavo_jax.image.levels import Levels, image_plane
from gavo_jax.image.pyramid import PyramidLevel, make_atlas
from gavo_jax.image.sampling import Target, pack_target
from gavo_jax.image.warp import Points, warp
from gavo_jax.objective.error import Objective, Scales
from gavo_jax.objective.losses import geman_mcclure
from gavo_jax.objective.points import Reference
from gavo_jax.objective.problem import TILES, Problem
from gavo_jax.presets import METHODS, PRESETS, preset
from gavo_jax.selfcheck import equations
from gavo_jax.settings import Settings
from gavo_jax.solvers.base import Bounds, largest
from gavo_jax.solvers.genetic import GeneticAlgorithm, GeneticState
from gavo_jax.solvers.operators import SMALLEST_CHANCE

BORDERS = tuple(2**k + offset for k in range(11, 15) for offset in (-1, 0, 1))
"""Numbers of rows around powers of two, where compilers switch between forms of a loop."""
ENDS = (BORDERS[0], BORDERS[2], BORDERS[-1])
"""A few of `BORDERS`, for kernels that are slow to compile."""


class Check(NamedTuple):
    """Comparison of a kernel with its equation at some sizes."""

    words: str
    """What is computed, with a placeholder for the size."""
    deviation: Callable[[int], float]
    """Runs the kernel at a size: the largest deviation from float64, infinite if a number is missing."""
    tolerance: float
    """Deviation allowed to float32 arithmetic, several times the usual one."""
    sizes: tuple[int, ...]
    """Sizes of the presets, the largest one last."""
    borders: tuple[int, ...]
    """Further sizes at which a fault may show."""

    def run(self, size: int) -> "Outcome":
        """Compare at one size."""
        return Outcome(self.words.format(size), self.deviation(size), self.tolerance)


class Outcome(NamedTuple):
    """Result of a check."""

    name: str
    deviation: float
    tolerance: float

    @property
    def is_right(self) -> bool:
        """Whether the kernel computed the right numbers."""
        return self.deviation <= self.tolerance


def largest_deviation(found: Any, expected: Any, unit: float = 1.0) -> float:
    """Return the largest difference, in a unit; infinities must be in the same places, and NaN is never right."""
    numbers, truth = np.asarray(found, np.float64), np.asarray(expected, np.float64)
    with np.errstate(invalid="ignore"):
        difference = np.where(numbers == truth, 0.0, np.abs(numbers - truth))
    return float(np.max(np.where(np.isnan(difference), np.inf, difference), initial=0.0)) / unit


def _all_presets() -> list[Settings]:
    return [preset(method, name) for method in METHODS for name in PRESETS]


FULL_IMAGE = Camera.preset("fr1")
"""A camera of the size that the presets are made for."""


def preset_points(merged: bool = False) -> tuple[int, ...]:
    """Return the numbers of points of a view, or of all views of a level, in the presets."""
    counts = set()
    for settings in _all_presets():
        views = max(settings.alignment.views) if merged and settings.odometry.reference == "keyframe" else 1
        counts.add(views * Levels.of(FULL_IMAGE, settings.solver.levels, settings.alignment.points).most_points)
    return tuple(sorted(counts))


def _populations(settings: Settings) -> tuple[int, int]:
    """Return the number of islands, and of candidates on each."""
    return max(settings.alignment.islands), largest(getattr(settings.solver, "population", 1))


def preset_candidates() -> tuple[int, ...]:
    """Return the numbers of motions that presets score at once: populations of all islands, and scouts."""
    counts = {settings.alignment.scouts for settings in _all_presets()}
    counts |= {islands * population for islands, population in map(_populations, _all_presets())}
    return tuple(sorted(counts - {0, 1}))


def preset_islands() -> tuple[int, ...]:
    """Return the numbers of populations that presets search at once."""
    return tuple(sorted({islands for islands, _ in map(_populations, _all_presets())}))


def preset_scouts() -> tuple[int, ...]:
    """Return the numbers of motions from which presets choose the best distinct ones."""
    return tuple(sorted({settings.alignment.scouts for settings in _all_presets()} - {0}))


WIDE = preset("ga", "wide")
"""The preset with the most motions."""


def _given(arrays: Any) -> Any:
    """Put a kernel's inputs, an array or a tree of arrays, on the device."""
    return jax.device_put(arrays)


def _random_twists(rows: int, reach: float) -> np.ndarray:
    return np.random.default_rng(rows).uniform(-reach, reach, (rows, 6)).astype(np.float32)


exp, log, rigid_inverse = jax.jit(se3.exp), jax.jit(se3.log), jax.jit(se3.rigid_inverse)
transform = jax.jit(lambda problem, x: problem.transform(x))
warp_points = jax.jit(warp)
score = jax.jit(lambda objective, motions: objective.score(motions))
linearize = jax.jit(lambda problem: problem.linearize(jnp.zeros(6)))
best_distinct = jax.jit(modes.best_distinct, static_argnames="count")


@jax.jit
def examine(problem: Problem) -> Any:
    """Examine a motion as at the end of a search, with the points of all views in one array."""
    problem = replace(problem, objective=problem.objective.merged())
    return problem.examine(problem.objective.residuals(problem.origin))[:2]


def exp_deviation(rows: int) -> float:
    """Return the deviation of `se3.exp`: metres, and entries of a rotation."""
    twists = _random_twists(rows, 1.5)
    return largest_deviation(exp(twists), equations.exp(twists))


def log_deviation(rows: int) -> float:
    """Return the deviation of `se3.log` of motions that are `equations.exp` of twists: metres, radians."""
    twists = _random_twists(rows, 1.5)
    return largest_deviation(log(equations.exp(twists).astype(np.float32)), twists)


def inverse_deviation(rows: int) -> float:
    """Return the deviation of `se3.rigid_inverse`: metres, and entries of a rotation."""
    motions = equations.exp(_random_twists(rows, 1.5)).astype(np.float32)
    return largest_deviation(rigid_inverse(motions), np.linalg.inv(motions.astype(np.float64)))


ORIGIN = np.array([0.03, -0.02, 0.04, 0.02, -0.03, 0.05], np.float32)
"""Twist of the motion that a search starts from."""
BASIS = (np.diag([0.01, 0.01, 0.02, 0.005, 0.005, 0.01]) + 0.002).astype(np.float32)
"""Search coordinates in which the image changes by some grey levels per unit."""


def _origin() -> np.ndarray:
    return equations.exp(ORIGIN[None])[0].astype(np.float32)


def transform_deviation(rows: int) -> float:
    """Return the deviation of `Problem.transform`: metres, and entries of a rotation."""
    x = _random_twists(rows, 20.0)
    problem = Problem(_objective(_scene(9)), _given(_origin()), _given(BASIS))
    return largest_deviation(
        transform(problem, x), _origin().astype(np.float64) @ equations.exp(x @ BASIS.T.astype(float))
    )


LEVEL = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
"""Camera of a middle pyramid level."""
WEIGHING = equations.Weighing(5.0, 0.01, 0.3, 1.0, WIDE.alignment.min_overlap)
"""Scales as typical of tracking."""


def _scene(points: int) -> equations.Scene:
    """Make a scene with points on a grid that is as near to square as possible, the last row incomplete."""
    columns = max(1, round((points * LEVEL.width / LEVEL.height) ** 0.5))
    row, column = np.divmod(np.arange(points), columns)
    step_u, step_v = (LEVEL.width - 1) / columns, (LEVEL.height - 1) * columns / points
    # rounded to 1/64 pixel, so that float32 holds positions and inverse depths exactly
    u, v = (np.round(64 * (place + 0.5) * step) / 64 for place, step in ((column, step_u), (row, step_v)))
    return equations.plane_scene(LEVEL, u, np.minimum(v, LEVEL.height - 1))


@cache
def _target() -> Target:
    scene = _scene(1)
    rows, columns = np.mgrid[: LEVEL.height, : LEVEL.width]
    inverse_depth = scene.plane[0] + scene.plane[1] * columns + scene.plane[2] * rows
    level = PyramidLevel(*_given([image.astype(np.float32) for image in (scene.target_grey, inverse_depth)]))
    return jax.jit(lambda level: pack_target(make_atlas([level])))(level)


def _points(scene: equations.Scene) -> Points:
    return Points(*_given([scene.x, scene.y, scene.q]))


def _objective(scene: equations.Scene) -> Objective:
    """Make E with robust loss and depth term as in a level's search: one view, with its number of points."""
    nothing = np.zeros_like(scene.q)
    leaves = (scene.grey, *[nothing] * 4, scene.facing, nothing, np.ones_like(scene.q))
    points, leaves = _given(jax.tree.map(lambda leaf: leaf[None], ([scene.x, scene.y, scene.q], leaves)))
    view = Reference(Points(*points), *leaves)
    grey, depth, depth_weight, outside_cost, min_overlap = _given([np.float32(value) for value in WEIGHING])
    return Objective(
        view,
        _target(),
        image_plane(LEVEL),
        Scales(grey, depth, depth_weight),
        min_overlap,
        outside_cost,
        _given(np.int32(len(scene.q))),
        _given(np.int32(1)),
        loss=geman_mcclure,
        use_depth=True,
    )


def warp_deviation(points: int) -> float:
    """Return the deviation of `warp`, pixels; that of inverse depth (1/m) counts a hundredfold."""
    scene, motion = _scene(points), _origin()
    found = jax.device_get(warp_points(_points(scene), motion, LEVEL))
    expected = equations.warp(scene, motion.astype(np.float64))
    inside, judged = expected.inside, ~expected.on_border
    where = largest_deviation(np.stack([found.u, found.v])[:, inside], np.stack([expected.u, expected.v])[:, inside])
    inverse_depth = largest_deviation(found.inverse_depth[inside], 1.0 / expected.depth[inside], 0.01)
    flips = largest_deviation(found.inside[judged], inside[judged])
    return max(where, inverse_depth, flips)


SPREAD = np.repeat([0.05, 0.1], 3)
"""Spread of the motions that are scored, metres and radians; many move part of the points out of view, some nearly
all."""
REFERENCE_EVALUATIONS = 1_000_000
"""Largest number of points times candidates that the reference evaluates; beyond, only some candidates are compared."""


def spread_rows(rows: int, most: int) -> np.ndarray:
    """Return at most `most` indices of rows, evenly spread and, as far as they fit, next to powers of two."""
    powers = 2 ** np.arange(3, 31)[::-1]
    near = (powers[:, None] + np.array([0, -1])).ravel()
    near = near[near < rows][: most // 2]
    return np.unique(np.concatenate([near, np.linspace(0, rows - 1, max(1, most - len(near)), dtype=int)]))[:rows]


def score_deviation(candidates: int, points: int) -> float:
    """Return the deviation of `Objective.score`: errors as a share of E, and overlaps."""
    scene = _scene(points)
    motions = _scored_motions(candidates)
    found = np.stack(score(_objective(scene), motions), axis=1)
    rows = spread_rows(candidates, max(8, REFERENCE_EVALUATIONS // points))
    return max(_deviation_of_row(scene, motions[row].astype(np.float64), *found[row]) for row in rows)


def _deviation_of_row(scene: equations.Scene, motion: np.ndarray, error: float, overlap: float) -> float:
    """Compare one motion's error, as a share of E, and overlap, beyond the effect of points on the image's border."""
    r = equations.residuals(scene, motion)
    true_error, true_overlap = equations.error(scene, r, WEIGHING)
    on_border = int(np.count_nonzero(r.warped.on_border))
    least = on_border / np.count_nonzero(scene.q > 0)
    if abs(true_overlap - WEIGHING.min_overlap) <= least:  # whether it is valid at all is undecided
        return 0.0
    cost = float(equations.geman_mcclure(1e9)) * (1.0 + WEIGHING.depth_weight)
    doubt = WEIGHING.grey**2 * cost * on_border / equations.divisor(scene, r, WEIGHING)
    share = true_error if np.isfinite(true_error) else 1.0
    return max(
        (largest_deviation(error, true_error) - doubt) / share, largest_deviation(overlap, true_overlap) - least, 0.0
    )


def _scored_motions(count: int) -> np.ndarray:
    twists = SPREAD * np.random.default_rng(count).normal(size=(count, 6))
    return equations.exp(twists).astype(np.float32)


LEAST_POINTS = min(Levels.of(FULL_IMAGE, (level,)).most_points for level in WIDE.solver.levels)
"""Number of points of the coarsest level, on which scouts are scored."""
POPULATION = max(population for _, population in map(_populations, _all_presets()))
"""Number of candidates of the largest population."""
ISLAND = _populations(WIDE)[1]
"""Number of chromosomes of an island, where there are many."""


def _derivatives(points: int) -> tuple[Problem, equations.Slope, tuple[float, float]]:
    """Make a problem with its true derivatives and error at x = 0.

    Points that land on a pixel's edge get no reading, as slopes are discontinuous there.
    """
    scene, motion = _scene(points), _origin().astype(np.float64)
    warped = equations.warp(scene, motion)
    edge = np.min([np.abs(place - np.rint(place)) for place in warped[:2]], axis=0) < 1e-3
    scene = scene._replace(q=np.where(edge, np.float32(0), scene.q))
    problem = Problem(_objective(scene), _given(_origin()), _given(BASIS))
    expected = equations.slope(scene, motion, BASIS.astype(np.float64), WEIGHING, TILES)
    return problem, expected, equations.error(scene, equations.residuals(scene, motion), WEIGHING)


def _deviation_of_model(model: Any, expected: equations.Slope, error: tuple[float, float]) -> float:
    """Return the deviation of each part from its expectation, as a share of its largest entry."""
    pairs = ((model.error, error[0]), (model.gradient, expected.gradient), (model.hessian, expected.hessian))
    shares = [largest_deviation(found, truth, float(np.max(np.abs(truth)))) for found, truth in pairs]
    return max(*shares, largest_deviation(model.overlap, error[1]))


def linearize_deviation(points: int) -> float:
    """Return the deviation of `Problem.linearize`: error, gradient and Hessian, as shares of their largest entries."""
    problem, expected, error = _derivatives(points)
    return _deviation_of_model(jax.device_get(linearize(problem)), expected, error)


def examine_deviation(points: int) -> float:
    """Return the deviation of what `Problem.examine` returns, each as a share of its largest entry."""
    problem, expected, error = _derivatives(points)
    model, scatter = jax.device_get(examine(problem))
    return max(
        _deviation_of_model(model, expected, error),
        largest_deviation(scatter, expected.scatter, float(np.max(np.abs(expected.scatter)))),
    )


class Table(NamedTuple):
    """A problem with given errors, distinct enough that rounding never decides which candidate is better."""

    error: jax.Array

    def score(self, x: jax.Array, counted: jax.Array | None = None) -> tuple[jax.Array, jax.Array]:
        """Score as `Problem.score` does."""
        del x, counted
        return self.error, jnp.ones_like(self.error)


@jax.jit
def breed(solver: GeneticAlgorithm, seed: int, states: GeneticState, newcomers: jax.Array) -> Any:
    """Run a generation on every island; return it with the random numbers that it draws."""
    keys = jax.random.split(jax.random.key(seed), newcomers.shape[0])

    def one(key: jax.Array, state: GeneticState, error: jax.Array) -> tuple[GeneticState, jax.Array]:
        chance = jax.random.uniform(key, (error.shape[0], 8), minval=SMALLEST_CHANCE)
        table: Any = Table(error)
        return solver.step(key, state, table), chance

    return jax.vmap(one)(keys, states, newcomers)


HALF_WIDTH = 4.0
"""Half-width of the box that generations are bred in, search units; a few offspring reach it."""


def generation_deviation(islands: int, population: int) -> float:
    """Return the deviation of `GeneticAlgorithm.step`, search units; populations are about 1 wide."""
    rng = np.random.default_rng(islands)
    x = rng.normal(size=(islands, 2 * population, 6)).astype(np.float32)
    errors = _distinct(1.0 + np.einsum("ipk,kl,ipl->ip", x, np.eye(6) + 0.2, x - 0.3) / 8 + 1.0)
    solver = GeneticAlgorithm(population=population)
    width = np.full((islands, 6), np.float32(HALF_WIDTH))
    step = np.full((islands, 6), np.float32(1.5))
    first, second = np.split(x, 2, axis=1)
    first_errors, newcomers = np.split(errors, 2, axis=1)
    parents, parent_errors, offspring, step = _given([first, first_errors, second, step])
    state = GeneticState(parents, parent_errors, offspring, step, Bounds(*_given([-width, width])))
    found, chance = jax.device_get(breed(solver, islands, state, newcomers))
    mutants = round(solver.mutants * population)
    settings = equations.Breeding(solver.pressure, mutants, solver.crossover_range, 1.5, HALF_WIDTH)
    expected = equations.generation(x.astype(float), errors.astype(float), chance.astype(float), settings)
    return max(
        largest_deviation(found.population, expected.population),
        largest_deviation(found.error, expected.error),
        largest_deviation(found.offspring[expected.certain], expected.offspring[expected.certain]),
    )


def _distinct(errors: np.ndarray) -> np.ndarray:
    """Change errors [I, n] slightly, so that they are at least 1/256 apart."""
    order = np.argsort(errors, axis=1)
    steps = np.arange(errors.shape[1])
    apart = np.maximum.accumulate(np.rint(np.take_along_axis(errors, order, 1) * 256) - steps, axis=1) + steps
    result = np.empty(errors.shape, np.float32)
    np.put_along_axis(result, order, apart.astype(np.float32) / 256, 1)
    return result


def distinct_deviation(rows: int) -> float:
    """Return the deviation of the errors of motions chosen by `modes.best_distinct`: 0 if they are the right ones.

    Motions lie in clusters that are clearly narrower than a mode, and clearly further apart than that.
    """
    rng = np.random.default_rng(rows)
    places = 1.7 * rng.integers(-2, 3, (rows, 6)) + rng.uniform(-0.1, 0.1, (rows, 6))
    motions = equations.exp(places * np.repeat(modes.NICHE, 3)).astype(np.float32)
    errors = (100.0 + rng.permutation(rows)).astype(np.float32)
    errors[rng.random(rows) < 0.1] = np.inf
    count = max(preset_islands())
    found = best_distinct(motions, errors, count=count)
    return largest_deviation(errors[np.asarray(found)], errors[equations.best_distinct(places, errors, count)])


def _checks() -> dict[str, Check]:
    rows, points, merged = preset_candidates(), preset_points(), preset_points(merged=True)
    many = tuple(size for size in rows if size >= BORDERS[0])
    return {
        "exp": Check("exp of {} twists", exp_deviation, 3e-6, rows, BORDERS),
        "log": Check("log of {} motions", log_deviation, 5e-6, many, ENDS),
        "inverse": Check("inverse of {} motions", inverse_deviation, 3e-6, rows, BORDERS),
        "transform": Check("motions of {} candidates", transform_deviation, 3e-6, rows, BORDERS),
        "warp": Check("warp of {} points", warp_deviation, 2e-4, points, BORDERS),
        "candidates": Check(
            f"error of {{}} motions, {LEAST_POINTS} points",
            partial(score_deviation, points=LEAST_POINTS),
            1e-5,
            many,
            ENDS,
        ),
        "points": Check(
            f"error of {POPULATION} motions, {{}} points", partial(score_deviation, POPULATION), 1e-5, points, ENDS
        ),
        "derivatives": Check("derivatives, {} points", linearize_deviation, 1e-5, points, ENDS),
        "covariance": Check("covariance, {} points", examine_deviation, 5e-5, merged, ENDS),
        "generation": Check(
            f"generation of {{}} x {ISLAND}",
            partial(generation_deviation, population=ISLAND),
            1e-3,
            preset_islands(),
            ENDS[1:2],
        ),
        "distinct": Check("best distinct of {} motions", distinct_deviation, 0.0, preset_scouts(), ENDS),
    }


CHECKS = _checks()
"""Checks by name, cheap ones first."""
CONTAINED = ("log", "derivatives")
"""Checks whose kernel is part of another check's: `distinct` compares logarithms, and the covariance is computed from
the derivatives' terms."""


def full_size() -> Iterator[Outcome]:
    """Run every check that is not `CONTAINED` in another one, at the largest size of any preset."""
    return (_at_full_size(check) for name, check in CHECKS.items() if name not in CONTAINED)


def _at_full_size(check: Check) -> Outcome:
    """Return a check's outcome, with the error if the kernel does not run at all."""
    size = check.sizes[-1]
    try:
        return check.run(size)
    except jax.errors.JaxRuntimeError as error:
        return Outcome(f"{check.words.format(size)} ({' '.join(str(error).split())[:200]})", np.inf, check.tolerance)


REPETITIONS = 3
"""Number of speed measurements, whose median counts."""
RECORDED_NANOSECONDS = {"AMD EPYC": 2.3, "Intel Xeon": 5.3}
"""`scoring_nanoseconds` on 2 cores, from `benchmarks/kernel.py`, "score, robust + depth" of 640x480."""


def scoring_nanoseconds() -> float:
    """Measure `Objective.score` with robust loss and depth on the largest image: ns per point and candidate."""
    points = CHECKS["points"].sizes[-1]
    given = jax.device_put((_objective(_scene(points)), _scored_motions(POPULATION)))
    jax.block_until_ready(score(*given))
    seconds = []
    for _ in range(REPETITIONS):
        start = time.perf_counter()
        jax.block_until_ready(score(*given))
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds)) * 1e9 / (points * POPULATION)
