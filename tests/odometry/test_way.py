"""Frames that are found and do not become the reference."""

from dataclasses import replace

import numpy as np
import pytest
from small import ALONE, CAMERA

from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.frame_checks import History
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.plausibility import UNKNOWN_SECONDS
from gavo_jax.odometry.progress import Progress
from gavo_jax.odometry.way import Way
from gavo_jax.rigid_motions import exp, length_and_angle
from gavo_jax.settings import Settings
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import Trajectory, inverse

SEARCH = Settings(GaussNewton(iterations=(0, 15, 0, 0, 20)), odometry=ALONE)


def test_the_way_goes_on_at_the_last_velocity() -> None:
    step = np.array([0.01, 0.0, 0.0, 0.0, 0.02, 0.0])
    way = Way()
    assert way.at(0.1, History()) is None, "the motion before the reference tells"
    way = way.after(0.1, step)
    assert way.at(0.2, History()) == pytest.approx(2 * step)
    way = way.after(0.2, 3 * step)
    assert way.at(0.3, History()) == pytest.approx(5 * step)
    way = way.after(0.3, 3 * step)
    assert way.at(0.5, History()) == pytest.approx(3 * step) and len(way.fixes) == 2
    assert way.at(0.3, History()) is None and way.at(0.1, History()) is None


def test_two_stamps_that_nearly_coincide_tell_no_velocity() -> None:
    step = np.array([0.01, 0.0, 0.0, 0.0, 0.02, 0.0])
    usual = History(intervals=(0.1,) * 5)
    assert Way().after(0.1, step).after(0.102, 2 * step).at(0.2, usual) == pytest.approx(2.98 * step)


def test_a_clock_that_is_set_back_tells_no_velocity() -> None:
    """The motion since the reference counted as that of a millisecond, and all that followed as implausible."""
    step = np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert Way().after(0.1, step).after(-49.9, step).at(-49.86, History()) is None
    frame = replace(SyntheticSequence(1, camera=CAMERA)[0], timestamp=40.0)
    clocks = [Progress(reference_timestamp=stamp, last_index=1).clock(frame) for stamp in (frame.timestamp - 0.1, 50.0)]
    assert [float(clock.elapsed) for clock in clocks] == pytest.approx([0.1, UNKNOWN_SECONDS])


def swinging(frames: int) -> SyntheticSequence:
    """A camera that turns by 12 degrees to either side."""
    begin = SyntheticSequence(1, camera=CAMERA).ground_truth.world_T_camera[0]
    stamps = np.arange(frames) / 30
    yaw = np.radians(12) * np.cos(1.5 * np.pi * stamps)
    poses = np.stack([begin @ exp(np.array([0.0, 0.0, 0.0, 0.0, angle, 0.0])) for angle in yaw])
    return SyntheticSequence(trajectory=Trajectory(stamps, poses), camera=CAMERA)


def test_a_camera_that_turns_is_followed_while_depth_is_missing() -> None:
    """Expected to go on as before the reference, it was lost after nine frames without depth, and 7 degrees off."""
    sequence = swinging(20)
    odometry = Odometry(sequence.camera, SEARCH)
    steps: list[Step] = []
    for index, frame in enumerate(sequence):
        seen = replace(frame, depth=np.zeros_like(frame.depth)) if 3 <= index < 15 else frame
        step = odometry.register(seen, frame.timestamp)
        if step is not None:
            steps.append(step)
    assert [step.index for step in steps if step.lost] == []
    assert {step.alignment.status for step in steps[2:14]} == {AlignmentStatus.NO_DEPTH}
    truth = sequence.ground_truth.world_T_camera
    for step in steps:
        metres, radians = length_and_angle(inverse(inverse(truth[0]) @ truth[step.index]) @ step.world_T_camera)
        assert metres < 0.02 and radians < 0.01
