"""Light that changes from place to place is no body; texture that moves is not taken for light."""

from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from gavo_jax.bodies.lighting import light_residual
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.tum import TumSequence
from gavo_jax.odometry.driver import Odometry
from gavo_jax.presets import preset
from gavo_jax.status import AlignmentStatus

HEIGHT, WIDTH = 120, 160
ROWS, COLUMNS = np.mgrid[0:HEIGHT, 0:WIDTH]
FAST = preset("gauss-newton", "fast")


@pytest.fixture(scope="module")
def texture() -> np.ndarray:
    """Grey levels about 110 that change within a few pixels."""
    noise = np.random.default_rng(0).normal(0.0, 1.0, (HEIGHT + 8, WIDTH + 8))
    blurred = 4.0 * cv2.blur(noise, (4, 4))
    return np.clip(110.0 + 40.0 * blurred, 0.0, 255.0)


def left(residual: np.ndarray, grey: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """Size of what local light does not explain of residuals."""
    counted = np.ones_like(grey) if weight is None else weight
    light = light_residual(*(jnp.asarray(one[None], jnp.float32) for one in (residual, grey, counted)))
    return np.abs(residual - np.asarray(light)[0])


@pytest.mark.parametrize(
    "gain",
    [
        1.0 - 0.3 * (((COLUMNS - 80) / 80) ** 2 + ((ROWS - 60) / 60) ** 2) / 2,
        1.0 + 0.08 * np.sin(ROWS / HEIGHT * 4.0 * np.pi),
        1.0 - 0.3 / (1.0 + np.exp((COLUMNS - 80) / 12.0)),
    ],
    ids=["vignette", "flicker by rows", "shade"],
)
def test_a_gain_that_changes_smoothly_is_light(texture: np.ndarray, gain: np.ndarray) -> None:
    grey = texture[:HEIGHT, :WIDTH]
    residual = (gain - 1.0) * grey
    assert np.mean(left(residual, grey)) < 0.5 * np.mean(np.abs(residual))


def test_texture_that_moves_is_not(texture: np.ndarray) -> None:
    grey, moved = texture[:HEIGHT, :WIDTH], texture[4 : 4 + HEIGHT, 6 : 6 + WIDTH]
    residual = np.where((COLUMNS > 40) & (COLUMNS < 100) & (ROWS > 30), moved - grey, 0.0)
    kept = left(residual, grey)
    assert np.mean(kept[residual != 0.0]) > 0.9 * np.mean(np.abs(residual[residual != 0.0]))
    assert np.mean(kept[residual == 0.0]) < 2.0


def test_what_does_not_count_says_nothing_of_the_light(texture: np.ndarray) -> None:
    grey = texture[:HEIGHT, :WIDTH]
    hidden = COLUMNS < 50
    residual = np.where(hidden, 60.0, 0.0)
    assert np.max(left(residual, grey, ~hidden)[:, 60:]) < 1.0


class Flickering:
    """A clip whose lamp flickers while rows are exposed: bands of other brightness in every frame."""

    def __init__(self, clip: TumSequence) -> None:
        self.clip, self.camera = clip, clip.camera

    def frame(self, index: int) -> Frame:
        """A frame of it."""
        frame = self.clip[index]
        rows = np.arange(len(frame.grey))[:, None] / len(frame.grey)
        gain = 1.0 + 0.08 * np.sin(4.0 * np.pi * rows + 2.1 * index)
        grey = np.clip(frame.grey * gain, 0, 255).astype(np.uint8)
        return Frame(grey, frame.depth, frame.timestamp, depth_timestamp=frame.depth_timestamp)


def test_a_lamp_that_flickers_is_no_body(data_dir: Path) -> None:
    clip = Flickering(TumSequence(data_dir / "fr1_desk"))
    odometry = Odometry(clip.camera, FAST)
    steps = [odometry.register(frame, frame.timestamp) for frame in map(clip.frame, range(12))]
    assert not any(body.share > 0.02 for step in steps if step for body in step.bodies)
    assert all(AlignmentStatus.MOVING_BODY not in step.alignment.statuses for step in steps if step)
