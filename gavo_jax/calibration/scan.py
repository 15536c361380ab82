"""The least of a rough function of one number: values of it alone, no derivatives, and how sure the least is."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

Score = Callable[[float], tuple[Float[np.ndarray, " pairs"], Bool[np.ndarray, " pairs"]]]
"""Cost of each pair at a value, and which pairs count."""

BLOCK = 5
"""Consecutive pairs share their motion and their scene: they are drawn together."""
DRAWS = 300
POINTS = 5
"""Values, evenly spaced about the least, to which the last parabola is fitted."""


class Least(NamedTuple):
    """Where a function is least."""

    value: float
    deviation: float
    """One standard deviation, by drawing blocks of pairs anew; infinite where the pairs leave it open."""


def coarse(score: Score, values: Float[np.ndarray, " n"]) -> float:
    """The value of a grid at which the mean cost is least, over the pairs that count everywhere."""
    costs, counted = _evaluate(score, values)
    return float(values[np.argmin(costs[:, counted].mean(axis=1))]) if counted.any() else float(np.median(values))


def refine(score: Score, start: float, step: float, low: float, high: float, rounds: int = 3) -> Least:
    """The least near a value, by parabolas through evenly spaced values that follow it.

    Args:
        score: the function.
        start: where to look.
        step: between the values; wide enough that the function's roughness is small against its rise.
        low: no value below is tried,
        high: and none above.
        rounds: how often the values are moved to the least found, at most.
    """
    reach = step * (POINTS // 2)
    middle, least = float(np.clip(start, low + reach, high - reach)), Least(start, np.inf)
    for _ in range(rounds):
        values = middle + step * (np.arange(POINTS) - POINTS // 2)
        costs, counted = _evaluate(score, values)
        if not counted.any():
            return Least(middle, np.inf)
        means = costs[:, counted].mean(axis=1)
        vertex = _vertex(values, means)
        if vertex is not None and low <= vertex <= high:
            least = Least(vertex, _deviation(values, costs[:, counted]))
        else:
            least = Least(float(values[np.argmin(means)]), np.inf)
        moved = float(np.clip(least.value, max(middle, low + 2 * reach) - reach, min(middle, high - 2 * reach) + reach))
        if abs(moved - middle) < 0.5 * step:
            break
        middle = moved
    return least


def _evaluate(score: Score, values: Float[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
    """Costs [n, pairs], and the pairs that count at every value."""
    results = [score(float(value)) for value in values]
    return np.stack([costs for costs, _ in results]), np.all([counted for _, counted in results], axis=0)


def _vertex(values: Float[np.ndarray, " n"], costs: Float[np.ndarray, " n"]) -> float | None:
    """The least of the parabola through some values; None where it opens downwards."""
    unit = (values[-1] - values[0]) / 2
    curve, slope, _ = np.polyfit((values - values.mean()) / unit, costs, 2)
    return None if curve <= 0 else float(values.mean() - unit * slope / (2 * curve))


def _deviation(values: Float[np.ndarray, " n"], costs: Float[np.ndarray, "n pairs"]) -> float:
    """Scatter of the least over blocks of pairs drawn anew (the bootstrap), from the middle half of the draws."""
    blocks = np.array_split(costs, max(1, costs.shape[1] // BLOCK), axis=1)
    sums = np.stack([block.sum(axis=1) for block in blocks])
    draws = np.random.default_rng(0).integers(len(blocks), size=(DRAWS, len(blocks)))
    found = [_vertex(values, sums[draw].sum(axis=0)) for draw in draws]
    known = np.array([value for value in found if value is not None])
    if len(blocks) < 3 or len(known) < 0.9 * DRAWS:
        return np.inf
    low, high = np.percentile(known, [25, 75])
    return float(high - low) / 1.349
