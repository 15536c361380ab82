"""Pairs that turn out to have followed a body."""

from dataclasses import replace

import numpy as np

from gavo_jax.alignment.judgement import UNKNOWN
from gavo_jax.alignment.result import no_alignment
from gavo_jax.odometry.driver import Step
from gavo_jax.odometry.hindsight import revised
from gavo_jax.status import AlignmentStatus


def ran(*statuses: AlignmentStatus) -> list[Step]:
    """A run with a pair of each status."""
    exact = np.eye(6, dtype=np.float32)
    return [
        Step(i, i - 1.0, float(i), no_alignment(status)._replace(covariance=exact), np.eye(4), 1.0, False)
        for i, status in enumerate(statuses, start=1)
    ]


def test_pairs_that_followed_a_body_say_so_once_it_is_seen() -> None:
    ok, high_error, body = AlignmentStatus.OK, AlignmentStatus.HIGH_ERROR, AlignmentStatus.MOVING_BODY
    steps = ran(ok, ok, high_error, ok, body, ok)
    steps[3] = replace(steps[3], lost=True)
    steps[4] = replace(steps[4], revises=2, reference_timestamp=3.0)
    after = revised(steps)
    assert [step.alignment.statuses for step in after] == [(ok,), (body,), (high_error, body), (ok,), (body,), (ok,)]
    assert [np.array_equal(step.alignment.covariance, UNKNOWN) for step in after] == [False, True, True] + [False] * 3
    assert [step.alignment.status for step in steps] == [ok, ok, high_error, ok, body, ok], (
        "the steps stay as they were"
    )
    for once, twice in zip(after, revised(after), strict=True):
        assert once.alignment.statuses == twice.alignment.statuses


def test_no_more_pairs_are_revised_than_there_are() -> None:
    steps = ran(AlignmentStatus.OK, AlignmentStatus.OK)
    steps[1] = replace(steps[1], revises=9)
    assert [step.alignment.status for step in revised(steps)] == [AlignmentStatus.MOVING_BODY, AlignmentStatus.OK]


def test_a_stamp_out_of_order_speaks_of_the_one_before() -> None:
    ok, early, implausible = AlignmentStatus.OK, AlignmentStatus.BAD_TIMESTAMP, AlignmentStatus.IMPLAUSIBLE_MOTION
    steps = ran(ok, ok, early, ok)
    steps[2] = replace(steps[2], revises=1, lost=True)
    assert [step.alignment.status for step in revised(steps)] == [ok, implausible, early, ok]
