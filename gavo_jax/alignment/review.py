"""What is looked at on the host once a pair was aligned: moving cameras, each image by itself, repetitions."""

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
    """Return a batch's results on the host, with all that is looked at there.

    Args:
        result: The result of `align_rows`, of B pairs.
        frames: References and targets as they were given, whose stamps tell the delays of depth.
        sides: The same images as `stacked_images` gives them.
        camera: Camera of both frames.
        settings: What searched.
        expected: Motions to start from, where any were given.
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
    """Seconds from each frame's colour image to its depth image; 0 where that is not known."""
    frames = list(side) if len(side) == count else [None] * count  # else both kinds of images, each of all frames
    return [frame.depth_delay if isinstance(frame, Frame) else 0.0 for frame in frames]


def _with_moving_cameras(
    result: Alignment,
    reference: Images,
    target: Images,
    camera: Camera,
    settings: Settings,
    delays: tuple[float, float],
) -> Alignment:
    """Take into account what each frame's own motion did to it, where the settings look for features."""
    options = settings.alignment
    if not options.refine or options.features == "off" or not np.isfinite(result.covariance).all():
        return result
    if not camera.readout and not any(delays):
        return result
    found = refine_moving(reference, target, camera.rectified(), np.asarray(result.target_T_reference), delays)
    return result if found is None else with_own_motion(result, found)


def _with_image_findings(result: Alignment, reference: Images, target: Images, camera: Camera) -> Alignment:
    """Add what speaks against each image by itself: depth may tell of a motion to a black image, or numbers that are
    no metres agree with each other. Of a target the grey image is enough.
    """
    found = set(check_images(target.grey, target.depth, camera.depth_scale)) - {AlignmentStatus.NO_DEPTH}
    for finding in sorted(found.union(check_images(reference.grey, reference.depth, camera.depth_scale))):
        result = with_finding(result, finding)
    return result


def _with_repetition(
    result: Alignment, reference: Images, camera: Camera, expected: Float[np.ndarray, "4 4"] | None
) -> Alignment:
    """Call a motion ambiguous whose image repeats itself, so that another motion explains it as well; where a motion
    was expected, only if the other one is about as near to that.
    """
    if result.status not in (AlignmentStatus.OK, AlignmentStatus.LOW_TEXTURE):
        return result
    motion, images = np.asarray(result.target_T_reference), (reference.grey, reference.depth, camera)
    if expected is None:
        is_open = another_period_is_in_reach(motion, result.error, np.inf, *images)
    else:
        is_open = another_period_fits_expected(motion, result.error, expected, *images)
    return with_finding(result, AlignmentStatus.AMBIGUOUS) if is_open else result
