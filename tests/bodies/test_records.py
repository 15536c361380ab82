"""What is recorded of bodies."""

from pathlib import Path
from typing import Any

import numpy as np
from small import CAMERA, Rendered, StandIn

from gavo_jax.alignment.result import no_alignment
from gavo_jax.bodies.records import Seen
from gavo_jax.datasets.base import Frame
from gavo_jax.odometry.aligners import Attempt
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.tracking import Clock
from gavo_jax.output.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from gavo_jax.status import AlignmentStatus

SEEN = [(1, True), (1, False), (2, False), (1, False), (1, True), (1, True), (3, True)]
"""Number of the body in each frame after the first, and whether the camera's motion is usable there."""


class Seeing(StandIn):
    """An aligner that sees these bodies; it starts again after three frames that were lost."""

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        number, usable = SEEN[int(clock.index) - 1]
        body = Seen(number, np.ones((6, 8), np.float32), 0.1, np.zeros(3))
        return Attempt(frame.timestamp, no_alignment(AlignmentStatus.OK), usable, bodies=(body,))


def test_a_body_after_a_break_has_a_number_of_its_own(tmp_path: Path) -> None:
    """Numbers began again at 1: tables and the viewer took the first body then for the first one of the run."""
    odometry, numbers, checkpoint = Odometry(CAMERA, aligner=Seeing()), [], tmp_path / "checkpoint.npz"
    for index, frame in enumerate(Rendered(frames=len(SEEN) + 1, camera=CAMERA)):
        step = odometry.register(frame, index / 30)
        numbers += [] if step is None else [body.number for body in step.bodies]
        save_checkpoint(checkpoint, Checkpoint(odometry.progress._replace(tracker=np.zeros(1)), {}))
        odometry.progress = load_checkpoint(checkpoint, np.zeros(1)).progress
    assert numbers == [1, 2, 2, 4], "none of the lost ones, which show no bodies"
