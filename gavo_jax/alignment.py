"""Coarse to fine: the motion between two RGB-D frames (paper, section 3).

`align_pyramids` is the method in one place. From the coarsest level to the finest it takes the reference's points,
estimates what the data say about brightness and noise, chooses search coordinates, lets a solver minimise E there, and
starts the next level from its best candidate. Everything from images to `Alignment` is one compiled program.
"""

import enum
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Integer, PRNGKeyArray

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.errors import GavoError
from gavo_jax.objective import (
    Loss,
    Objective,
    Problem,
    Reference,
    Scales,
    concatenate_references,
    estimate_brightness,
    estimate_scales,
    explained_variance,
    make_reference,
    move_reference,
    preconditioner,
    reference_curvature,
    student_t,
)
from gavo_jax.pyramid import LEVELS, Pyramid, build_pyramid
from gavo_jax.solvers.base import Bounds, solve, static
from gavo_jax.solvers.genetic import GeneticAlgorithm
from gavo_jax.warp import exp, log, pack_target


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
}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AlignmentOptions:
    """What is minimised and where, apart from the solver.

    Attributes:
        loss: ρ of the squared normalised residual (static); see `objective.LOSSES`, or any callable.
        depth: Whether the depth residual joins the grey one (static).
        brightness: Whether a gain and a bias between the frames are estimated (static).
        robust_scale: Whether the losses' scales come from the data; without it σ = 1, the paper's (2) (static).
        precondition: Search in the coordinates of `objective.preconditioner` instead of in ξ (static).
        cells: Side of the blocks that give one point each, an entry a level (static); 1 takes every pixel.
        islands: Independent populations, an entry a level (static); the best ones go on to the next level.
        depth_weight: Factor on the depth cost's weight, which comes from the data; see `objective.estimate_scales`.
        min_overlap: Share of the reference's points that a candidate must keep in view to count.
        outside_cost: Cost of a point that leaves the view on levels where several islands compete; see `Objective`.
            None, and on the levels that refine one motion: (2) as printed.
        bounds: Half-widths of the search box about the guess, metres and radians, at the coarsest level.
        bounds_factor: Factor on the half-widths from a level to the next finer one.
        scouts: Motions drawn about the guess and scored before the coarsest level's search (static); its islands
            start from the best distinct ones. 0 starts all islands from the guess.
        scout_spread: Standard deviations of the scouts, metres and radians.
    """

    loss: Loss = static(student_t)
    depth: bool = static(True)
    brightness: bool = static(True)
    robust_scale: bool = static(True)
    precondition: bool = static(True)
    cells: tuple[int, ...] = static((2, 2, 2, 1, 1))
    islands: tuple[int, ...] = static((1, 1, 1, 1, 1))
    depth_weight: float = 1.0
    min_overlap: float = 0.35
    outside_cost: float | None = None
    bounds: tuple[float, float] = (0.5, 0.8)
    bounds_factor: float = 1.0
    scouts: int = static(0)
    scout_spread: tuple[float, float] = (0.15, 0.4)


class Alignment(NamedTuple):
    """The motion between two frames, with what is known about it.

    A batch holds the same fields with a leading axis, and `status` as an integer array.
    """

    target_T_reference: Float[Array, "4 4"]
    """Maps points of the reference camera into the target camera, metres."""
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


MIN_DEPTH_SHARE = 0.05
"""Share of the reference's points with a reading below which a pair is `NO_DEPTH`."""
MIN_CONTRAST = 2.0
"""Grey levels: a smaller standard deviation over the reference makes a pair `LOW_TEXTURE`."""
MIN_FINAL_OVERLAP = 0.3
"""Overlap of the result below which a pair is `LOW_OVERLAP`."""
MIN_EXPLAINED = 0.5
"""Share of the reference's grey variance that a result must explain; below, a pair is `HIGH_ERROR`."""
MAX_TRANSLATION_DEVIATION = 0.05
"""Metres: a larger standard deviation of a translation makes a pair `LOW_TEXTURE`."""
MAX_ROTATION_DEVIATION = 0.05
"""Radians, likewise for the rotation."""


