"""Frames as a camera that stands still would have taken them, in whatever numbers they come."""

from dataclasses import replace

import numpy as np
import pytest

from gavo_jax.camera import Camera
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.image.motion_compensation import compensate_motion, filled_inverse_depth, halve_depth
from gavo_jax.image.shutter import row_time
from gavo_jax.rigid_motions import exp

CAMERA = replace(Camera.preset("icl").level(2), readout=0.03)
METRES = replace(CAMERA, depth_scale=1.0)
TWIST = np.array([0.2, -0.1, 0.3, 0.1, -0.2, 0.3])


def test_depth_in_metres_is_that_of_raw_numbers() -> None:
    """It was rounded to whole metres, and nothing was nearer than one."""
    frame = SyntheticSequence(3, camera=CAMERA)[1]
    depth = (frame.depth // 3).astype(np.uint16)  # from 0.3 m on
    metres = depth.astype(np.float32) / np.float32(CAMERA.depth_scale)
    assert 0.0 < metres[metres > 0].min() < 0.7
    np.testing.assert_allclose(filled_inverse_depth(metres, METRES), filled_inverse_depth(depth, CAMERA), rtol=1e-6)
    step = 0.6 / CAMERA.depth_scale
    np.testing.assert_allclose(halve_depth(metres), halve_depth(depth) / CAMERA.depth_scale, atol=step)
    raw = compensate_motion(frame.grey, depth, CAMERA, TWIST, 0.01)
    metric = compensate_motion(frame.grey, metres, METRES, TWIST, 0.01)
    np.testing.assert_array_equal(metric.grey, raw.grey)
    both = (metric.depth > 0) & (raw.depth > 0)
    assert both.mean() > 0.95 * (raw.depth > 0).mean()
    np.testing.assert_allclose(metric.depth[both], raw.depth[both] / CAMERA.depth_scale, atol=2 * step)


def test_depth_of_any_whole_numbers_can_be_looked_up() -> None:
    frame = SyntheticSequence(3, camera=CAMERA)[1]
    raw = compensate_motion(frame.grey, frame.depth, CAMERA, TWIST)
    for kind in (np.int32, np.float64):
        other = compensate_motion(frame.grey, frame.depth.astype(kind), CAMERA, TWIST)
        np.testing.assert_allclose(other.depth, raw.depth, atol=2.0)


def depth_of_a_plane(camera: Camera, twist: np.ndarray, delay: float) -> np.ndarray:
    """Metres at which a camera sees a slanted plane, row by row, by the exact motion of its points."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.back_project(np.stack([u, v], -1).astype(float), np.ones(u.shape))
    normal, distance = np.array([0.2, 0.3, -1.0]), -2.0
    metres = np.empty(u.shape)
    for row, seconds in enumerate(camera.readout * row_time(np.arange(camera.height), camera) + delay):
        moved = exp(seconds * twist)
        n = moved[:3, :3] @ normal
        metres[row] = (distance + n @ moved[:3, 3]) / (rays[row] @ n)
    return metres


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("delay", [0.0, 0.02, -0.02])
def test_depth_is_moved_to_the_moment_of_the_image(axis: int, delay: float) -> None:
    """Catches a motion with one sign wrong: what rolls, tilts or comes nearer would be put at twice its error."""
    twist = np.zeros(6)
    twist[axis] = 0.5
    seen, wanted = depth_of_a_plane(CAMERA, twist, delay), depth_of_a_plane(replace(CAMERA, readout=0.0), twist, 0.0)
    grey = np.zeros(seen.shape, np.uint8)
    found = compensate_motion(grey, np.round(5000 * seen).astype(np.uint16), CAMERA, twist, delay).depth / 5000
    still = compensate_motion(grey, np.round(5000 * wanted).astype(np.uint16), CAMERA, np.zeros(6)).depth / 5000
    inner = np.s_[4:-4, 4:-4]
    assert (found[inner] > 0).all()
    assert np.abs(found - still)[inner].mean() < 0.004, "the nearest reading is up to half a pixel away"


def test_the_rows_of_a_fast_turn_are_put_where_they_belong() -> None:
    """Catches the time of another row: a point is in the image when the row is read that it has moved to."""
    twist = np.array([0.0, 0.0, 0.0, 6.0, 0.0, 0.0])
    _, y = np.broadcast_arrays(np.zeros(CAMERA.width), (np.arange(CAMERA.height)[:, None] - CAMERA.cy) / CAMERA.fy)
    seconds = CAMERA.readout * row_time(np.arange(CAMERA.height)[:, None], CAMERA)

    def grey(angle: np.ndarray) -> np.ndarray:
        return np.round(128 + 180 * angle).astype(np.uint8)

    depth = np.full(y.shape, 10000, np.uint16)
    found = compensate_motion(grey(np.arctan(y) + 6.0 * seconds), depth, CAMERA, twist).grey
    still = compensate_motion(grey(np.arctan(y)), depth, CAMERA, np.zeros(6)).grey
    inner = np.s_[12:-12, 30:-30]
    np.testing.assert_allclose(found[inner].astype(float), still[inner], atol=1.5)
