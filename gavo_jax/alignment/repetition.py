"""Whether an image is repetitive, so that a motion may be off by a whole period of a pattern.

Tiles, checks and wire netting look alike after a step of one period. E is as low there, and no covariance shows it.
Only prior knowledge can say which of the steps it was.
"""

from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float64, Integer

from gavo_jax.alignment.planes import Plane, Small, StraightView, planes, seen_straight, smaller
from gavo_jax.camera import Camera, to_pixels
from gavo_jax.frame_checks import some_of
from gavo_jax.trajectory import inverse

REPEATS = 0.6
"""Autocorrelation of an image above which a shift may be a repetition. Ordinary rooms reach 0.4."""
APART = 0.3
"""Drop of the autocorrelation that is required on the way to the shift: smooth images correlate everywhere."""
FARTHEST = 3
"""The largest shift that is examined is the view's size over this."""
OVERLAP = 0.3
"""Smallest share of a view of a plane that overlaps itself after a shift."""
AHEAD = 0.2
"""Cosine between the optical axis and a plane's normal above which the plane lies ahead."""
QUICK, EXACT = 4, 2
"""Factors by which the image is reduced: for a quick test, and for the exact one if that is positive."""
MIN_QUICK_CORRELATION = 0.3
"""Autocorrelation above which the quick test is positive; that one is not normalised by the overlap."""
FAST = (1.0, 2.0)
"""m/s and rad/s of a fast hand."""
NEAREST, FARTHEST_POINT, USUAL_DISTANCE = 0.1, 100.0, 1.5
"""Smallest and largest depth of any point, and the one assumed for an image without depth, metres."""
NEARLY = 2.0
"""Another repetition may be the right one if its distance from the expected motion is at most this many times that of
the motion found."""


def repetitions(grey: Any, depth: Any, camera: Camera) -> list[tuple[Plane, Float64[np.ndarray, "n 3"]]]:
    """Find a frame's planes with the steps along each, in metres, after which its view looks much as before.

    Args:
        grey: [H, W].
        depth: Raw depth; 0 = no reading.
        camera: Camera of both; the steps are along its axes.
    """
    if min(np.shape(grey)) < QUICK:
        return []
    coarse = smaller(grey, depth, camera, QUICK)
    promising = [plane for plane in planes(coarse) or [_ahead(depth, camera)] if _may_repeat(coarse, plane)]
    if not promising:
        return []
    fine = smaller(grey, depth, camera, EXACT)
    return [(plane, _steps_along(plane, fine)) for plane in promising]


def _may_repeat(frame: Small, plane: Plane) -> bool:
    view = seen_straight(frame, plane)
    return view is not None and len(_peaks(_self_likeness(view, exact=False), MIN_QUICK_CORRELATION)) > 0


def _steps_along(plane: Plane, frame: Small) -> Float64[np.ndarray, "n 3"]:
    view = seen_straight(frame, plane)
    if view is None:
        return np.zeros((0, 3))
    likeness = _self_likeness(view, exact=True)
    return _between_pixels(likeness, _peaks(likeness, REPEATS)) @ view.axes


