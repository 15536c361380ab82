"""The solver protocol and the one loop that runs every solver on a pyramid level."""

import contextlib
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, NamedTuple, Protocol, Self, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Integer, PRNGKeyArray

from gavo_jax.objective.problem import Problem


def static(default: Any, least: float | None = None) -> Any:
    """Declare a dataclass field that shapes arrays or selects an operator: part of the program, not an input of it.

    Args:
        default: Default value.
        least: Smallest allowed number, on levels that are searched.
    """
    return field(default=default, metadata={"static": True, "range": (least, None)})


def within(default: Any, least: float, most: float | None = None, instead_of: str | None = None) -> Any:
    """Declare a dataclass field that is an input of the program, with its range on levels that are searched.

    Args:
        default: Default value.
        least: Smallest allowed number.
        most: Largest allowed number.
        instead_of: Another field of the same solver, which must be None for this one to take effect.
    """
    return field(default=default, metadata={"range": (least, most), "instead_of": instead_of})


Schedule = Annotated[Any, "schedule"]
"""A tuple with an entry per pyramid level, level 0 first, or one number for all."""


class Bounds(NamedTuple):
    """Search box in the problem's coordinates."""

    lower: Float[Array, " 6"]
    upper: Float[Array, " 6"]


class Best(NamedTuple):
    """Best candidate so far."""

    x: Float[Array, " 6"]
    error: Float[Array, ""]


class Candidates(NamedTuple):
    """The candidates that a state holds, for the viewer and for figures of a search."""

    x: Float[Array, "p 6"]
    error: Float[Array, " p"]


