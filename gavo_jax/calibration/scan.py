"""Minimisation of a rough function of one variable without derivatives, with the minimum's uncertainty."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

Score = Callable[[float], tuple[Float[np.ndarray, " pairs"], Bool[np.ndarray, " pairs"]]]
"""Returns the cost of each pair at a value, and which pairs count."""

BLOCK = 5
"""Number of consecutive pairs that the bootstrap draws together, as they share their motion and scene."""
DRAWS = 300
FLAT = 1e-5
"""Rise of the mean cost over the outermost values up to which it is only rounding errors."""
POINTS = 5
"""Number of evenly spaced values that a parabola is fitted to."""


class Minimum(NamedTuple):
    """Minimum of a function."""

    value: float
    deviation: float
    """Standard deviation, by a bootstrap over blocks of pairs; infinite if the pairs do not determine the value."""


def coarse(score: Score, values: Float[np.ndarray, " n"]) -> float:
    """Return the value of a grid with the smallest mean cost, over the pairs that count everywhere."""
    costs, counted = _evaluate(score, values)
    return float(values[np.argmin(costs[:, counted].mean(axis=1))]) if counted.any() else float(np.median(values))


def refine(score: Score, start: float, step: float, low: float, high: float, rounds: int = 3) -> Minimum:
    """Find the minimum near a value, by parabolas through evenly spaced values that are re-centred on it.

    Args:
        score: the function.
        start: initial value.
        step: spacing of the values; wide enough that the function's roughness is small against its rise.
        low: smallest value that is tried.
        high: largest value that is tried.
        rounds: largest number of times that the values are re-centred.
    """
    reach = step * (POINTS // 2)
    middle, least = float(np.clip(start, low + reach, high - reach)), Minimum(start, np.inf)
    for _ in range(rounds):
        values = middle + step * (np.arange(POINTS) - POINTS // 2)
        costs, counted = _evaluate(score, values)
        if not counted.any():
            return Minimum(middle, np.inf)
        means = costs[:, counted].mean(axis=1)
        vertex = _vertex(values, means)
        if vertex is not None and low <= vertex <= high:
            least = Minimum(vertex, _deviation(values, costs[:, counted]))
        else:
            least = Minimum(float(values[np.argmin(means)]), np.inf)
        moved = float(np.clip(least.value, max(middle, low + 2 * reach) - reach, min(middle, high - 2 * reach) + reach))
        if abs(moved - middle) < 0.5 * step:
            break
        middle = moved
    return least


def _evaluate(score: Score, values: Float[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the costs [n, pairs], and which pairs count at every value."""
    results = [score(float(value)) for value in values]
    return np.stack([costs for costs, _ in results]), np.all([counted for _, counted in results], axis=0)


def _vertex(values: Float[np.ndarray, " n"], costs: Float[np.ndarray, " n"]) -> float | None:
    """Return the minimum of the parabola fitted to some values; None if it opens downwards, or is flat."""
    unit = (values[-1] - values[0]) / 2
    curve, slope, _ = np.polyfit((values - values.mean()) / unit, costs, 2)
    return None if curve <= FLAT else float(values.mean() - unit * slope / (2 * curve))


def _deviation(values: Float[np.ndarray, " n"], costs: Float[np.ndarray, "n pairs"]) -> float:
    """Bootstrap standard deviation of the minimum over blocks of pairs, from the draws' interquartile range."""
    blocks = np.array_split(costs, max(1, costs.shape[1] // BLOCK), axis=1)
    sums = np.stack([block.sum(axis=1) for block in blocks])
    draws = np.random.default_rng(0).integers(len(blocks), size=(DRAWS, len(blocks)))
    found = [_vertex(values, sums[draw].sum(axis=0)) for draw in draws]
    known = np.array([value for value in found if value is not None])
    if len(blocks) < 3 or len(known) < 0.9 * DRAWS:
        return np.inf
    low, high = np.percentile(known, [25, 75])
    return float(high - low) / 1.349
