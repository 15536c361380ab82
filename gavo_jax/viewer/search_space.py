"""The search as particles: the camera positions of a level's candidates, and their errors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, UInt32

from gavo_jax.alignment.search import Population
from gavo_jax.viewer.colors import PARTICLE_COLORS

MAX_PARTICLES = 256
"""Maximum number of particles shown per generation; of a larger one every k-th by rank, the best included."""
MILLIMETRES = 1e3
"""Millimetres per metre. The search space is drawn in millimetres, as its particles are that close."""
KEY = (
    "RMSE of the best particle, in grey levels. Particles: blue is best. White: the last camera. Green star: the true "
    "next one, where the arrow leads. The time line `generation` steps through."
)


class Level(NamedTuple):
    """A level's search as it is shown: g generations of p particles."""

    positions: Float[np.ndarray, "g p 3"]
    """Camera position of each particle, in the reference camera, millimetres; the best first."""
    colors: UInt32[np.ndarray, "g p"]
    """Packed RGBA: from blue for the level's best error to vermilion for the worst twentieth."""
    centre: Float[np.ndarray, " 3"]
    half_sizes: Float[np.ndarray, " 3"]
    number: int
    """Number of the pyramid level."""
    particles: int
    """Number of particles in a generation, shown or not."""
    rmse: Float[np.ndarray, " g"]
    """Root mean square residual of each generation's best particle, grey levels."""

    def states(self, errors: Float[np.ndarray, " g"] | None = None) -> list[str]:
        """Return each generation's state as Markdown; `errors` are the best particles' distances from the truth, mm."""
        heading, count = "| particles | level | DSR | iteration | RMSE |", len(self.rmse)
        rows = [
            f"| {self.particles} | {self.number} | 1/{2**self.number} | {i} of {count} | {best:.2f} |"
            for i, best in enumerate(self.rmse.tolist(), 1)
        ]
        if errors is not None:
            heading += " error |"
            rows = [f"{row} {error:.1f} mm |" for row, error in zip(rows, errors.tolist(), strict=True)]
        rule = "|---" * (heading.count("|") - 1) + "|"
        return [f"{heading}\n{rule}\n{row}\n\n{KEY}" for row in rows]


def level_of(population: Population) -> Level | None:
    """Return a level's candidates as they are shown; None if all of them are invalid."""
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
    return Level(
        positions[:-1].reshape(*rmse.shape, 3),
        PARTICLE_COLORS[np.nan_to_num(place, nan=255.0).astype(np.uint8)],
        positions[-1],
        np.asarray(population.half_widths)[:3] * np.float32(MILLIMETRES),
        int(population.level),
        count,
        rmse[:, 0],
    )


def camera_positions(xi: Float[np.ndarray, "*batch 6"]) -> Float64[np.ndarray, "*batch 3"]:
    """Return the target camera's positions in the reference camera for twists of target_T_reference: −V(−w) v, m."""
    v, w = np.asarray(xi[..., :3], np.float64), np.asarray(xi[..., 3:], np.float64)
    square = np.sum(w * w, axis=-1, keepdims=True)
    safe = np.sqrt(np.maximum(square, 1e-8))
    first = np.where(square < 1e-8, 0.5, (1 - np.cos(safe)) / safe**2)
    second = np.where(square < 1e-8, 1 / 6, (safe - np.sin(safe)) / safe**3)
    twice_turned = np.sum(w * v, axis=-1, keepdims=True) * w - square * v
    return -(v - first * np.cross(w, v) + second * twice_turned)


class Ticks(NamedTuple):
    """Ticks along the three edges of a box that meet in the corner which the view looks into: −x, +y, +z."""

    strips: list[Float[np.ndarray, "2 3"]]
    places: Float[np.ndarray, "t 3"]
    """Positions of the labels."""
    labels: list[str]


def ticks_of(centre: Float[np.ndarray, " 3"], half_sizes: Float[np.ndarray, " 3"]) -> Ticks:
    """Return ticks at round numbers of millimetres, three to nine on the longest edge."""
    low, high = centre - half_sizes, centre + half_sizes
    corner = np.array([low[0], high[1], high[2]], np.float64)
    longest = float(np.max(high - low))
    step = next((s for s in _round_steps(longest) if longest / s <= 8), longest)
    strips, places, labels = [], [], []
    for axis, name in enumerate("xyz"):
        inward = np.zeros(3)
        across = (axis + 1) % 3
        inward[across] = 0.02 * longest * np.sign(centre[across] - corner[across])
        for number in range(int(np.ceil(low[axis] / step)), int(np.floor(high[axis] / step)) + 1):
            start = corner.copy()
            start[axis] = number * step
            strips.append(np.stack([start, start + inward]))
            places.append(start + 2 * inward)
            labels.append(f"{name} {number * step:g}")
    return Ticks(strips, np.array(places).reshape(-1, 3), labels)


def _round_steps(length: float) -> list[float]:
    """Return 1, 2 and 5 times powers of ten, ascending, up to about a length."""
    power = np.floor(np.log10(max(length, 1e-6)))
    return [float(f"{digit}e{int(power + shift)}") for shift in (-2, -1, 0) for digit in (1, 2, 5)]


def star_strips(centre: Float[np.ndarray, " 3"], size: float) -> list[Float[np.ndarray, "2 3"]]:
    """Return the strokes of a star in space."""
    directions = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1, -1, 1], [-1, 1, 1], [1, 1, -1]], float)
    directions *= size / np.linalg.norm(directions, axis=1, keepdims=True)
    return [np.stack([centre - d, centre + d]) for d in directions]