@runtime_checkable
class Solver(Protocol):
    """A frozen dataclass pytree of hyperparameters.

    Sizes (population, iterations) are static, every rate is a leaf: a sweep over rates is one `vmap` and never
    recompiles. A field that is a tuple holds one entry per pyramid level, level 0 first. One compiled program serves
    every level, so arrays have the size of the largest entry, and a level's own entry is an input. `PerLevel` provides
    this.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def iterations(self) -> tuple[int, ...]:
        """Largest number of iterations; 0 skips a level."""
        ...

    @property
    def patience(self) -> int:
        """Iterations without progress after which a level ends."""
        ...

    @property
    def progress(self) -> Schedule:
        """Smallest relative decrease of the best error that counts as progress."""
        ...

    @property
    def levels(self) -> tuple[int, ...]:
        """Levels with at least one iteration, coarsest first."""
        ...

    def at_level(self, level: Integer[Array, ""] | int) -> Self:
        """Return the solver for one pyramid level."""
        ...

    def here(self, schedule: Schedule) -> Any:
        """Return the entry of a schedule for that level."""
        ...

    def init(self, key: PRNGKeyArray, problem: Problem, guess: Float[Array, "g 6"], bounds: Bounds) -> Any:
        """Return the state before the first iteration, from G >= 1 guesses (the first is the coarser level's result).

        Nothing is evaluated yet: the best error is +inf until the first step.
        """
        ...

    def step(self, key: PRNGKeyArray, state: Any, problem: Problem) -> Any:
        """Run one iteration: evaluate the pending candidates, then choose the next ones."""
        ...

    def best(self, state: Any) -> Best:
        """Return the best candidate that the state holds."""
        ...

    def candidates(self, state: Any) -> Candidates:
        """Return all candidates that the state holds, the best one first if they are ordered."""
        ...


@dataclass(frozen=True, kw_only=True)
class PerLevel:
    """Base of the solvers: resolves fields that hold an entry per level.

    Attributes:
        progress: An iteration that lowers the best error by no more than this share makes no progress; an entry per
            level.
        level: The level that is being searched; an input of the compiled program.
    """

    progress: Schedule = within(1e-4, 0, 1)
    level: Integer[Array, ""] | int = field(default=0, repr=False)

    def at_level(self, level: Integer[Array, ""] | int) -> Self:
        """Return the same solver on one level."""
        return replace(self, level=level)

    def here(self, schedule: Schedule) -> Any:
        """Return the entry of a schedule for the current level."""
        if not isinstance(schedule, tuple):
            return schedule
        if isinstance(self.level, int):
            return schedule[self.level]
        return jnp.stack([jnp.asarray(entry) for entry in schedule])[self.level]

    @property
    def levels(self) -> tuple[int, ...]:
        """Levels with at least one iteration, coarsest first."""
        iterations: tuple[int, ...] = self.iterations  # pyright: ignore[reportAttributeAccessIssue]
        if isinstance(iterations, tuple):
            with contextlib.suppress(TypeError):  # an entry is not a number
                return tuple(k for k in reversed(range(len(iterations))) if iterations[k] > 0)
        return ()  # refused by `require_settings`


def largest(schedule: Schedule) -> int:
    """Return the largest entry of a static schedule: the size of the arrays that serve every level."""
    return max(schedule) if isinstance(schedule, tuple) else schedule


class Solution(NamedTuple):
    """Result of a level's search."""

    x: Float[Array, " 6"]
    error: Float[Array, ""]
    history: Float[Array, " iterations"]
    """Best error after each iteration; NaN for iterations that were not run because of stagnation."""
    iterations: Integer[Array, ""]
    candidates: Candidates
    trail: Candidates | None = None
    """All candidates after each iteration, if recorded: x [iterations, P, 6], error [iterations, P]; NaN like
    `history`."""


def static_stop(count: Integer[Array, ""], iterations: Integer[Array, ""] | int) -> Bool[Array, ""]:
    """The paper's static stop criterion: the largest number of iterations is reached."""
    return count >= iterations


def diversity_stop(stale: Integer[Array, ""], patience: int) -> Bool[Array, ""]:
    """The paper's diversity stop criterion: the best error has stagnated for `patience` iterations."""
    return stale >= patience


def stagnation(
    stale: Integer[Array, ""],
    error: Float[Array, ""],
    best_error: Float[Array, ""],
    progress: Float[Array, ""] | float,
) -> Integer[Array, ""]:
    """Count consecutive iterations without progress, for `diversity_stop`; the last iteration ended with `error`.

    An iteration makes progress if it lowers the best error so far by more than the share `progress` of it.
    """
    return jnp.where(error < best_error * (1.0 - progress), 0, stale + 1)


def solve(
    key: PRNGKeyArray,
    solver: Any,
    problem: Problem,
    guess: Float[Array, "g 6"],
    bounds: Bounds,
    record: bool = False,
) -> Solution:
    """Run a solver on one level until its number of iterations or stagnation, and keep the best candidate seen.

    With `record` (static) the candidates of every iteration are kept for inspection.
    """
    longest = largest(solver.iterations)
    keys = jax.random.split(key, longest + 1)
    state = solver.init(keys[-1], problem, guess, bounds)
    iterations, least = solver.here(solver.iterations), solver.here(solver.progress)

    def entry(state: Any, best: Best) -> tuple[jax.Array, Candidates | None]:
        return best.error, solver.candidates(state) if record else None

    def go_on(carry: tuple[Any, ...]) -> jax.Array:
        _, _, count, stale, _ = carry
        return ~static_stop(count, iterations) & ~diversity_stop(stale, solver.patience)

    def iterate(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        state, best, count, stale, log = carry
        state = solver.step(keys[count], state, problem)
        new = solver.best(state)
        stale = stagnation(stale, new.error, best.error, least)
        best = jax.tree.map(lambda a, b: jnp.where(new.error < best.error, a, b), new, best)
        log = jax.tree.map(lambda rows, row: rows.at[count].set(row), log, entry(state, best))
        return state, best, count + 1, stale, log

    best = solver.best(state)
    log = jax.tree.map(lambda row: jnp.full((longest, *row.shape), jnp.nan), entry(state, best))
    start = (state, best, jnp.int32(0), jnp.int32(0), log)
    state, best, count, _, (history, trail) = jax.lax.while_loop(go_on, iterate, start)
    return Solution(best.x, best.error, history, count, solver.candidates(state), trail)
