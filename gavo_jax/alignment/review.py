"""Checks on the host after a pair was aligned: camera motion during exposure, each image by itself, repetitions."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from gavo_jax.alignment.own_motion import refine_moving, with_own_motion
from gavo_jax.alignment.repetition import another_period_fits_expected, another_period_is_in_reach
from gavo_jax.alignment.result import Alignment, on_host, with_finding
from gavo_jax.alignment.stacking import Images
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.frame_checks import check_images
from gavo_jax.settings import Settings
from gavo_jax.status import AlignmentStatus


def review(
    result: Alignment,
    frames: tuple[Any, Any],
    sides: Any,
    camera: Camera,
    settings: Settings,
    expected: Float[Array | np.ndarray, "b 4 4"] | None,
) -> Alignment:
    """Move a batch's results to the host, and apply the checks that are made there.

    Args:
        result: The result of `align_rows`, of B pairs.
        frames: References and targets as they were given, whose stamps give the delays of depth.
        sides: The same images as returned by `stacked_images`.
        camera: Camera of both frames.
        settings: Settings of the search.
        expected: Initial guesses, if any were given.
    """
    result, count = on_host(result), len(sides[0].grey)
    delays = zip(*(_depth_delays(side, count) for side in frames), strict=True)
    stacked = zip(*(np.asarray(images) for side in sides for images in side), strict=True)
    guesses = [None] * count if expected is None else list(np.asarray(expected, np.float64))
    rows = []
    for k, (pair_delays, (grey0, depth0, grey1, depth1)) in enumerate(zip(delays, stacked, strict=True)):
        row: Alignment = jax.tree.map(lambda leaf, k=k: leaf[k], result)
        reference, target = Images(grey0, depth0), Images(grey1, depth1)
        row = _with_moving_cameras(row, reference, target, camera, settings, pair_delays)
        row = _with_image_findings(row, reference, target, camera)
        rows.append(_with_repetition(row, reference, camera, guesses[k]))
    return jax.tree.map(lambda like, *leaves: np.array(leaves, like.dtype), result, *rows)


def _depth_delays(side: Any, count: int) -> list[float]:
    """Return the seconds from each frame's colour image to its depth image; 0 where unknown."""
    frames = list(side) if len(side) == count else [None] * count  # else a pair of stacked arrays, without stamps
    return [frame.depth_delay if isinstance(frame, Frame) else 0.0 for frame in frames]


def _with_moving_cameras(
    result: Alignment,
    reference: Images,
    target: Images,
    camera: Camera,
    settings: Settings,
    delays: tuple[float, float],
) -> Alignment:
    """Correct for the camera's motion during each exposure, if the settings use features."""
    options = settings.alignment
    if not options.refine or options.features == "off" or not np.isfinite(result.covariance).all():
        return result
    if not camera.readout and not any(delays):
        return result
    found = refine_moving(reference, target, camera.rectified(), np.asarray(result.target_T_reference), delays)
    return result if found is None else with_own_motion(result, found)


def _with_image_findings(result: Alignment, reference: Images, target: Images, camera: Camera) -> Alignment:
    """Add the faults of each image by itself, which the alignment may not show; a target needs no depth.

    Depth can determine a motion despite a black image, and depths in wrong units can agree with each other.
    """
    found = set(check_images(target.grey, target.depth, camera.depth_scale)) - {AlignmentStatus.NO_DEPTH}
    for finding in sorted(found.union(check_images(reference.grey, reference.depth, camera.depth_scale))):
        result = with_finding(result, finding)
    return result


def _with_repetition(
    result: Alignment, reference: Images, camera: Camera, expected: Float[np.ndarray, "4 4"] | None
) -> Alignment:
    """Mark a motion as ambiguous if a repetitive image lets another motion explain it as well.

    If a motion was expected, the other one must also be about as near to that.
    """
    if result.status not in (AlignmentStatus.OK, AlignmentStatus.LOW_TEXTURE):
        return result
    motion, images = np.asarray(result.target_T_reference), (reference.grey, reference.depth, camera)
    if expected is None:
        is_open = another_period_is_in_reach(motion, result.error, np.inf, *images)
    else:
        is_open = another_period_fits_expected(motion, result.error, expected, *images)
    return with_finding(result, AlignmentStatus.AMBIGUOUS) if is_open else result
