"""Cost of scoring a candidate motion, in nanoseconds per pixel and candidate, for several formulations.

Prints one row per formulation and one column per image size (the five pyramid levels of 640x480):

- `Objective.score` as the solvers call it, its two forms (candidates in turn in a fused loop; all side by side), and
  the same with the default preset's robust loss and depth term;
- `score` without the barrier behind the look-up (XLA may then read a word again for each of its bytes), and with costs
  and marks of the points outside in two arrays (XLA may then pass over the points twice);
- a plain version with [N, 4] points, `vmap` and `map_coordinates`;
- references outside JAX: a hand-written numba loop (`prange`, `fastmath`) and SciPy's `map_coordinates`.

All but the robust one compute the same errors, which is checked. A second table has the ratios of the plain version to
`score` and of `score` to the numba loop. Times are medians of runs in turn (A B C A B C ...), so that a slow spell
affects all.

    python benchmarks/kernel.py
    python benchmarks/kernel.py --levels 2,3 --population 16 --rounds 3 --json kernel.json

On 2 cores the defaults take about 2 minutes. SciPy is timed on 4 candidates, one after the other.
"""

import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import common
import jax
import jax.numpy as jnp
import numpy as np

from gavo_jax.alignment.fitting import objectives_of
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.image.pyramid import Pyramid, build_pyramid
from gavo_jax.objective.error import Objective, Residuals, lane_sum
from gavo_jax.objective.losses import l2
from gavo_jax.output.screen import number
from gavo_jax.se3 import exp
from gavo_jax.settings import AlignmentOptions

SCORE, MAPPED, SIDE_BY_SIDE, FULL = "score", "score, in turn", "score, side by side", "score, robust + depth"
NO_BARRIER, TWO_MARKS = "score, no barrier", "score, two marks"
PLAIN, NUMBA, SCIPY = "plain vmap", "numba", "scipy"
GREY_ONLY = AlignmentOptions(loss=l2, depth=False, brightness=False, robust_scale=False, points=None, min_overlap=0.0)
SCIPY_CANDIDATES = 4
GENERATIONS = 10
"""Populations that one timed call of ours scores in turn: a search is one program, entered once."""
LEAST_SECONDS = 0.2
"""A measurement repeats its call until it takes about this long."""


class Scene(NamedTuple):
    """Input of the formulations: a level of a pair, as plain arrays, and the motions."""

    camera: Camera
    rays: np.ndarray
    """[3, N] x, y of the ray and inverse depth (0 = no reading) of the reference's points."""
    grey: np.ndarray
    """[N] grey levels of the reference."""
    target: np.ndarray
    """[h, w] grey levels of the target, rounded."""
    motions: np.ndarray
    """[P, 4, 4] target_T_reference."""


def score_without_barrier(objective: Objective, motions: jax.Array) -> tuple[jax.Array, jax.Array]:
    """`Objective.score` traced without `sampling.look_up`'s barrier."""
    with mock.patch.object(jax.lax, "optimization_barrier", lambda words: words):
        return objective.score(motions)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TwoMarks(Objective):
    """The objective with costs and marks of the points inside in two arrays."""

    @classmethod
    def of(cls, objective: Objective) -> "TwoMarks":
        """Make it from the usual objective."""
        return cls(**{field.name: getattr(objective, field.name) for field in fields(objective)})

    def cost(self, r: Residuals) -> jax.Array:
        """Costs [0], 0 outside, and marks [1], 1 inside: [2, N]."""
        return jnp.stack([jnp.where(r.inside > 0, super().cost(r), 0.0), r.inside])

    def sums(self, cost: jax.Array) -> jax.Array:
        """Sum each array."""
        return jnp.stack([lane_sum(cost[0]), lane_sum(cost[1])])


@jax.jit
def plain_score(points: jax.Array, grey: jax.Array, target: jax.Array, camera: Camera, motions: jax.Array) -> jax.Array:
    """E of every motion, written like the equations, with homogeneous points [N, 4]; NaN without a reading."""

    def error(target_T_reference: jax.Array) -> jax.Array:
        moved = (points @ target_T_reference.T)[:, :3]
        u = camera.fx * moved[:, 0] / moved[:, 2] + camera.cx
        v = camera.fy * moved[:, 1] / moved[:, 2] + camera.cy
        inside = (moved[:, 2] > 1e-3) & (u >= 0) & (u < camera.width - 1) & (v >= 0) & (v < camera.height - 1)
        sampled = jax.scipy.ndimage.map_coordinates(target, [v, u], order=1, mode="nearest")
        square = jnp.where(inside, (sampled - grey) ** 2, 0.0)
        return jnp.sum(square) / jnp.maximum(jnp.sum(inside), 1)

    return jax.vmap(error)(motions)


