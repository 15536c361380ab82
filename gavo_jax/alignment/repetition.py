"""Whether an image repeats itself, so that a motion may be off by a whole period of a pattern.

Tiles, checks and wire netting look alike after a step of one period. E is as low there, and no covariance tells. Which
of the steps it was, only what was known before can say.
"""

from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float64, Integer

from gavo_jax.camera import Camera
from gavo_jax.trajectory import inverse

REPEATS = 0.6
"""Correlation of an image with itself, shifted, from which on it may repeat itself. Rooms reach 0.4."""
APART = 0.3
"""By how much less it has to be on the way there: a smooth image is like itself everywhere."""
FARTHEST = 3
"""The largest shift that is looked at is the image's size over this."""
QUICK, EXACT = 4, 2
"""Factors by which the image is made smaller: for a first look, and where that finds something."""
HINT = 0.3
"""Correlation from which on a first look finds something: it takes no account of what lies outside."""
FAST = (1.0, 2.0)
"""m/s and rad/s of a hand that moves fast."""
NEAREST, USUAL_DISTANCE = 0.1, 1.5
"""Metres: nothing is nearer; and what an image without depth is taken to show."""
NEARLY = 2.0
"""Distance from what was expected to another repetition, over the distance to what was found, up to which it may be
that one."""


def periods(grey: Any) -> Float64[np.ndarray, "n 2"]:
    """Shifts (columns, rows), pixels, after which an image [H, W] looks much as before."""
    if min(np.shape(grey)) < QUICK or not len(_peaks(_self_likeness(_smaller(grey, QUICK), exact=False), HINT)):
        return np.zeros((0, 2))
    likeness = _self_likeness(_smaller(grey, EXACT), exact=True)
    return EXACT * _between_pixels(likeness, _peaks(likeness, REPEATS))


def _smaller(grey: Any, factor: int) -> Float[np.ndarray, "h w"]:
    small = cv2.resize(np.asarray(grey, np.float32), None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
    return small - np.mean(small)


def _self_likeness(image: Float[np.ndarray, "h w"], exact: bool) -> Float[np.ndarray, "n m"]:
    """Correlation of an image with itself by the shift; none is in the middle.

    Args:
        image: Of mean 0.
        exact: Whether it is that of the parts that overlap, else of the image as a torus.
    """
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
        squares, inside = spectrum(image**2), spectrum(np.ones_like(image))
        energies = correlation(squares, inside) * correlation(inside, squares)
        likeness = likeness / np.sqrt(np.maximum(energies, 1.0))
    else:
        likeness = likeness / max(float(likeness[0, 0]), 1.0)
    middle = np.fft.fftshift(likeness)[rows // 2 - beyond[0] :, columns // 2 - beyond[1] :]
    return middle[: 2 * beyond[0] + 1, : 2 * beyond[1] + 1]


def _peaks(likeness: Float[np.ndarray, "n m"], least: float) -> Integer[np.ndarray, "k 2"]:
    """Shifts (columns, rows) at which it is highest around, between which and no shift it is lower."""
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
    """Where parabolas through the likeness at peaks and beside them are highest."""
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


def _difference(grey: Any, shift: Float64[np.ndarray, " 2"]) -> float:
    """Mean square, squared grey levels, of what an image differs by from itself, shifted, where the two overlap."""
    image = np.asarray(grey, np.float32)
    size = image.shape[::-1]
    move = np.column_stack([np.eye(2), shift]).astype(np.float32)
    there = cv2.warpAffine(np.ones_like(image), move, size) > 0.999
    return float(np.mean(np.square(cv2.warpAffine(image, move, size, flags=cv2.INTER_CUBIC) - image)[there]))


def image_shift_of(motion: Float64[np.ndarray, "4 4"], depth: Any, camera: Camera) -> Float64[np.ndarray, " 2"]:
    """By how many pixels (columns, rows) a motion moves the middle of an image, about.

    Args:
        motion: target_T_reference.
        depth: Of either frame, [H, W], in units of the camera's.
        camera: Of both.
    """
    away = _distance(depth, camera)
    (x, y, _), (about_x, about_y, _) = motion[:3, 3], cv2.Rodrigues(motion[:3, :3])[0].ravel()
    return np.array([camera.fx * (x / away + about_y), camera.fy * (y / away - about_x)])


def _distance(depth: Any, camera: Camera) -> float:
    """Metres, of the median of what is read."""
    read = np.asarray(depth)[::8, ::8]
    read = read[read > 0]
    return max(float(np.median(read)) / float(camera.depth_scale), NEAREST) if read.size else USUAL_DISTANCE


LEAST_SHIFT = 4.0
"""Pixels from which on what was found is asked about: a third of the smallest period that a first look sees."""
AS_GOOD, NOISE = 6.0, 4.0
"""What a repetition differs by, over E, up to which it explains the images as well; and squared grey levels that E has
at least, as an image between pixels is a guess."""
MOST = 8
"""Repetitions that are compared, the nearest."""


def may_be_another_period(
    found: Float64[np.ndarray, "4 4"],
    error: Any,
    expected: Float64[np.ndarray, "4 4"],
    grey: Any,
    depth: Any,
    camera: Camera,
) -> bool:
    """Whether a motion may be off by a period of a pattern: another repetition is nearly as near to what was expected.

    Args:
        found: target_T_reference.
        error: Its E, squared grey levels.
        expected: The same motion, by what was known before.
        grey: Of either frame, [H, W].
        depth: Of the same, in units of the camera's.
        camera: Of both.
    """
    shift = image_shift_of(found @ inverse(expected), depth, camera)
    length = float(np.hypot(*shift))
    return length >= LEAST_SHIFT and _repeats(grey, float(error), shift, NEARLY * length)


def may_be_any_period(
    found: Float64[np.ndarray, "4 4"], error: Any, seconds: float, grey: Any, depth: Any, camera: Camera
) -> bool:
    """The same, where nothing was known before: whether another repetition is a motion that a hand makes in that time.

    Args:
        found: target_T_reference.
        error: As above.
        seconds: That it took; infinite where that is not known.
        grey: As above.
        depth: As above.
        camera: As above.
    """
    reach = seconds * float(camera.fx) * (FAST[0] / _distance(depth, camera) + FAST[1])
    return _repeats(grey, float(error), image_shift_of(found, depth, camera), reach)


def _repeats(grey: Any, error: float, shift: Float64[np.ndarray, " 2"], reach: float) -> bool:
    """Whether an image looks as before after another shift that is no further from a given one."""
    others = periods(grey)
    away = np.linalg.norm(others - shift, axis=1)
    near = others[np.argsort(away)][: np.count_nonzero(away < reach)][:MOST]
    return any(_difference(grey, other) < AS_GOOD * max(error, NOISE) for other in near)
