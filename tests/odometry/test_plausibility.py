"""Frames that match, but not their stamps, their depth or the run so far."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from gavo_jax.alignment.judgement import UNKNOWN
from gavo_jax.alignment.result import Alignment, no_alignment
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.rendered.synthetic import DEFAULT_CAMERA, SyntheticSequence
from gavo_jax.objective.estimates import ExplainedShare
from gavo_jax.odometry.aligners import Attempt
from gavo_jax.odometry.driver import MAX_DOUBTED, MAX_HELD, Odometry, Step
from gavo_jax.odometry.plausibility import MIN_REMEMBERED, STAMP_JITTER, Usual, _change, is_abrupt, judge_by_history
from gavo_jax.odometry.run import trajectory_of
from gavo_jax.odometry.second_thoughts import DoubtingDepth
from gavo_jax.odometry.stream import track
from gavo_jax.presets import preset
from gavo_jax.rigid_motions import exp
from gavo_jax.settings import OdometryOptions, Settings
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.status import AlignmentStatus as Status
from gavo_jax.status import bit

CAMERA = DEFAULT_CAMERA.level(1)
SETTINGS = Settings(
    GaussNewton(iterations=(0, 15, 0, 0, 20)), odometry=OdometryOptions(relight=False, recover=False, bodies="off")
)
DT = 1 / 30


def result_of(x: float = 0.0, error: float = 0.5, depth: float = 0.95, scale: float = 0.005) -> Alignment:
    """A pair that moved along x, metres; its error is in squared pixels. Grey explains little more than depth may."""
    motion = jnp.eye(4).at[0, 3].set(x)
    explained = ExplainedShare(jnp.float32(0.7), jnp.float32(depth))
    alignment = no_alignment(Status.OK)._replace(target_T_reference=motion, error=jnp.float32(error))
    return alignment._replace(explained=explained, findings=jnp.int32(0), depth_scale=jnp.float32(scale))


def usual() -> Usual:
    """After a few pairs of the usual error and with most of depth explained."""
    return usual_of(result_of())


def usual_of(result: Alignment) -> Usual:
    """After a few pairs like one."""
    known = Usual.unknown()
    for _ in range(MIN_REMEMBERED):
        known = known.after(result, result.error)
    return known


@pytest.mark.parametrize(
    ("result", "velocity", "elapsed", "finding"),
    [
        (result_of(), 0.0, DT, None),
        (result_of(x=0.02), 0.0, DT, None),
        (result_of(x=0.06), 0.0, DT, Status.IMPLAUSIBLE_MOTION),
        (result_of(x=0.06), 1.8, DT, None),
        (result_of(x=-0.06), 1.8, DT, Status.IMPLAUSIBLE_MOTION),
        (result_of(x=0.06), 0.0, 4 * DT, None),
        (result_of(x=0.2), 6.0, DT, Status.IMPLAUSIBLE_MOTION),
        (result_of(error=2.5), 0.0, DT, None),
        (result_of(error=3.5), 0.0, DT, Status.HIGH_ERROR),
        (result_of(error=3.5, x=0.02), 0.0, DT, Status.HIGH_ERROR),
        (result_of(depth=0.7), 0.0, DT, None),
        (result_of(depth=0.5), 0.0, DT, Status.DEPTH_MISMATCH),
        (result_of(depth=0.5, x=0.05), 1.5, DT, None),
        (result_of(depth=0.3, x=0.05), 1.5, DT, Status.DEPTH_MISMATCH),
        (result_of(depth=np.nan), 0.0, DT, None),
        (result_of(scale=0.02), 0.0, DT, None),
        (result_of(scale=0.05), 0.0, DT, Status.DEPTH_MISMATCH),
        (result_of(scale=0.04, x=0.05), 1.5, DT, None),
        (result_of(scale=0.05, x=0.05), 1.5, DT, Status.DEPTH_MISMATCH),
    ],
)
def test_a_pair_is_judged_by_those_before(
    result: Alignment, velocity: float, elapsed: float, finding: Status | None
) -> None:
    predicted = jnp.zeros(6).at[0].set(velocity * elapsed)
    clock = jnp.float32(elapsed), jnp.float32(DT)
    judged = judge_by_history(result, usual(), result.error, predicted, *clock)
    assert judged.findings == (0 if finding is None else bit(finding))
    assert judged.status == (Status.OK if finding is None else finding)


@pytest.mark.parametrize("rate", [30, 60, 200])
def test_no_stamp_turns_a_motion_round(rate: int) -> None:
    """From 50 frames a second on, the stamps' error exceeds the time between two frames."""
    expected = jnp.array([2.0, 0.0, 0.0, 0.0, 3.0, 0.0]) / rate
    change = _change(-0.9 * expected, expected, jnp.float32(STAMP_JITTER * rate))
    assert np.all(np.asarray(change) >= 0.9 * np.array([2.0, 3.0]) / rate - 1e-6)


