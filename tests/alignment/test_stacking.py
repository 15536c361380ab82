"""Frames of any kind are stacked; what is none is refused."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small import CAMERA, NEWTON

from gavo_jax import presets
from gavo_jax.alignment.pairs import align, align_batch
from gavo_jax.alignment.stacking import stacked_images, typed_keys
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.run import run_odometry
from gavo_jax.settings import AlignmentOptions, Settings


@pytest.mark.parametrize("put", [np.asarray, jnp.asarray])
def test_depth_that_is_no_number_is_no_reading_however_it_comes(put: Any) -> None:
    grey, depth = np.zeros((2, 120, 160), np.float32), np.ones((2, 120, 160), np.float32)
    depth[0, 0], depth[0, 1] = np.inf, np.nan
    camera = Camera(131.0, 131.0, 79.5, 59.5, 160, 120)
    for side in ((put(grey), put(depth)), [(put(grey[i]), put(depth[i])) for i in range(2)]):
        cleaned = np.asarray(stacked_images(side, camera).depth)
        assert not cleaned[0, :2].any() and (cleaned[0, 2:] == 1).all() and (cleaned[1] == 1).all()


def test_two_lists_are_no_stacks() -> None:
    """Two pairs as a tuple of lists were read as a stack of grey and a stack of depth."""
    grey, depth = np.zeros((2, 120, 160), np.float32), np.ones((2, 120, 160), np.float32)
    for side in (([grey[0], depth[0]], [grey[1], depth[1]]), (list(grey), list(depth))):
        with pytest.raises(GavoError, match="a tuple of two lists"):
            stacked_images(side, CAMERA)
    with pytest.raises(GavoError, match="2 grey images but 1 of depth"):
        stacked_images((grey, depth[:1]), replace(CAMERA, distortion=(0.1, 0.0, 0.0, 0.0, 0.0)))


def test_what_is_no_frame_is_refused_by_name(small_frames: dict[int, Frame]) -> None:
    frame = small_frames[0]
    with pytest.raises(GavoError, match="pair \\(grey, depth\\), got ndarray"):
        align(frame.grey, frame.depth, CAMERA, NEWTON)  # pyright: ignore[reportArgumentType]
    with pytest.raises(GavoError, match="expected lists of frames or pairs of arrays, got NoneType"):
        align_batch(None, None, CAMERA, NEWTON)
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


@pytest.mark.parametrize("kind", [bool, complex, object, str, "datetime64[s]"])
@pytest.mark.parametrize("name", ["grey", "depth"])
def test_what_holds_no_real_numbers_is_no_image(kind: Any, name: str, small_frames: dict[int, Frame]) -> None:
    """Truth values and complex numbers were aligned without a word."""
    frame = small_frames[0]
    wrong = replace(frame, **{name: getattr(frame, name).astype(kind)})
    pair = wrong.grey, wrong.depth
    stack = wrong.grey[None], wrong.depth[None]
    calls: list[Callable[[], Any]] = [
        lambda: align(pair, frame, CAMERA, NEWTON),
        lambda: align_batch(stack, [frame], CAMERA, NEWTON),
        lambda: Odometry(CAMERA, NEWTON).register(wrong, 0.0),
    ]
    for call in calls:
        with pytest.raises(GavoError, match=f"{name} image is .*: expected numbers of shape "):
            call()


@pytest.mark.parametrize("shift", [-128.0, -100.0])
def test_grey_levels_about_zero_are_refused(shift: float, small_frames: dict[int, Frame]) -> None:
    """Images without their mean were aligned as if they were dark, and were off by two per cent of the way."""
    frame = small_frames[0]
    shifted = replace(frame, grey=frame.grey.astype(np.float32).clip(0, 200) + np.float32(shift))
    shifted.grey[0, 0] = np.nan
    for call in (
        lambda: align(shifted, frame, CAMERA, NEWTON),
        lambda: Odometry(CAMERA, NEWTON).register(shifted, 0.0),
    ):
        with pytest.raises(GavoError, match="grey levels must range from 0 to 255, not from -"):
            call()


def test_sharpening_may_go_below_zero(small_frames: dict[int, Frame]) -> None:
    frame = small_frames[0]
    sharp = frame.grey.astype(np.float32)
    sharp[:2], sharp[2:4] = -90.0, 320.0
    stacked_images([replace(frame, grey=sharp)], CAMERA)


def test_numbers_beyond_32_bits_are_no_reading(small_frames: dict[int, Frame]) -> None:
    frame = small_frames[0]
    depth = frame.depth.astype(np.float64)
    depth[0] = np.finfo(np.float64).max
    assert not np.asarray(stacked_images([replace(frame, depth=depth)], CAMERA).depth)[0, 0].any()


def test_a_traced_call_is_told(small_frames: dict[int, Frame]) -> None:
    """It ended in a traceback from the middle of the checks."""
    first, second = small_frames[0], small_frames[0]
    grey, depth = jnp.asarray(first.grey), jnp.asarray(first.depth)
    for call in (
        lambda: jax.jit(lambda grey: align((grey, depth), second, CAMERA, NEWTON).error)(grey),
        lambda: jax.jit(lambda x: x + align(first, second, CAMERA, NEWTON).error)(1.0),
        lambda: jax.vmap(lambda grey: align((grey, depth), second, CAMERA, NEWTON).error)(grey[None]),
        lambda: jax.vmap(lambda grey: align(Frame(grey, depth, 0.0), second, CAMERA, NEWTON).error)(grey[None]),  # pyright: ignore
        lambda: jax.grad(lambda guess: align(first, second, CAMERA, NEWTON, guess=guess).error)(jnp.eye(4)),
        lambda: jax.grad(lambda fx: align(first, second, replace(CAMERA, fx=fx), NEWTON).error)(131.0),
        lambda: jax.jit(lambda x: x + len(run_odometry(SyntheticSequence(2, camera=CAMERA), NEWTON).steps))(1.0),
        lambda: jax.jit(lambda grey: align_batch((grey, depth[None]), [second], CAMERA, NEWTON).error)(grey[None]),
    ):
        with pytest.raises(GavoError, match="outside jax.jit, jax.vmap and jax.grad"):
            call()


def test_keys_of_both_kinds_are_the_same() -> None:
    """For those of the old kind the search was compiled anew."""
    one, two = jax.random.key(5), jax.random.split(jax.random.key(5), 2)
    assert typed_keys(jax.random.PRNGKey(5), ()) == typed_keys(one, ()) == one
    assert (typed_keys(jax.random.split(jax.random.PRNGKey(5), 2), (2,)) == two).all()
    for wrong in (5, np.zeros(2, np.uint32), jnp.zeros(3, jnp.uint32), jnp.zeros(2), jnp.uint32(3)):
        with pytest.raises(GavoError, match="expected a key"):
            typed_keys(wrong, ())
    with pytest.raises(GavoError, match="expected a single key"):
        typed_keys(two, ())
    with pytest.raises(GavoError, match="expected one per pair"):
        typed_keys(jax.random.PRNGKey(5), (2,))


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
