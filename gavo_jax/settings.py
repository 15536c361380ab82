"""Everything besides the frames that decides a result, as one value: solver, objective, and their use in odometry.

Change settings with `dataclasses.replace`; `presets` has named ones, `settings_file` reads and writes them.
"""

import warnings
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import jax

from gavo_jax.image.levels import PointsPerLevel
from gavo_jax.objective.losses import Loss, geman_mcclure
from gavo_jax.settings_check import require_settings
from gavo_jax.solvers.base import Solver, static, within
from gavo_jax.solvers.genetic import GeneticAlgorithm


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AlignmentOptions:
    """What is minimised and where, apart from the solver.

    Attributes:
        loss: ρ of the squared normalised residual (static); see `objective.losses.LOSSES`, or any callable.
        depth: Whether the depth residual joins the grey one (static).
        brightness: Whether a gain and a bias between the frames are estimated (static).
        centred: Whether, while the motion is undecided, each candidate's grey residuals are taken about their own mean
            (static); see `Objective`.
        symmetric: Whether the target's points, seen from the reference, count as much as the reference's (static).
        refine: Whether candidates are chosen by the evidence for them instead of by E, and the best ones are refined
            through all levels by Gauss-Newton, with brightness and scales estimated there (static). The solver stops
            where islands no longer compete. See `alignment.contest`.
        features: Features of two images whose motion competes with those found by the search, where `refine` is set
            (static). For single pairs only (`align`), not for a sequence's frames.
        robust_scale: Whether the losses' scales are estimated from the data; without it σ = 1 and depth has no weight:
            the paper's error (static).
        precondition: Whether to search in the coordinates of `objective.preconditioning.preconditioner` instead of in
            ξ (static).
        points: Largest number of reference points per level, one per square block of pixels, or an entry per level
            (static); None takes every pixel.
        estimation_points: Largest number of points per view from which brightness, scales and curvature are estimated
            before a level is searched (static); None takes all.
        views: Largest number of reference frames whose points are scored together, an entry per level (static); of the
            two in a run, 1 uses only the previous frame.
        islands: Independent populations, an entry per level (static); the best ones go on to the next level.
        depth_weight: Weight λ of the depth cost against the grey one, both in units of their own scales, an entry per
            level.
        doubt_depth: Whether depth loses up to two thirds of its weight, from the second level on, where whole surfaces
            have wrong depth residuals (static); see `objective.estimates.depth_trust`.
        last_step: Whether the motion that the search ends with takes one more Newton step, with the gradient and
            Hessian of E that also give its covariance (static); Le Cam's one-step estimate. Sampled candidates end
            scattered about the minimum; this centres them. More steps follow while E falls. Where the error is
            `symmetric`, only a sequence's sway is refined: the derivatives cover one direction only.
        min_overlap: Share of the reference's points that a candidate must keep in view to count.
        outside_cost: Cost of a point that leaves the view on levels where several islands compete; see `Objective`.
            Where it is None, and on levels that refine a single motion, such a point does not count: the paper's error.
        bounds: Half-widths of the search box about the guess, metres and radians, at the coarsest level.
        bounds_factor: Factor on the half-widths from a level to the next finer one.
        scouts: Motions drawn about the guess and scored before the coarsest level's search (static); its islands
            start from the best distinct ones. 0 starts all islands from the guess.
        scout_spread: Standard deviations of the scouts, metres and radians.
    """

    loss: Loss = static(geman_mcclure)
    depth: bool = static(True)
    brightness: bool = static(True)
    centred: bool = static(False)
    symmetric: bool = static(False)
    refine: bool = static(False)
    features: Literal["off", "sift", "orb", "both"] = static("off")
    robust_scale: bool = static(True)
    precondition: bool = static(True)
    points: PointsPerLevel = static(4800, least=1)
    estimation_points: int | None = static(1200, least=1)
    views: tuple[int, ...] = static((2, 2, 1, 1, 1), least=1)
    islands: tuple[int, ...] = static((1, 1, 1, 1, 1), least=1)
    depth_weight: tuple[float, ...] = within((0.05, 0.05, 0.05, 0.3, 0.3), 0)
    doubt_depth: bool = static(False)
    last_step: bool = static(True)
    min_overlap: float = within(0.35, 0, 1)
    outside_cost: float | None = within(None, 0)
    bounds: tuple[float, float] = within((0.5, 0.8), 1e-6)
    bounds_factor: float = within(1.0, 1e-6)
    scouts: int = static(0)
    scout_spread: tuple[float, float] = within((0.15, 0.4), 0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OdometryOptions:
    """How the driver uses the alignment; all but `keyframe_overlap` is static.

    Attributes:
        reference: What a new frame is aligned with: the previous frame alone, or the previous frame and a keyframe
            at once, their points scored together.
        keyframe_overlap: Share of the keyframe's points in view below which they are replaced by a newer frame's; the
            mean over the keyframe's parts, see `odometry.tracking.renew_keyframe`.
        prior: Whether the last motion is offered as a second guess beside no motion; the better one leads.
        synchronise: Whether depth is warped to the colour image's timestamp by the camera's motion, where the sequence
            has both stamps.
        rolling_shutter: Whether each row is taken as exposed at its own time, where the camera has a `readout`.
        sway: Whether, under a rolling shutter, the camera's velocity at each frame's timestamp is estimated with the
            motion; else it is assumed to be the mean since the last frame. See `alignment.sway`.
        relight: Whether a badly explained pair is searched again with its references relit like the new frame, where
            the light changed locally. See `odometry.relighting`.
        recover: Whether a pair that looks wrong is tried again by the wide search against the previous frame.
        bodies: Whether independently moving bodies are left out of the search: `off` no, `mask` yes; `track` also
            estimates each body's motion. See docs/bodies.md.
        on_lost: The motion recorded for a lost pair: `hold` none, `predict` the last one, `stop` ends the run.
        loops: Whether `run_odometry` and the command keep a map of keyframes and correct the trajectory by loop
            closures. Frames that are given to an `Odometry` one by one have no map.
    """

    reference: Literal["previous", "keyframe"] = static("keyframe")
    keyframe_overlap: float = within(0.7, 0, 1)
    prior: bool = static(True)
    synchronise: bool = static(True)
    rolling_shutter: bool = static(True)
    sway: bool = static(True)
    relight: bool = static(True)
    recover: bool = static(True)
    bodies: Literal["off", "mask", "track"] = static("mask")
    on_lost: Literal["hold", "predict", "stop"] = static("hold")
    loops: bool = static(False)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Settings:
    """A solver, what it minimises, and how the driver uses it; by default those of the preset `default`.

    Attributes:
        solver: `GeneticAlgorithm`, `ParticleSwarm`, `GaussNewton`, `GradientDescent`, or a custom one.
        alignment: What is minimised and where.
        odometry: How a sequence is tracked; not used for a single pair.
    """

    solver: Solver = field(default_factory=GeneticAlgorithm)
    alignment: AlignmentOptions = field(default_factory=AlignmentOptions)
    odometry: OdometryOptions = field(default_factory=OdometryOptions)


def as_settings(value: "Settings | Solver | None" = None, solver: Solver | None = None, **parts: Any) -> Settings:
    """Return the settings that a caller's arguments stand for.

    Args:
        value: Settings; a solver stands for the default settings with that solver, None for the default ones.
        solver: Replaces their solver.
        parts: `alignment` and `odometry`, likewise; deprecated arguments of version 0.1.

    Raises:
        TypeError: `value` is neither.
        GavoError: A value in it is of the wrong kind or out of its range.
    """
    if isinstance(named := getattr(value, "settings", None), Settings):  # what `load_settings` returns
        value = named
    if value is None:
        settings = Settings()
    elif isinstance(value, Settings):
        settings = value
    elif isinstance(value, Solver) and not isinstance(value, type):
        settings = Settings(value)
    else:
        hint = ": gavo.preset(METHOD, PRESET) gives settings, as of 'ga' and 'fast'" if isinstance(value, str) else ""
        raise TypeError(f"neither Settings nor a solver: {type(value).__name__}{hint}")
    given = {name: part for name, part in parts.items() if part is not None}
    if given:
        words = "options and alignment are now parts of the settings: dataclasses.replace(settings, alignment=…)"
        warnings.warn(words, DeprecationWarning, stacklevel=4)  # the caller's caller, past a wrapper
    if solver is not None:
        given["solver"] = solver
    settings = replace(settings, **given)
    require_settings(settings)
    return settings