@cache
def make_numba_score() -> Callable[..., np.ndarray]:
    """Make the hand-written loop: candidates in parallel, pixels one by one, no intermediate arrays."""
    import numba

    @numba.njit(parallel=True, fastmath=True)
    def score(rays, grey, target, intrinsics, motions):
        fx, fy, cx, cy = intrinsics
        height, width = target.shape
        errors = np.empty(motions.shape[0], np.float32)
        for p in numba.prange(motions.shape[0]):
            m = motions[p]
            total, count = np.float32(0.0), 0
            for i in range(grey.shape[0]):
                x, y, q = rays[0, i], rays[1, i], rays[2, i]
                depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] + m[2, 3] * q
                if q <= 0 or depth <= np.float32(1e-3):
                    continue
                u = fx * (m[0, 0] * x + m[0, 1] * y + m[0, 2] + m[0, 3] * q) / depth + cx
                v = fy * (m[1, 0] * x + m[1, 1] * y + m[1, 2] + m[1, 3] * q) / depth + cy
                if u < 0 or u >= width - 1 or v < 0 or v >= height - 1:
                    continue
                column, row = int(u), int(v)
                a, b = u - np.float32(column), v - np.float32(row)
                top = target[row, column] + a * (target[row, column + 1] - target[row, column])
                low = target[row + 1, column] + a * (target[row + 1, column + 1] - target[row + 1, column])
                residual = top + b * (low - top) - grey[i]
                total += residual * residual
                count += 1
            errors[p] = total / np.float32(max(count, 1))
        return errors

    return score


def scipy_score(scene: Scene, motions: np.ndarray) -> np.ndarray:
    """E of every motion with NumPy and SciPy, one candidate after the other."""
    from scipy.ndimage import map_coordinates

    camera, (x, y, q) = scene.camera, scene.rays
    errors = []
    for m in motions:
        moved = m[:3, :3] @ np.stack([x, y, np.ones_like(x)]) + m[:3, 3:] * q
        u = camera.fx * moved[0] / moved[2] + camera.cx
        v = camera.fy * moved[1] / moved[2] + camera.cy
        inside = (q > 0) & (moved[2] > 1e-3) & (u >= 0) & (u < camera.width - 1) & (v >= 0) & (v < camera.height - 1)
        sampled = map_coordinates(scene.target, [v, u], order=1, mode="nearest", prefilter=False)
        errors.append(np.mean((sampled - scene.grey)[inside] ** 2))
    return np.array(errors)


def make_objective(
    pyramids: tuple[Pyramid, Pyramid], camera: Camera, level: int, options: AlignmentOptions
) -> Objective:
    """The objective of one level of a pair, with every pixel a point."""
    return jax.jit(lambda a, b: objectives_of(a, b, camera, (level,), options, jnp.eye(4))[0])(*pyramids)


def make_scene(pyramids: tuple[Pyramid, Pyramid], camera: Camera, level: int, motions: np.ndarray) -> Scene:
    """One level as plain arrays; the target is rounded as by `pack_grey`, so that all see the same image."""
    reference, target = (jax.device_get(pyramid[level]) for pyramid in pyramids)
    camera = camera.level(level)
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    rays = [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, reference.inverse_depth]
    flat = np.stack([np.ravel(ray) for ray in rays]).astype(np.float32)
    return Scene(camera, flat, np.ravel(reference.grey), np.round(target.grey).astype(np.float32), motions)


class Formulation(NamedTuple):
    """One implementation of scoring."""

    run: Callable[[], np.ndarray]
    """Score all candidates and wait; returns the errors."""
    candidates: int
    same: bool
    """Whether it computes the plain photometric error, like the others."""