class View(NamedTuple):
    """A frame that serves as reference, and where it stands."""

    pyramid: Pyramid
    anchor_T_view: Float[Array, "4 4"]
    """Maps the view's points into the camera that the result is relative to."""


def level_objective(
    views: tuple[View, ...],
    target: Pyramid,
    camera: Camera,
    level: int,
    guess: Float[Array, "4 4"],
    options: AlignmentOptions,
    brightness: bool,
) -> Objective:
    """E of one level, with its scales, and from the second level on its brightness model, estimated at the guess.

    Before anything is aligned a regression of one image on the other would only tell that they differ: its gain would
    fall towards 0 and reward motions that hide contrast.
    """
    charge_outside = options.outside_cost is not None and options.islands[level] > 1
    camera = camera.level(level)
    packed = pack_target(target[level].grey, target[level].inverse_depth)

    def objective(reference: Reference) -> Objective:
        return Objective(
            reference,
            packed,
            camera,
            Scales.unit(),
            jnp.float32(options.min_overlap),
            options.loss,
            options.depth,
            camera.width // options.cells[level],
            jnp.float32(options.outside_cost) if charge_outside else None,
        )

    references = []
    for i, view in enumerate(views):
        reference = make_reference(view.pyramid[level], camera, options.cells[level])
        if i > 0:
            reference = move_reference(reference, view.anchor_T_view)
        if brightness:
            gain, bias = estimate_brightness(objective(reference), guess)
            reference = reference._replace(grey=gain * reference.grey + bias)
        references.append(reference)
    whole = objective(concatenate_references(references))
    if not options.robust_scale:
        return whole
    return replace(whole, scales=estimate_scales(whole, guess, options.depth_weight))


def _best_guess(
    make_objective: Callable[[Float[Array, "4 4"]], Objective], guesses: Float[Array, "g 4 4"]
) -> tuple[Float[Array, "4 4"], Objective]:
    """The guess with the smallest residuals, and the objective with its scales estimated there.

    Unscaled residuals are compared: each guess has its own scales, and E in units of them says nothing.
    """
    if guesses.shape[0] == 1:
        return guesses[0], make_objective(guesses[0])
    objectives = jax.vmap(make_objective)(guesses)

    def unexplained(objective: Objective, guess: jax.Array) -> jax.Array:
        r = objective.residuals(guess)
        share = jnp.sum(r.inside) / jnp.maximum(jnp.sum(objective.reference.points.q > 0), 1.0)
        error = jnp.sum(r.inside * jnp.abs(r.grey)) / jnp.maximum(jnp.sum(r.inside), 1.0)
        return jnp.where(share < objective.min_overlap, jnp.inf, error)

    best = jnp.argmin(jax.vmap(unexplained)(objectives, guesses))
    return guesses[best], jax.tree.map(lambda leaf: leaf[best], objectives)


def align_pyramids(
    views: tuple[View, ...],
    target: Pyramid,
    camera: Camera,
    solver: Any,
    options: AlignmentOptions,
    key: PRNGKeyArray,
    guesses: Float[Array, "g 4 4"],
) -> Alignment:
    """Motion from an anchor camera to the target camera, coarse to fine; traced, not compiled by itself.

    Args:
        views: Reference frames; the first one is the anchor, the others' points are moved into its camera.
        target: Pyramid of the target frame.
        camera: Camera of level 0.
        solver: Any `solvers.base.Solver` with an entry a level.
        options: What is minimised.
        key: Random key.
        guesses: Motions to start from; the best by error leads, so that a wrong one costs nothing.
    """
    box = jnp.repeat(jnp.stack([jnp.float32(half) for half in options.bounds]), 3)
    islands, centre, objective = guesses, guesses[0], None
    histories: list[jax.Array] = []
    for level in solver.levels:
        first, count = not histories, options.islands[level]
        make_objective = partial(
            level_objective, views, target, camera, level, options=options, brightness=options.brightness and not first
        )
        leader, objective = _best_guess(make_objective, guesses if first else islands[:1])
        basis = preconditioner(reference_curvature(objective)) if options.precondition else jnp.eye(6)
        key, level_key, start_key = jax.random.split(key, 3)
        if not first:
            origins = islands[:count]
        elif options.scouts:
            origins = _scout(objective, leader, options, count, start_key)
        else:
            origins = jnp.repeat(leader[None], count, axis=0)
        centre = leader if first else centre
        search = partial(
            _search_island, Problem(objective, leader, basis, centre), solver.at_level(level), options, box
        )
        if count == 1:
            islands, errors, history = jax.tree.map(lambda a: a[None], search(level_key, origins[0]))
        else:
            islands, errors, history = jax.vmap(search)(jax.random.split(level_key, count), origins)
        histories.append(history[jnp.argmin(errors)])
        islands = islands[_best_distinct(islands, errors, count)]
        box = box * options.bounds_factor
    assert objective is not None, "the solver has no level with an iteration"
    return _conclude(objective, islands[0], options, jnp.concatenate(histories))


