"""Frames that went missing without a gap in the stamps, and frames of another moment."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from small import StandIn

from gavo_jax.alignment.judgement import UNKNOWN
from gavo_jax.alignment.result import no_alignment, with_finding
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.rendered.synthetic import DEFAULT_CAMERA
from gavo_jax.evaluation import rotation_angle
from gavo_jax.odometry.aligners import Attempt
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.leaps import Leap, _seconds, align_leaping
from gavo_jax.odometry.tracking import Clock
from gavo_jax.presets import preset
from gavo_jax.rigid_motions import exp
from gavo_jax.status import AlignmentStatus as Status
from gavo_jax.trajectory import inverse

SPEED, DT = 0.6, 1 / 30
STEP = SPEED * DT


class OnRails(StandIn):
    """Finds every motion, and cannot believe one that is far from the last one's speed."""

    def start(self, frame: Frame) -> tuple[float, float]:
        return self.place(frame), SPEED

    def place(self, frame: Frame) -> float:
        return float(frame.grey[0, 0])

    def predict(self, state: tuple[float, float], elapsed: float) -> NDArray[np.float64]:
        return moved(-state[1] * elapsed)

    def align(self, state: tuple[float, float], frame: Frame, clock: Clock) -> Attempt:
        way = self.place(frame) - state[0]
        speed = way / float(clock.elapsed)
        plausible = abs(speed - state[1]) < 0.9
        result = no_alignment(Status.OK)._replace(target_T_reference=moved(-way))
        result = result if plausible else with_finding(result, Status.IMPLAUSIBLE_MOTION)
        return Attempt((self.place(frame), speed), result, plausible)


def guessed(attempt: Attempt) -> Attempt:
    return attempt._replace(usable=True, result=attempt.result._replace(covariance=UNKNOWN), unknown=1)


def moved(x: float) -> NDArray[np.float64]:
    result = np.eye(4)
    result[0, 3] = x
    return result


def follow(numbers: list[int]) -> list[Step]:
    """Frames of these moments, stamped one after the other."""
    odometry = Odometry(DEFAULT_CAMERA, aligner=OnRails())
    size = (DEFAULT_CAMERA.height, DEFAULT_CAMERA.width)
    steps = []
    for i, number in enumerate(numbers):
        grey = np.random.default_rng(abs(number)).normal(120, 20, size).astype(np.float32)
        grey[0, 0] = number * STEP
        step = odometry.register(Frame(grey, np.full(size, 5000, np.uint16) + grey.astype(np.uint16), i * DT), i * DT)
        steps += [step] if step is not None else []
    return steps


@pytest.fixture
def all_frames_are_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    from gavo_jax.odometry import overlays

    whole = overlays.Finding(Status.OK, overlays.Use.ALL)
    monkeypatch.setattr(overlays, "check_frame", lambda frame, timestamp, camera, history: (whole, history))


def places(steps: list[Step]) -> list[float]:
    return [round(float(step.world_T_camera[0, 3]) / STEP, 3) for step in steps]


@pytest.mark.usefixtures("all_frames_are_fit")
def test_the_frame_after_a_leap_confirms_it() -> None:
    steps = follow([0, 1, 2, 12, 13, 14])
    assert [step.lost for step in steps] == [False, False, True, False, False]
    assert places(steps) == [1, 2, 2, 13, 14]
    assert Status.IMPLAUSIBLE_MOTION in steps[3].alignment.statuses, "stamps and images do not agree here"
    assert steps[3].reference_timestamp == pytest.approx(2 * DT), "the leap is in this step's motion"
    assert steps[4].alignment.status is Status.OK
    assert {step.segment for step in steps} == {0}


@pytest.mark.usefixtures("all_frames_are_fit")
def test_an_image_of_another_moment_is_no_leap() -> None:
    steps = follow([0, 1, 2, -7, 4, 5])
    assert [step.lost for step in steps] == [False, False, True, False, False]
    assert places(steps) == [1, 2, 2, 4, 5]
    assert [step.alignment.status for step in steps[3:]] == [Status.OK, Status.OK]


@pytest.mark.usefixtures("all_frames_are_fit")
def test_two_images_of_other_moments_are_no_leap() -> None:
    steps = follow([0, 1, 2, -7, 19, 5, 6])
    assert [step.lost for step in steps] == [False, False, True, True, False, False]
    assert places(steps)[-2:] == [5, 6]


