"""The map beside the tracking: what it says does not depend on the timing."""

import threading
import time
from typing import Any, cast

import numpy as np
import pytest
from small import CAMERA

from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.mapping.background import MOST_AHEAD, BackgroundMapper
from gavo_jax.mapping.mapper import Mapper

FRAME: Frame = SyntheticSequence(1, camera=CAMERA)[0]


class Slow:
    """Stands for a mapper, and takes its time."""

    def __init__(self, worst_at: int | None = None):
        self.seen: list[Any] = []
        self.worst_at = worst_at
        self.threads: set[int] = set()

    def watch(self, frame: Frame | None, step: Any) -> None:
        self.threads.add(threading.get_ident())
        time.sleep(0.002 * (step % 3))
        if step == self.worst_at:
            raise GavoError("worst")
        self.seen.append(step)

    def find(self, frame: Frame, segment: int) -> list[Any]:
        self.threads.add(threading.get_ident())
        return list(self.seen)

    def finish(self, steps: Any) -> list[Any]:
        return list(self.seen)


def beside(slow: Slow) -> BackgroundMapper:
    return BackgroundMapper(cast(Mapper, slow))


def test_frames_are_seen_in_their_order_and_all_before_one_is_looked_for():
    slow = Slow()
    mapper = beside(slow)
    for step in range(3 * MOST_AHEAD):
        mapper.watch(FRAME, cast(Any, step))
        assert step + 1 - len(slow.seen) <= MOST_AHEAD
        if step % 7 == 0:
            assert mapper.find(FRAME, 1) == list(range(step + 1))
    assert mapper.finish() == list(range(3 * MOST_AHEAD))
    assert len(slow.threads) == 1 and threading.get_ident() not in slow.threads


def test_what_goes_wrong_is_raised_by_a_later_call():
    mapper = beside(Slow(worst_at=4))
    with pytest.raises(GavoError, match="worst"):
        for step in range(3 * MOST_AHEAD):
            mapper.watch(FRAME, cast(Any, step))
    with pytest.raises(GavoError, match="worst"):
        mapper.finish()


def test_the_map_is_that_of_a_mapper_alone():
    pytest.importorskip("gtsam")
    from test_keyframes import WALK, drifting

    maps = []
    steps = drifting(WALK, np.array([2e-3, -1e-3, 1e-3, 0.0, 1e-3, 5e-4]))
    for mapper in (Mapper(CAMERA), BackgroundMapper(Mapper(CAMERA))):
        mapper.watch(WALK[0], None)
        for step in steps:
            mapper.watch(WALK[step.index], step)
        maps.append(mapper.finish())
    alone, background = maps
    np.testing.assert_array_equal(alone.solution.world_T_camera, background.solution.world_T_camera)
    np.testing.assert_array_equal(alone.solution.residuals, background.solution.residuals)
