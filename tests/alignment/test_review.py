"""Pairs that cannot be aligned are not ok, and what an image says by itself is told."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from aligning import Images, difference, run, target_T_reference
from small import CAMERA, NEWTON

from gavo_jax.alignment.pairs import align, align_batch
from gavo_jax.alignment.result import Alignment
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.sensor_noise import NONE
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.status import AlignmentStatus, bit


def black(frame: Frame) -> Frame:
    return replace(frame, grey=np.zeros_like(frame.grey))


def blind(frame: Frame) -> Frame:
    return replace(frame, depth=np.zeros_like(frame.depth))


def upside_down(frame: Frame) -> Frame:
    return replace(frame, grey=frame.grey[::-1, ::-1].copy(), depth=frame.depth[::-1, ::-1].copy())


def blank(frame: Frame) -> Frame:
    return replace(frame, grey=np.full_like(frame.grey, 128))


SPOILT = [(spoil, side) for spoil in (black, blank, upside_down, blind) for side in ("reference", "target", "both")]
# enough is known of these two: grey alone finds the motion, and so it does when the world stands on its head
SPOILT = [case for case in SPOILT if case not in ((blind, "target"), (upside_down, "both"))]


@pytest.mark.parametrize("spoil, side", SPOILT)
@pytest.mark.parametrize("method", ["ga", "gauss-newton"])
def test_what_cannot_be_aligned_is_not_ok(
    spoil: Callable[[Frame], Frame],
    side: str,
    method: str,
    sequence: SyntheticSequence,
    frames: dict[int, Frame],
) -> None:
    reference = spoil(frames[0]) if side in ("reference", "both") else frames[0]
    target = spoil(frames[1]) if side in ("target", "both") else frames[1]
    result = run(method, reference, target, sequence.camera)
    assert result.status is not AlignmentStatus.OK or is_right(result, sequence)
    if spoil is blind:
        assert result.status is AlignmentStatus.NO_DEPTH


def is_right(result: Alignment, sequence: SyntheticSequence) -> bool:
    """Whether the motion was found in spite of all, say from depth alone."""
    metres, degrees = difference(result.target_T_reference, target_T_reference(sequence, 0, 1))
    return metres < 0.005 and degrees < 0.3


def test_frames_of_two_rooms_are_not_ok(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    elsewhere = SyntheticSequence(frames=30, noise=NONE, seed=11)[15]
    for method in ("ga", "gauss-newton"):
        assert run(method, frames[0], elsewhere, sequence.camera).status is not AlignmentStatus.OK


def test_a_target_without_depth_is_aligned_by_its_grey(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    result = run("gauss-newton", frames[0], blind(frames[1]), sequence.camera)
    metres, degrees = difference(result.target_T_reference, target_T_reference(sequence, 0, 1))
    assert metres < 0.002 and degrees < 0.05


def test_nothing_but_numbers_comes_out_of_nothing(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    result = run("gauss-newton", blind(black(frames[0])), blind(black(frames[1])), sequence.camera)
    assert np.isfinite(result.target_T_reference).all()
    assert result.status is not AlignmentStatus.OK


@pytest.mark.parametrize(("share", "is_low"), [(0.2, True), (0.37, True), (0.6, False)])
def test_a_small_overlap_is_told_as_such(share: float, is_low: bool) -> None:
    """It was `not_finite`, as the error of a motion with too few points in view is infinite by definition."""
    texture = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 1, (120, 400)), (0, 0), 2.0)
    texture = (255 * (texture - texture.min()) / np.ptp(texture)).astype(np.uint8)
    depth, shift = np.full((120, 160), 2 * CAMERA.depth_scale, np.uint16), round((1 - share) * 160)
    guess = np.eye(4)
    guess[0, 3] = -shift * 2 / CAMERA.fx
    wall, farther = ((texture[:, at : at + 160], depth) for at in (0, shift))
    result = align(wall, farther, CAMERA, NEWTON, guess=guess)
    assert share - 0.07 < result.overlap < share
    assert (result.status is AlignmentStatus.LOW_OVERLAP) == is_low
    assert AlignmentStatus.NOT_FINITE not in result.statuses


def grey_of(value: int) -> Callable[[Images], Images]:
    return lambda images: (np.full_like(images[0], value), images[1])


def in_metres(images: Images) -> Images:
    return images[0], (images[1] / CAMERA.depth_scale).astype(np.float32)


@pytest.mark.parametrize(
    ("spoil", "finding"),
    [
        (grey_of(0), AlignmentStatus.BLANK),
        (grey_of(255), AlignmentStatus.BLANK),
        (in_metres, AlignmentStatus.DEPTH_UNITS),
        (lambda images: (np.where(images[0] > 200, np.nan, images[0]), images[1]), AlignmentStatus.NOT_FINITE),
    ],
)
def test_what_an_image_says_by_itself_is_told(
    spoil: Callable[[Images], Images], finding: AlignmentStatus, small_frames: dict[int, Frame]
) -> None:
    """A white target and depth in metres where raw numbers belong were `ok`."""
    before, after = ((small_frames[i].grey, small_frames[i].depth) for i in (0, 1))
    for pair in ((before, spoil(after)), (spoil(before), spoil(after))):
        result = align(*pair, CAMERA, NEWTON)
        assert result.status is not AlignmentStatus.OK and finding in result.statuses
    batch = align_batch([before, before], [after, spoil(after)], CAMERA, NEWTON)
    assert batch.status[0] == AlignmentStatus.OK and int(batch.findings[1]) & bit(finding)
