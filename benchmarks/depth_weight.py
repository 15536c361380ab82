"""Weight that depth deserves beside grey: the motion by each channel alone, and how far the two disagree.

Tracks with Gauss-Newton, and finds the optima of the grey cost alone and of the depth cost alone at each pair and
level. Prints, for each clip, one row per level, with medians over the pairs:

- weight by scatter: the weight of depth that each channel's own scatter from tile to tile of the image justifies;
- disagreement: squared distance between the two optima, in units of the covariance of their difference that the
  scatters predict (1 if they explain it);
- weight by disagreement: the weight of depth if the disagreement is depth's error.

A disagreement far above 1 is an error common to a whole image (calibration, timing), which scatter does not show. No
ground truth is used.

    python benchmarks/depth_weight.py
    python benchmarks/depth_weight.py --clips FOLDER --json depth_weight.json

On 2 cores the defaults take about a minute.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import common
import jax
import jax.numpy as jnp
import numpy as np

from gavo_jax import presets
from gavo_jax.alignment.fitting import fit_objective
from gavo_jax.alignment.visits import Level, levels_of, stack_levels
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.objective.error import Objective
from gavo_jax.objective.problem import Problem
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.stream import track
from gavo_jax.odometry.tracking import TrackerState
from gavo_jax.output.screen import number
from gavo_jax.se3 import exp
from gavo_jax.settings import AlignmentOptions

STEPS = 5
"""Gauss-Newton steps from the joint optimum to a channel's own."""
DEPTH_ALONE = 1e6
"""Weight of depth that makes grey negligible."""
FIGURES = ("by_scatter", "disagreement", "by_disagreement")


@jax.jit
def own_optima(
    before: TrackerState, after: TrackerState, camera: Camera, solver: Any, options: AlignmentOptions
) -> list[tuple[jax.Array, ...]]:
    """Optimum, Hessian and covariance of the gradient for grey alone and for depth alone.

    Levels are on the leading axis, coarsest first. The optimum is a step from the tracked motion. The Hessian is that
    of the mean cost there, with residuals in units of their scale; the covariance is that of its gradient.
    """
    motion = exp(after.motion)
    geometry = levels_of(camera, solver, options)
    levels = stack_levels((before.previous,), camera, geometry, options, None, camera.readout / after.seconds)

    def of_level(level: Level) -> list[tuple[jax.Array, ...]]:
        objective, _ = fit_objective(level, after.previous_image, options, motion)
        scales = objective.scales
        depth = replace(objective, scales=scales._replace(depth_weight=jnp.float32(DEPTH_ALONE)))
        unit = scales.grey**2
        return [
            optimum(replace(objective, use_depth=False), motion, unit),
            optimum(depth, motion, unit * DEPTH_ALONE),
        ]

    return jax.lax.map(of_level, levels)


def optimum(objective: Objective, motion: jax.Array, unit: jax.Array) -> tuple[jax.Array, ...]:
    """One channel's part of `own_optima`."""
    problem = Problem(objective, motion, jnp.eye(6))

    def step(_: int, x: jax.Array) -> jax.Array:
        model = problem.linearize(x)
        return x - jnp.linalg.solve(model.hessian, model.gradient)

    x = jax.lax.fori_loop(0, STEPS, step, jnp.zeros(6))
    found = replace(problem, origin=problem.transform(x))
    model, scatter, _ = found.examine(objective.residuals(found.origin))
    return x, model.hessian / unit, scatter / unit**2


def weigh(channels: list[tuple[np.ndarray, ...]]) -> tuple[float, ...]:
    """The three `FIGURES` of one level of one pair."""
    (at_grey, grey_hessian, grey_scatter), (at_depth, hessian, scatter) = (
        [np.asarray(leaf, np.float64) for leaf in channel] for channel in channels
    )
    grey_covariance, covariance = (
        np.linalg.solve(h, np.linalg.solve(h, s).T) for h, s in ((grey_hessian, grey_scatter), (hessian, scatter))
    )
    grey, depth = np.trace(grey_hessian @ grey_covariance), np.trace(hessian @ covariance)
    apart = at_depth - at_grey
    disagreement = apart @ np.linalg.solve(grey_covariance + covariance, apart) / 6
    distance = apart @ hessian @ apart - np.trace(hessian @ grey_covariance)
    return float(grey / depth), float(disagreement), float(grey / max(distance, depth))


def measure(clip: str) -> dict[int, dict[str, float]]:
    """Medians over a clip's pairs, level by level."""
    sequence, settings = common.open_clip(clip), presets.preset("gauss-newton")
    alone = replace(settings.odometry, reference="previous", relight=False, recover=False, bodies="off")
    settings = replace(settings, odometry=alone)
    odometry = Odometry(sequence.camera, settings)
    pairs, states = [], []

    def compare(_: Frame | None, step: Step | None) -> None:
        states.append(odometry.progress.tracker)
        if step is not None and not step.lost and None not in (states[-2], states[-1]):
            found = jax.device_get(own_optima(*states[-2:], odometry.camera, settings.solver, settings.alignment))
            places = range(len(settings.solver.levels))
            pairs.append([weigh(jax.tree.map(lambda leaf, i=i: leaf[i], found)) for i in places])
        del states[:-1]

    for _ in track(sequence, odometry=odometry, watch=compare):
        pass
    medians = np.median(np.array(pairs), axis=0)
    levels = settings.solver.levels
    return {level: dict(zip(FIGURES, row.tolist(), strict=True)) for level, row in zip(levels, medians, strict=True)}


def main(clips: str = common.CLIPS, json: Path | None = None) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clips: comma-separated names; see `common.open_clip`.
        json: file for the figures.
    """
    found = {clip: measure(clip) for clip in common.names(clips)}
    for clip, levels in found.items():
        cells = [[str(level), *(number(row[name], 3) for name in FIGURES)] for level, row in levels.items()]
        common.print_table(
            f"what depth is worth, {clip}", ("level", "weight by scatter", "disagreement", "by disagreement"), cells
        )
    results = {"clips": found}
    common.record(json, "depth_weight", results)
    return results


if __name__ == "__main__":
    common.command(main)
