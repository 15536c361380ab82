"""Images that repeat themselves, and what is said of motions that may be off by a period."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from small import ALONE, CAMERA

import gavo_jax as gavo
from gavo_jax import se3
from gavo_jax.alignment.repetition import another_period_fits_expected, another_period_is_in_reach, repetitions
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence

SETTINGS = replace(gavo.preset("gauss-newton"), odometry=ALONE)
DISTANCE = 1.5
DEPTH = np.full((CAMERA.height, CAMERA.width), DISTANCE * CAMERA.depth_scale, np.uint16)


def wall(period: float, shift: float = 0.0, noise: float = 1.0) -> np.ndarray:
    """A tiled wall straight ahead; period and shift of the camera to the right in pixels."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    a, b = 2 * np.pi * (u + shift) / period, 2 * np.pi * v / period
    grey = 128 + 25 * np.sin(a) + 25 * np.sin(b) + 15 * np.sin(2 * a + b) + 15 * np.sin(a - 3 * b)
    return np.round(grey + noise * np.random.default_rng(int(abs(shift))).normal(size=grey.shape)).astype(np.uint8)


def moved_by(pixels: float) -> np.ndarray:
    """target_T_reference of a camera that moves the image by so many pixels to the right."""
    step = np.array([pixels * DISTANCE / CAMERA.fx, 0, 0, 0, 0, 0], np.float32)
    return np.asarray(se3.exp(jnp.asarray(step)), np.float64)


def steps(grey: np.ndarray, depth: np.ndarray = DEPTH) -> np.ndarray:
    """All after which a frame looks as before, metres."""
    found = [others for _, others in repetitions(grey, depth, CAMERA)]
    return np.concatenate([np.zeros((0, 3)), *found])


def pixels(grey: np.ndarray) -> set[tuple[int, ...]]:
    """The same before a wall straight ahead."""
    return {tuple(step) for step in np.round(steps(grey)[:, :2] * CAMERA.fx / DISTANCE).astype(int).tolist()}


def test_a_tiled_wall_repeats_itself_after_a_tile() -> None:
    assert {(20, 0), (0, 20), (-20, 0), (20, -20)} <= pixels(wall(20.0, noise=3.0))


