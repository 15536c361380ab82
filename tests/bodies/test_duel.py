"""Which of two motions is the camera's: by votes, by contradiction, or by nothing at all."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gavo_jax.alignment.result import Alignment, no_alignment
from gavo_jax.bodies.duel import AGREED_AFTER, DROPPED_AFTER, Duel, Motions, Span, leads
from gavo_jax.bodies.votes import Margin
from gavo_jax.rigid_motions import exp
from gavo_jax.status import AlignmentStatus

LATE, EARLY = Span(9, 2 * DROPPED_AFTER), Span(1, AGREED_AFTER / 2)
UNDECIDED = Span(4, (AGREED_AFTER + DROPPED_AFTER) / 2)


def result_of(x: float = 0.0, deviation: float = 1e-3, turned: float = 0.0) -> Alignment:
    found = exp(np.array([x, 0.0, 0.0, 0.0, turned, 0.0]))
    covariance = np.diag(np.full(6, deviation**2, np.float32))
    return no_alignment(AlignmentStatus.OK)._replace(target_T_reference=found, covariance=covariance, findings=0)


def duel(apart: float, deviation: float = 1e-3, age: Span = UNDECIDED, **changes: Any) -> Duel:
    """One between a motion of so many metres and none, after a frame, both as exact."""
    first, rival = result_of(apart, deviation), result_of(0.0, deviation)
    motions = Motions.none().after(first, rival)
    return replace(Duel.of(motions, first, deviation, age, stands_before=True), **changes)


def verdicts(one: Duel) -> set[str]:
    said = {"won": one.is_won, "doubt": one.casts_doubt, "lost": one.is_rival_unsupported, "given up": one.is_given_up}
    return {name for name, is_so in said.items() if is_so}


def margin(whole: float, far: float) -> Any:
    return Margin(np.float32(whole), np.float32(far))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(("age", "said"), [(EARLY, set()), (UNDECIDED, {"lost"}), (LATE, {"lost", "given up"})])
def test_motions_that_are_the_same_settle_it_for_the_first_after_some_time(age: Span, said: set[str]) -> None:
    assert verdicts(duel(0.001, age=age)) == said


def test_a_rival_that_is_vague_tells_nothing() -> None:
    for votes in (None, margin(1.0, 1.0)):
        vague = duel(0.3, 0.05, margin=votes, ahead=5)
        assert verdicts(vague) == {"given up"} and not vague.asks_for_votes
    assert verdicts(duel(0.3, np.nan)) == {"given up"}


def test_votes_are_asked_for_only_where_the_motions_are_far_apart() -> None:
    assert [duel(apart).asks_for_votes for apart in (0.001, 0.02, 0.03)] == [False, False, True]


@pytest.mark.parametrize(
    ("votes", "ahead", "is_won"),
    [((0.3, 0.7), 1, False), ((0.3, 0.7), 2, True), ((0.7, 0.7), 0, True), ((0.7, -0.1), 5, False)],
)
def test_votes_decide_by_a_landslide_or_if_they_last(votes: tuple[float, float], ahead: int, is_won: bool) -> None:
    """At a deviation at which the contradiction alone may not."""
    said = duel(0.04, 0.0085, margin=margin(*votes), ahead=ahead)
    assert said.is_won == is_won
    assert not duel(0.04, 0.013, margin=margin(*votes), ahead=ahead).is_won, "not exact enough"


def test_votes_lead_where_both_margins_are_large() -> None:
    assert [leads(margin(*votes)) for votes in ((0.3, 0.7), (0.3, 0.5), (0.1, 0.7))] == [True, False, False]


def test_an_exact_rival_that_contradicts_the_first_is_taken() -> None:
    assert duel(0.02).is_won
    assert not duel(0.02, stands_before=False).is_won, "what it leaves out is as far away as the rest"
    assert duel(0.04, margin=margin(0.0, 0.1)).is_won and not duel(0.04, margin=margin(0.0, -0.1)).is_won


@pytest.mark.parametrize(
    ("contradiction", "age", "said"),
    [
        (10.0, UNDECIDED, {"lost"}),
        (40.0, UNDECIDED, set()),
        (60.0, UNDECIDED, {"doubt"}),
        (60.0, EARLY, set()),
        (60.0, LATE, {"doubt", "given up"}),
        (90.0, UNDECIDED, {"won", "doubt"}),
    ],
)
def test_a_contradiction_settles_it_or_casts_doubt(contradiction: float, age: Span, said: set[str]) -> None:
    assert verdicts(duel(0.012, age=age, contradiction=contradiction)) == said


@pytest.mark.parametrize("degrees", [0.0, 2.0, 10.0])
def test_two_motions_are_as_far_apart_as_their_covariances_say_while_the_camera_turns(degrees: float) -> None:
    """The first is 5 cm beside the rival's along an axis of the reference, of which each knows so much."""
    vague = np.diag([0.05**2] + [1e-3**2] * 5).astype(np.float32)
    rival = result_of(0.02, turned=np.radians(degrees))._replace(covariance=vague)
    beside = rival.target_T_reference @ exp(np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0]))
    first = rival._replace(target_T_reference=beside)
    motions = Motions.none().after(first, rival)
    assert motions.contradiction() == pytest.approx(1.0, rel=1e-3)
    assert Duel.of(motions, rival, 0.05, EARLY, stands_before=True).contradiction == pytest.approx(0.5, rel=1e-3)


def test_errors_of_the_frames_add_up() -> None:
    motions = Motions.none()
    for _ in range(4):
        motions = motions.after(result_of(), result_of()).stored()
    assert np.diag(motions.covariance) == pytest.approx(np.full(6, 4e-6), rel=1e-3)
    assert not motions.have_parted() and motions.contradiction() == 0.0


def test_motions_have_parted_clearly_where_the_rivals_errors_do_not_explain_it() -> None:
    exact, vague = duel(0.02).motions, duel(0.02, 0.01).motions
    assert exact.have_parted() and exact.have_parted(clearly=True)
    assert vague.have_parted() and not vague.have_parted(clearly=True)
