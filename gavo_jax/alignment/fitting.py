"""E of one level, with all that is estimated from the data: brightness, noise, and the weight of depth."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gavo_jax.alignment.visits import Exchanged, Level, prepare_pair, stack_levels
from gavo_jax.camera import Camera
from gavo_jax.image.levels import Levels
from gavo_jax.image.pyramid import Pyramid
from gavo_jax.image.sampling import Target
from gavo_jax.objective.error import Objective, Scales
from gavo_jax.objective.estimates import Brightness, depth_trust, estimate_brightness, estimate_scales
from gavo_jax.se3 import rigid_inverse
from gavo_jax.settings import AlignmentOptions


def level_objective(level: Level, target: Target, options: AlignmentOptions, brightness: Brightness) -> Objective:
    """Return E of one level under a brightness model, with the scales of the paper's error."""
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
    """Return E of one level with everything that is estimated from the data at its initial motion.

    On the first level nothing is aligned yet, and while several islands compete the leader may be wrong. A regression
    of one image on the other would then have a gain near 0, which rewards motions that hide contrast. Nor do residuals
    of a wrong motion show how far depth can be trusted. So brightness is left unchanged there (`Objective.centred`
    handles exposure); depth keeps its whole weight on the first level.
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
        backward, _ = fit_objective(level.with_parts_exchanged(), exchanged.target, options, rigid_inverse(guess))
        objective = replace(objective, backward=replace(backward, scales=objective.scales))
    return objective, brightness


def comparable_objective(
    level: Level, target: Target, options: AlignmentOptions, exchanged: Exchanged | None
) -> Objective:
    """Return the objective for `evidence` on one level; nothing in it depends on a motion."""
    objective = level_objective(level, target, options, unchanged_brightness(level))
    if exchanged is None or level.exchanged is None:
        return objective
    backward = comparable_objective(level.with_parts_exchanged(), exchanged.target, options, None)
    return replace(objective, backward=backward)


def objectives_of(
    reference: Pyramid,
    target: Pyramid,
    camera: Camera,
    numbers: tuple[int, ...],
    options: AlignmentOptions,
    target_T_reference: Float[Array, "4 4"],
) -> list[Objective]:
    """Return E of some levels of a pair, each as minimised by a search that starts the level at a given motion."""
    levels = Levels.of(camera, numbers, options.points)
    view, packed, exchanged = prepare_pair(reference, target, camera, levels, options)
    stacked = stack_levels((view,), camera, levels, options, exchanged)
    rows = [jax.tree.map(lambda leaf, place=place: leaf[place], stacked) for place in range(len(numbers))]
    return [fit_objective(level, packed, options, target_T_reference, exchanged)[0] for level in rows]


def unchanged_brightness(level: Level) -> Brightness:
    """Return the brightness model in which every view is as bright as the target."""
    return Brightness.unchanged(level.reference.grey.shape[0])
