"""The genetic algorithm's operators: the paper's (9) to (14) as functions of plain arrays, and one extension.

In preconditioned coordinates (`Problem`) E is close to isotropic, which two of them exploit. The first population may
be a normal cloud (`initial_population`). One offspring of a generation may be bred from the whole population, at the
minimum of a quadratic fitted to its errors (`surrogate_minimum`). That uses evaluations only, no derivatives, and
replaces the slow last third of a search (`benchmarks/ablation.py`).

Operators do not draw random numbers: they are passed in as `chance`, as a generation draws all of its own at once
(`draw`).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Integer, PRNGKeyArray

from gavo_jax.solvers.base import Bounds

SMALLEST_CHANCE = 2.0**-24
"""Smallest random number. A mutation from 0 would be infinite."""


def draw(key: PRNGKeyArray, count: int) -> Float[Array, "p 8"]:
    """Draw the random numbers of P chromosomes, uniform from `SMALLEST_CHANCE` to 1: six for genes, two for parents.

    Genes are either crossed or mutated, so both operators may use the same six.
    """
    return jax.random.uniform(key, (count, 8), minval=SMALLEST_CHANCE)


def initial_population(
    key: PRNGKeyArray,
    count: int,
    spread: Float[Array, ""] | float | None,
    guess: Float[Array, "g 6"],
    bounds: Bounds,
) -> Float[Array, "p 6"]:
    """First population, uniform within the bounds: ξ = ξ^L + rand (ξ^U − ξ^L). Equation (9).

    The first G are the guesses themselves, as a level begins where the coarser one ended. With a `spread`, which the
    paper doesn't have, the others are a normal cloud about the guesses with this standard deviation.
    """
    about = guess[jnp.arange(count) % guess.shape[0]]
    chance = draw(key, count)[:, :6]
    x = bounds.lower + (bounds.upper - bounds.lower) * chance if spread is None else about + spread * _randn(chance)
    kept = jnp.arange(count)[:, None] < guess.shape[0]
    return jnp.clip(jnp.where(kept, about, x), bounds.lower, bounds.upper)


def fitness(error: Float[Array, " p"], pressure: Float[Array, ""] | float) -> Float[Array, " p"]:
    """Fitness of a population sorted by error, f = exp(−8 E/E_min); 8 is the `pressure`. Equation (10).

    All values are multiplied by e⁸, so that the best is 1: only their proportions matter. A chromosome without a finite
    error has a fitness of 0.
    """
    least = jnp.maximum(error[0], 1e-12)
    return jnp.where(jnp.isfinite(error), jnp.exp(-pressure * (error / least - 1.0)), 0.0)


def roulette(fitness: Float[Array, " p"], chance: Float[Array, "p n"]) -> Integer[Array, "p n"]:
    """Roulette wheel: indices drawn in proportion to the fitness, by its cumulative sum. Equation (11)."""
    up_to = np.triu(np.ones((fitness.shape[0],) * 2, np.float32))
    wheel = fitness @ up_to  # one operation, where a cumulative sum takes many
    # all compared at once: on a population a binary search's loop costs more than it saves
    places = jnp.searchsorted(wheel, chance * wheel[-1], method="compare_all")
    return jnp.minimum(places, fitness.shape[0] - 1)


def mutate(parents: Float[Array, "p 6"], chance: Float[Array, "p 6"], delta: Float[Array, " 6"]) -> Float[Array, "p 6"]:
    """Mutation of every gene: ξ' = ξ + δ randn, in the paper with δ = p_m (ξ^U − ξ^L). Equation (12)."""
    return parents + delta * _randn(chance)


def crossover(
    parents: Float[Array, "p 2 6"], chance: Float[Array, "p 6"], extra_range: Float[Array, ""] | float
) -> Float[Array, "p 6"]:
    """Intermediate crossover: a + α (b − a), α drawn for every gene. Equation (13).

    α is uniform in [−d, 1 + d], d being the `extra_range`.
    """
    first, second = parents[:, 0], parents[:, 1]
    alpha = -extra_range + (1.0 + 2.0 * extra_range) * chance
    return first + alpha * (second - first)


def survive(
    population: Float[Array, "p 6"],
    error: Float[Array, " p"],
    offspring: Float[Array, "q 6"],
    offspring_error: Float[Array, " q"],
    present: Bool[Array, " p"],
) -> tuple[Float[Array, "p 6"], Float[Array, " p"]]:
    """Replacement: parents and offspring merged, sorted by error, and the best P kept with their errors. Equation (14).

    Places that are not `present`, those beyond the level's population, stay empty: their error is +inf.
    """
    everyone = jnp.concatenate([population, offspring])
    errors = jnp.concatenate([error, offspring_error])
    keep = jnp.argsort(errors)[: error.shape[0]]
    return everyone[keep], jnp.where(present, errors[keep], jnp.inf)


def _randn(chance: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Standard normal numbers from uniform ones."""
    return jnp.sqrt(2.0) * jax.lax.erf_inv(2.0 * chance - 1.0)


_PAIRS = np.triu_indices(6, 1)
RIDGE = 0.1
"""Strength of the fit's shrinkage towards isotropy; the problem's coordinates make it nearly isotropic."""


def surrogate_minimum(x: Float[Array, "p 6"], error: Float[Array, " p"]) -> Float[Array, " 6"]:
    """Minimum of a quadratic fitted to evaluated candidates, best first, by weighted ridge regression.

    The mean curvature is fitted freely and anisotropy is shrunk, so that a population smaller than the 28 coefficients
    still gives a sound step. Candidates far above the best have little weight, and the step is limited to four times
    the population's spread.
    """
    finite = jnp.isfinite(error)
    counted = finite.astype(jnp.float32)
    offset = jnp.where(finite[:, None], x - x[0], 0.0)
    count = jnp.maximum(jnp.sum(counted), 1.0)
    radius = jnp.sqrt(jnp.sum(offset**2) / (6.0 * count)) + 1e-6
    z = offset / radius
    height = jnp.where(finite, error - error[0], 0.0)
    height = height / (jnp.sum(height) / count + 1e-12)
    weight = counted / (1.0 + height) ** 2
    square = jnp.sum(z**2, axis=1, keepdims=True)
    features = jnp.concatenate(
        [jnp.ones_like(square), z, square, z**2 - square / 6.0, z[:, _PAIRS[0]] * z[:, _PAIRS[1]]], axis=1
    )
    penalty = jnp.concatenate([jnp.full(8, 1e-6), jnp.full(21, RIDGE)]) * jnp.sum(weight)
    weighted = features * weight[:, None]
    fit = jax.scipy.linalg.solve(weighted.T @ features + jnp.diag(penalty), weighted.T @ height, assume_a="pos")
    slope, bowl, uneven = fit[1:7], fit[7], fit[8:14] - jnp.mean(fit[8:14])
    cross = jnp.zeros((6, 6)).at[_PAIRS].set(fit[14:])
    values, vectors = jnp.linalg.eigh(jnp.diag(2.0 * (bowl + uneven)) + cross + cross.T)
    step = -vectors @ ((vectors.T @ slope) / jnp.maximum(values, 0.2 * jnp.maximum(bowl, 1e-3)))
    step = step * jnp.minimum(1.0, 4.0 / jnp.maximum(jnp.linalg.norm(step), 1e-9))
    return x[0] + radius * jnp.where(jnp.all(jnp.isfinite(step)), step, 0.0)
