"""Surfaces that stand before others, told from one depth image."""

import numpy as np
import pytest

from gavo_jax.bodies.surfaces import nearer_part, standing_before, whole_surfaces

EVERYWHERE = np.ones((60, 80), bool)


def wall(depth: float = 2.0) -> np.ndarray:
    return np.full((60, 80), 1.0 / depth)


def test_a_card_before_a_wall_stands_before_it() -> None:
    q, card = wall(), np.zeros((60, 80), bool)
    card[20:40, 30:60] = True
    q[card] = 1.0 / 0.8
    assert (standing_before(q) == card).all() and (nearer_part(q).mask == card).all() and nearer_part(q).stands_before


def test_of_two_surfaces_that_fill_the_image_the_larger_one_is_asked() -> None:
    """What is left is to show a motion; all that stands before something is too much."""
    q, card, table = wall(), np.zeros((60, 80), bool), np.zeros((60, 80), bool)
    card[:, 25:75], table[35:, :22] = True, True
    q[table], q[card] = 1.0 / 1.2, 1.0 / 0.8
    assert (standing_before(q) == card).all()
    q[:, 55:75], card[:, 55:75] = 1.0 / 2.0, False
    assert (standing_before(q) == card | table).all()


def test_a_shadow_without_depth_lies_between_a_card_and_a_wall() -> None:
    q, card = wall(), np.zeros((60, 80), bool)
    card[20:40, 30:60] = True
    q[17:43, 27:63] = 0.0
    q[card] = 1.0 / 0.8
    assert (standing_before(q) == card).all()


def test_a_window_is_behind_and_no_body() -> None:
    q = wall(1.0)
    q[20:40, 30:60] = 1.0 / 3.0
    assert not standing_before(q)[20:40, 30:60].any()


@pytest.mark.parametrize("q", [wall(), np.zeros((60, 80)), np.where(np.arange(80) == 3, 1.0, wall())])
def test_nothing_stands_before_a_plain_wall(q: np.ndarray) -> None:
    assert not nearer_part(q).mask.any()


def test_a_floor_has_a_nearer_part() -> None:
    q = np.repeat(np.linspace(0.3, 1.2, 60)[:, None], 80, axis=1)
    near, stands_before = nearer_part(q)
    assert not stands_before and near[-1].all() and not near[0].any() and 0.3 < near.mean() < 0.7


def test_a_body_that_turns_is_all_of_its_surface() -> None:
    """About its axis it is nearly at rest, and was taken for the scene there."""
    q, card = wall(), np.zeros((60, 80), bool)
    card[20:40, 30:60] = True
    q[card] = 1.0 / 0.8
    seen = np.zeros((60, 80), np.int32)
    seen[20:28, 30:60] = 3
    assert (whole_surfaces(seen, card, q) == 3 * card).all()
    assert (whole_surfaces(seen, seen > 0, q) == seen).all()  # what the card has come to stand beside, at its depth
    seen[24:28] = 0  # a fifth of it
    assert (whole_surfaces(seen, card, q) == seen).all()


def test_what_stands_before_nothing_is_not_completed() -> None:
    """A hand on a table is no reason to take the table for a body."""
    seen = np.zeros((60, 80), np.int32)
    seen[:40] = 1
    assert (whole_surfaces(seen, EVERYWHERE, wall()) == seen).all()


def test_two_bodies_keep_their_own_surfaces() -> None:
    q, seen = wall(), np.zeros((60, 80), np.int32)
    q[10:30, 10:30], q[10:30, 50:70] = 1.0 / 0.8, 1.0 / 0.9
    seen[10:20, 10:30], seen[10:25, 50:70] = 1, 2
    whole = whole_surfaces(seen, EVERYWHERE, q)
    assert (whole[10:30, 10:30] == 1).all() and (whole[10:30, 50:70] == 2).all() and np.sum(whole > 0) == 800


def test_a_surface_that_fills_the_image_is_not_completed() -> None:
    """What is left to see then is too little to go on from, should it be the scene."""
    q, seen = wall(0.8), np.zeros((60, 80), np.int32)
    q[:, 70:] = 1.0 / 2.0
    seen[:30, :70] = 1
    assert standing_before(q)[:, :70].all() and (whole_surfaces(seen, EVERYWHERE, q) == seen).all()
