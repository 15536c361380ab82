"""What a search meets on each level of the pyramid: the frames' data, and E with all that is estimated for it."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Integer

from gavo_jax.camera import Camera
from gavo_jax.image.levels import ImagePlane, Levels
from gavo_jax.image.pyramid import Pyramid, make_atlas
from gavo_jax.image.sampling import Target, pack_target
from gavo_jax.objective.error import Objective, Scales
from gavo_jax.objective.estimates import Brightness, depth_trust, estimate_brightness, estimate_scales
from gavo_jax.objective.points import Reference, make_references
from gavo_jax.se3 import rigid_inverse
from gavo_jax.settings import AlignmentOptions
from gavo_jax.solvers.base import Solver


class Exchanged(NamedTuple):
    """The two frames of a pair with their parts exchanged, for the symmetric error."""

    references: Reference
    """Points of the target frame, as of `make_references`."""
    target: Target
    """The anchor's frame, as of `prepare_target`."""


def levels_of(camera: Camera, solver: Solver, options: AlignmentOptions) -> Levels:
    """The levels that a solver searches, with as many points as the options say."""
    return Levels.of(camera, solver.levels, options.points)


def prepare_target(pyramid: Pyramid, levels: Levels) -> Target:
    """What a search needs of a target frame: a solver's levels packed for sampling, coarsest first."""
    return pack_target(make_atlas([pyramid[number] for number in levels.numbers]))


def prepare_pair(
    reference: Pyramid, target: Pyramid, camera: Camera, levels: Levels, options: AlignmentOptions
) -> tuple[Reference, Target, Exchanged | None]:
    """What a search needs of two frames."""
    view = make_references(reference, camera, levels)
    exchanged = None
    if options.symmetric:
        exchanged = Exchanged(make_references(target, camera, levels), prepare_target(reference, levels))
    return view, prepare_target(target, levels), exchanged


class Level(NamedTuple):
    """What changes from level to level; with a leading axis L the input of the scan over the levels."""

    number: Integer[Array, ""]
    """Number of the pyramid's level; 0 is the full image."""
    is_first: Bool[Array, ""]
    plane: ImagePlane
    reference: Reference
    """[V, N]: the points of all views as rays of the anchor camera."""
    points: Integer[Array, ""]
    """Points a view on this level; places from there on are empty."""
    columns: Integer[Array, ""]
    """Points of a view in one row."""
    views: Integer[Array, ""]
    """Views that count; the points of the others have lost their readings."""
    islands: Integer[Array, ""]
    """Number of independent populations."""
    depth_weight: Float[Array, ""]
    """Weight of the depth cost."""
    exchanged: Reference | None = None
    """[1, N]: the target's points, where the error is symmetric."""
    readout: Float[Array, ""] | None = None
    """Share of the motion that passes during a rolling shutter's readout; see `Objective`."""

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


def reach_of(options: AlignmentOptions) -> Float[Array, " 2"]:
    """How far from its centre a search is held on every level: metres and radians."""
    return jnp.stack([jnp.float32(half) for half in options.bounds])


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


def comparable_objective(
    level: Level, target: Target, options: AlignmentOptions, exchanged: Exchanged | None
) -> Objective:
    """What `evidence` asks of one level: nothing in it depends on a motion."""
    objective = level_objective(level, target, options, unchanged_brightness(level))
    if exchanged is None or level.exchanged is None:
        return objective
    readout = None if level.readout is None else -level.readout
    swapped = level._replace(reference=level.exchanged, exchanged=None, readout=readout)
    return replace(objective, backward=comparable_objective(swapped, exchanged.target, options, None))


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


class Search(NamedTuple):
    """What one level hands on to the next."""

    islands: Float[Array, "i 4 4"]
    """Motions, the best one first."""
    box: Float[Array, " 6"]
    """Half-widths of the search box, metres and radians."""
    brightness: Brightness
    rival: Float[Array, ""]
    """How far the second-best mode is behind, where several competed: the best one's evidence over its, or its error
    over the best one's; +inf without one."""