def test_a_tile_is_as_large_before_a_sensor_that_reads_every_other_row() -> None:
    read = np.where(np.arange(CAMERA.height)[:, None] % 2 == 1, DEPTH // 3, 0)
    size = np.linalg.norm(steps(wall(20.0), read), axis=1).min()
    np.testing.assert_allclose(size, 20 * DISTANCE / 3 / CAMERA.fx, rtol=0.01)


def slanted(slope: float, period: float = 0.2, noise: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A tiled wall, turned by its slope along x, with tiles of so many metres; its depth as a Kinect reads it."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    z = DISTANCE / (1 - slope * x)
    a, b = 2 * np.pi * x * z * np.hypot(1, slope) / period, 2 * np.pi * y * z / period
    grey = 128 + 25 * np.sin(a) + 25 * np.sin(b) + 15 * np.sin(2 * a + b) + 15 * np.sin(a - 3 * b)
    generator = np.random.default_rng(0)
    read = 1 / (1 / z + 0.0015 * generator.normal(size=z.shape))
    image = np.round(grey + noise * generator.normal(size=grey.shape)).astype(np.uint8)
    return image, np.round(read * CAMERA.depth_scale).astype(np.uint16)


@pytest.mark.parametrize("slope", [-0.6, 0.3, 0.9])
def test_a_tiled_wall_repeats_itself_along_the_wall(slope: float) -> None:
    """No shift of its image does, as tiles grow with nearness."""
    tile = 0.2 * np.array([1.0, 0.0, slope]) / np.hypot(1.0, slope)
    apart = np.linalg.norm(steps(*slanted(slope)) - tile, axis=1)
    assert apart.min() < 0.01


def test_a_floor_repeats_itself_before_a_bare_wall() -> None:
    """Seen by a camera that looks down by 37 degrees."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], axis=-1)
    down, ahead = np.array([0.0, 0.8, 0.6]), np.array([0.0, -0.6, 0.8])
    to_floor, to_wall = 1.2 / np.maximum(rays @ down, 1e-3), 2.2 / np.maximum(rays @ ahead, 1e-3)
    z = np.minimum(to_floor, to_wall)
    points = z[..., None] * rays
    checks = np.sign(np.sin(np.pi * points[..., 0] / 0.2) * np.sin(np.pi * (points @ ahead) / 0.2))
    grey = np.where(to_floor < to_wall, 128 + 50 * checks, 128).astype(np.uint8)
    found = steps(grey, np.round(z * CAMERA.depth_scale).astype(np.uint16))
    assert np.linalg.norm(found - (np.array([0.2, 0.0, 0.0]) + 0.2 * ahead), axis=1).min() < 0.02


def test_a_room_repeats_nothing() -> None:
    frame = SyntheticSequence(frames=2, camera=CAMERA)[0]
    assert not len(steps(frame.grey, frame.depth))


@pytest.mark.parametrize("kind", ["plain", "ramp", "noise", "edge"])
@pytest.mark.parametrize("depth", [DEPTH, np.zeros_like(DEPTH), slanted(0.6)[1]], ids=["ahead", "none", "slanted"])
def test_what_has_no_pattern_repeats_nothing(kind: str, depth: np.ndarray) -> None:
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    images = {
        "plain": np.full(u.shape, 128),
        "ramp": u,
        "noise": np.random.default_rng(0).integers(0, 255, u.shape),
        "edge": np.where(u > 70, 200, 50),
    }
    assert not len(steps(images[kind].astype(np.uint8), depth))


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (1, 640), (640, 1), (5, 7)])
def test_what_is_too_small_for_a_pattern_repeats_nothing(size: tuple[int, int]) -> None:
    grey = np.random.default_rng(0).integers(0, 255, size).astype(np.uint8)
    for depth in (np.zeros(size, np.uint16), np.full(size, 7500, np.uint16)):
        assert not len(steps(grey, depth))


def test_a_motion_whose_error_is_far_below_what_a_period_changes_is_not_off_by_it() -> None:
    """On a wall that grows brighter to the right."""
    grey = np.round(wall(24.0) * 0.8 + 0.3 * np.arange(CAMERA.width)).astype(np.uint8)
    assert (24, 0) in pixels(grey)
    assert another_period_fits_expected(moved_by(9.0), 200.0, np.eye(4), grey, DEPTH, CAMERA)
    assert not another_period_fits_expected(moved_by(9.0), 5.0, np.eye(4), grey, DEPTH, CAMERA)


def test_a_motion_is_doubted_from_a_third_of_a_period_on() -> None:
    grey = wall(24.0)
    still = np.eye(4)
    assert not another_period_fits_expected(moved_by(6.0), 4.0, still, grey, DEPTH, CAMERA)
    assert another_period_fits_expected(moved_by(9.0), 4.0, still, grey, DEPTH, CAMERA)
    assert not another_period_fits_expected(moved_by(9.0), 4.0, moved_by(10.0), grey, DEPTH, CAMERA), "as was expected"
    assert another_period_fits_expected(moved_by(-14.0), 4.0, moved_by(10.0), grey, DEPTH, CAMERA), "a period off"


def test_where_nothing_was_known_any_period_counts_that_a_hand_reaches() -> None:
    grey = wall(24.0)
    assert another_period_is_in_reach(moved_by(3.0), 4.0, np.inf, grey, DEPTH, CAMERA)
    assert another_period_is_in_reach(moved_by(3.0), 4.0, 0.1, grey, DEPTH, CAMERA)
    assert not another_period_is_in_reach(moved_by(3.0), 4.0, 0.005, grey, DEPTH, CAMERA)


def test_align_says_so_of_a_slanted_wall_too() -> None:
    first, second = slanted(0.6), slanted(0.6, noise=2.0)
    result = gavo.align(first, second, CAMERA, SETTINGS)
    assert gavo.AlignmentStatus.AMBIGUOUS in result.statuses
    assert gavo.align(first, second, CAMERA, SETTINGS, guess=np.eye(4)).status == gavo.AlignmentStatus.OK


def test_align_says_that_a_tiled_wall_leaves_the_motion_open() -> None:
    """The motion of 14 pixels, off by a tile of 20, was `ok`."""
    frames = (wall(20.0), DEPTH), (wall(20.0, -14.0), DEPTH)
    result = gavo.align(*frames, CAMERA, SETTINGS)
    assert gavo.AlignmentStatus.AMBIGUOUS in result.statuses
    known = gavo.align(*frames, CAMERA, SETTINGS, guess=moved_by(13.0))
    assert known.status == gavo.AlignmentStatus.OK
    np.testing.assert_allclose(known.target_T_reference, moved_by(14.0), atol=0.005)
    batch = gavo.align_batch([frames[0]], [frames[1]], CAMERA, SETTINGS)
    assert int(batch.status[0]) == gavo.AlignmentStatus.AMBIGUOUS


def test_a_run_before_a_tiled_wall_is_doubted_until_its_motion_is_known() -> None:
    odometry = gavo.Odometry(CAMERA, SETTINGS)
    for i in range(4):
        depth = DEPTH + np.random.default_rng(i).integers(0, 9, DEPTH.shape).astype(np.uint16)  # else it is frozen
        step = odometry.register(gavo.Frame(wall(20.0, 3.0 * i), depth, i / 10), i / 10)
        if step is not None:
            assert gavo.AlignmentStatus.AMBIGUOUS in step.alignment.statuses and not step.lost
