"""What the driver believes of the time between two frames."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from gavo_jax.datasets.base import Frame
from gavo_jax.frame_checks import History
from gavo_jax.odometry.plausibility import UNKNOWN_SECONDS
from gavo_jax.odometry.progress import Progress
from gavo_jax.status import AlignmentStatus
from tests.odometry.test_leaps import real


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
    steps, off = real(data_dir, "fr1_xyz", [*range(36)], stamped=on_arrival)
    assert {step.alignment.status for step in steps} <= {AlignmentStatus.OK, AlignmentStatus.GAP}
    assert max(off(step)[0] for step in steps) < 0.012


def on_arrival(stamps: NDArray[np.float64]) -> NDArray[np.float64]:
    late = stamps + 0.06 * (np.arange(len(stamps)) % 10 == 9)
    for i in range(1, len(late)):
        late[i] = max(late[i], late[i - 1] + 0.002)
    return late