@pytest.mark.parametrize(
    ("metres", "radians", "seconds", "abrupt"),
    [(0.014, 0.0, 1 / 30, True), (0.010, 0.0, 1 / 30, False), (0.0, 0.1, 1 / 30, False), (0.014, 0.0, 1 / 10, False)],
)
def test_an_abrupt_change_is_one_of_the_translation(
    metres: float, radians: float, seconds: float, abrupt: bool
) -> None:
    """A hand turns a camera abruptly, but does not push it so."""
    predicted = exp(np.array([0.02, 0.0, 0.01, 0.0, 0.02, 0.0]))
    motion = predicted @ exp(np.array([0.0, metres, 0.0, radians, 0.0, 0.0]))
    assert is_abrupt(motion, predicted, seconds, seconds) == abrupt
    assert is_abrupt(predicted, motion, seconds, seconds) == abrupt


def test_nothing_is_unusual_before_anything_is_known() -> None:
    clock = jnp.float32(DT), jnp.float32(1.0)
    result = result_of(0.1, 1e4, 0.1)
    judged = judge_by_history(result, Usual.unknown(), result.error, jnp.zeros(6), *clock)
    assert judged.status == Status.OK


@pytest.mark.parametrize(("error", "status"), [(1.0, Status.OK), (1.4, Status.HIGH_ERROR)])
def test_a_camera_may_start_from_rest(error: float, status: Status) -> None:
    """Its usual error was the sensor's noise alone."""
    result, clock = result_of(0.02, error), (jnp.float32(DT), jnp.float32(DT))
    judged = judge_by_history(result, usual_of(result_of(error=0.002)), result.error, jnp.zeros(6), *clock)
    assert judged.status == status


def test_all_that_is_found_is_kept() -> None:
    result = result_of(0.06, 1e4, 0.05)
    judged = judge_by_history(result, usual(), result.error, jnp.zeros(6), jnp.float32(DT), jnp.float32(DT))
    result = judged._replace(status=Status(int(judged.status)))
    assert result.statuses[0] is Status.HIGH_ERROR
    assert set(result.statuses) == {Status.HIGH_ERROR, Status.DEPTH_MISMATCH, Status.IMPLAUSIBLE_MOTION}


class Reordered:
    """A sequence with other frames' images at some stamps."""

    def __init__(self, frames: list[Frame], alter: Callable[[list[Frame]], list[Frame]]):
        self.frames = [
            replace(frame, timestamp=i * DT, depth_timestamp=None) for i, frame in enumerate(alter(list(frames)))
        ]
        self.timestamps = np.arange(len(self.frames)) * DT
        self.name, self.camera, self.ground_truth = "reordered", CAMERA, None

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: Any) -> Any:
        return self.frames[index]

    def __iter__(self) -> Any:
        return iter(self.frames)

    def check(self) -> None:
        pass


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    """A camera that moves by some 0.8 m/s."""
    return list(SyntheticSequence(frames=24, camera=CAMERA, speed=2.0))


