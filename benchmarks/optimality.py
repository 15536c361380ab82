"""How close the GA's result is to the minimum of E, over all consecutive pairs of the clips.

For each pair the GA and Gauss-Newton are run coarse to fine from the identity. Then one objective is made for the
finest level, with brightness model and scales estimated at the GA's result. Its E judges the two motions found, and the
minima that Gauss-Newton, run to convergence on it, reaches from either. The lower minimum is the reference. Prints one
row per clip: the excess of the GA's E over the reference in per cent (median, 90th and 95th percentile, largest), the
share of pairs within 0.5 %, and the same share for Gauss-Newton's own result.

    python benchmarks/optimality.py
    python benchmarks/optimality.py --clips fr1_desk:31 --preset fast --json optimality.json

On 2 cores the defaults take about 3 minutes.
"""

from pathlib import Path
from typing import Any, NamedTuple

import common
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from gavo_jax import presets
from gavo_jax.alignment.fitting import objectives_of
from gavo_jax.alignment.search import align_views
from gavo_jax.alignment.stacking import Images
from gavo_jax.alignment.visits import levels_of, prepare_pair
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Sequence
from gavo_jax.image.pyramid import build_pyramid
from gavo_jax.objective.error import Objective
from gavo_jax.objective.preconditioning import preconditioner, reference_curvature
from gavo_jax.objective.problem import Problem
from gavo_jax.output.screen import number
from gavo_jax.settings import AlignmentOptions
from gavo_jax.solvers.base import Bounds, solve
from gavo_jax.solvers.gauss_newton import GaussNewton

TOLERANCE = 0.5
"""Per cent of E within which a result counts as optimal."""
POLISH = 40
"""Gauss-Newton steps to the reference minima."""


class FinalErrors(NamedTuple):
    """E of one pair by one objective, squared grey levels."""

    genetic: Float[Array, ""]
    gauss_newton: Float[Array, ""]
    minimum_from_genetic: Float[Array, ""]
    minimum_from_gauss_newton: Float[Array, ""]


def converged_error(objective: Objective, start: Float[Array, "4 4"]) -> Float[Array, ""]:
    """E to which Gauss-Newton converges from a start motion; never above E at the start."""
    problem = Problem(objective, start, preconditioner(reference_curvature(objective)))
    solver = GaussNewton(iterations=(POLISH,), patience=POLISH).at_level(0)
    unbounded = Bounds(jnp.full(6, -jnp.inf), jnp.full(6, jnp.inf))
    return solve(jax.random.key(0), solver, problem, jnp.zeros((1, 6)), unbounded).error


@jax.jit
def final_errors(
    reference: Images,
    target: Images,
    camera: Camera,
    genetic: Any,
    gauss_newton: Any,
    options: AlignmentOptions,
    key: PRNGKeyArray,
) -> FinalErrors:
    """E of one pair, all by the same objective (see the module's docstring)."""
    before, after = (build_pyramid(frame.grey, frame.depth, camera.depth_scale) for frame in (reference, target))
    levels = levels_of(camera, genetic, options)
    view, packed, exchanged = prepare_pair(before, after, camera, levels, options)
    guesses = jnp.eye(4)[None]
    results = [
        align_views((view,), packed, camera, levels, solver, options, key, guesses, exchanged=exchanged)[0]
        for solver in (genetic, gauss_newton)
    ]
    found, descended = (result.target_T_reference for result in results)
    objective = objectives_of(before, after, camera, genetic.levels, options, found)[-1]
    minima = jax.lax.map(lambda start: converged_error(objective, start), jnp.stack([found, descended]))
    return FinalErrors(objective.error(found)[0], objective.error(descended)[0], *minima)


def pair_errors(sequence: Sequence, preset_name: str, seed: int) -> list[FinalErrors]:
    """E of every consecutive pair."""
    genetic, descent = presets.preset("ga", preset_name), presets.preset("gauss-newton", preset_name)
    errors, last = [], None
    for index, frame in enumerate(sequence):
        images = Images(frame.grey, frame.depth)
        if last is not None:
            key = jax.random.fold_in(jax.random.key(seed), index)
            result = final_errors(last, images, sequence.camera, genetic.solver, descent.solver, genetic.alignment, key)
            errors.append(jax.device_get(result))
        last = images
    return errors


def stack(errors: list[FinalErrors]) -> FinalErrors:
    """Stack the errors into arrays over the pairs."""
    return jax.tree.map(lambda *values: np.stack(values), *errors)


def excess(error: np.ndarray, errors: FinalErrors) -> np.ndarray:
    """Excess over the lower minimum, per cent; infinite where the error is not finite."""
    minimum = np.minimum(errors.minimum_from_genetic, errors.minimum_from_gauss_newton)
    return np.where(np.isfinite(error), 100.0 * (error / minimum - 1.0), np.inf)


def summarise(name: str, errors: FinalErrors) -> dict[str, Any]:
    """Figures of one clip, or of all; the fields of the errors are arrays over the pairs."""
    genetic, descent = (excess(np.asarray(e), errors) for e in (errors.genetic, errors.gauss_newton))
    return {
        "clip": name,
        "pairs": len(genetic),
        "median": float(np.median(genetic)),
        "p90": float(np.percentile(genetic, 90)),
        "p95": float(np.percentile(genetic, 95)),
        "max": float(np.max(genetic)),
        "share": float(np.mean(genetic <= TOLERANCE)),
        "gauss_newton_share": float(np.mean(descent <= TOLERANCE)),
    }


def main(clips: str = common.CLIPS, preset: str = "default", seed: int = 0, json: Path | None = None) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clips: comma-separated, as for drift.py.
        preset: preset of both methods; the objective is the GA's.
        seed: seed of the GA.
        json: file for the figures and every pair's errors.
    """
    rows, pairs, everything = [], {}, []
    for clip in common.names(clips):
        errors = pair_errors(common.open_clip(clip), preset, seed)
        everything += errors
        stacked = stack(errors)
        pairs[clip] = stacked._asdict()
        rows.append(summarise(clip, stacked))
    if len(rows) > 1:
        rows.append(summarise("all", stack(everything)))
    cells = [
        [row["clip"], row["pairs"]]
        + [number(row[key], 3) for key in ("median", "p90", "p95", "max", "share", "gauss_newton_share")]
        for row in rows
    ]
    shares = (f"share <= {TOLERANCE} %", "Gauss-Newton's share")
    columns = ("clip", "pairs", "median %", "p90", "p95", "max", *shares)
    common.print_table(f"excess of E over the minimum, GA preset {preset}", columns, cells)
    results = {"preset": preset, "seed": seed, "summary": rows, "pairs": pairs}
    common.record(json, "optimality", results)
    return results


if __name__ == "__main__":
    common.command(main)
