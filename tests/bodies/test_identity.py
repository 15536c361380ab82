"""From a mask to bodies: what is one, and which one it is."""

import numpy as np
from carded import BOX, OTHER, THIN, field

from gavo_jax.bodies.identity import BodyTracks, associate, body_components


def test_what_is_thin_is_no_body() -> None:
    nowhere = np.zeros((60, 80), bool)
    assert set(np.unique(body_components(field(BOX, THIN), field(BOX, THIN), nowhere))) == {0, 1}
    assert not np.any(body_components(field(THIN), field(THIN), nowhere))


def test_a_body_that_was_known_needs_less() -> None:
    nowhere, there = np.zeros((60, 80), bool), field(BOX) > 0
    little = 0.2 * field(BOX)
    assert not np.any(body_components(field(BOX), little, nowhere))
    assert np.any(body_components(field(BOX), little, there))


def test_the_largest_part_needs_less_where_depth_disagrees() -> None:
    nowhere, both = np.zeros((60, 80), bool), field(BOX, OTHER)
    little = 0.25 * both
    assert not np.any(body_components(both, little, nowhere))
    assert set(np.unique(body_components(both, little, nowhere, depth_disagrees=True))) == {0, 1}
    assert not np.any(body_components(both, 0.05 * both, nowhere, depth_disagrees=True))


def test_a_body_keeps_its_number_in_a_fast_pan() -> None:
    """It no longer overlaps where it was."""
    mask = np.zeros((60, 80), np.int32)
    before, after, elsewhere = mask.copy(), mask.copy(), mask.copy()
    before[20:40, 10:20] = after[20:40, 24:34] = elsewhere[20:40, 68:78] = 1
    tracks = associate(before, BodyTracks.empty((60, 80)))
    assert set(np.unique(associate(after, tracks).labels)) >= {0, 1}
    assert associate(after, tracks).labels[30, 30] == 1 and associate(after, tracks).last == 1
    assert associate(elsewhere, tracks).labels[30, 70] == 2


def test_bodies_keep_their_numbers() -> None:
    nowhere = np.zeros((60, 80), bool)
    both = body_components(field(BOX, OTHER), field(BOX, OTHER), nowhere)
    tracks = associate(both, BodyTracks.empty((60, 80)))
    number = tracks.labels[20, 20]
    moved = np.s_[12:32, 14:34]
    alone = associate(body_components(field(moved), field(moved), nowhere), tracks)
    assert alone.labels[20, 20] == number
    again = associate(both, alone)
    assert set(again.numbers[again.numbers > 0]) == {1, 2} and again.labels[20, 20] == number
