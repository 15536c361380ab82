"""What is believed of pixels: suspicions spread, fade, and end."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from carded import BOX, CAMERA, DISTANCE, FRAMES, OTHER, TRACKED, Carded, beliefs, field, view

from gavo_jax.bodies.belief import follow, form_belief, suspect
from gavo_jax.bodies.pixel_evidence import PixelEvidence, gather_evidence
from gavo_jax.bodies.scene import MotionSegmenter

SEGMENTER = MotionSegmenter(CAMERA, TRACKED)
SEEN_PIXEL = DISTANCE / SEGMENTER.camera.fx
"""Step of the card, metres, by which it moves one pixel of the level that bodies are seen on."""


def evidence_of(seen: Any, measured: Any, inverse_depth: Any, place: Any) -> PixelEvidence:
    """Evidence of pixels that agree with the other view."""
    nothing: Any = np.zeros(seen.shape, np.float32)
    agrees = {name: nothing for name in ("grey", "grey_around", "unlike", "depth", "texture")}
    return PixelEvidence(**agrees, seen=seen, measured=measured, inverse_depth=inverse_depth, place=place)


def test_a_suspicion_spreads_to_what_comes_into_view_of_its_surface_and_no_further() -> None:
    shape = 1, 20, 30
    columns = np.arange(30)
    near = np.broadcast_to(np.where(columns < 15, 1.0, 0.4), shape[1:]).astype(np.float32)
    place = np.stack(np.meshgrid(columns.astype(np.float32), np.arange(20, dtype=np.float32)))[None]
    seen = np.broadcast_to((columns >= 6).astype(np.float32), shape)
    evidence = evidence_of(seen, np.ones(shape, np.float32), near, place)
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
    measured = np.broadcast_to((columns < 15).astype(np.float32), shape)
    evidence = evidence_of(np.ones(shape, np.float32), measured, near, place)
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


def on_card(card: Carded) -> np.ndarray:
    """Pixels of the seen level that show the card in each of its frames, away from its edges."""
    inside = np.logical_and.reduce([card.mask(index) for index in range(len(card))])
    factor = CAMERA.height // SEGMENTER.size[0]
    return inside.reshape(SEGMENTER.size[0], factor, SEGMENTER.size[1], factor).all(axis=(1, 3))


@pytest.mark.parametrize(("pixels", "moves"), [(0.3, False), (1.5, True)])
def test_texture_finer_than_a_seen_pixel_tells_by_its_area(pixels: float, moves: bool) -> None:
    """A small shift may cause as much in each pixel, so a card with a fine grain seemed to be at rest."""
    card = Carded(step=pixels * SEEN_PIXEL, is_fine=True)
    before, here = (view(card[index].grey, card[index].depth, SEGMENTER.levels) for index in (0, 1))
    others = jax.tree.map(lambda leaf: leaf[None], before)
    seen, inside = gather_evidence(here, others, jnp.eye(4)[None], SEGMENTER.camera), on_card(card)
    assert np.median(np.asarray(seen.grey[0])[inside]) < 1.0, "no pixel tells by itself"
    share = np.mean(np.asarray(seen.grey_around[0])[inside] > 1.0)
    assert share > 0.8 if moves else share < 0.02


def belief_on_card(card: Carded, last: int, older: int, was_body: bool) -> float:
    """Mean belief on a card after its last frame, 0.5 before, by two earlier frames as the other views."""
    here, *others = (view(card[index].grey, card[index].depth, SEGMENTER.levels) for index in (FRAMES - 1, last, older))
    two = jax.tree.map(lambda *leaves: jnp.stack(leaves), *others)
    inside = on_card(card)
    known, at_rest = jnp.where(jnp.asarray(inside), 0.5, 0.0), jnp.tile(jnp.eye(4), (2, 1, 1))
    belief = form_belief(here, two, at_rest, SEGMENTER.camera, known, known * was_body, carried=True)
    return float(np.asarray(belief.known)[inside].mean())


def test_a_body_of_fine_texture_stays_one() -> None:
    """It was lost after some frames, its points came back, and they led the camera on."""
    card = Carded(step=1.5 * SEEN_PIXEL, is_fine=True)
    assert belief_on_card(card, 3, 3, was_body=True) > 0.5 > 0.35 > belief_on_card(card, 3, 3, was_body=False)


def test_a_body_that_slows_down_is_not_at_rest_as_the_older_view_tells() -> None:
    card = Carded(step=0.3 * SEEN_PIXEL, is_fine=True)
    assert belief_on_card(card, 3, 0, was_body=True) > 0.38
    assert belief_on_card(card, 3, 0, was_body=False) < 0.3 and belief_on_card(card, 4, 4, was_body=True) < 0.3
