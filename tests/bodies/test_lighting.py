"""Light that changes from place to place is no body; texture that moves is not taken for light."""

from functools import partial
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from carded import TRACKED
from flicker import followed

from gavo_jax.alignment.visits import prepare_target
from gavo_jax.bodies.lighting import light_change
from gavo_jax.bodies.pixel_evidence import Compared, compare, view_of
from gavo_jax.bodies.scene import MotionSegmenter
from gavo_jax.camera import Camera
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.image.levels import Levels
from gavo_jax.image.pyramid import build_pyramid
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
    light = light_change(*(jnp.asarray(one[None], jnp.float32) for one in (residual, grey, counted)))
    return np.abs(residual - grey * np.asarray(light)[0])


@pytest.mark.parametrize(
    "gain",
    [
        1.0 - 0.3 * (((COLUMNS - 80) / 80) ** 2 + ((ROWS - 60) / 60) ** 2) / 2,
        1.0 + 0.08 * np.sin(ROWS / HEIGHT * 4.0 * np.pi),
        1.0 + 0.15 * np.sin(ROWS / HEIGHT * 14.0 * np.pi),
        1.0 - 0.3 / (1.0 + np.exp((COLUMNS - 80) / 12.0)),
    ],
    ids=["vignette", "flicker by rows", "flicker of few rows", "shade"],
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


def test_texture_of_a_tiny_image_is_not_light(texture: np.ndarray) -> None:
    """A cell of two pixels explained a third of it."""
    kept, whole = 0.0, 0.0
    for row in range(0, 96, 16):
        grey, moved = texture[row : row + 15, :20], texture[row + 4 : row + 19, 6:26]
        kept += float(np.sum(left(moved - grey, grey)))
        whole += float(np.sum(np.abs(moved - grey)))
    assert kept > 0.93 * whole


def test_what_does_not_count_says_nothing_of_the_light(texture: np.ndarray) -> None:
    grey = texture[:HEIGHT, :WIDTH]
    hidden = COLUMNS < 50
    residual = np.where(hidden, 60.0, 0.0)
    assert np.max(left(residual, grey, ~hidden)[:, 60:]) < 1.0


@partial(jax.jit, static_argnames=("levels", "stride"))
def compared(greys: jax.Array, depth: jax.Array, camera: Camera, levels: Levels, stride: int) -> Compared:
    """The first of two images in the second one, by a camera at rest."""
    pyramids = [build_pyramid(grey, depth, camera.depth_scale) for grey in greys]
    here, there = (view_of(prepare_target(pyramid, levels), levels, jnp.zeros(6)) for pyramid in pyramids)
    others = jax.tree.map(lambda leaf: leaf[None], there)
    return compare(here, others, jnp.eye(4)[None], camera, stride)


@pytest.mark.parametrize(("width", "height", "stride", "most"), [(20, 16, 1, 0.8), (83, 123, 2, 0.4)])
def test_light_is_taken_off_images_of_any_size(width: int, height: int, stride: int, most: float) -> None:
    """Tiny, upright, and of sides that the stride does not divide: pixels taken for others would leave the light."""
    camera = Camera(0.8 * width, 0.8 * width, width / 2 - 0.5, height / 2 - 0.5, width, height)
    segmenter = MotionSegmenter(camera, TRACKED)
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(0.0, 90.0, (height, width)), (0, 0), 1.5)
    grey = np.clip(110.0 + noise, 0.0, 200.0)
    ramp = 1.0 + 0.15 * np.linspace(-1.0, 1.0, width)
    greys = np.stack([grey, ramp * grey]).round().astype(np.uint8)
    depth = np.full((height, width), 2 * camera.depth_scale, np.uint16)
    found = jax.device_get(compared(greys, depth, segmenter.camera, segmenter.levels, stride))
    r, seen = found.residuals, found.residuals.inside > 0
    assert np.mean(seen) > 0.7
    assert np.mean(np.abs(r.grey[seen])) < most * np.mean(np.abs(r.grey_sample.value - found.grey.value)[seen])


def test_what_is_saturated_in_either_image_says_nothing_of_the_light() -> None:
    """A white patch that the second image shows darker: its surroundings would seem to have changed."""
    camera = Camera(131.0, 131.0, 79.5, 59.5, WIDTH, HEIGHT)
    segmenter = MotionSegmenter(camera, TRACKED)
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(0.0, 90.0, (HEIGHT, WIDTH)), (0, 0), 1.5)
    grey = np.clip(110.0 + noise, 0.0, 200.0)
    white = (COLUMNS > 40) & (COLUMNS < 52) & (ROWS > 40) & (ROWS < 52)
    greys = np.stack([np.where(white, 255, grey), np.where(white, 210, grey)]).round().astype(np.uint8)
    depth = np.full((HEIGHT, WIDTH), 2 * camera.depth_scale, np.uint16)
    for pair in (greys, greys[::-1]):
        found = jax.device_get(compared(pair, depth, segmenter.camera, segmenter.levels, 1))
        height, width = segmenter.size
        shown = cv2.resize(white.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
        shown = cv2.dilate(shown.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        assert np.max(np.abs(found.light.reshape(height, width)[~shown])) < 0.02


def test_a_lamp_that_flickers_is_no_body(data_dir: Path) -> None:
    clip = TumSequence(data_dir / "fr1_desk")
    steps = followed(clip, clip.camera, FAST, frames=12)
    assert not any(body.share > 0.02 for step in steps for body in step.bodies)
    assert all(AlignmentStatus.MOVING_BODY not in step.alignment.statuses for step in steps)