def _search_island(
    problem: Problem,
    solver: Any,
    options: AlignmentOptions,
    box: Float[Array, " 6"],
    key: PRNGKeyArray,
    origin: Float[Array, "4 4"],
) -> tuple[Float[Array, "4 4"], Float[Array, ""], Float[Array, " iterations"]]:
    """Search one level from one origin."""
    if options.precondition:
        problem = replace(problem, origin=origin, reach=jnp.stack([box[0], box[3]]))
        reach = jnp.abs(jnp.linalg.inv(problem.basis)) @ box
        bounds = Bounds(-reach, reach)
        guess = jnp.zeros((1, 6))
    else:
        problem = replace(problem, origin=jnp.eye(4))
        bounds = Bounds(log(origin) - box, log(origin) + box)
        guess = log(origin)[None]
    solution = solve(key, solver, problem, guess, bounds)
    return problem.transform(solution.x), solution.error, solution.history


NICHE = (0.08, 0.08)
"""Metres and radians of ξ within which two motions count as one mode."""


def _best_distinct(motions: Float[Array, "n 4 4"], errors: Float[Array, " n"], count: int) -> Integer[Array, " k"]:
    """Indices of the `count` best motions with no two of one mode, best first (clearing, Petrowski 1996).

    Where there are fewer modes than that, the last places go to the best motions that are left over.
    """
    if count == 1:
        return jnp.argmin(errors)[None]
    scale = jnp.repeat(jnp.stack([jnp.float32(radius) for radius in NICHE]), 3)
    places = log(motions) / scale

    def pick(cleared: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        best = jnp.argmin(cleared)
        near = jnp.sum((places - places[best]) ** 2, axis=1) < 1.0
        return jnp.where(near, cleared + CLEARED, cleared).at[best].set(jnp.inf), best

    return jax.lax.scan(pick, jnp.minimum(jnp.nan_to_num(errors, nan=jnp.inf), CLEARED / 2), length=count)[1]


CLEARED = 1e9
"""Added to the error of a motion whose mode is taken; above any error."""


def _scout(
    objective: Objective, leader: Float[Array, "4 4"], options: AlignmentOptions, count: int, key: PRNGKeyArray
) -> Float[Array, "k 4 4"]:
    """Origins of the coarsest level's islands: the best distinct ones of many motions drawn about the leader."""
    spread = jnp.repeat(jnp.stack([jnp.float32(s) for s in options.scout_spread]), 3)
    twists = spread * jax.random.normal(key, (options.scouts, 6))
    scouts = leader @ exp(twists.at[0].set(0.0))
    errors, _ = objective.score(scouts)
    return scouts[_best_distinct(scouts, errors, count)]


def _conclude(
    objective: Objective, target_T_reference: Float[Array, "4 4"], options: AlignmentOptions, history: jax.Array
) -> Alignment:
    """Error, covariance and status at the motion that the search ended with.

    The scales are estimated once more there, so that errors of different solvers can be compared.
    """
    if options.robust_scale:
        objective = replace(objective, scales=estimate_scales(objective, target_T_reference, options.depth_weight))
    problem = Problem(objective, target_T_reference, jnp.eye(6))
    model = problem.linearize(jnp.zeros(6))
    ridge = 1e-6 * jnp.diag(jnp.diag(model.hessian)) + 1e-9 * jnp.eye(6)
    inverse = jnp.linalg.inv(model.hessian + ridge)
    covariance = inverse @ problem.gradient_scatter(jnp.zeros(6)) @ inverse.T
    covariance = 0.5 * (covariance + covariance.T)
    deviation = jnp.sqrt(jnp.maximum(jnp.diag(covariance), 0.0))
    depth_share = jnp.mean((objective.reference.points.q > 0).astype(jnp.float32))
    finite = jnp.isfinite(model.error) & jnp.all(jnp.isfinite(problem.origin)) & jnp.all(jnp.isfinite(covariance))
    wide = (jnp.max(deviation[:3]) > MAX_TRANSLATION_DEVIATION) | (jnp.max(deviation[3:]) > MAX_ROTATION_DEVIATION)
    contrast = jnp.std(objective.reference.grey, where=objective.reference.points.q > 0)
    status = jnp.int32(AlignmentStatus.OK)
    for found, value in (
        (wide | (contrast < MIN_CONTRAST), AlignmentStatus.LOW_TEXTURE),
        (explained_variance(objective, problem.origin) < MIN_EXPLAINED, AlignmentStatus.HIGH_ERROR),
        (model.overlap < MIN_FINAL_OVERLAP, AlignmentStatus.LOW_OVERLAP),
        (~finite, AlignmentStatus.NOT_FINITE),
        (depth_share < MIN_DEPTH_SHARE, AlignmentStatus.NO_DEPTH),
    ):
        status = jnp.where(found, jnp.int32(value), status)
    return Alignment(problem.origin, log(problem.origin), model.error, model.overlap, covariance, status, history)


class Images(NamedTuple):
    """Grey [H, W] and depth [H, W] of one frame, or of a batch with a leading axis."""

    grey: Any
    depth: Any


def _align_images(
    reference: Images,
    target: Images,
    camera: Camera,
    solver: Any,
    options: AlignmentOptions,
    key: PRNGKeyArray,
    guess: Float[Array, "4 4"],
) -> Alignment:
    pyramids = [build_pyramid(image.grey, image.depth, camera.depth_scale, LEVELS) for image in (reference, target)]
    view = View(pyramids[0], jnp.eye(4))
    return align_pyramids((view,), pyramids[1], camera, solver, options, key, guess[None])


@jax.jit
def _align_pairs(count, references, targets, camera, solver, options, keys, guesses):
    """The first `count` of B pairs: one after the other on a CPU, which one pair already fills; side by side elsewhere.

    The count is an input, so that XLA compiles one and the same loop body for one pair and for many, whose results then
    agree to the last bit; unrolled, a single pair would round differently.
    """

    def one(i):
        reference, target, key, guess = jax.tree.map(lambda leaf: leaf[i], (references, targets, keys, guesses))
        return _align_images(reference, target, camera, solver, options, key, guess)

    if jax.default_backend() != "cpu":
        return jax.vmap(one)(jnp.arange(keys.shape[0]))
    empty = jax.tree.map(lambda leaf: jnp.zeros((keys.shape[0], *leaf.shape), leaf.dtype), jax.eval_shape(one, 0))
    return jax.lax.fori_loop(
        0, count, lambda i, results: jax.tree.map(lambda all, new: all.at[i].set(new), results, one(i)), empty
    )


def _align_rows(sides, camera, solver, options, keys, guesses):
    """`_align_pairs` of B pairs; a single one is padded to two rows, of which one is computed."""
    count = len(guesses)
    if count == 1:
        sides, keys, guesses = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), (sides, keys, guesses))
    result = _align_pairs(
        jnp.int32(count),
        *sides,
        camera.rectified(),
        GeneticAlgorithm() if solver is None else solver,
        AlignmentOptions() if options is None else options,
        keys,
        guesses,
    )
    return jax.tree.map(lambda leaf: leaf[:count], result)


