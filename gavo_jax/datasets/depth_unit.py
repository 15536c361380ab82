"""Check of the depth scale: a scale wrong by 5 or 1000 gives a trajectory wrong by as much.

The median depth alone does not decide: scenes of 0.4 m and of 8 m are both real. The sensor does. The first Kinect and
similar cameras measure disparity, so the steps between the depths that they return grow with the square of depth, by
the same factor in every such camera: `KINECT_STEP`. They also see nothing nearer than `KINECT_NEAREST`.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import FrameError
from gavo_jax.datasets.base import Sequence as FrameSequence
from gavo_jax.datasets.images import without_invalid

COMMON = (5000.0, 1000.0, 1.0)
"""Common depth scales, units per metre: the TUM benchmark's, millimetres, metres."""

SHIFTED, TENTHS = 8000.0, 10000.0
"""Units per metre: SUN3D's eighths of a millimetre; tenths of a millimetre. Proposed only if the depth steps match."""

CENTIMETRES = 100.0
"""Centimetres, in units per metre: proposed only if the steps match or the median is implausible."""

SAMPLED_FRAMES = 3
"""Number of frames that are sampled."""

KINECTS = ("fr1", "fr2", "fr3", "bonn")
"""Presets of Kinect-like cameras."""

KINECT_STEP = 2.85e-3
"""Step between two neighbouring depths of a Kinect over depth squared, 1/m: an eighth of a pixel of disparity at a
baseline of 75 mm and a focal length of 585 pixels."""

KINECT_NEAREST = 0.35
"""Nearest depth that a Kinect measures, metres."""

KINECT_VIEW = (0.76, 0.93)
"""Range of a Kinect's focal length over its image width."""

PLAUSIBLE = (0.15, 150.0)
"""Plausible median depth of a scene, metres."""

DEPTH_RANGE = (0.4, 15.0)
"""Plausible median depth of an RGB-D camera, metres, unless depth left the range gradually. Millimetres read as fifths
of a millimetre put any scene nearer than 2 m below it."""

USUAL = (0.2, 10.0)
"""Range of the median depth, metres, that a unit has to give to replace one whose median is implausible."""

USUAL_MEDIAN = 1.5
"""Most typical median depth, metres: of several possible units the one that comes nearest to it is proposed."""

STEP_TOLERANCE = 0.15
"""Relative tolerance between the scale estimated from the steps and a common one."""

NEAR = 2.0
"""Farthest depth, metres, below which a unit finer than millimetres that is only a guess is doubted: rooms reach
farther."""

LEAST_STEP = 3.5
"""Smallest step used, raw units: rounding hides the law in smaller ones."""

HALVES = (0x2E66, 0x7C00)
"""Range of the integers whose bits are those of 16-bit floats from 0.1 to infinity: Mid-Air stores depth so in PNG."""

LEAST_STEPS, SPREAD = 40, 0.35
"""Minimum number of steps, and largest interquartile range relative to their median, for the steps to follow a law."""


class DepthSample(NamedTuple):
    """Statistics of the raw depth of a few frames, in its own units."""

    near: float
    """First percentile of the raw depth."""
    median: float
    far: float
    """99th percentile of the raw depth."""
    kinect_scale: float | None
    """Units per metre estimated from the steps, if the sensor is Kinect-like; None where the steps follow no law."""
    is_whole: bool = False
    """Whether all images are 16-bit integers."""


def sample_depth(images: Sequence[np.ndarray]) -> DepthSample | None:
    """Compute the statistics of a few raw depth images; None where there is no reading."""
    clean = [without_invalid(image) for image in images]
    readings = np.concatenate([image[image > 0] for image in clean]) if clean else np.empty(0)
    if readings.size == 0:
        return None
    near, median, far = np.percentile(readings, [1, 50, 99])
    is_whole = all(image.dtype == np.uint16 for image in images)
    return DepthSample(float(near), float(median), float(far), _kinect_scale(readings), is_whole)


def _kinect_scale(readings: np.ndarray) -> float | None:
    values = np.unique(readings).astype(float)
    steps, middles = np.diff(values), (values[1:] + values[:-1]) / 2
    resolution = 1.0 if readings.dtype == np.uint16 else 0.0
    per_square = (steps / middles**2)[steps >= LEAST_STEP * resolution]
    if len(per_square) < LEAST_STEPS:
        return None
    low, middle, high = np.percentile(per_square, [25, 50, 75])
    return None if high - low > SPREAD * middle else KINECT_STEP / float(middle)


