"""A lens's vignetting by surfaces that moved, and that of a whole run."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from small import CAMERA, Rendered

from gavo_jax.calibration.darkness import darkness_of
from gavo_jax.calibration.vignetting import (
    FEWEST_PAIRS,
    Blocks,
    Seen,
    corner_darkness,
    fit_vignetting,
    lens_vignetting,
    seen_twice,
)
from gavo_jax.camera import vignetting_gain
from gavo_jax.datasets.base import Frame, FrameError
from gavo_jax.trajectory import Trajectory

WALK = Rendered(24, camera=CAMERA)


class Darkened:
    """A walk whose frames a lens darkens towards their corners; some may be unreadable."""

    name = "darkened"

    def __init__(self, amount: float, unreadable: tuple[int, ...] = ()) -> None:
        self.camera, self.timestamps, self.ground_truth = WALK.camera, WALK.timestamps, WALK.ground_truth
        self.gain = vignetting_gain(replace(CAMERA, vignetting=lens_vignetting(amount)))
        self.unreadable = unreadable
        self.frames = [WALK[index] for index in range(len(WALK))]

    def __len__(self) -> int:
        return len(WALK)

    def __getitem__(self, index: int) -> Frame:
        if index in self.unreadable:
            raise FrameError("torn")
        frame = self.frames[index]
        return replace(frame, grey=np.round(frame.grey / self.gain).astype(np.uint8))


def seen(amount: float, seed: int, wrong: float = 0.0) -> Seen:
    """Surfaces that a lens darkens, in a pair with another exposure."""
    rng = np.random.default_rng(seed)
    before, after = rng.uniform(0, 0.6, (2, 400))
    change = 2 * np.log((1 + amount * before) / (1 + amount * after)) + 0.1 * seed + 0.02 * rng.standard_normal(400)
    change[: int(400 * wrong)] += 1.0
    return Seen(change, before, after)


@pytest.mark.parametrize("amount", [0.0, 0.4, 1.0, 2.0])
def test_the_lens_is_fitted_beside_exposure_and_reflections(amount: float) -> None:
    found = fit_vignetting([seen(amount, seed, wrong=0.2) for seed in range(FEWEST_PAIRS)])
    assert found.value == pytest.approx(amount, abs=0.02) and found.deviation < 0.02


def test_too_few_pairs_show_nothing() -> None:
    assert fit_vignetting([seen(1.0, seed) for seed in range(FEWEST_PAIRS - 1)]).deviation == np.inf


def test_pairs_of_a_wrong_motion_do_not_decide() -> None:
    pairs = [seen(0.5, seed) for seed in range(12)] + [seen(-0.2, seed) for seed in range(12, 15)]
    assert fit_vignetting(pairs).value == pytest.approx(0.5, abs=0.03)


def test_blocks_that_are_hidden_or_saturated_are_not_compared() -> None:
    grey, near = np.full((120, 160), 100.0), np.full((120, 160), 0.5)
    blocks, still = Blocks.of(grey, near, CAMERA), np.eye(4)
    aside = np.eye(4)
    aside[0, 3] = 0.06
    both = seen_twice(blocks, blocks, aside)
    assert both is not None and 59 * 78 <= len(both.change) <= 60 * 80 and np.abs(both.change).max() < 1e-6
    assert seen_twice(blocks, blocks, still) is None
    assert seen_twice(blocks, Blocks.of(grey, 1.5 * near, CAMERA), aside) is None
    assert seen_twice(blocks, Blocks.of(grey + 150, near, CAMERA), aside) is None
    assert seen_twice(Blocks.of(grey, 0 * near, CAMERA), blocks, aside) is None
    away = np.diag([-1.0, 1.0, -1.0, 1.0])
    assert seen_twice(blocks, blocks, away) is None


@pytest.mark.parametrize("amount", [0.0, 0.3, 0.8])
def test_a_run_shows_how_dark_its_corners_are(amount: float) -> None:
    sequence: Any = Darkened(amount, unreadable=(12,))
    assert WALK.ground_truth is not None
    found = darkness_of(sequence, WALK.ground_truth)
    assert found is not None
    assert found.share == pytest.approx(corner_darkness(amount, CAMERA), abs=0.03), found
    assert found.is_harmful == (amount > 0)


def test_a_frame_of_another_size_is_left_out() -> None:
    """It ended a whole run with a traceback, after its last frame."""
    sequence: Any = Darkened(0.3)
    sequence.gain = 1.0
    sequence.frames[12] = replace(sequence.frames[12], grey=sequence.frames[12].grey[:-8])
    assert darkness_of(sequence, WALK.ground_truth) is not None  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("seed", range(8))
def test_a_camera_at_rest_shows_nothing(seed: int) -> None:
    """Noise alone asked for any lens: pairs that share a frame share its noise, and seemed to agree (seed 4)."""
    rng = np.random.default_rng(seed)
    still, shape = WALK[0], WALK[0].grey.shape
    sequence: Any = Darkened(0.0)
    noisy = [np.clip(still.grey + rng.normal(0, 2, shape), 0, 255).astype(np.uint8) for _ in range(len(WALK))]
    sequence.frames = [replace(still, grey=grey) for grey in noisy]
    poses = np.tile(np.eye(4), (len(WALK), 1, 1))
    poses[:, :3, 3] = rng.normal(0, 2e-4, (len(WALK), 3))
    found = darkness_of(sequence, Trajectory(WALK.timestamps, poses))
    assert found is None or not found.is_harmful


@pytest.mark.parametrize("amount", [-0.4, 1.0])
def test_a_wide_lens_keeps_light_positive(amount: float) -> None:
    """Far off the axis a bright corner had a light below zero."""
    rng = np.random.default_rng(3)
    pairs = []
    for _ in range(8):
        before, after = rng.uniform(0, 8, (2, 400))
        model = np.log(np.maximum(1 + amount * before, 0.01) / np.maximum(1 + amount * after, 0.01))
        pairs.append(Seen(2 * model, before, after))
    assert np.isfinite(fit_vignetting(pairs).value)


def test_what_the_camera_says_is_no_longer_there() -> None:
    sequence: Any = Darkened(0.8)
    sequence.camera = replace(CAMERA, vignetting=lens_vignetting(0.8))
    found = darkness_of(sequence, WALK.ground_truth)  # pyright: ignore[reportArgumentType]
    assert found is not None and abs(found.share) < 0.03


@pytest.mark.parametrize("frames", [1, 8, 12])
def test_a_short_run_or_one_in_pieces_shows_nothing(frames: int) -> None:
    truth: Any = WALK.ground_truth
    sequence: Any = Darkened(0.8)
    assert darkness_of(sequence, truth[:frames]) is None
    pieces = Trajectory(truth.timestamps, truth.world_T_camera, np.arange(len(truth.timestamps)) // 5)
    assert darkness_of(sequence, pieces) is None