def steps_of(frames: list[Frame], alter: Callable[[list[Frame]], list[Frame]]) -> list[Step]:
    return list(track(Reordered(frames, alter), SETTINGS))


def stale(frames: list[Frame]) -> list[Frame]:
    return [*frames[:14], frames[2], *frames[15:]]


def with_depth(make: Callable[[list[Frame], int], Any], count: int = 1) -> Callable[[list[Frame]], list[Frame]]:
    def alter(frames: list[Frame]) -> list[Frame]:
        changed = {i: replace(frames[i], depth=make(frames, i)) for i in range(12, 12 + count)}
        return [changed.get(i, frame) for i, frame in enumerate(frames)]

    return alter


def test_a_clean_run_is_ok(frames: list[Frame]) -> None:
    steps = steps_of(frames, list)
    assert all(step.alignment.statuses == (Status.OK,) and step.segment == 0 for step in steps)


def resting(frames: list[Frame]) -> list[Frame]:
    """The first frame again and again with another noise, then every frame."""
    rest, random = [], np.random.default_rng(0)
    for _ in range(8):
        grey = np.clip(frames[0].grey + random.normal(0.0, 1.2, frames[0].grey.shape), 0, 255).astype(np.uint8)
        depth = np.where(frames[0].depth > 0, frames[0].depth + random.integers(-8, 9, frames[0].depth.shape), 0)
        rest.append(replace(frames[0], grey=grey, depth=depth.astype(np.uint16)))
    return [*rest, *frames]


def test_a_camera_that_starts_from_rest_is_ok(data_dir: Path) -> None:
    """Its errors are many times those at rest, which were noise alone."""
    clip = TumSequence(data_dir / "fr1_desk")[:5]
    sequence = Reordered(list(clip), resting)
    sequence.camera = clip.camera
    statuses = [step.alignment.statuses for step in track(sequence, preset("ga", "fast"))]
    assert statuses == [(Status.OK,)] * 12


def test_an_older_image_is_told(frames: list[Frame]) -> None:
    flagged = {step.index: step for step in steps_of(frames, stale) if step.alignment.status is not Status.OK}
    assert set(flagged) == {14} and flagged[14].lost


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("twice as far", lambda frames, i: frames[i].depth * 2),
        ("upside down", lambda frames, i: np.flipud(frames[i].depth)),
        ("of one distance", lambda frames, i: np.full_like(frames[i].depth, 10000)),
        ("the last one", lambda frames, i: frames[i - 1].depth),
    ],
)
def test_depth_that_does_not_belong_is_told(frames: list[Frame], name: str, make: Any) -> None:
    steps = steps_of(frames, with_depth(make))
    assert {step.index for step in steps if step.alignment.status is not Status.OK} == {12}


def test_depth_that_stands_still_is_told_and_does_no_harm(frames: list[Frame]) -> None:
    clean = steps_of(frames, list)
    steps = steps_of(frames, with_depth(lambda frames, i: frames[11].depth, 3))
    assert [Status.FROZEN in step.alignment.statuses for step in steps] == [11 <= i < 14 for i in range(23)]
    assert not any(step.lost for step in steps)
    assert [step.alignment.frozen for step in steps[10:15]] == ["", "depth", "depth", "depth", ""]
    assert steps[11].alignment.sentence == "The depth repeats the last one."
    assert np.abs(steps[-1].world_T_camera - clean[-1].world_T_camera).max() < 5e-3


def test_depth_that_comes_less_often_than_colour_is_no_fault(frames: list[Frame]) -> None:
    halved = [replace(frame, depth=frames[i - i % 2].depth) for i, frame in enumerate(frames)]
    sequence = Reordered(halved, list)
    sequence.frames = [replace(f, depth_timestamp=(i - i % 2) * DT) for i, f in enumerate(sequence.frames)]
    steps = list(track(sequence, SETTINGS))
    assert not any(Status.FROZEN in step.alignment.statuses for step in steps)


