"""A short room, a quick search, and stand-ins, with which the parts of the driver are tested."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from small import StandIn

from gavo_jax.alignment.result import Alignment, no_alignment
from gavo_jax.datasets.base import Frame, FrameError
from gavo_jax.datasets.rendered.synthetic import DEFAULT_CAMERA
from gavo_jax.odometry.aligners import Attempt
from gavo_jax.odometry.run import OdometryRun, run_odometry
from gavo_jax.odometry.tracking import Clock
from gavo_jax.settings import OdometryOptions, Settings
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import Trajectory

CAMERA = DEFAULT_CAMERA.level(1)
FRAMES = 12
PLAIN = OdometryOptions(relight=False, recover=False, bodies="off")
"""No second thoughts where a pair looks wrong: what happens to lost pairs is the subject here."""
FRAME_TO_FRAME = replace(PLAIN, reference="previous", prior=False)
SOLVER = GaussNewton(iterations=(0, 15, 0, 0, 20))
"""Two levels: soon compiled."""
SEARCH_ALONE = Settings(SOLVER, odometry=PLAIN)


class Altered:
    """A sequence whose frames pass through a function (index, frame) -> frame, which may also raise FrameError."""

    def __init__(self, inner: Any, alter: Callable[[int, Frame], Frame], ground_truth: bool = True):
        self.inner, self.alter, self.has_truth = inner, alter, ground_truth
        self.read: list[int] = []
        self.checked = 0
        self.name, self.camera, self.timestamps = inner.name, inner.camera, inner.timestamps

    @property
    def ground_truth(self) -> Trajectory | None:
        return self.inner.ground_truth if self.has_truth else None

    def __len__(self) -> int:
        return len(self.inner)

    def __getitem__(self, index: Any) -> Any:
        self.read.append(index)
        return self.alter(index, self.inner[index])

    def __iter__(self) -> Any:
        return (self[i] for i in range(len(self)))

    def check(self) -> None:
        self.checked += 1


def run(sequence: Any, options: OdometryOptions = PLAIN, **arguments: Any) -> OdometryRun:
    return run_odometry(sequence, Settings(SOLVER, odometry=options), **arguments)


def errors(result: OdometryRun, sequence: Any) -> np.ndarray:
    """Distance of each recorded position from the truth, metres, both relative to the first camera."""
    world_T_camera, _ = sequence.ground_truth.interpolate(result.trajectory.timestamps)
    truth = np.linalg.inv(world_T_camera[0]) @ world_T_camera
    return np.linalg.norm(result.trajectory.world_T_camera[:, :3, 3] - truth[:, :3, 3], axis=1)


def known(figure: float | None) -> float:
    assert figure is not None
    return figure


def unreadable(*indices: int) -> Callable[[int, Frame], Frame]:
    def alter(index: int, frame: Frame) -> Frame:
        if index in indices:
            raise FrameError(f"{index}.png: cannot be read")
        return frame

    return alter


class Told(StandIn):
    """An aligner that finds what it is told."""

    def __init__(self, result: Alignment, confirmed: bool = False) -> None:
        self.result = result
        self.confirmed = confirmed
        self.clocks: list[Clock] = []

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        self.clocks.append(clock)
        is_ok = self.result.status is AlignmentStatus.OK
        return Attempt(frame.timestamp, self.result, is_ok or self.confirmed, is_ok)


def found(status: AlignmentStatus, x: float) -> Alignment:
    """A motion of so many metres to the right, and what is said of it."""
    motion = np.eye(4)
    motion[0, 3] = x
    return no_alignment(status)._replace(target_T_reference=motion)
