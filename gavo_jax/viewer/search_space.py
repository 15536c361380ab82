"""The particles at work: where a level's candidates put the camera, and how good they are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, UInt32

from gavo_jax.alignment.search import Population
from gavo_jax.viewer.colors import PARTICLE_COLORS

MAX_PARTICLES = 256
"""Particles shown of a generation; of a larger one every k-th by rank, the best included."""
MILLIMETRES = 1e3
"""Of the search space: its particles lie millimetres apart."""
KEY = (
    "Particles: blue is best. White: the last camera. Green star: the true next one. Arrow: error of the best "
    "particle. Step through a search on the time line `generation`."
)


class Level(NamedTuple):
    """The search of a level as it is shown, g generations of p particles."""

    positions: Float[np.ndarray, "g p 3"]
    """Where each particle puts the camera, seen from the last one, millimetres; the best first."""
    colors: UInt32[np.ndarray, "g p"]
    """RGBA, a byte each. Blue is the level's best error, vermilion that of its worst particles."""
    centre: Float[np.ndarray, " 3"]
    half_sizes: Float[np.ndarray, " 3"]
    texts: list[str]
    """A generation's state, as Markdown."""


def level_of(population: Population) -> Level | None:
    """Return what is shown of a level's candidates, None where none of them is worth anything."""
    population = population.trimmed()
    xi, error = np.asarray(population.xi), np.asarray(population.error)
    finite = np.sqrt(error[np.isfinite(error)])
    if finite.size == 0:
        return None
    iterations, count = error.shape
    order = np.argsort(error, axis=1, kind="stable")[:, :: -(-count // MAX_PARTICLES)]
    rows = np.arange(iterations)[:, None]
    xi, rmse = xi[rows, order], np.sqrt(error[rows, order])
    worst = int(0.95 * (finite.size - 1))
    low, high = finite.min(), np.partition(finite, worst)[worst]
    place = (np.minimum(rmse, high) - low) * (255 / max(high - low, 1e-6))
    twists = np.concatenate([xi.reshape(-1, 6), np.asarray(population.centre)[None]])
    positions = (camera_positions(twists) * MILLIMETRES).astype(np.float32)
    level = int(population.level)
    texts = [
        f"| particles | level | DSR | iteration | best RMSE |\n|---|---|---|---|---|\n"
        f"| {count} | {level} | 1/{2**level} | {i} of {iterations} | {best:.2f} grey levels |\n\n{KEY}"
        for i, best in enumerate(rmse[:, 0].tolist(), 1)
    ]
    return Level(
        positions[:-1].reshape(*rmse.shape, 3),
        PARTICLE_COLORS[place.astype(np.uint8)],
        positions[-1],
        np.asarray(population.half_widths)[:3] * np.float32(MILLIMETRES),
        texts,
    )


def camera_positions(xi: Float[np.ndarray, "*batch 6"]) -> Float64[np.ndarray, "*batch 3"]:
    """Return where twists of target_T_reference put the target camera, seen from the reference: −V(−w) v, metres."""
    v, w = np.asarray(xi[..., :3], np.float64), np.asarray(xi[..., 3:], np.float64)
    square = np.sum(w * w, axis=-1, keepdims=True)
    safe = np.sqrt(np.maximum(square, 1e-8))
    first = np.where(square < 1e-8, 0.5, (1 - np.cos(safe)) / safe**2)
    second = np.where(square < 1e-8, 1 / 6, (safe - np.sin(safe)) / safe**3)
    twice_turned = np.sum(w * v, axis=-1, keepdims=True) * w - square * v
    return -(v - first * np.cross(w, v) + second * twice_turned)


def star_strips(centre: Float[np.ndarray, " 3"], size: float) -> list[Float[np.ndarray, "2 3"]]:
    """Return the strokes of a star in space."""
    directions = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1, -1, 1], [-1, 1, 1], [1, 1, -1]], float)
    directions *= size / np.linalg.norm(directions, axis=1, keepdims=True)
    return [np.stack([centre - d, centre + d]) for d in directions]