def test_an_image_that_hardly_differs_from_the_last_is_frozen(frames: list[Frame]) -> None:
    def doubled(frames: list[Frame]) -> list[Frame]:
        change = np.random.default_rng(0).integers(-1, 2, frames[0].grey.shape)
        again = [replace(f, grey=np.clip(f.grey + change, 0, 255).astype(np.uint8)) for f in frames]
        return [frame for pair in zip(frames, again, strict=True) for frame in pair]

    steps = steps_of(frames[:6], doubled)
    assert [step.alignment.status is Status.FROZEN for step in steps] == [step.index % 2 == 1 for step in steps]


@pytest.mark.parametrize(("gain", "bias"), [(0.4, 0), (1 / 8, 100), (0.5, 120)])
def test_a_change_of_gain_loses_nothing(frames: list[Frame], gain: float, bias: float) -> None:
    def change(frames: list[Frame]) -> list[Frame]:
        changed = [replace(f, grey=np.clip(np.round(gain * f.grey + bias), 0, 255).astype(np.uint8)) for f in frames]
        return [*frames[:10], *changed[10:14], *frames[14:]]

    assert all(step.alignment.status is Status.OK for step in steps_of(frames, change))


def test_exposure_that_fades_slowly_is_followed(frames: list[Frame]) -> None:
    """Points of earlier frames kept the brightness of their time, and what a search estimates ends at 1.8."""

    def fade(frames: list[Frame]) -> list[Frame]:
        gains = 0.93 ** np.arange(len(frames))
        return [replace(f, grey=np.round(g * f.grey).astype(np.uint8)) for f, g in zip(frames, gains, strict=True)]

    steps = steps_of(frames, fade)
    assert all(step.alignment.status is Status.OK for step in steps)
    assert steps[-1].alignment.error < 2.0 * steps[4].alignment.error


def test_exposures_that_differ_lose_nothing_where_much_is_white(frames: list[Frame]) -> None:
    """What was cut off hid how much brighter the next image was: half of all pairs were `HIGH_ERROR`."""

    def expose(frames: list[Frame]) -> list[Frame]:
        white = 255.0 / np.quantile(frames[0].grey, 0.6)
        gains = white * (1.0 + 0.2 * np.sin(2.1 * np.arange(len(frames))))
        return [
            replace(f, grey=np.minimum(g * f.grey, 255).astype(np.uint8)) for f, g in zip(frames, gains, strict=True)
        ]

    assert all(step.alignment.status is Status.OK for step in steps_of(frames, expose))


def test_the_trajectory_breaks_where_the_motion_is_unknown(frames: list[Frame], tmp_path: Any) -> None:
    covered = replace(frames[0], grey=np.zeros_like(frames[0].grey))
    elsewhere = [replace(f, grey=f.grey[::-1, ::-1].copy(), depth=f.depth[::-1, ::-1].copy()) for f in frames]
    steps = steps_of(frames, lambda frames: [*frames[:8], covered, covered, *elsewhere[8:]])
    segments = [step.segment for step in steps]
    first = segments.index(1)
    assert segments == [0] * first + [1] * (len(steps) - first) and 9 <= first <= 9 + MAX_HELD
    assert all(step.lost for step in steps[7 : first + 1]) and not any(step.lost for step in steps[first + 1 :])
    trajectory = trajectory_of(0.0, steps)
    assert trajectory.segments.tolist() == [0, *segments]


def test_no_segment_starts_from_a_frame_whose_depth_is_in_doubt(frames: list[Frame]) -> None:
    covered = replace(frames[0], grey=np.zeros_like(frames[0].grey))

    def alter(frames: list[Frame]) -> list[Frame]:
        wrong = [replace(frame, depth=frame.depth * 2) for frame in frames[10:14]]
        unlike = [replace(frame, grey=frame.grey[::-1].copy()) for frame in wrong[2:]]
        return [*frames[:10], *wrong[:2], *unlike, covered, *frames[14:]]

    steps = steps_of(frames, alter)
    assert any(step.lost for step in steps) and {step.segment for step in steps} == {0}


