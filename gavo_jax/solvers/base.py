"""The solver protocol and the one loop that runs every solver on a pyramid level."""

import contextlib
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, NamedTuple, Protocol, Self, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Integer, PRNGKeyArray

from gavo_jax.objective.problem import Problem


def static(default: Any, least: float | None = None) -> Any:
    """A dataclass field that shapes arrays or picks an operator: part of the program, not an input of it.

    Args:
        default: Its value.
        least: What a number must at least be, on the levels that are searched.
    """
    return field(default=default, metadata={"static": True, "range": (least, None)})


def within(default: Any, least: float, most: float | None = None, instead_of: str | None = None) -> Any:
    """A dataclass field that is an input of the program, and the range of its numbers on levels that are searched.

    Args:
        default: Its value.
        least: What a number must at least be.
        most: What it may at most be.
        instead_of: Another field of the same solver, which has to be None for this one to count.
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
    """The candidates that a state holds, kept for the viewer and the figures of a search."""

    x: Float[Array, "p 6"]
    error: Float[Array, " p"]


@runtime_checkable
class Solver(Protocol):
    """A frozen dataclass pytree of hyperparameters.

    Sizes (population, iterations) are static, every rate is a leaf: a sweep over rates is one `vmap` and never
    recompiles. A field that is a tuple holds one entry per pyramid level, level 0 first. One compiled program serves
    every level, so arrays are made for the largest entry and what counts on a level is a number in the program:
    `PerLevel` brings what that needs.
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
        """Share of its best error that an iteration must exceed to be one with progress."""
        ...

    @property
    def levels(self) -> tuple[int, ...]:
        """Levels with at least one iteration, coarsest first."""
        ...

    def at_level(self, level: Integer[Array, ""] | int) -> Self:
        """The solver of one pyramid level."""
        ...

    def here(self, schedule: Schedule) -> Any:
        """Entry of a schedule for that level."""
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


@dataclass(frozen=True, kw_only=True)
class PerLevel:
    """Base of the solvers: resolves fields that hold an entry per level.

    Attributes:
        progress: An iteration that lowers the best error by no more than this share counts as one without progress;
            an entry per level.
        level: The level that is being searched; an input of the compiled program.
    """

    progress: Schedule = within(1e-4, 0, 1)
    level: Integer[Array, ""] | int = field(default=0, repr=False)

    def at_level(self, level: Integer[Array, ""] | int) -> Self:
        """The same solver on one level."""
        return replace(self, level=level)

    def here(self, schedule: Schedule) -> Any:
        """Entry of a schedule for the present level."""
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
            with contextlib.suppress(TypeError):  # an entry that is no count
                return tuple(k for k in reversed(range(len(iterations))) if iterations[k] > 0)
        return ()  # for `require_settings` to refuse


def largest(schedule: Schedule) -> int:
    """Largest entry of a static schedule: the size of the arrays that serve every level."""
    return max(schedule) if isinstance(schedule, tuple) else schedule


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
    """Iterations in a row without progress, of which the last one ended with `error`: what `diversity_stop` asks for.

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
    """Run a solver on one level, to its number of iterations or to stagnation, and keep the best candidate seen.

    With `record` (static) the candidates of every iteration are kept for people to look at.
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