def formulations(scene: Scene, objective: Objective, full: Objective) -> dict[str, Formulation]:
    """The formulations by name; numba and SciPy only where installed."""
    count = len(scene.motions)
    motions = jnp.asarray(scene.motions)

    generations = jnp.tile(motions, (GENERATIONS, 1, 1, 1))

    def ours(score: Callable[[Objective, jax.Array], Any], what: Objective = objective) -> Callable[[], np.ndarray]:
        compiled = jax.jit(lambda o, all_motions: jax.lax.map(lambda m: score(o, m)[0], all_motions))
        return lambda: np.asarray(compiled(what, generations)[0])

    x, y, q = scene.rays
    with np.errstate(divide="ignore"):
        depth = np.where(q > 0, 1.0 / q, np.nan).astype(np.float32)
    points = jnp.asarray(np.stack([x * depth, y * depth, depth, np.ones_like(depth)], axis=1))
    arrays = (points, jnp.asarray(scene.grey), jnp.asarray(scene.target), scene.camera, motions)
    found = {
        SCORE: Formulation(ours(Objective.score), count * GENERATIONS, True),
        MAPPED: Formulation(ours(lambda o, m: jax.lax.map(o.error, m)), count * GENERATIONS, True),
        SIDE_BY_SIDE: Formulation(ours(lambda o, m: jax.vmap(o.error)(m)), count * GENERATIONS, True),
        NO_BARRIER: Formulation(ours(score_without_barrier), count * GENERATIONS, True),
        TWO_MARKS: Formulation(ours(Objective.score, TwoMarks.of(objective)), count * GENERATIONS, True),
        FULL: Formulation(ours(Objective.score, full), count * GENERATIONS, False),
        PLAIN: Formulation(lambda: np.asarray(plain_score(*arrays)), count, True),
    }
    if importlib.util.find_spec("numba"):
        score, camera = make_numba_score(), scene.camera
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
        given = (scene.rays, scene.grey, scene.target, intrinsics, scene.motions)
        found[NUMBA] = Formulation(lambda: score(*given), count, True)
    if importlib.util.find_spec("scipy"):
        few = scene.motions[:SCIPY_CANDIDATES]
        found[SCIPY] = Formulation(lambda: scipy_score(scene, few), len(few), True)
    return found


def measure(candidates: dict[str, Formulation], pixels: int, rounds: int) -> dict[str, float]:
    """Median nanoseconds per pixel and candidate, the formulations in turn.

    Raises:
        GavoError: two formulations of the same error disagree.
    """
    expected = candidates[SCORE].run()
    repeats, times = {}, {name: [] for name in candidates}
    for name, formulation in candidates.items():
        errors = formulation.run()
        if formulation.same and not np.allclose(errors, expected[: len(errors)], rtol=5e-3, equal_nan=False):
            raise GavoError(f"{name}: errors differ from those of {SCORE}")
        start = time.perf_counter()
        formulation.run()
        repeats[name] = max(1, round(LEAST_SECONDS / (time.perf_counter() - start)))
    for _ in range(rounds):
        for name, formulation in candidates.items():
            formulation.run()  # warm-up: memory and threads are then its own
            start = time.perf_counter()
            for _ in range(repeats[name]):
                formulation.run()
            seconds = (time.perf_counter() - start) / repeats[name]
            times[name].append(seconds * 1e9 / (pixels * formulation.candidates))
    return {name: float(np.median(values)) for name, values in times.items()}


def random_motions(count: int) -> np.ndarray:
    """Random motions [P, 4, 4] about the identity; standard deviation 1 cm and 0.6 degrees per axis."""
    return np.asarray(exp(0.01 * jax.random.normal(jax.random.key(0), (count, 6))))


def pyramid_of(frame: Frame, camera: Camera) -> Pyramid:
    """The pyramid of a frame, on the device."""
    return jax.jit(build_pyramid)(frame.grey, frame.depth, camera.depth_scale)


def main(levels: str = "0,1,2,3,4", population: int = 64, rounds: int = 7, json: Path | None = None) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        levels: comma-separated pyramid levels of 640x480.
        population: number of candidates.
        rounds: measurements of each formulation.
        json: file for the figures.
    """
    sequence = SyntheticSequence(2)
    camera = sequence.camera
    pyramids = (pyramid_of(sequence[0], camera), pyramid_of(sequence[1], camera))
    motions = random_motions(population)
    by_size: dict[str, dict[str, float]] = {}
    for level in common.counts(levels):
        scene = make_scene(pyramids, camera, level, motions)
        objective = make_objective(pyramids, camera, level, GREY_ONLY)
        full = make_objective(pyramids, camera, level, AlignmentOptions(points=None, min_overlap=0.0))
        size = f"{scene.camera.width}x{scene.camera.height}"
        by_size[size] = measure(formulations(scene, objective, full), scene.grey.size, rounds)
    rows = [[name, *(number(times[name], 2) for times in by_size.values())] for name in next(iter(by_size.values()))]
    device = jax.devices()[0].device_kind
    common.print_table(f"ns per pixel and candidate, {population} candidates, {device}", ("", *by_size), rows)
    ratios = {f"{PLAIN} / {SCORE}": {size: times[PLAIN] / times[SCORE] for size, times in by_size.items()}}
    if all(NUMBA in times for times in by_size.values()):
        ratios[f"{SCORE} / {NUMBA}"] = {size: times[SCORE] / times[NUMBA] for size, times in by_size.items()}
    rows = [[name, *(number(value, 2) for value in values.values())] for name, values in ratios.items()]
    common.print_table("ratios", ("", *by_size), rows)
    results = {"population": population, "rounds": rounds, "nanoseconds": by_size, "ratios": ratios}
    common.record(json, "kernel", results)
    return results


if __name__ == "__main__":
    common.command(main)