def align(
    reference: Frame | tuple[Any, Any],
    target: Frame | tuple[Any, Any],
    camera: Camera,
    solver: Any = None,
    key: PRNGKeyArray | None = None,
    guess: Float[Array, "4 4"] | None = None,
    options: AlignmentOptions | None = None,
) -> Alignment:
    """Estimate the motion of the camera between two RGB-D frames.

    Args:
        reference: Frame t: a `Frame`, or a pair of arrays (grey, depth) of [H, W]; depth in units of
            `camera.depth_scale` a metre, 0 = no reading.
        target: Frame t + 1.
        camera: Their camera. Lens distortion, where it has any, is taken out first.
        solver: `GeneticAlgorithm()` by default; any solver with an entry a level.
        key: Random key; `jax.random.key(0)` by default. The same key gives the same result, bit for bit.
        guess: A motion target_T_reference to start from; the identity by default.
        options: What is minimised.

    Returns:
        `Alignment`; the camera's own motion is the inverse of its `target_T_reference`.

    Raises:
        GavoError: The images are not of the camera's size, or of a wrong shape.
    """
    sides = [_stacked_images([frame], camera) for frame in (reference, target)]
    keys = (jax.random.key(0) if key is None else key)[None]
    guesses = (jnp.eye(4) if guess is None else jnp.asarray(guess, jnp.float32))[None]
    result = _align_rows(sides, camera, solver, options, keys, guesses)
    return on_host(jax.tree.map(lambda leaf: leaf[0], result))


