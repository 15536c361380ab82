"""The solver protocol and the one loop that runs every solver on a pyramid level."""

from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple, Protocol, Self

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Integer, PRNGKeyArray

from gavo_jax.objective import Problem


def static(default: Any) -> Any:
    """A dataclass field that shapes arrays or picks an operator: part of the program, not an input of it."""
    return field(default=default, metadata={"static": True})


Schedule = Any
"""A tuple with an entry a pyramid level, level 0 first; a plain number once `at_level` has picked a level's entry."""


class Bounds(NamedTuple):
    """Search box in the problem's coordinates."""

    lower: Float[Array, " 6"]
    upper: Float[Array, " 6"]


class Best(NamedTuple):
    """Best candidate so far."""

    x: Float[Array, " 6"]
    error: Float[Array, ""]


class Candidates(NamedTuple):
    """The candidates that a state holds, for what wants to look at them (covariance, modes, viewer)."""

    x: Float[Array, "p 6"]
    error: Float[Array, " p"]


class Solver(Protocol):
    """A frozen dataclass pytree of hyperparameters.

    Sizes (population, iterations) are static, every rate is a leaf: a sweep over rates is one `vmap` and never
    recompiles. A field that is a tuple holds one entry a pyramid level, level 0 first; `at_level` picks.
    """

    @property
    def iterations(self) -> Schedule:
        """Largest number of iterations; 0 skips a level."""
        ...

    @property
    def patience(self) -> int:
        """Iterations without a better candidate after which a level ends."""
        ...

    def at_level(self, level: int) -> Self:
        """The solver of one pyramid level."""
        ...

    def init(self, key: PRNGKeyArray, problem: Problem, guess: Float[Array, "g 6"], bounds: Bounds) -> Any:
        """State before the first iteration, from G >= 1 guesses (the first is where the coarser level ended).

        Nothing is evaluated yet: the best error is +inf until the first step.
        """
        ...

    def step(self, key: PRNGKeyArray, state: Any, problem: Problem) -> Any:
        """One iteration: evaluate the candidates in waiting, then choose the next ones."""
        ...

    def best(self, state: Any) -> Best:
        """Best candidate that the state holds."""
        ...

    def candidates(self, state: Any) -> Candidates:
        """All candidates that the state holds, the best one first where there is an order."""
        ...


@dataclass(frozen=True)
class PerLevel:
    """Base of the solvers: resolves fields that hold an entry a level."""

    def at_level(self, level: int) -> Self:
        """The same solver with every per-level tuple replaced by its entry for `level`."""
        entries = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{name: v[level] for name, v in entries.items() if isinstance(v, tuple)})

    @property
    def levels(self) -> tuple[int, ...]:
        """Levels with at least one iteration, coarsest first."""
        iterations: tuple[int, ...] = self.iterations  # pyright: ignore[reportAttributeAccessIssue]
        return tuple(k for k in reversed(range(len(iterations))) if iterations[k] > 0)


class Solution(NamedTuple):
    """What a level's search ends with."""

    x: Float[Array, " 6"]
    error: Float[Array, ""]
    history: Float[Array, " iterations"]
    """Best error after each iteration; NaN from the one that the stagnation stop left out."""
    iterations: Integer[Array, ""]
    candidates: Candidates
    trail: Candidates | None = None
    """All candidates after each iteration, where they were recorded: x [iterations, P, 6], error [iterations, P]; NaN
    like `history`."""


STAGNATION = 1e-4
"""An iteration whose best error is not lower by this share counts as one without progress."""


def solve(
    key: PRNGKeyArray,
    solver: Any,
    problem: Problem,
    guess: Float[Array, "g 6"],
    bounds: Bounds,
    record: bool = False,
) -> Solution:
    """Run a solver on one level, to its number of iterations or to stagnation, and keep the best candidate seen.

    With `patience` of at least `iterations` the loop is a `lax.scan`; below, a `lax.while_loop` that really stops.
    With `record` (static) the candidates of every iteration are kept for people to look at.
    """
    init_key, loop_key = jax.random.split(key)
    state = solver.init(init_key, problem, guess, bounds)
    iterations = solver.iterations
    keys = jax.random.split(loop_key, iterations)

    def iterate(state: Any, best: Best, step_key: PRNGKeyArray) -> tuple[Any, Best, jax.Array]:
        state = solver.step(step_key, state, problem)
        new = solver.best(state)
        better = new.error < best.error
        progress = new.error < best.error * (1.0 - STAGNATION)
        return state, jax.tree.map(lambda a, b: jnp.where(better, a, b), new, best), progress

    best = solver.best(state)
    if solver.patience >= iterations:

        def body(carry: tuple[Any, Best], step_key: PRNGKeyArray) -> tuple[tuple[Any, Best], Any]:
            state, best, _ = iterate(*carry, step_key)
            return (state, best), (best.error, solver.candidates(state) if record else None)

        (state, best), (history, trail) = jax.lax.scan(body, (state, best), keys)
        count = jnp.int32(iterations)
    else:

        def go_on(carry: tuple[Any, ...]) -> jax.Array:
            return (carry[2] < iterations) & (carry[3] < solver.patience)

        def turn(carry: tuple[Any, ...]) -> tuple[Any, ...]:
            state, best, count, stale, logs = carry
            state, best, progress = iterate(state, best, keys[count])
            entries = (best.error, solver.candidates(state) if record else None)
            logs = jax.tree.map(lambda log, entry: log.at[count].set(entry), logs, entries)
            return state, best, count + 1, jnp.where(progress, 0, stale + 1), logs

        def empty(entry: jax.Array) -> jax.Array:
            return jnp.full((iterations, *entry.shape), jnp.nan)

        logs = jax.tree.map(empty, (best.error, solver.candidates(state) if record else None))
        start = (state, best, jnp.int32(0), jnp.int32(0), logs)
        state, best, count, _, (history, trail) = jax.lax.while_loop(go_on, turn, start)
    return Solution(best.x, best.error, history, count, solver.candidates(state), trail)
