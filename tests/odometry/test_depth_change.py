"""Depth that was wrong from the first frame on does not change as the motions of the image say."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from small import CAMERA, Rendered, StandIn

from gavo_jax.alignment.result import no_alignment, with_finding
from gavo_jax.bodies.records import Seen
from gavo_jax.datasets.base import Frame
from gavo_jax.odometry.aligners import Attempt
from gavo_jax.odometry.depth_change import (
    MIN_REMEMBERED,
    REMEMBERED,
    DepthChange,
    depth_on_grid,
    gone_back,
    left_unexplained,
)
from gavo_jax.odometry.depth_watch import DepthWatch
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.hindsight import revised
from gavo_jax.odometry.progress import Progress
from gavo_jax.odometry.tracking import Clock
from gavo_jax.output.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from gavo_jax.rigid_motions import exp
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import inverse

FRAMES = 20


@cache
def room() -> tuple[list[Frame], np.ndarray]:
    """Frames, and the true world_T_camera of each."""
    sequence = Rendered(FRAMES, camera=CAMERA)
    truth, _ = sequence.ground_truth.interpolate(sequence.timestamps)
    return [sequence[i] for i in range(FRAMES)], truth


class Knowing(StandIn):
    """An aligner that knows the truth, and sees some bodies."""

    def __init__(self, bodies: tuple[Seen, ...] = ()) -> None:
        frames, poses = room()
        self.poses = {frame.timestamp: pose for frame, pose in zip(frames, poses, strict=True)}
        self.bodies = bodies

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        motion = inverse(self.poses[frame.timestamp]) @ self.poses[state]
        result = no_alignment(AlignmentStatus.OK)._replace(target_T_reference=motion, error=np.float32(1.0))
        return Attempt(frame.timestamp, result, usable=True, candidates=(), bodies=self.bodies)


def steps_of(frames: list[Frame], bodies: tuple[Seen, ...] = ()) -> list[Step]:
    odometry = Odometry(CAMERA, aligner=Knowing(bodies))
    return [step for frame in frames if (step := odometry.register(frame, frame.timestamp)) is not None]


def tracked(frames: list[Frame], bodies: tuple[Seen, ...] = ()) -> tuple[Progress, DepthWatch]:
    """Where the driver stands after these frames, and what it knows of their depth then."""
    odometry = Odometry(CAMERA, aligner=Knowing(bodies))
    for frame in frames:
        odometry.register(frame, frame.timestamp)
    assert odometry.progress.depth is not None
    return odometry.progress, odometry.progress.depth


def is_unexplained(frames: list[Frame], bodies: tuple[Seen, ...] = ()) -> bool:
    return tracked(frames, bodies)[1].change.is_unexplained


def flagged(steps: list[Step]) -> list[bool]:
    return [AlignmentStatus.DEPTH_MISMATCH in step.alignment.statuses for step in steps]


def turned_round(depth: np.ndarray) -> np.ndarray:
    return depth[::-1, ::-1].copy()


def as_disparity(depth: np.ndarray) -> np.ndarray:
    return (CAMERA.depth_scale**2 * 4.0 / np.maximum(depth, 1)).astype(np.uint16)


def test_depth_that_changes_as_the_camera_moves_is_right() -> None:
    steps = steps_of(room()[0])
    assert not any(flagged(steps)) and not any(step.revises for step in steps)


def test_depth_of_two_frames_before_changed_as_the_camera_moved_then() -> None:
    """Its speed changes from frame to frame: continued from the last motion, depth seemed to be wrong."""
    frames, poses = room()
    interval, chosen = 1 / 30, [0, 1, 4, 5, 8, 9, 12, 13, 16, 17]
    change = None
    for k, number in enumerate(chosen):
        depth = frames[chosen[max(k - 2, 0)]].depth
        frame = Frame(frames[number].grey, depth, k * interval, depth_timestamp=(k - 2) * interval)
        if change is None:
            change = DepthChange(depth_on_grid(frame, CAMERA), frame.depth_delay)
            continue
        motion = inverse(poses[number]) @ poses[chosen[k - 1]]
        change = change.after(frame, frame, interval, motion, 1.0, CAMERA).seen_from(frame, CAMERA)
    assert change is not None and len(change.left) >= 6 and max(change.left[3:]) < 0.3


def test_the_way_back_follows_the_last_motions() -> None:
    along, round_ = np.array([0.3, 0, 0, 0, 0, 0]), np.array([0, 0, 0, 0, 0.6, 0])
    motions = ((0.1, *round_), (0.05, *along))
    assert np.allclose(gone_back(0.02, motions), exp(-0.02 * along))
    assert np.allclose(gone_back(0.25, motions), exp(-0.2 * round_) @ exp(-0.05 * along)), "the first goes on"


@pytest.mark.parametrize(("damage", "silent"), [(turned_round, 3), (np.flipud, 0), (as_disparity, 0)])
def test_depth_that_was_never_right_is_told_of_every_pair(
    damage: Callable[[np.ndarray], np.ndarray], silent: int
) -> None:
    """`silent`: so many pairs it takes beyond the fewest that tell."""
    steps = steps_of([replace(frame, depth=damage(frame.depth)) for frame in room()[0]])
    before = MIN_REMEMBERED - 1 + silent
    assert flagged(steps) == [False] * before + [True] * (FRAMES - 1 - before)
    assert all(flagged(revised(steps))) and all(flagged(revised(revised(steps))))


@pytest.mark.parametrize("status", [AlignmentStatus.MOVING_BODY, AlignmentStatus.IMPLAUSIBLE_MOTION])
def test_wrong_depth_is_told_of_every_pair_whatever_else_the_pair_shows_at_which_it_is_found(
    status: AlignmentStatus,
) -> None:
    """The pairs before it got the status that this one had already: they were said to have followed a body."""

    class Doubting(Knowing):
        def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
            attempt = super().align(state, frame, clock)
            is_last = frame.timestamp == room()[0][MIN_REMEMBERED].timestamp
            return attempt._replace(result=with_finding(attempt.result, status)) if is_last else attempt

    odometry = Odometry(CAMERA, aligner=Doubting())
    upside_down = [replace(frame, depth=np.flipud(frame.depth)) for frame in room()[0][: MIN_REMEMBERED + 1]]
    steps = [step for frame in upside_down if (step := odometry.register(frame, frame.timestamp)) is not None]
    assert flagged(steps) == [False] * (MIN_REMEMBERED - 1) + [True] and status in steps[-1].alignment.statuses
    for after in (revised(steps), revised(revised(steps))):
        assert {step.alignment.status for step in after} == {AlignmentStatus.DEPTH_MISMATCH}


def test_depth_that_became_wrong_and_was_told_says_nothing_of_the_run() -> None:
    """Ten frames of doubled depth had all pairs of a run flagged, those before and those after them too."""

    class Doubting(Knowing):
        def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
            attempt = super().align(state, frame, clock)
            if frame.timestamp not in doubled:
                return attempt
            return attempt._replace(result=with_finding(attempt.result, AlignmentStatus.DEPTH_MISMATCH), fit=False)

    frames = list(room()[0])
    frames[4:14] = [replace(frame, depth=2 * frame.depth) for frame in frames[4:14]]
    doubled = {frame.timestamp for frame in frames[4:14]}
    odometry = Odometry(CAMERA, aligner=Doubting())
    steps = [step for frame in frames if (step := odometry.register(frame, frame.timestamp)) is not None]
    told = [step.index for step, is_flagged in zip(steps, flagged(revised(steps)), strict=True) if is_flagged]
    assert told == list(range(4, 14))


def test_depth_of_another_moment_is_right_where_its_stamp_says_so() -> None:
    frames = room()[0]
    sources = [frames[2 * k + k % 2] for k in range(FRAMES // 2)]  # three intervals from one to the next, then one
    late = [replace(frame, depth=source.depth) for frame, source in zip(frames[::2], sources, strict=True)]
    stamped = [replace(frame, depth_timestamp=source.timestamp) for frame, source in zip(late, sources, strict=True)]
    figures = [np.median(tracked(sequence)[1].change.left) for sequence in (late, stamped)]
    assert figures[1] < 0.5 * figures[0]


RIGHT, WRONG = 0.1, 1.9


@pytest.mark.parametrize(
    ("left", "pairs", "covered"),
    [
        ((WRONG,) * 9, 12, 12),
        ((RIGHT, RIGHT, *(WRONG,) * 7), 9, 9),  # by chance
        ((*(RIGHT,) * 5, *(WRONG,) * 6), 11, 6),
        ((*(RIGHT,) * 4, WRONG, RIGHT, RIGHT, *(WRONG,) * 8), 40, 8),
        ((WRONG, RIGHT) * 7 + (WRONG,), 40, 15),
    ],
)
def test_pairs_before_depth_became_wrong_are_not_spoken_against(
    left: tuple[float, ...], pairs: int, covered: int
) -> None:
    """Depth that became coarse after nine pairs flagged these, too."""
    change = DepthChange(np.zeros((1, 1)), 0.0, left=left)
    assert change.is_unexplained and change.pairs_covered(pairs) == covered


def test_of_half_of_the_pairs_a_body_may_be_why_that_was_not_known_yet() -> None:
    """In a room with a box that moved, the first eight pairs were told to have wrong depth."""
    change = DepthChange(np.zeros((1, 1)), 0.0, left=(1.9,) * 4 + (0.1,) * 4)
    assert not change.is_unexplained and change._replace(left=(1.9,) * 5 + (0.1,) * 4).is_unexplained


def half_body() -> Seen:
    """A body that covers the left half of the image."""
    field = np.where(np.arange(80) < 40, 1.0, -1.0) * np.ones((60, 1))
    return Seen(1, field.astype(np.float32), 0.5, np.zeros(3))


def half_upside_down(depth: np.ndarray) -> np.ndarray:
    """Depth that is wrong where that body is."""
    return np.where(np.arange(160) < 80, np.flipud(depth), depth)


def test_depth_where_a_body_moves_says_nothing() -> None:
    body = half_body()
    halves = [replace(f, depth=half_upside_down(f.depth)) for f in room()[0]]
    assert not is_unexplained(halves, (body,)) and is_unexplained(halves)
    assert is_unexplained([replace(f, depth=np.flipud(f.depth)) for f in room()[0]], (body,))


@pytest.mark.parametrize(
    ("known_from", "is_told"), [(MIN_REMEMBERED - 1, False), (MIN_REMEMBERED, False), (FRAMES - 1, True)]
)
def test_a_body_that_was_found_late_is_why_depth_seemed_wrong(known_from: int, is_told: bool) -> None:
    """In a far room with two near bodies, found after seven pairs, depth of the first thirteen was said to be wrong."""

    class Learning(Knowing):
        def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
            attempt = super().align(state, frame, clock)
            return attempt if frame.timestamp >= room()[0][known_from].timestamp else attempt._replace(bodies=())

    def told(damage: Callable[[np.ndarray], np.ndarray]) -> bool:
        odometry, unexplained = Odometry(CAMERA, aligner=Learning((half_body(),))), []
        for frame in room()[0]:
            odometry.register(replace(frame, depth=damage(frame.depth)), frame.timestamp)
            assert odometry.progress.depth is not None
            unexplained.append(odometry.progress.depth.change.is_unexplained)
        return any(unexplained)

    assert told(half_upside_down) == is_told
    assert told(np.flipud)


@pytest.mark.parametrize("depth", [np.zeros((120, 160), np.uint16), np.full((120, 160), np.nan, np.float32)])
def test_nothing_is_known_without_readings_or_without_motion(depth: np.ndarray) -> None:
    frames, poses = room()
    seen = depth_on_grid(frames[0], CAMERA)
    motion = inverse(poses[5]) @ poses[0]
    assert np.isnan(left_unexplained(seen, depth, motion, CAMERA))
    assert np.isnan(left_unexplained(np.zeros_like(seen), frames[5].depth, motion, CAMERA))
    assert np.isnan(left_unexplained(seen, frames[0].depth, np.eye(4), CAMERA))
    assert left_unexplained(seen, frames[5].depth, motion, CAMERA) < 0.5
    assert left_unexplained(seen, frames[5].depth, inverse(motion), CAMERA) > 1.0


def test_no_more_is_remembered_than_tells_and_it_survives_a_checkpoint(tmp_path: Path) -> None:
    progress, watch = tracked(room()[0])
    assert len(watch.change.left) == REMEMBERED
    save_checkpoint(tmp_path / "checkpoint.npz", Checkpoint(progress._replace(tracker=jnp.zeros(3)), {}))
    found = load_checkpoint(tmp_path / "checkpoint.npz", np.zeros(3, np.float32)).progress.depth
    assert found is not None
    for part, kept in zip(found[:2], watch[:2], strict=True):
        np.testing.assert_array_equal(part[0], kept[0])
        assert part[1:] == kept[1:]
    assert found.found_wrong == watch.found_wrong
