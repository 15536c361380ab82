"""From a mask to bodies: what is one, and which one it is."""

import numpy as np
from carded import BOX, OTHER, THIN, field

from gavo_jax.bodies.identity import MAX_UNSEEN, BodyTracks, associate, body_components


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


def at(*places: tuple[slice, slice]) -> np.ndarray:
    """Parts of a mask, numbered from 1."""
    found = np.zeros((60, 80), np.int32)
    for number, place in enumerate(places, start=1):
        found[place] = number
    return found


NOWHERE = at()


def test_a_hidden_body_keeps_its_number_for_a_while() -> None:
    """Catches one that is never forgotten, or at once, and a number that is given where there is nothing."""
    tracks = associate(at(BOX), BodyTracks.empty((60, 80)))
    for unseen in range(1, MAX_UNSEEN + 1):
        tracks = associate(NOWHERE, tracks)
        assert tracks.numbers.tolist() == [1] + [0] * 7 and tracks.ages[0] == unseen and tracks.last == 1
        assert (tracks.labels == at(BOX)).all(), "expected where it was last seen"
        assert associate(at(BOX), tracks).labels[BOX].min() == 1
    forgotten = associate(NOWHERE, tracks)
    assert not forgotten.numbers.any() and not forgotten.labels.any()
    assert associate(at(BOX), forgotten).numbers[0] == 2, "no number is given twice"


def test_a_body_that_moves_is_no_longer_where_it_was() -> None:
    moved = np.s_[14:34, 16:36]
    after = associate(at(moved), associate(at(BOX), BodyTracks.empty((60, 80))))
    np.testing.assert_array_equal(after.labels, at(moved))
    assert after.numbers.tolist() == [1] + [0] * 7 and not after.ages.any()


def test_a_hidden_body_is_not_what_comes_near_its_place() -> None:
    """Only what was there in the last frame can have gone so far since."""
    near = np.s_[20:40, 24:34]
    seen = associate(at(np.s_[20:40, 10:20]), BodyTracks.empty((60, 80)))
    assert associate(at(near), seen).labels[near].min() == 1
    assert associate(at(near), associate(NOWHERE, seen)).labels[near].min() == 2


def test_of_a_body_that_falls_apart_the_part_that_overlaps_more_keeps_the_number() -> None:
    """Whichever comes first among the parts; and of two bodies that meet, the larger overlap decides."""
    small, large = np.s_[10:20, 10:20], np.s_[10:40, 30:50]
    whole = associate(at(np.s_[10:40, 10:50]), BodyTracks.empty((60, 80)))
    for parts in ((small, large), (large, small)):
        labels = associate(at(*parts), whole).labels
        assert (labels[large].min(), labels[small].min()) == (1, 2)
    for parts in ((small, large), (large, small)):
        two = associate(at(*parts), BodyTracks.empty((60, 80)))
        met = associate(at(np.s_[10:40, 10:50]), two)
        assert (met.labels == two.labels[large].min()).sum() == 30 * 40


def test_how_far_a_body_can_have_gone_is_by_the_smaller_of_its_two_sizes() -> None:
    """Catches a speck that takes the number of a large body far away."""
    large, speck = np.s_[5:55, 5:45], np.s_[28:32, 70:74]
    assert associate(at(speck), associate(at(large), BodyTracks.empty((60, 80)))).labels[speck].min() == 2
