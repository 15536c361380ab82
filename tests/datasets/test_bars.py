"""Black bars at the sides of images are no part of the scene."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small import CAMERA, NEWTON

from gavo_jax.alignment.pairs import align
from gavo_jax.alignment.stacking import stacked_images
from gavo_jax.camera import Camera
from gavo_jax.datasets.bars import RIM, without_bars
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.rectified import rectified
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.odometry.driver import Odometry
from gavo_jax.presets import preset

DEPTH = np.full((60, 80), 5000, np.uint16)


@pytest.fixture
def grey() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (60, 80)).astype(np.uint8)


def barred(grey: np.ndarray, level: int = 0) -> np.ndarray:
    """With bars of 10 rows on top, 6 below, and 8 columns on the left."""
    image = np.full_like(grey, level)
    image[10:-6, 8:] = grey[10:-6, 8:]
    return image


@pytest.mark.parametrize("level", [0, 16])
def test_bars_go_on_as_the_rows_beside_them_and_have_no_depth(grey: np.ndarray, level: int) -> None:
    clean, depth = without_bars(barred(grey, level), DEPTH)
    inner = np.s_[10 + RIM : -6 - RIM, 8 + RIM :]
    np.testing.assert_array_equal(clean[inner], grey[inner])
    np.testing.assert_array_equal(clean[0, 8 + RIM :], grey[10 + RIM, 8 + RIM :])
    np.testing.assert_array_equal(depth[inner], DEPTH[inner])
    assert depth.sum() == DEPTH[inner].sum() and clean.dtype == grey.dtype and depth.dtype == DEPTH.dtype


def test_images_without_bars_stay_the_objects_that_they_are(grey: np.ndarray) -> None:
    dim = (10 + grey // 64).astype(np.uint8)
    bright = np.full_like(grey, 200)
    blank = np.zeros_like(grey)
    unknown = np.full(grey.shape, np.nan, np.float32)
    for image in (grey, dim, bright, blank, unknown):
        found = without_bars(image, DEPTH)
        assert found[0] is image and found[1] is DEPTH


def test_what_was_cleaned_stays_as_it_is(grey: np.ndarray) -> None:
    """Frames pass more than once: dark rows behind the rim of a bar were another bar the next time."""
    image = barred(grey)
    image[13:20] = 3
    clean, depth = without_bars(image, DEPTH)
    again = without_bars(clean, depth)
    assert again[0] is clean and again[1] is depth


@pytest.mark.parametrize("size", [16, 17, 24])
@pytest.mark.parametrize("rows", [4, 6, 7])
def test_tiny_images_with_bars(grey: np.ndarray, size: int, rows: int) -> None:
    image, depth = grey[:size, :size].copy(), DEPTH[:size, :size]
    image[:rows], image[-rows:] = 0, 0
    clean, kept = without_bars(image, depth)
    assert clean.shape == kept.shape == (size, size)


def test_rows_of_many_levels_or_few_rows_are_no_bar(grey: np.ndarray) -> None:
    ramp, thin = grey.copy(), grey.copy()
    ramp[:20] = np.arange(0, 20)[:, None]
    thin[:3] = 0
    assert without_bars(ramp, DEPTH)[0] is ramp and without_bars(thin, DEPTH)[0] is thin


def test_stacks_of_images_come_without_bars(grey: np.ndarray) -> None:
    camera = Camera(60.0, 60.0, 39.5, 29.5, 80, 60)
    image = barred(grey)
    clean = without_bars(image, DEPTH)
    for kind in (np.asarray, jnp.asarray):
        pair = kind(image), kind(DEPTH)
        for side in ([pair], tuple(part[None] for part in pair)):
            for found, wanted in zip(stacked_images(side, camera), clean, strict=True):
                np.testing.assert_array_equal(found[0], wanted)


def test_frames_and_pairs_come_without_bars() -> None:
    frames = [replace(frame, grey=np.where(bar(frame), 0, frame.grey)) for frame in SyntheticSequence(2, camera=CAMERA)]
    clean = [replace(f, grey=g, depth=d) for f in frames for g, d in [without_bars(f.grey, f.depth)]]
    np.testing.assert_array_equal(rectified(frames[0], CAMERA).grey, clean[0].grey)
    pairs = ((frames[0], frames[1]), (clean[0], clean[1]))
    found, wanted = (align(*pair, CAMERA, NEWTON, key=jax.random.key(0)).xi for pair in pairs)
    np.testing.assert_array_equal(found, wanted)


def bar(frame: Frame) -> np.ndarray:
    """The upper and the lower eighth of an image."""
    rows = np.arange(len(frame.grey))[:, None]
    return np.broadcast_to((rows < 15) | (rows >= 105), np.shape(frame.grey))


def test_bars_are_no_bodies(data_dir: Path) -> None:
    """What stays put while the scene moves looked like one: two of three images of this clip showed some."""
    clip = TumSequence(data_dir / "fr1_desk")
    odometry = Odometry(clip.camera, preset("gauss-newton", "fast"))
    steps = []
    for index in range(45, 51):
        frame = clip[index]
        grey = np.array(frame.grey)
        grey[:60], grey[-60:] = 0, 0
        steps.append(odometry.register(replace(frame, grey=grey), frame.timestamp))
    assert not any(step.bodies for step in steps if step)
