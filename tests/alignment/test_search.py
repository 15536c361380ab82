"""Coarse to fine: what competes, what is refined, and where a search is held."""

from dataclasses import replace

import cv2
import numpy as np
from aligning import Images, difference, target_T_reference, wide_search

from gavo_jax import presets
from gavo_jax.alignment.pairs import align
from gavo_jax.alignment.visits import visited_levels
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.settings import AlignmentOptions, Settings
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.status import AlignmentStatus


def test_what_won_is_refined_on_all_levels(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    options = AlignmentOptions(islands=(1, 1, 1, 1, 3), scouts=32, refine=True)
    assert visited_levels((4, 3), options) == (4,)
    assert visited_levels((4, 3), replace(options, refine=False)) == (4, 3)
    wide = presets.preset("ga", "wide")
    searched = visited_levels(wide.solver.levels, wide.alignment)
    assert searched == (4, 3) and wide.solver.levels[-1] == 1
    result = wide_search(frames[0], frames[1], sequence.camera)
    assert result.history.shape == (sum(wide.solver.iterations[level] for level in searched),)
    assert difference(result.target_T_reference, target_T_reference(sequence, 0, 1))[0] < 0.01


def wallpaper(sequence: SyntheticSequence, shift: float, repeats: bool) -> Images:
    """A wall 1 m ahead, moved by some pixels to the side; its pattern may repeat every 160 pixels."""
    height, width = sequence.camera.height, sequence.camera.width
    u, v = np.arange(width) - shift, np.arange(height)[:, None]
    phase = 2 * np.pi * u / 160 + 2 * np.sin(v / 60)
    grey = 110 + 50 * np.sin(phase) + (0.0 if repeats else 60 * np.sin(u / 200 + v / 90))
    clouds = np.random.default_rng(int(shift)).normal(0, 5, (24, 32))
    grey = grey + cv2.resize(clouds, (width, height), interpolation=cv2.INTER_CUBIC)
    depth = np.full((height, width), sequence.camera.depth_scale)
    return np.clip(grey, 0, 255).astype(np.uint8), depth.astype(np.uint16)


def test_a_pattern_that_repeats_is_ambiguous(sequence: SyntheticSequence) -> None:
    near = {"scout_spread": (0.15, 0.02)}
    results = [
        wide_search(wallpaper(sequence, 0, repeats), wallpaper(sequence, shift, repeats), sequence.camera, **near)
        for repeats, shift in ((True, 80), (False, 40))
    ]
    assert results[0].status is AlignmentStatus.AMBIGUOUS
    assert results[1].status is AlignmentStatus.OK
    assert abs(results[1].xi[0] - 40 / sequence.camera.fx) < 0.005


def test_exposure_does_not_hide_a_large_motion(sequence: SyntheticSequence) -> None:
    bright = frame_with(sequence[0], 40.0)
    result = wide_search(bright, sequence[14], sequence.camera)
    metres, degrees = difference(result.target_T_reference, target_T_reference(sequence, 0, 14))
    assert metres < 0.01 and degrees < 0.3


def frame_with(frame: Frame, brighter: float) -> Frame:
    return replace(frame, grey=np.clip(frame.grey + brighter, 0, 255).astype(np.uint8))


def test_bounds_are_inputs_of_the_program(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    """Half-widths that shut the true motion out show in the result, without a second compilation."""
    options = AlignmentOptions(bounds=(0.001, 0.001))
    result = align(frames[0], frames[1], sequence.camera, Settings(GaussNewton(), options))
    metres, degrees = difference(result.target_T_reference, np.eye(4))
    true_metres, true_degrees = difference(target_T_reference(sequence, 0, 1), np.eye(4))
    assert true_degrees > 0.3 and true_metres > 0.005
    assert degrees < 0.9 * true_degrees or metres < 0.9 * true_metres
    assert AlignmentStatus.HIGH_ERROR in result.statuses, "the search ended where it was held"


def test_a_box_that_shrinks_is_about_what_was_found(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    """Held about the first guess, a search by the last half-widths would have no candidate left."""
    options = AlignmentOptions(bounds_factor=0.1)
    result = align(frames[0], frames[1], sequence.camera, Settings(GaussNewton(), options))
    metres, degrees = difference(result.target_T_reference, target_T_reference(sequence, 0, 1))
    assert not np.isinf(result.history).any() and result.status is AlignmentStatus.OK
    assert metres < 0.003 and degrees < 0.1
