"""Frames of any kind are stacked; what is none is refused."""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from small import CAMERA, NEWTON

from gavo_jax import presets
from gavo_jax.alignment.pairs import align, align_batch
from gavo_jax.alignment.stacking import stacked_images
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.odometry.driver import Odometry
from gavo_jax.settings import AlignmentOptions, Settings


@pytest.mark.parametrize("put", [np.asarray, jnp.asarray])
def test_depth_that_is_no_number_is_no_reading_however_it_comes(put: Any) -> None:
    grey, depth = np.zeros((2, 120, 160), np.float32), np.ones((2, 120, 160), np.float32)
    depth[0, 0], depth[0, 1] = np.inf, np.nan
    camera = Camera(131.0, 131.0, 79.5, 59.5, 160, 120)
    for side in ((put(grey), put(depth)), [(put(grey[i]), put(depth[i])) for i in range(2)]):
        cleaned = np.asarray(stacked_images(side, camera).depth)
        assert not cleaned[0, :2].any() and (cleaned[0, 2:] == 1).all() and (cleaned[1] == 1).all()


def test_what_is_no_frame_is_refused_by_name(small_frames: dict[int, Frame]) -> None:
    frame = small_frames[0]
    with pytest.raises(GavoError, match="pair \\(grey, depth\\), not ndarray"):
        align(frame.grey, frame.depth, CAMERA, NEWTON)  # pyright: ignore[reportArgumentType]
    with pytest.raises(GavoError, match="frame_of"):
        align((np.repeat(frame.grey[..., None], 3, axis=2), frame.depth), frame, CAMERA, NEWTON)
    with pytest.raises(GavoError, match="alignment.loss: must be a function, not 'huber'"):
        align(frame, frame, CAMERA, Settings(NEWTON.solver, AlignmentOptions(loss="huber")))  # pyright: ignore


@pytest.mark.parametrize(("width", "height"), [(1, 640), (640, 1), (15, 20)])
def test_images_too_small_for_a_pyramid_are_refused(width: int, height: int) -> None:
    camera = Camera(100.0, 100.0, width / 2, height / 2, width, height)
    frame = np.zeros((height, width), np.uint8), np.zeros((height, width), np.uint16)
    for name in ("default", "wide"):
        with pytest.raises(GavoError, match="16 pixels"):
            align(frame, frame, camera, presets.preset("ga", name))
    with pytest.raises(GavoError, match="16 pixels"):
        Odometry(camera)


def test_wrong_sizes_are_refused(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    camera, frame = sequence.camera, frames[0]
    cut = replace(frame, depth=frame.depth[:-1])
    coloured = (np.zeros((480, 640, 3), np.uint8), frame.depth)
    for reference, target in ((cut, frame), (frame, cut), (coloured, frame), (frame, (frame.grey, frame.grey[:5]))):
        with pytest.raises(GavoError, match="shape"):
            align(reference, target, camera)
    with pytest.raises(GavoError):
        align(frame, frame, camera.level(1))
    with pytest.raises(GavoError):
        align_batch([frame, frame], [frame], camera)
    stack = np.zeros((2, 480, 640), np.uint8)
    with pytest.raises(GavoError):
        align_batch((stack, stack[:, :-1]), (stack, stack), camera)
    for nothing in ([], (stack[:0], stack[:0])):
        with pytest.raises(GavoError, match="a batch of no frames"):
            align_batch(nothing, nothing, camera)