class Doubtful:
    """Finds motions, but depth never agrees; without depth they are found or not."""

    def __init__(self, alone_usable: bool):
        self.alone_usable = alone_usable

    def start(self, frame: Frame) -> Any:
        return frame.timestamp

    def align(self, state: Any, frame: Frame, clock: Any) -> Attempt:
        with_depth = bool(np.any(frame.depth))
        usable = not with_depth and self.alone_usable
        status = Status.OK if usable else Status.DEPTH_MISMATCH if with_depth else Status.HIGH_ERROR
        motion = np.eye(4)
        motion[0, 3] = 0.01
        result = no_alignment(status)._replace(target_T_reference=motion)
        return Attempt(frame.timestamp, result, usable)

    def predict(self, state: Any, elapsed: float) -> np.ndarray:
        return np.eye(4)

    def warm_up(self) -> float:
        return 0.0


@pytest.mark.parametrize("alone_usable", [False, True])
def test_a_frame_of_doubtful_depth_is_no_reference(frames: list[Frame], alone_usable: bool) -> None:
    aligner = Doubtful(alone_usable)
    odometry = Odometry(CAMERA, aligner=DoubtingDepth(aligner, aligner))
    steps = list(track(Reordered(frames, list), odometry=odometry))
    assert all(step.alignment.status is Status.DEPTH_MISMATCH for step in steps)
    assert [step.lost for step in steps] == [not alone_usable] * len(steps)
    stamps = [step.reference_timestamp for step in steps]
    renewed = [i for i in range(len(stamps) - 1) if stamps[i] != stamps[i + 1]]
    assert renewed == ([] if alone_usable else [MAX_DOUBTED - 1])


def test_a_motion_that_is_only_guessed_says_nothing_of_depth() -> None:
    """It fits any frame, so that the reference was never renewed as long as a plain body covered the image."""

    class Guessing(Doubtful):
        def align(self, state: Any, frame: Frame, clock: Any) -> Attempt:
            attempt = super().align(state, frame, clock)
            return attempt._replace(result=attempt.result._replace(covariance=UNKNOWN))

    frame = SyntheticSequence(frames=1, camera=CAMERA)[0]
    for kind, usable in ((Guessing, False), (Doubtful, True)):
        attempt = DoubtingDepth(kind(True), kind(True)).align(0.0, frame, None)  # pyright: ignore[reportArgumentType]
        assert attempt.usable == usable and attempt.result.status is Status.DEPTH_MISMATCH


@pytest.mark.parametrize(
    ("grey", "depth", "disagrees"), [(0.95, 0.3, True), (0.95, 0.9, False), (0.6, 0.3, False), (np.nan, np.nan, False)]
)
def test_depth_is_wrong_that_disagrees_alone(grey: float, depth: float, disagrees: bool) -> None:
    """Known of the first pair already, before anything is usual."""
    explained = ExplainedShare(jnp.float32(grey), jnp.float32(depth))
    result = result_of()._replace(explained=explained)
    still, elapsed = jnp.zeros(6), jnp.float32(DT)
    judged = judge_by_history(result, Usual.unknown(), result.error, still, elapsed, jnp.float32(1.0))
    assert bool(int(judged.findings) & bit(Status.DEPTH_MISMATCH)) == disagrees


@pytest.mark.parametrize("clip", ["fr1_xyz", "fr1_desk", "fr1_rpy"])
def test_depth_upside_down_in_the_second_frame(data_dir: Path, clip: str) -> None:
    sequence = TumSequence(data_dir / clip)
    odometry = Odometry(sequence.camera, preset("ga", "fast"))
    odometry.register(sequence[0], sequence[0].timestamp)
    frame = replace(sequence[1], depth=np.flipud(sequence[1].depth))
    step = odometry.register(frame, frame.timestamp)
    assert step is not None and Status.DEPTH_MISMATCH in step.alignment.statuses
