"""Candidates compete by the evidence for them, whatever found them."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gavo_jax.alignment.contest import Entry, hold_contest
from gavo_jax.alignment.evidence import Evidence
from gavo_jax.objective.estimates import Brightness
from gavo_jax.se3 import exp

NOWHERE = jnp.full((1, 4, 4), jnp.nan)


def sideways(*metres: float) -> jax.Array:
    return exp(jnp.stack([jnp.array([x, 0.0, 0.0, 0.0, 0.0, 0.0]) for x in metres]))


class Peak(NamedTuple):
    """Where the frames speak for a motion, and how much: over all readings, and over the points seen alone."""

    place: float
    total: float
    seen: float


def contest(
    known: jax.Array, found: jax.Array, peaks: Sequence[Peak], aliases: jax.Array = NOWHERE
) -> tuple[Entry, float, float]:
    """The winner, its lead, and 1 where there was a search, else not-a-number; evidence falls off from its peaks."""
    places, totals, seen = jnp.array(peaks).T

    def refine(motion: jax.Array, is_last: jax.Array) -> Entry:
        fall = 10.0 * jnp.abs(motion[0, 3] - places)
        nearest = jnp.argmin(fall)
        evidence = Evidence(totals[nearest] - fall[nearest], seen[nearest] - fall[nearest])
        return Entry(motion, evidence, evidence, Brightness(jnp.ones(1), jnp.where(is_last, 1.0, 0.0)[None]))

    winner, lead, searched = jax.jit(
        lambda: hold_contest(known, lambda: (found, jnp.float32(1.0)), aliases, refine, always=False)
    )()
    return winner, float(lead), float(searched)


def test_what_most_speaks_for_wins() -> None:
    peaks = [Peak(0.0, 0.4, 5.0), Peak(0.3, 1.0, 1.5), Peak(0.6, 0.7, 1.6)]
    winner, lead, searched = contest(sideways(0.0), sideways(0.3, 0.6), peaks)
    assert winner.motion[0, 3] == pytest.approx(0.3), "by all readings, as few points may match by chance"
    assert winner.brightness.bias[0] == 1.0, "refined once more, on the finest level"
    assert lead == pytest.approx(1.5 / 1.6, rel=1e-3), "by the points seen, over those of the only rival"
    assert searched == 1.0


@pytest.mark.parametrize(("more", "wins"), [(2.9, 0.3), (3.6, 0.0)])
def test_among_even_motions_the_points_seen_decide(more: float, wins: float) -> None:
    """A plain wall matched itself: a smaller motion that kept more of it in view won over the true one, by 4 %."""
    peaks = [Peak(0.0, more, 3.4), Peak(0.3, 2.8, 3.9)]
    winner, lead, _ = contest(sideways(0.0, 0.3), sideways(0.6), peaks)
    assert winner.motion[0, 3] == pytest.approx(wins)
    assert lead == pytest.approx(3.9 / 3.4 if wins else 3.4 / 3.9, rel=1e-3)


def test_what_is_known_is_not_enough_where_the_points_seen_match_badly() -> None:
    _, _, searched = contest(sideways(0.5), sideways(0.3), [Peak(0.3, 0.5, 1.0), Peak(0.5, 2.0, 2.5)])
    assert searched == 1.0


def test_nothing_is_searched_where_what_is_known_explains_the_frames() -> None:
    known = jnp.concatenate([NOWHERE, sideways(0.5)])
    winner, lead, searched = contest(known, sideways(0.3), [Peak(0.3, 3.0, 6.0), Peak(0.5, 2.0, 4.0)])
    assert winner.motion[0, 3] == pytest.approx(0.5)
    assert np.isnan(searched) and lead == float("inf")


def test_another_repetition_is_a_rival() -> None:
    peaks = [Peak(0.5, 2.0, 4.0), Peak(0.3, 1.9, 3.2)]
    _, lead, searched = contest(sideways(0.5), sideways(0.3), peaks, aliases=sideways(-0.2))
    assert np.isnan(searched)
    assert lead == pytest.approx(4.0 / 3.2, rel=1e-3)