def align_batch(
    references: Any,
    targets: Any,
    camera: Camera,
    solver: Any = None,
    keys: PRNGKeyArray | None = None,
    guesses: Float[Array, "b 4 4"] | None = None,
    options: AlignmentOptions | None = None,
) -> Alignment:
    """Align B pairs in one compiled call.

    Args:
        references: B frames: a list of `Frame` or of (grey, depth), or a pair of arrays of [B, H, W] from a camera
            without distortion.
        targets: The other B frames, alike.
        camera: Their camera.
        solver: As in `align`.
        keys: [B] random keys; `jax.random.split(jax.random.key(0), B)` by default.
        guesses: [B, 4, 4] motions to start from; the identity by default.
        options: As in `align`.

    Returns:
        An `Alignment` whose fields have a leading axis B; `status` is an integer array.

    Raises:
        GavoError: The images are not of the camera's size, or the two sides differ in number.
    """
    sides = [_stacked_images(side, camera) for side in (references, targets)]
    count = len(sides[0].grey)
    if len(sides[1].grey) != count:
        raise GavoError(f"align_batch: {count} references but {len(sides[1].grey)} targets")
    keys = jax.random.split(jax.random.key(0), count) if keys is None else keys
    guesses = jnp.tile(jnp.eye(4), (count, 1, 1)) if guesses is None else jnp.asarray(guesses, jnp.float32)
    return _align_rows(sides, camera, solver, options, keys, guesses)


def on_host(alignment: Alignment) -> Alignment:
    """The same result as NumPy arrays, with `status` as an `AlignmentStatus`."""
    host = jax.device_get(alignment)
    return host._replace(status=AlignmentStatus(int(host.status)))


def _rectified_images(frame: Frame | tuple[Any, Any], camera: Camera) -> Images:
    grey, depth = (frame.grey, frame.depth) if isinstance(frame, Frame) else frame
    expected = (camera.height, camera.width)
    for name, image in (("grey", grey), ("depth", depth)):
        if np.shape(image) != expected:
            raise GavoError(f"{name} image is of shape {np.shape(image)}, the camera's is {expected}")
    if camera.is_distorted:
        grey, depth = camera.undistort(np.asarray(grey), np.asarray(depth))
    return Images(grey, depth)


def _stacked_images(side: Any, camera: Camera) -> Images:
    if isinstance(side, tuple) and len(side) == 2 and np.ndim(side[0]) == 3:
        if camera.is_distorted:
            return _stacked_images(list(zip(*side, strict=True)), camera)
        if np.shape(side[0])[1:] != (camera.height, camera.width) or np.shape(side[0]) != np.shape(side[1]):
            raise GavoError(f"images are of shape {np.shape(side[0])} and {np.shape(side[1])}, not [B, H, W] alike")
        return Images(jnp.asarray(side[0]), jnp.asarray(side[1]))
    images = [_rectified_images(frame, camera) for frame in side]
    return Images(jnp.stack([i.grey for i in images]), jnp.stack([i.depth for i in images]))
