"""Depth jumps where the image has edges, unless it lies elsewhere."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from small import StandIn

from gavo_jax.alignment.result import no_alignment
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.registry import open_source
from gavo_jax.depth_edges import (
    EARLY,
    EVERY,
    MIN_SEEN,
    REACH,
    SELDOM,
    DepthEdges,
    depth_jumps,
    edges,
    likeness,
)
from gavo_jax.odometry.aligners import Attempt
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.hindsight import revised
from gavo_jax.odometry.tracking import Clock
from gavo_jax.status import AlignmentStatus

TOLD_WITHIN = 24


def zoomed(depth: np.ndarray, factor: float) -> np.ndarray:
    height, width = depth.shape
    about = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), 0.0, factor)
    return cv2.warpAffine(depth, about, (width, height), flags=cv2.INTER_NEAREST)


WAYS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "mirrored": (np.fliplr, "mirrored"),
    "upside down": (np.flipud, "upside down"),
    "turned by half": (lambda depth: depth[::-1, ::-1], "turned by half"),
    "60 pixels to the left": (lambda depth: np.roll(depth, -60, axis=1), "shifted"),
    "too large": (lambda depth: zoomed(depth, 1.3), "of another angle of view"),
    "too small": (lambda depth: zoomed(depth, 0.67), "of another angle of view"),
}


def boxes(noise: np.random.Generator, number: int) -> Frame:
    """Boxes of other depth and grey than the wall behind them, and wallpaper with edges of its own."""
    grey = np.repeat(np.repeat(noise.integers(90, 110, (30, 40)), 8, 0), 8, 1).astype(float)
    depth = np.full((240, 320), 15000.0)
    for _ in range(6):
        row, column = noise.integers(10, 190), noise.integers(10, 240)
        part = np.s_[row : row + noise.integers(20, 45), column : column + noise.integers(20, 70)]
        grey[part], depth[part] = noise.integers(0, 255), noise.integers(4000, 9000)
    return Frame(grey.astype(np.uint8), depth.astype(np.uint16), timestamp=number / 30)


class Still(StandIn):
    """An aligner for which the camera never moves."""

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        result = no_alignment(AlignmentStatus.OK)._replace(target_T_reference=np.eye(4), error=np.float32(1.0))
        return Attempt(frame.timestamp, result, usable=True, candidates=())


def seen(frames: Iterable[Frame], camera: Camera) -> DepthEdges:
    found = DepthEdges.none()
    for frame in frames:
        found = found.after(frame, camera)
    return found


def altered(frame: Frame, way: str) -> Frame:
    return replace(frame, depth=np.ascontiguousarray(WAYS[way][0](frame.depth)))


BOXES = Camera(260.0, 260.0, 159.5, 119.5, 320, 240)


@pytest.fixture(scope="module")
def scene() -> list[Frame]:
    noise = np.random.default_rng(0)
    return [boxes(noise, number) for number in range(EVERY * MIN_SEEN)]


def test_depth_on_the_edges_of_the_image_is_where_it_belongs(scene: list[Frame]) -> None:
    found = seen(scene, BOXES)
    assert found.seen == MIN_SEEN and not found.fault
    assert np.unravel_index(found.sums.argmax(), found.sums.shape) == (0, REACH, REACH)


@pytest.mark.parametrize("way", WAYS)
def test_depth_that_lies_elsewhere_is_told_whether_or_not_the_camera_moves(scene: list[Frame], way: str) -> None:
    assert seen((altered(frame, way) for frame in scene), BOXES).fault == WAYS[way][1]


def test_the_shift_of_an_unregistered_depth_is_not_held_against_it(scene: list[Frame]) -> None:
    shifted = [replace(frame, depth=np.roll(frame.depth, (4, -12), (0, 1))) for frame in scene]
    found = seen(shifted, BOXES)
    assert np.unravel_index(found.sums.argmax(), found.sums.shape) == (0, REACH - 2, REACH + 6)
    assert not found.fault


def test_likeness_is_the_mean_edge_under_the_jumps() -> None:
    noise = np.random.default_rng(1)
    image, jumps = noise.normal(size=(50, 60)).astype(np.float32), (noise.random((50, 60)) < 0.05).astype(np.float32)
    found, wide = likeness(image, jumps), np.pad(image, REACH)
    for down, right in ((0, 0), (-3, 5), (REACH, -REACH)):
        moved = wide[REACH + down : REACH + down + 50, REACH + right : REACH + right + 60]
        for way, depth in zip(found[:4], (jumps, jumps[:, ::-1], jumps[::-1], jumps[::-1, ::-1]), strict=True):
            assert way[REACH + down, REACH + right] == pytest.approx(moved[depth > 0].mean(), abs=1e-5)


@pytest.mark.parametrize(
    "depth",
    [np.zeros((240, 320), np.uint16), np.full((240, 320), np.nan, np.float32), np.full((240, 320), 5000, np.uint16)],
)
def test_depth_without_jumps_says_nothing(scene: list[Frame], depth: np.ndarray) -> None:
    found = seen((replace(frame, depth=depth) for frame in scene), BOXES)
    assert found.references == len(scene) and found.seen == 0 and not found.fault


def test_the_edge_of_what_has_no_reading_is_no_jump() -> None:
    depth = np.full((240, 320), 5000, np.uint16)
    depth[:, 100:200] = 0
    assert not depth_jumps(depth, BOXES).any()
    depth[:, 260:] = 2000
    assert depth_jumps(depth, BOXES).any()


def test_grey_of_any_depth_has_its_edges(scene: list[Frame]) -> None:
    grey = scene[0].grey
    for other in (grey.astype(np.uint16) * 256, grey.astype(np.float32)):
        assert np.corrcoef(edges(grey).ravel(), edges(other).ravel())[0, 1] > 0.9


def test_few_frames_are_looked_at() -> None:
    frames = [boxes(np.random.default_rng(2), 0)] * (EARLY + 2 * SELDOM)
    assert seen(frames, BOXES).seen <= EARLY // EVERY + 2


def test_pairs_before_it_was_told_are_flagged_once_the_run_has_ended() -> None:
    """A camera that stands still: how depth changes says nothing."""
    noise = np.random.default_rng(3)
    frames = [altered(boxes(noise, number), "mirrored") for number in range(TOLD_WITHIN)]
    odometry = Odometry(BOXES, aligner=Still())
    steps = [step for frame in frames if (step := odometry.register(frame, frame.timestamp)) is not None]
    told = [AlignmentStatus.DEPTH_MISMATCH in step.alignment.statuses for step in steps]
    assert told.index(True) == EVERY * (MIN_SEEN - 1) and all(told[told.index(True) :])
    assert all(AlignmentStatus.DEPTH_MISMATCH in step.alignment.statuses for step in revised(steps))


@pytest.mark.parametrize("clip", ["fr1_xyz", "fr1_desk", "fr1_rpy", "fr1_desk_loop", "redkitchen_7scenes"])
def test_real_depth_is_where_it_belongs(data_dir: Path, clip: str) -> None:
    sequence = open_source(data_dir / clip)
    found = DepthEdges.none()
    for index in range(len(sequence)):
        found = found.after(sequence[index], sequence.camera)
        assert not found.fault
    assert found.seen > MIN_SEEN


@pytest.mark.parametrize("way", ["mirrored", "upside down", "turned by half"])
@pytest.mark.parametrize("clip", ["fr1_xyz", "fr1_desk", "fr1_rpy", "fr1_desk_loop"])
def test_real_depth_that_lies_elsewhere_is_told_within_a_second(data_dir: Path, clip: str, way: str) -> None:
    sequence = open_source(data_dir / clip)
    assert seen((altered(sequence[index], way) for index in range(TOLD_WITHIN)), sequence.camera).fault == WAYS[way][1]
