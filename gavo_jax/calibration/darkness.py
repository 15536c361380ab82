"""How much darker the images of a run are in their corners, by its own motion."""

from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gavo_jax.calibration.vignetting import Blocks, corner_darkness, fit_vignetting, seen_twice
from gavo_jax.camera import inverse_depth
from gavo_jax.datasets.base import FrameError, Sequence
from gavo_jax.datasets.rectified import rectified_at, without_distortion
from gavo_jax.trajectory import Trajectory

PAIRS, APART = 24, 8
"""Number of pairs that are looked at, spread over the run, and how many poses lie between the frames of each."""

HARMFUL = 0.2
"""Share from which the drift suffers: twice a first Kinect's 0.12, without which its drift is the same."""


class Darkness(NamedTuple):
    """How much darker the corners are than the middle: 0 is not at all, 1 is black."""

    share: float
    least: float
    """Share that it has at least, three deviations below."""

    @property
    def is_harmful(self) -> bool:
        """Whether it is certainly large enough to show in the drift."""
        return self.least > HARMFUL


def darkness_of(sequence: Sequence, trajectory: Trajectory) -> Darkness | None:
    """Find vignetting that is left in the frames of a run; None if they do not show it.

    Args:
        sequence: The recording; some of its frames are read again.
        trajectory: Its poses.
    """
    sequence = without_distortion(sequence)
    camera = sequence.camera

    @cache  # the pairs of a short run share frames
    def blocks(place: int) -> Blocks:
        frame = rectified_at(sequence, place)
        return Blocks.of(frame.grey, inverse_depth(frame.depth, camera), camera)

    pairs = []
    for start, end, motion in _pairs(sequence, trajectory):
        try:
            pairs.append(seen_twice(blocks(start), blocks(end), motion))
        except FrameError:
            continue
    found = fit_vignetting([pair for pair in pairs if pair is not None])
    if not np.isfinite(found.deviation):
        return None
    least = max(0.0, found.value - 3 * found.deviation)  # of a camera at rest, both numbers are large
    return Darkness(corner_darkness(found.value, camera), corner_darkness(least, camera))


def _pairs(sequence: Sequence, trajectory: Trajectory) -> Iterator[tuple[int, int, Float[np.ndarray, "4 4"]]]:
    """Yield pairs of frames of one segment, with the motion from the first to the second."""
    poses, segments = trajectory.world_T_camera, trajectory.segments

    def place(pose: int) -> int:
        return int(np.abs(sequence.timestamps - trajectory.timestamps[pose]).argmin())

    for end in np.unique(np.linspace(APART, len(poses) - 1, PAIRS).astype(int)) if len(poses) > APART else ():
        start = end - APART
        motion = np.linalg.inv(poses[end]) @ poses[start]
        if segments[start] == segments[end] and np.isfinite(motion).all():
            yield place(start), place(end), motion
