"""Candidates compete by the evidence for them, whatever found them."""

from collections.abc import Sequence

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


def contest(
    known: jax.Array, found: jax.Array, peaks: Sequence[tuple[float, float]], aliases: jax.Array = NOWHERE
) -> tuple[Entry, float, float]:
    """The winner's place, its lead, and whether there was a search, where evidence falls off from its peaks."""

    def refine(motion: jax.Array, is_last: jax.Array) -> Entry:
        x = motion[0, 3]
        heights = [height - 10.0 * jnp.abs(x - place) for place, height in peaks]
        total = jnp.max(jnp.stack(heights))
        brightness = Brightness(jnp.ones(1), jnp.where(is_last, 1.0, 0.0)[None])
        return Entry(motion, Evidence(total, 2.0 * total), brightness)

    winner, lead, searched = jax.jit(lambda: hold_contest(known, lambda: (found, jnp.float32(1.0)), aliases, refine))()
    return winner, float(lead), float(searched)


def test_what_most_speaks_for_wins() -> None:
    winner, lead, searched = contest(sideways(0.0), sideways(0.3, 0.6), [(0.0, 0.4), (0.3, 1.0), (0.6, 0.8)])
    assert winner.motion[0, 3] == pytest.approx(0.3)
    assert winner.brightness.bias[0] == 1.0, "refined once more, on the finest level"
    assert lead == pytest.approx(1.25, rel=1e-3)
    assert searched == 1.0


def test_nothing_is_searched_where_what_is_known_explains_the_frames() -> None:
    known = jnp.concatenate([NOWHERE, sideways(0.5)])
    winner, lead, searched = contest(known, sideways(0.3), [(0.3, 3.0), (0.5, 2.0)])
    assert winner.motion[0, 3] == pytest.approx(0.5)
    assert np.isnan(searched) and lead == float("inf")


def test_another_repetition_is_a_rival() -> None:
    peaks = [(0.5, 2.0), (0.3, 1.9)]
    _, lead, searched = contest(sideways(0.5), sideways(0.3), peaks, aliases=sideways(-0.2))
    assert np.isnan(searched)
    assert lead == pytest.approx(2.0 / 1.9, rel=1e-3)
