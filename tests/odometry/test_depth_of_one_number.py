"""Depth that is one number everywhere passes for a wall: it is told where the image is not that of one."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from small import CAMERA

from gavo_jax.alignment.result import Alignment, no_alignment
from gavo_jax.datasets.base import Frame
from gavo_jax.objective.estimates import ExplainedShare
from gavo_jax.odometry.depth_change import MIN_REMEMBERED
from gavo_jax.odometry.depth_watch import DepthWatch, judge_by_depth, watch_from
from gavo_jax.status import AlignmentStatus

FLAT = np.full((CAMERA.height, CAMERA.width), 7500, np.uint16)
TILTED = FLAT + np.arange(CAMERA.width, dtype=np.uint16)
GREY = np.zeros(FLAT.shape, np.uint8)


def judged(depth: np.ndarray, explained: float, pairs: int = MIN_REMEMBERED) -> tuple[list[Alignment], DepthWatch]:
    """Pairs of a camera that slides along, each with this depth, of whose grey so much is explained."""
    share = ExplainedShare(jnp.float32(explained), jnp.float32(1.0))
    motion = np.eye(4)
    motion[0, 3] = 0.05
    pair = no_alignment(AlignmentStatus.OK)._replace(target_T_reference=motion, explained=share)
    watch, results = watch_from(None, Frame(GREY, depth, 0.0), CAMERA), []
    for i in range(1, pairs + 1):
        frame = Frame(GREY, depth, i / 30)
        result, watch = judge_by_depth(watch, frame, (), 1 / 30, pair, CAMERA)
        watch = watch_from(watch, frame, CAMERA)
        results.append(result)
    return results, watch


def told(results: list[Alignment]) -> list[bool]:
    return [AlignmentStatus.DEPTH_MISMATCH in result.statuses for result in results]


def test_depth_of_one_number_is_told_where_the_image_is_no_walls() -> None:
    results, watch = judged(FLAT, 0.87)
    assert told(results) == [False] * (MIN_REMEMBERED - 1) + [True]
    assert watch.pairs_covered(len(results)) == len(results)


@pytest.mark.parametrize(("depth", "explained"), [(FLAT, 0.99), (TILTED, 0.5), (0 * FLAT, 0.5)])
def test_a_wall_is_not_nor_depth_that_has_relief_nor_none(depth: np.ndarray, explained: float) -> None:
    assert not any(told(judged(depth, explained, 20)[0]))


def test_holes_and_floats_change_nothing() -> None:
    holes = np.where(np.arange(CAMERA.width) % 16 < 3, 0, FLAT)
    assert told(judged(holes, 0.8)[0])[-1] and told(judged(FLAT.astype(np.float32) * 0.9, 0.8)[0])[-1]


def test_pairs_of_which_nothing_is_known_say_nothing() -> None:
    assert not any(told(judged(FLAT, np.nan)[0]))
    results, watch = judged(FLAT, 0.8)
    watch = watch._replace(change=watch.change._replace(left=()))
    relief = replace(Frame(GREY, TILTED, 1.0), depth_timestamp=1.0)
    assert told([judge_by_depth(watch, relief, (), 1 / 30, results[0], CAMERA)[0]]) == [False]
