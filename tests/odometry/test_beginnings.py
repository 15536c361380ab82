"""Pairs that a body carried which filled the image: they say so once it leaves."""

from functools import reduce
from typing import Any

import numpy as np
import pytest
from small import Rendered, StandIn

from gavo_jax.alignment.result import no_alignment
from gavo_jax.bodies.records import Seen
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.sensor_noise import NONE
from gavo_jax.datasets.rendered.synthetic import DEFAULT_CAMERA
from gavo_jax.odometry.aligners import Attempt
from gavo_jax.odometry.beginnings import PROVEN_AFTER, SURVIVED, Beginning, begun, followed, revised_by
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.hindsight import revised
from gavo_jax.odometry.tracking import Clock
from gavo_jax.status import AlignmentStatus

RATE = 30.0
CAMERA = DEFAULT_CAMERA.level(2)


def track(before: Beginning | None, frames: int, stamp: float = 0.0, share: float = 0.0) -> Beginning | None:
    """So many frames of a video in which bodies have some share of the image."""
    stamps = [stamp + (k + 1) / RATE for k in range(frames)]
    return reduce(lambda track, stamp: followed(track, stamp, share, is_reference=True), stamps, before)


def test_a_clock_that_was_set_back_begins_the_second_anew() -> None:
    """The track stayed unproven for as long as the clock was set back, and then all of it counted as a body's."""
    before = track(begun(None, 3600.0), 3, 3600.0)
    assert before is not None and track(before, 10, 0.0) is not None
    assert track(before, round(PROVEN_AFTER * RATE) + 3, 0.0) is None


def test_what_moves_behind_a_break_was_followed_before_it() -> None:
    followed_before = track(begun(None, 0.0), 10)
    assert revised_by(followed_before, 0.5) == 0  # a body that comes in is no news of the past
    broken = begun(followed_before, 0.5)
    assert revised_by(broken, 0.5) == 11  # the ten and the way across the break
    assert revised_by(broken, 0.1) == 0
    assert revised_by(track(broken, 1, 0.5), 0.5) == 0


def test_a_long_track_of_a_still_world_is_the_scene() -> None:
    proven = track(begun(None, 0.0), int(PROVEN_AFTER * RATE) + 2)
    assert proven is None
    assert revised_by(begun(proven, 2.0), 0.5) == 0


def test_where_bodies_are_known_the_camera_is_told_from_them() -> None:
    still = track(begun(None, 0.0), 3)
    assert track(still, int(SURVIVED * RATE) + 2, 0.1, share=0.05) is None
    assert followed(None, 0.3, 0.0, is_reference=True) is None


def test_what_comes_to_move_just_before_a_break_was_not_followed_before() -> None:
    """A card that filled the image left it: a tenth moved for two frames, then the track broke; nine pairs were ok."""
    leaving = track(track(begun(None, 0.0), 9), 2, 0.3, share=0.1)
    assert revised_by(leaving, 0.2) == 0
    broken = begun(begun(leaving, 0.5), 0.6)
    assert revised_by(broken, 0.2) == 13
    again = begun(track(broken, 4, 0.6), 0.9)
    assert revised_by(again, 0.2) == 0 and revised_by(again, 0.5) == 5  # what was told is told no more


class Covered(StandIn):
    """An aligner that follows a body for some frames, loses it, and then sees it as one."""

    def __init__(self, followed: int, share: float) -> None:
        body = Seen(1, np.ones((6, 8), np.float32), share, np.zeros(3))
        good, lost = no_alignment(AlignmentStatus.OK), no_alignment(AlignmentStatus.LOW_TEXTURE)
        self.attempts = [(good, ())] * followed + [(lost, ())] * 3 + [(good, (body,))] * 2

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        result, bodies = self.attempts.pop(0)
        return Attempt(frame.timestamp, result, result.status is AlignmentStatus.OK, bodies=bodies)


@pytest.mark.parametrize(("followed", "share", "told"), [(5, 0.5, range(5)), (5, 0.1, range(0)), (40, 0.5, range(0))])
def test_a_run_says_so_at_its_end(followed: int, share: float, told: range) -> None:
    odometry = Odometry(CAMERA, aligner=Covered(followed, share))
    sequence = Rendered(frames=followed + 6, camera=CAMERA, noise=NONE)
    steps = [odometry.register(frame, frame.timestamp) for frame in sequence]
    whole: list[Step] = revised(step for step in steps if step is not None)
    marked = [place for place, step in enumerate(whole) if step.alignment.status is AlignmentStatus.MOVING_BODY]
    assert marked == list(told)
    assert whole[-1].segment == 1 and whole[-1].alignment.status is AlignmentStatus.OK