def test_a_motion_that_is_only_guessed_confirms_no_leap() -> None:
    """Where bodies hide the scene the search goes on as before: that fits any time, and was taken for a leap."""

    class Guessing(OnRails):
        def align(self, state: tuple[float, float], frame: Frame, clock: Clock) -> Attempt:
            attempt = super().align(state, frame, clock)
            return attempt if float(clock.elapsed) < 1.5 * DT else guessed(attempt)

    frame = Frame(np.full((2, 2), 9 * STEP, np.float32), np.full((2, 2), 5000, np.uint16), DT)
    clock = Clock(np.float32(DT), np.float32(0), np.uint32(1))
    attempt, leap = align_leaping(Guessing(), (0.0, SPEED), frame, clock, None)
    assert not attempt.usable and leap is None
    before = Leap(moved(-8 * STEP), 8 * DT, 0.0)
    assert not align_leaping(Guessing(), (0.0, SPEED), frame, clock, before)[0].usable
    assert align_leaping(OnRails(), (0.0, SPEED), frame, clock, before)[0].usable


@pytest.mark.usefixtures("all_frames_are_fit")
def test_leap_after_leap() -> None:
    steps = follow([0, 1, 2, 12, 13, 30, 31, 45, 46])
    assert places(steps) == [1, 2, 2, 13, 13, 31, 31, 46]


VELOCITY = np.array([4.0, -1.0, 0.5, 0.2, -0.5, 0.3])
"""Of the points in the camera, m/s and rad/s."""


class Searching(StandIn):
    """Expects a velocity, and finds one motion whatever the time; it counts what it was asked."""

    def __init__(self, found: Attempt, velocity: NDArray[np.float64] = VELOCITY) -> None:
        self.found, self.velocity, self.asked = found, velocity, []

    def predict(self, state: object, elapsed: float) -> NDArray[np.float64]:
        return exp(self.velocity * elapsed)

    def align(self, state: object, frame: Frame, clock: Clock) -> Attempt:
        self.asked.append(float(clock.elapsed))
        return self.found if len(self.asked) == 1 else self.found._replace(usable=True)


def found(motion: NDArray[np.float64], status: Status = Status.OK, usable: bool = True) -> Attempt:
    return Attempt(None, no_alignment(status)._replace(target_T_reference=motion), usable)


FRAME = Frame(np.zeros((2, 2), np.uint8), np.full((2, 2), 5000, np.uint16), 2 * DT)
CLOCK = Clock(np.float32(2 * DT), np.float32(0), np.uint32(1))
FAR = exp(np.array([0.4, 0.0, 0.3, 0.0, 1.5, 0.0]))


@pytest.mark.parametrize(
    ("leap", "motion", "is_confirmed"),
    [
        (FAR, exp(VELOCITY * DT) @ FAR, True),
        (FAR, exp(np.array([0.5, 0, 0, 0, 0, 0])) @ exp(VELOCITY * DT) @ FAR, False),  # by its translation alone
        (FAR, exp(np.array([0, 0, 0, 0, 0, 0.5])) @ exp(VELOCITY * DT) @ FAR, False),  # by its rotation alone
        (FAR, exp(VELOCITY * 2 * DT), False),  # where it was expected
        (exp(np.array([0.05, 0, 0, 0, 0, 0])) @ exp(VELOCITY * DT), exp(VELOCITY * 2 * DT), False),  # nearer to that
    ],
)
def test_a_leap_is_confirmed_by_one_ordinary_step_further(
    leap: NDArray[np.float64], motion: NDArray[np.float64], is_confirmed: bool
) -> None:
    """Of a camera that turns as well: catches steps that are taken off on the wrong side."""
    aligner = Searching(found(motion))
    attempt, later = align_leaping(aligner, None, FRAME, CLOCK, Leap(leap, 10 * DT, DT))
    assert aligner.asked == pytest.approx([2 * DT, 11 * DT]), "as long as the leap and the step together"
    assert later is None and attempt.usable
    assert attempt.result.statuses == (Status.IMPLAUSIBLE_MOTION if is_confirmed else Status.OK,)


