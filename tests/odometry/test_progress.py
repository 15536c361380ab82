"""What the driver believes of the time between two frames."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.frame_checks import History
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.plausibility import UNKNOWN_SECONDS
from gavo_jax.odometry.progress import Progress
from gavo_jax.presets import preset
from gavo_jax.rigid_motions import length_and_angle
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import inverse


def test_the_time_between_two_frames() -> None:
    progress = Progress(last_index=9, reference_timestamp=10.0, history=History(intervals=(0.03,) * 5))
    blank = np.zeros((4, 4), np.uint8)
    believed = [float(progress.clock(Frame(blank, blank, t)).elapsed) for t in (10.06, 10.002, 9.0)]
    assert np.allclose(believed, (0.06, 0.03, UNKNOWN_SECONDS))
    late = progress._replace(reference_late=0.05)
    assert [late.since_reference(t) for t in (10.06, 9.0)] == pytest.approx([0.11, -1.0])


def test_frames_that_were_stamped_when_they_arrived(data_dir: Path) -> None:
    """Every tenth frame is late, and those behind it arrive at once: the camera moved as ever.

    Depth was moved along ten times the motion, the references with it, and for half a second nothing fitted.
    """
    sequence = TumSequence(data_dir / "fr1_xyz")
    odometry, truth, statuses, errors = Odometry(sequence.camera, preset("ga", "fast")), sequence.ground_truth, [], []
    assert truth is not None
    stamps = sequence.timestamps[:36] + 0.06 * (np.arange(36) % 10 == 9)
    for i in range(1, len(stamps)):
        stamps[i] = max(stamps[i], stamps[i - 1] + 0.002)
    for i, stamp in enumerate(stamps):
        frame = sequence[i]
        step = odometry.register(replace(frame, depth_timestamp=stamp + frame.depth_delay), stamp)
        if step is None:
            continue
        poses, _ = truth.interpolate(sequence.timestamps[[i - 1, i]])
        error = inverse(inverse(poses[1]) @ poses[0]) @ np.asarray(step.alignment.target_T_reference)
        statuses.append(step.alignment.status)
        errors.append(length_and_angle(error)[0])
    assert set(statuses) <= {AlignmentStatus.OK, AlignmentStatus.GAP} and max(errors) < 0.012
