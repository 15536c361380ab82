"""Frames as a camera that stands still would have taken them, in whatever numbers they come."""

from dataclasses import replace

import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.image.motion_compensation import compensate_motion, filled_inverse_depth, halve_depth

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