@pytest.mark.parametrize("before", [None, Leap(FAR, 10 * DT, DT)])
@pytest.mark.parametrize("status", [Status.LOW_OVERLAP, Status.HIGH_ERROR])
def test_what_failed_for_another_reason_is_no_leap(before: Leap | None, status: Status) -> None:
    """Nothing is searched again, and nothing is remembered."""
    aligner = Searching(found(FAR, status, usable=False))
    attempt, later = align_leaping(aligner, None, FRAME, CLOCK, before)
    assert later is None and not attempt.usable and len(aligner.asked) == 1
    usable = Searching(found(FAR, Status.IMPLAUSIBLE_MOTION))  # as a wider search may find it
    assert align_leaping(usable, None, FRAME, CLOCK, None)[1] is None and len(usable.asked) == 1


@pytest.mark.parametrize(
    ("turn", "speed", "frames"),
    [(0.1, 0.6, 5.0), (0.4, 0.6, 20.0), (1.0, 0.6, 30.0), (0.001, 0.6, 1.0), (0.05, 0.0, 10.0), (3.0, 0.0, 30.0)],
)
def test_a_leap_lasts_as_long_as_the_camera_needs_for_it(turn: float, speed: float, frames: float) -> None:
    """At its last speed; a second at most, the time between the stamps at least, and no eternity from rest."""
    axis = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    clock = CLOCK._replace(elapsed=np.float32(DT))
    assert _seconds(Searching(found(FAR), speed * axis), None, clock, found(exp(turn * axis))) == pytest.approx(
        frames * DT, rel=1e-5
    )


def real(
    data_dir: Path,
    clip: str,
    numbers: list[int],
    moments: list[int] | None = None,
    stamped: Callable[[NDArray[np.float64]], NDArray[np.float64]] = np.copy,
) -> tuple[list[Step], Callable[[Step], tuple[float, float]]]:
    """`ga:fast` over frames of a clip under the stamps of its first ones, or what `stamped` makes of them; how far each
    step is from the truth, at the moments of these frames or of others.
    """
    sequence = TumSequence(data_dir / clip)
    truth, stamps = sequence.ground_truth, stamped(sequence.timestamps)
    of_truth = sequence.timestamps[numbers if moments is None else moments]
    assert truth is not None
    odometry, steps = Odometry(sequence.camera, preset("ga", "fast")), []
    for number, stamp in zip(numbers, stamps, strict=False):
        frame = sequence[number]
        assert frame.depth_timestamp is not None
        delay = frame.depth_timestamp - frame.timestamp
        step = odometry.register(replace(frame, timestamp=stamp, depth_timestamp=stamp + delay), stamp)
        steps += [step] if step is not None else []

    def off(step: Step) -> tuple[float, float]:
        before = int(np.argmin(np.abs(stamps - step.reference_timestamp)))
        poses = truth.interpolate(of_truth[[before, step.index]])[0]
        error = inverse(inverse(poses[1]) @ poses[0]) @ np.asarray(step.alignment.target_T_reference)
        return float(np.linalg.norm(error[:3, 3])), float(np.degrees(rotation_angle(error[None, :3, :3])[0]))

    return steps, off


def test_missing_frames_that_were_stamped_anew(data_dir: Path) -> None:
    steps, off = real(data_dir, "fr1_xyz", [*range(15), *range(25, 30)])
    leap, landed, after = steps[14], steps[15], steps[16:]
    assert leap.lost and Status.IMPLAUSIBLE_MOTION in leap.alignment.statuses
    assert not landed.lost and Status.IMPLAUSIBLE_MOTION in landed.alignment.statuses
    assert off(landed)[0] < 0.01 and off(landed)[1] < 0.5  # 0.013 m by the speed that the stamps say
    assert all(off(step)[0] < 0.006 and step.alignment.status is Status.OK for step in after)


def test_an_image_of_six_frames_before(data_dir: Path) -> None:
    """A second search, begun from what most of the image asks for, is judged by the run's own speed all the same."""
    steps, off = real(data_dir, "fr1_desk", [*range(15, 23), 17, *range(24, 28)])
    stale, after = steps[7], steps[8:]
    assert stale.lost and Status.IMPLAUSIBLE_MOTION in stale.alignment.statuses
    assert all(off(step)[0] < 0.01 and step.alignment.status is Status.OK for step in after)