def better_scale(sample: DepthSample, scale: float, camera: Camera, is_kinect: bool = False) -> float | None:
    """The likely depth scale, units per metre, if it differs from `scale`; None if there is no evidence for another.

    Args:
        sample: statistics of a few frames.
        scale: units per metre according to the camera.
        camera: the camera of the images.
        is_kinect: whether the camera is known to be Kinect-like.
    """
    looks_so = KINECT_VIEW[0] < camera.fx / max(camera.width, camera.height) < KINECT_VIEW[1]
    every = (*COMMON, SHIFTED, TENTHS, CENTIMETRES)
    others = [other for other in every if not 0.5 < other / scale < 2 and sample.median / other < USUAL[1]]
    seen = [other for other in others if sample.near / other > KINECT_NEAREST]
    if (is_kinect or looks_so) and (by_steps := _nearest_to_steps(sample, seen)) is not None:
        return by_steps
    if is_kinect and sample.median / scale < KINECT_NEAREST:
        return max((other for other in seen if other in (*COMMON, CENTIMETRES)), default=None)
    return None if PLAUSIBLE[0] < sample.median / scale < PLAUSIBLE[1] else _most_usual(sample, others)


def _nearest_to_steps(sample: DepthSample, units: list[float]) -> float | None:
    """The unit that matches the depth steps; None if none does."""
    by_steps = sample.kinect_scale
    if by_steps is None or not units:
        return None
    nearest = min(units, key=lambda unit: abs(by_steps / unit - 1))
    return nearest if abs(by_steps / nearest - 1) < STEP_TOLERANCE else None


def _most_usual(sample: DepthSample, units: list[float]) -> float | None:
    """The unit that makes the median depth most typical; None if none makes it usual."""
    usual = [unit for unit in units if sample.median / unit > USUAL[0]]
    likely = [unit for unit in usual if unit in COMMON] or [unit for unit in usual if unit == CENTIMETRES]
    return min(likely, key=lambda unit: abs(np.log(sample.median / unit / USUAL_MEDIAN)), default=None)


def fault_of_scale(sequence: FrameSequence, depths: list[np.ndarray] | None = None) -> str | None:
    """Describe a probably wrong depth scale of a sequence and what to set instead; None if it looks right.

    Judged by its first frames, except those that cannot be read.

    Args:
        sequence: The sequence.
        depths: Its `first_depths`; None to read them.
    """
    sample, scale = sample_sequence(sequence, depths)
    calibration = getattr(sequence, "calibration", None)
    is_kinect = getattr(calibration, "preset", None) in KINECTS
    better = None if sample is None else better_scale(sample, scale, sequence.camera, is_kinect)
    if sample is None:
        return None
    if better is not None:
        return (
            f"depth with depth_scale {scale:g} has a median of {sample.median / scale:.3g} m: it looks like "
            f"{name_of_unit(better)}; set --depth-scale {better:g}"
        )
    median, in_other = sample.median / scale, _in_another_unit(sample, scale)
    is_guess = sample.is_whole and getattr(sequence, "unit_is_assumed", False)
    if is_guess and (median > DEPTH_RANGE[1] or median < DEPTH_RANGE[0] and in_other):
        return (
            f"depth in {name_of_unit(scale)}, a guess, has a median of {median:.3g} m: set --depth-scale, units per "
            f"metre{in_other}{_as_halves(sample)}"
        )
    return None


def is_unusual(median: float, farthest: float, scale: float) -> bool:
    """Whether depth may be in other units: its median is unusual, and usual in another common unit.

    Cameras for short distances, as on a robot's wrist, see scenes of 0.2 m. In millimetres those are taken to be right:
    in no other common unit would they be usual.

    Args:
        median: Median depth, metres.
        farthest: Largest depth, metres.
        scale: Units per metre.
    """
    if DEPTH_RANGE[0] < median < DEPTH_RANGE[1]:
        return False
    return (
        not PLAUSIBLE[0] < median < PLAUSIBLE[1]
        or any(USUAL[0] < median * scale / unit < USUAL[1] for unit in COMMON if unit != scale)
        or _may_be_shares(farthest, scale)
    )


def _may_be_shares(farthest: float, scale: float) -> bool:
    """Whether floats may be shares of a greatest distance."""
    return farthest <= 1 and scale == 1


def _in_another_unit(sample: DepthSample, scale: float) -> str:
    """What the median depth is in another unit that makes it usual; empty if none does."""
    others = [unit for unit in COMMON if unit != scale and sample.median / unit < USUAL[1]]
    other = _most_usual(sample, others)
    if other is None:
        return ""
    named = f"{name_of_unit(other)} (--depth-scale {other:g})"
    return f"; in {named} it is {sample.median / other:.3g} m"