def _self_likeness(view: StraightView, exact: bool) -> Float[np.ndarray, "n m"]:
    """Autocorrelation of a view as a function of the shift; zero shift is in the middle.

    Args:
        view: Frontal view of a plane.
        exact: Whether to correlate only the parts that overlap; else the view wraps around.
    """
    there = view.inside.astype(np.float32)
    image = there * (view.grey - view.grey[view.inside].mean()) if view.inside.any() else there
    height, width = image.shape
    beyond = (height // FARTHEST, width // FARTHEST)
    rows, columns = map(cv2.getOptimalDFTSize, np.add(image.shape, beyond)) if exact else image.shape

    def spectrum(values: np.ndarray) -> np.ndarray:
        below, beside = rows - height, columns - width
        return cv2.dft(cv2.copyMakeBorder(values, 0, below, 0, beside, cv2.BORDER_CONSTANT) if exact else values)

    def correlation(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        product = cv2.mulSpectrums(first, second, 0, conjB=True)
        return cv2.dft(product, flags=cv2.DFT_INVERSE | cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT)

    own = spectrum(image)
    likeness = correlation(own, own)
    if exact:
        squares, inside = spectrum(image**2), spectrum(there)
        energies = correlation(squares, inside) * correlation(inside, squares)
        overlap = correlation(inside, inside)
        likeness = np.where(overlap > OVERLAP * there.sum(), likeness / np.sqrt(np.maximum(energies, 1.0)), 0.0)
    else:
        likeness = likeness / max(float(likeness[0, 0]), 1.0)
    middle = np.fft.fftshift(likeness)[rows // 2 - beyond[0] :, columns // 2 - beyond[1] :]
    return middle[: 2 * beyond[0] + 1, : 2 * beyond[1] + 1]


def _peaks(likeness: Float[np.ndarray, "n m"], least: float) -> Integer[np.ndarray, "k 2"]:
    """Return the shifts (columns, rows) of local maxima, with a drop between them and zero shift."""
    middle = np.array(likeness.shape) // 2
    highest = cv2.dilate(likeness, np.ones((5, 5), np.uint8))
    shifts = np.argwhere((likeness == highest) & (likeness > least)) - middle
    shifts = shifts[np.abs(shifts).max(axis=1) > 2]
    way = np.linspace(0.0, 1.0, max(likeness.shape))[:, None, None]
    row, column = np.moveaxis(np.round(middle + way * shifts).astype(int), -1, 0)
    lowest = likeness[row, column].min(axis=0)
    there = likeness[tuple((middle + shifts).T)]
    return shifts[lowest < there - APART][:, ::-1]


def _between_pixels(
    likeness: Float[np.ndarray, "n m"], shifts: Integer[np.ndarray, "k 2"]
) -> Float64[np.ndarray, "k 2"]:
    """Refine peaks to subpixel precision, by parabolas through the likeness at them and beside them."""
    padded = np.pad(likeness, 1, mode="edge")
    column, row = shifts.T + np.array(likeness.shape[::-1])[:, None] // 2 + 1
    here = padded[row, column]
    moved = []
    for ahead, behind in (
        (padded[row, column + 1], padded[row, column - 1]),
        (padded[row + 1, column], padded[row - 1, column]),
    ):
        bend = np.minimum(ahead + behind - 2 * here, -1e-6)
        moved.append(np.clip(0.5 * (behind - ahead) / bend, -0.5, 0.5))
    return shifts + np.stack(moved, axis=-1)


def _difference(frame: Small, step: Float64[np.ndarray, " 3"], plane: Plane) -> float:
    """Return the mean squared difference, in squared grey levels, of a frame from itself after its scene is shifted.

    It is infinite if nothing remains in view.

    Args:
        frame: Frame in full size.
        step: Metres, along the camera's axes.
        plane: Plane that is assumed where there is no reading.
    """
    image, q, step = frame.grey, frame.inverse_depth, step.astype(np.float32)
    z = 1 / np.where(q > 0, q, np.maximum(frame.inverse_depth_of(plane), 1 / FARTHEST_POINT))
    x, y = frame.slopes
    ahead = np.maximum(z + step[2], NEAREST)
    u, v = to_pixels(frame.camera, z * x + step[0], z * y[:, None] + step[1], 1 / ahead)
    there = (u >= 0) & (u <= image.shape[1] - 1) & (v >= 0) & (v <= image.shape[0] - 1)
    moved = cv2.remap(image, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return float(np.mean(np.square(moved - image)[there])) if there.any() else np.inf


LEAST_SHIFT = 4.0
"""Distance in pixels from the expected motion above which a motion is examined: a third of the smallest period that the
quick test sees."""
AS_GOOD, NOISE = 6.0, 4.0
"""Largest ratio of a repetition's difference to E for it to explain the images as well, and a lower bound on that E,
squared grey levels, as interpolated images are inexact."""
MAX_REPETITIONS = 8
"""Largest number of repetitions of each plane that are compared, the nearest ones."""


def another_period_fits_expected(
    found: Float64[np.ndarray, "4 4"],
    error: Any,
    expected: Float64[np.ndarray, "4 4"],
    grey: Any,
    depth: Any,
    camera: Camera,
) -> bool:
    """Whether a motion may be off by a period of a pattern: another repetition is about as near to the expected motion.

    Args:
        found: target_T_reference.
        error: Its E, squared grey levels.
        expected: The motion that was expected.
        grey: Grey of either frame, [H, W].
        depth: Raw depth of the same frame.
        camera: Camera of both frames.
    """
    apart = found @ inverse(expected)
    if _pixels(apart, depth, camera) < LEAST_SHIFT:
        return False
    near = [
        (plane, _nearest(others, step, NEARLY * float(np.linalg.norm(step))))
        for plane, others in repetitions(grey, depth, camera)
        for step in [_step_of(apart, plane)]
    ]
    return _is_any_as_good(near, error, grey, depth, camera)


def another_period_is_in_reach(
    found: Float64[np.ndarray, "4 4"], error: Any, seconds: float, grey: Any, depth: Any, camera: Camera
) -> bool:
    """Whether a motion without prior may be off by a period of a pattern.

    It may if another repetition is a motion that a hand can make in that time.

    Args:
        found: target_T_reference.
        error: Its E, squared grey levels.
        seconds: Time that the motion took; infinite if unknown.
        grey: Grey of either frame, [H, W].
        depth: Raw depth of the same frame.
        camera: Camera of both frames.
    """
    reach = seconds * (FAST[0] + FAST[1] * _distance(depth, camera))
    near = [
        (plane, _nearest(others, _step_of(found, plane), reach)) for plane, others in repetitions(grey, depth, camera)
    ]
    return _is_any_as_good(near, error, grey, depth, camera)


def _ahead(depth: Any, camera: Camera) -> Plane:
    """Return a fronto-parallel plane, for frames that show none."""
    return Plane(np.array([0.0, 0.0, 1.0]), _distance(depth, camera))


def _distance(depth: Any, camera: Camera) -> float:
    """Median depth, metres."""
    read = some_of(depth)
    read = read[read > 0]
    return max(float(np.median(read)) / float(camera.depth_scale), NEAREST) if read.size else USUAL_DISTANCE


def _pixels(motion: Float64[np.ndarray, "4 4"], depth: Any, camera: Camera) -> float:
    """Approximate displacement of the image centre by a motion, pixels."""
    ahead = _ahead(depth, camera)
    return float(np.linalg.norm(_step_of(motion, ahead))) * float(camera.fx) / ahead.distance


def _step_of(motion: Float64[np.ndarray, "4 4"], plane: Plane) -> Float64[np.ndarray, " 3"]:
    """Displacement, along a plane, of its point on the optical axis by a motion, metres.

    If the plane does not lie ahead, its foot is taken instead.
    """
    cosine = plane.normal[2]
    point = np.array([0.0, 0.0, plane.distance / cosine]) if cosine > AHEAD else plane.foot
    step = motion[:3, :3] @ point + motion[:3, 3] - point
    return step - (step @ plane.normal) * plane.normal


def _nearest(
    others: Float64[np.ndarray, "n 3"], step: Float64[np.ndarray, " 3"], reach: float
) -> Float64[np.ndarray, "k 3"]:
    away = np.linalg.norm(others - step, axis=1)
    return others[np.argsort(away)][: np.count_nonzero(away < reach)][:MAX_REPETITIONS]


def _is_any_as_good(
    near: list[tuple[Plane, Float64[np.ndarray, "k 3"]]], error: Any, grey: Any, depth: Any, camera: Camera
) -> bool:
    """Whether an image, after one of the planes' steps, differs from itself by no more than E allows."""
    if not any(len(steps) for _, steps in near):
        return False
    bound, full = AS_GOOD * max(float(error), NOISE), smaller(grey, depth, camera, 1)
    return any(_difference(full, step, plane) < bound for plane, steps in near for step in steps)
