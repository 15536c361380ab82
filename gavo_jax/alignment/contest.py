"""Candidates of any origin, refined and chosen by the evidence for them: prior, features, what the islands found."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gavo_jax.alignment.evidence import Evidence
from gavo_jax.alignment.modes import rival_error

STRONG_TOTAL, STRONG_SEEN = 1.5, 2.8
"""Evidence beyond which a motion that was known before needs no search."""
LEAST_EVIDENCE = 0.02
"""Evidence counts as this much at least where two are compared."""


class Contest(NamedTuple):
    """What competes: motions with the evidence for them."""

    motions: Float[Array, "k 4 4"]
    evidence: Evidence
    """[K] each; -inf in a place that is empty."""

    @property
    def winner(self) -> tuple[Float[Array, "4 4"], Evidence]:
        """The motion that most speaks for."""
        best = jnp.argmax(self.evidence.total)
        return self.motions[best], jax.tree.map(lambda leaf: leaf[best], self.evidence)

    @property
    def lead(self) -> Float[Array, ""]:
        """The winner's evidence over that of the best motion of another mode; +inf without one."""
        return rival_error(self.motions, 1.0 / jnp.maximum(self.evidence.total, LEAST_EVIDENCE))

    @property
    def is_decided(self) -> jax.Array:
        """Whether a motion explains the frames so well that nothing need be searched."""
        _, best = self.winner
        return (best.total > STRONG_TOTAL) & (best.seen > STRONG_SEEN)


def hold_contest(
    known: Float[Array, "g 4 4"],
    search: Callable[[], tuple[Float[Array, "k 4 4"], Any]],
    refine: Callable[[Float[Array, "4 4"]], tuple[Float[Array, "4 4"], Evidence]],
) -> tuple[Contest, Any]:
    """Refine what is known and, unless that decides it, what a search finds.

    Args:
        known: Motions that need no search; not-a-number where there is none.
        search: Finds K motions, and whatever else is to be kept of it.
        refine: Takes a motion to the nearest one that the frames speak for, with the evidence for it.

    Returns:
        All that competed, and what was kept of the search: zeros if there was none.
    """
    found, kept = jax.eval_shape(search)
    places = max(known.shape[0], found.shape[0])

    def fill(motions: jax.Array) -> jax.Array:
        return jnp.full((places, 4, 4), jnp.nan).at[: motions.shape[0]].set(motions)

    def skip(motion: jax.Array) -> tuple[jax.Array, Evidence]:
        del motion
        return jnp.eye(4), Evidence(jnp.float32(-jnp.inf), jnp.float32(-jnp.inf))

    def enter(motion: jax.Array) -> tuple[jax.Array, Evidence]:
        return jax.lax.cond(jnp.all(jnp.isfinite(motion)), refine, skip, motion)

    def hold_round(carry: tuple[jax.Array, Contest, Any]) -> tuple[jax.Array, Contest, Any]:
        number, contest, kept = carry

        def search_now() -> tuple[jax.Array, Any]:
            motions, kept = search()
            return fill(motions), kept

        entries, kept = jax.lax.cond(number == 0, lambda: (fill(known), kept), search_now)
        refined, evidence = jax.lax.map(enter, entries)
        put = jax.tree.map(
            lambda all, new: jax.lax.dynamic_update_slice_in_dim(all, new, number * places, axis=0),
            contest,
            Contest(refined, evidence),
        )
        return number + 1, put, kept

    def go_on(carry: tuple[jax.Array, Contest, Any]) -> jax.Array:
        number, contest, _ = carry
        return (number == 0) | ((number == 1) & ~contest.is_decided)

    nothing = jnp.full(2 * places, -jnp.inf)
    empty = Contest(jnp.tile(jnp.eye(4), (2 * places, 1, 1)), Evidence(nothing, nothing))
    kept = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), kept)
    _, contest, kept = jax.lax.while_loop(go_on, hold_round, (jnp.int32(0), empty, kept))
    return contest, kept
