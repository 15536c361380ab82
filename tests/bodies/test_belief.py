"""What is believed of pixels: suspicions spread, fade, and end."""

import jax.numpy as jnp
import numpy as np
import pytest
from carded import BOX, OTHER, Carded, beliefs, field

from gavo_jax.bodies.belief import follow, suspect
from gavo_jax.bodies.pixel_evidence import PixelEvidence


def test_a_suspicion_spreads_to_what_comes_into_view_of_its_surface_and_no_further() -> None:
    shape = 1, 20, 30
    columns = np.arange(30)
    near = np.broadcast_to(np.where(columns < 15, 1.0, 0.4), shape[1:]).astype(np.float32)
    place = np.stack(np.meshgrid(columns.astype(np.float32), np.arange(20, dtype=np.float32)))[None]
    seen = np.broadcast_to((columns >= 6).astype(np.float32), shape)
    nothing, one = np.zeros(shape, np.float32), np.ones(shape, np.float32)
    evidence = PixelEvidence(nothing, nothing, nothing, seen, one, near, place)  # pyright: ignore[reportArgumentType]
    before = np.broadcast_to(((columns >= 6) & (columns < 15)).astype(np.float32), shape[1:])
    after = np.asarray(follow(jnp.asarray(before), evidence, jnp.zeros(shape[1:])))
    np.testing.assert_array_equal(after, np.broadcast_to(columns < 15, shape[1:]))
    nobody = np.asarray(follow(jnp.zeros(shape[1:]), evidence, jnp.zeros(shape[1:])))
    assert not nobody.any()


def test_a_suspicion_of_what_was_not_measured_says_nothing_of_the_surface_that_shows_there_next() -> None:
    """In the sensor's shadow beside a body: the wall that came into view there lost its points for half a second."""
    shape = 1, 20, 30
    columns = np.arange(30)
    near = np.broadcast_to(np.where(columns < 15, 1.0, 0.4), shape[1:]).astype(np.float32)
    place = np.stack(np.meshgrid(columns.astype(np.float32), np.arange(20, dtype=np.float32)))[None]
    nothing, one = np.zeros(shape, np.float32), np.ones(shape, np.float32)
    measured = np.broadcast_to((columns < 15).astype(np.float32), shape)
    evidence = PixelEvidence(nothing, nothing, nothing, one, measured, near, place)  # pyright: ignore[reportArgumentType]
    before = np.broadcast_to((columns < 20).astype(np.float32), shape[1:])
    after = np.asarray(follow(jnp.asarray(before), evidence, jnp.zeros(shape[1:])))
    np.testing.assert_array_equal(after, np.broadcast_to(columns < 15, shape[1:]))


def test_a_suspicion_fades_ends_where_all_is_at_rest_and_is_not_learnt_from_a_wrong_motion() -> None:
    body = field(BOX) > 0
    belief = beliefs(Carded(moves=False))[0]._replace(
        known=np.where(field(OTHER) > 0, -0.9, 0.5), suspected=np.ones((60, 80))
    )  # pyright: ignore
    after = suspect(belief, body, 1 / 30, trusted=True)
    assert np.all(after[body] == 1) and not np.any(after[field(OTHER) > 0]) and 0.9 < after[0, 0] < 1
    assert suspect(belief, body, 0.2, trusted=True)[0, 0] == pytest.approx(after[0, 0] ** 6, rel=1e-5), "by the clock"
    kept = suspect(belief, body, 1 / 30, trusted=False)
    np.testing.assert_array_equal(kept, 1.0, "one that stopped seems to be at rest under a motion that follows it")
    nobody = belief._replace(suspected=np.zeros((60, 80)))  # pyright: ignore
    assert not np.any(suspect(nobody, body, 1 / 30, trusted=False))
