"""Refinement of candidates of any origin (prior, features, islands), and choice among them by their evidence."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Integer

from gavo_jax.alignment.evidence import Evidence
from gavo_jax.alignment.modes import rival_error
from gavo_jax.objective.estimates import Brightness

STRONG_TOTAL, STRONG_SEEN = 0.9, 2.8
"""Evidence beyond which a motion that was known beforehand makes a search unnecessary."""
LEAST_EVIDENCE = 0.02
"""Lower bound on evidence where two motions are compared."""
KNOWN, FOUND, ALIASES, WINNER = range(4)
"""Rounds: motions known beforehand, those that a search finds, the aliases of the best of both on a repetitive pattern,
and the best of all on the finest level."""
CLOSE = 0.8
"""Ratio of a motion's evidence to the largest above which both are even. Then the points that each sees decide: a plain
wall matches itself anywhere, so a smaller motion, which keeps more of it in view, has more evidence but is no better.
"""
LEAST_RIVAL = 0.5
"""Ratio of a mode's evidence to the winner's above which it is a rival."""


class Entry(NamedTuple):
    """A motion that competes, or [K] of them."""

    motion: Float[Array, "*k 4 4"]
    evidence: Evidence
    """By fixed scales, which its bounds are for; negative infinity in an empty place."""
    at_best: Evidence
    """Under the noise that explains the motion best, by which motions are compared."""
    brightness: Brightness
    """Brightness with which the motion was refined."""


def hold_contest(
    known: Float[Array, "g 4 4"],
    search: Callable[[], tuple[Float[Array, "k 4 4"], Any]],
    aliases: Float[Array, "a 4 4"],
    refine: Callable[[Float[Array, "4 4"], Bool[Array, ""]], Entry],
    always: bool,
) -> tuple[Entry, Float[Array, ""], Any]:
    """Refine the known motions and, unless one of them is decisive, those of a search; then the winner once more.

    The winner is refined on the finest level, all others on the coarser ones.

    Args:
        known: Motions that need no search; NaN where there is none.
        search: Finds K motions, and returns whatever else is to be kept.
        aliases: Motions after which the reference looks as before (`aliases.self_motions`).
        refine: Refines a motion, on the finest level if its second argument is true, else on all the others.
        always: Whether to search even if a known motion is decisive (static).

    Returns:
        The winner; the ratio of its evidence to that of a rival mode, over the points that each sees, +inf without a
        rival; and what was kept of the search, NaN if there was none.
    """
    search, refine = jax.jit(search), jax.jit(refine)  # traced once, for the shapes of their results and for the rounds
    found, kept = jax.eval_shape(search)
    places = max(known.shape[0], found.shape[0], aliases.shape[0])
    like = partial(jax.tree.map, lambda leaf: jnp.zeros(leaf.shape, leaf.dtype))
    nothing = Evidence(jnp.float32(-jnp.inf), jnp.float32(-jnp.inf))
    blank: Entry = like(jax.eval_shape(lambda: refine(jnp.eye(4), jnp.array(True))))
    blank = Entry(jnp.eye(4), nothing, nothing, blank.brightness)
    rows = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (WINNER + 1, places, *leaf.shape)), blank)

    def fill(motions: jax.Array) -> jax.Array:
        return jnp.full((places, 4, 4), jnp.nan, jnp.float32).at[: motions.shape[0]].set(motions)

    def hold_round(carry: tuple[jax.Array, Entry, Any]) -> tuple[jax.Array, Entry, Any]:
        number, rows, kept = carry

        def search_now() -> tuple[jax.Array, Any]:
            motions, kept = search()
            return fill(motions), kept

        leader = _best(rows).motion
        rounds = (
            lambda: (fill(known), kept),
            search_now,
            lambda: (fill(leader @ aliases), kept),
            lambda: (fill(leader[None]), kept),
        )
        entries, kept = jax.lax.switch(number, rounds)

        def enter(motion: jax.Array) -> Entry:
            exists = jnp.all(jnp.isfinite(motion))
            return jax.lax.cond(exists, lambda: refine(motion, number == WINNER), lambda: blank)

        entered = jax.lax.map(enter, entries)
        rows = jax.tree.map(lambda all, new: all.at[number].set(new), rows, entered)
        best = _best(rows).evidence
        decided = (not always) & (best.total > STRONG_TOTAL) & (best.seen > STRONG_SEEN)
        return jnp.where((number == KNOWN) & decided, ALIASES, number + 1), rows, kept

    start = (jnp.int32(KNOWN), rows, jax.tree.map(_unknown, kept))
    _, rows, kept = jax.lax.while_loop(lambda carry: carry[0] <= WINNER, hold_round, start)
    return jax.tree.map(lambda leaf: leaf[WINNER, 0], rows), _lead(rows), kept


def _unknown(leaf: jax.ShapeDtypeStruct) -> jax.Array:
    """NaN, or 0 for integers."""
    return jnp.full(leaf.shape, jnp.nan if jnp.issubdtype(leaf.dtype, jnp.inexact) else 0, leaf.dtype)


def _competing(rows: Entry) -> Entry:
    """Return all entries that competed."""
    return jax.tree.map(lambda leaf: leaf[:WINNER].reshape(-1, *leaf.shape[2:]), rows)


def _best(rows: Entry) -> Entry:
    """Return the entry that wins."""
    entries = _competing(rows)
    winner = _winner(entries.at_best)
    return jax.tree.map(lambda leaf: leaf[winner], entries)


def _winner(of: Evidence) -> Integer[Array, ""]:
    """Return the number of the entry with the most evidence; among even ones, over the points that each sees."""
    most = jnp.max(of.total)
    even = of.total >= jnp.where(most > 0, CLOSE * most, most)
    return jnp.argmax(jnp.where(even, of.seen, -jnp.inf))


def _lead(rows: Entry) -> Float[Array, ""]:
    """Return the ratio of the winner's evidence to a rival's.

    Only the points that each sees count, as a larger overlap alone makes no motion better.
    """
    motions, _, of, _ = _competing(rows)
    winner = _winner(of)
    is_rival = of.total >= LEAST_RIVAL * of.total[winner]
    costs = jnp.where(is_rival, 1.0 / jnp.maximum(of.seen, LEAST_EVIDENCE), jnp.inf)
    return of.seen[winner] * rival_error(motions, costs, winner)