def doubt_of_guess(sequence: FrameSequence, depths: list[np.ndarray] | None = None) -> str | None:
    """Describe integer depth that is all near in a unit guessed from the layout, and what it is in millimetres.

    Args:
        sequence: The sequence.
        depths: Its `first_depths`; None to read them.

    Returns:
        None where the unit is known, the steps of a Kinect confirm it, or depth is not all near.
    """
    if not getattr(sequence, "unit_is_assumed", False):
        return None
    sample, scale = sample_sequence(sequence, depths)
    millimetres = COMMON[1]
    if sample is None or not sample.is_whole or scale <= millimetres or sample.far / scale > NEAR:
        return None
    if _nearest_to_steps(sample, [scale]) or not USUAL[0] < sample.median / millimetres < USUAL[1]:
        return None
    return (
        f"its unit is a guess, in which the farthest is {sample.far / scale:.3g} m, the median "
        f"{sample.median / scale:.3g} m; in millimetres (--depth-scale {millimetres:g}) they are "
        f"{sample.far / millimetres:.3g} and {sample.median / millimetres:.3g} m"
    )


def doubt_of_scale(sequence: FrameSequence, depths: list[np.ndarray] | None = None) -> str | None:
    """Describe a median depth that is unusual, and what it is in another unit; None where it is usual.

    Args:
        sequence: The sequence.
        depths: Its `first_depths`; None to read them.
    """
    if guess := doubt_of_guess(sequence, depths):
        return guess
    sample, scale = sample_sequence(sequence, depths)
    if sample is None or DEPTH_RANGE[0] < sample.median / scale < DEPTH_RANGE[1]:
        return None
    in_other, as_bits = _in_another_unit(sample, scale), _as_halves(sample) or _as_shares(sample, scale)
    if not in_other and not as_bits:
        return None
    return f"a median of {sample.median / scale:.3g} m is unusual{in_other}{as_bits}"


def _as_halves(sample: DepthSample) -> str:
    """Describe the median depth if the integers are bits of 16-bit floats; empty where they cannot be."""
    if not (sample.is_whole and HALVES[0] <= sample.near and sample.far <= HALVES[1]):
        return ""
    metres = float(np.uint16(sample.median).view(np.float16))
    return f"; as bits of floats, as in PNG of Mid-Air, it is {metres:.3g}: write those as TIFF or .npy of floats"


def _as_shares(sample: DepthSample, scale: float) -> str:
    """What depth is if floats are shares of a greatest distance, as simulators have it; empty where they cannot be."""
    if sample.is_whole or not _may_be_shares(sample.far, scale):
        return ""
    return "; floats up to 1 may be fractions of a largest distance: pass --depth-scale 0.1 if 1 stands for 10 m"


def lack_of_depth(sequence: FrameSequence) -> str | None:
    """Describe why a sequence has no depth; None if any of its first, middle and last frames has a reading."""
    read = reader_of(sequence)
    places = sorted({*range(min(SAMPLED_FRAMES, len(sequence))), len(sequence) // 2, len(sequence) - 1})
    looked = recorded = 0
    for index in places:
        try:
            recorded += bool(without_invalid(read(index)).any())
            if recorded and sequence[index].depth.any():
                return None
            looked += 1
        except FrameError:
            continue
    if recorded:
        return (
            f"no depth reading of the {looked} frames sampled falls into the colour image; check that "
            "colour_T_depth is not inverted, and in metres"
        )
    if not looked:
        return None
    return f"no depth readings in the {looked} frames sampled; check for values other than 0, 65535, negative and NaN"


def reader_of(sequence: FrameSequence) -> Callable[[int], np.ndarray]:
    """A function from a frame's index to its depth, as stored where the sequence gives that."""
    return getattr(sequence, "raw_depth", None) or (lambda index: sequence[index].depth)


def first_depths(sequence: FrameSequence) -> list[np.ndarray]:
    """The first frames' depth as stored, where the sequence gives that, without frames that cannot be read."""
    read = reader_of(sequence)
    images = []
    for index in range(min(SAMPLED_FRAMES, len(sequence))):
        try:
            images.append(read(index))
        except FrameError:
            continue
    return images


def unit_of_file(sequence: FrameSequence) -> float:
    """Units per metre of what `reader_of` reads."""
    unit = getattr(sequence, "depth_unit", None)
    return sequence.camera.depth_scale if unit is None else unit.file


def sample_sequence(
    sequence: FrameSequence, depths: list[np.ndarray] | None = None
) -> tuple[DepthSample | None, float]:
    """Statistics of the first frames' depth (`depths`, or as read here), and its units per metre."""
    return sample_depth(first_depths(sequence) if depths is None else depths), unit_of_file(sequence)


NAMES = {
    1.0: "metres",
    1000.0: "millimetres",
    5000.0: "the TUM benchmark's 5000 per metre",
    SHIFTED: "SUN3D's 8000 per metre",
    TENTHS: "tenths of a millimetre",
    CENTIMETRES: "centimetres",
}
"""Names of common units, by their number per metre."""


def name_of_unit(scale: float) -> str:
    """The name of a unit for messages."""
    return NAMES.get(scale, f"{scale:g} per metre")
