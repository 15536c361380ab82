"""A lamp that flickers while rows are exposed."""

from dataclasses import replace
from typing import Any

import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.settings import Settings


def flickering(index: int, frame: Frame, amplitude: float = 0.08) -> Frame:
    """A frame under it: bands of other brightness in every one."""
    rows = np.arange(len(frame.grey))[:, None] / len(frame.grey)
    gain = 1.0 + amplitude * np.sin(4.0 * np.pi * rows + 2.1 * index)
    return replace(frame, grey=np.clip(frame.grey * gain, 0, 255).astype(np.uint8))


def followed(clip: Any, camera: Camera, settings: Settings, frames: int) -> list[Step]:
    """What a driver makes of the first frames of a clip under it."""
    odometry = Odometry(camera, settings)
    given = [flickering(index, clip[index]) for index in range(frames)]
    steps = [odometry.register(frame, frame.timestamp) for frame in given]
    return [step for step in steps if step is not None]
