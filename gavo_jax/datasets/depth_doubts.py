"""Depth images that contain something other than depth: swapped bytes, stretched pictures, disparity, limits.

Each is recognised by a property that true depth never has, whatever the scene. A run refuses what `fault_of_depth`
finds, and reports what `doubt_of_limit` finds; only `gavo inspect` reports all that `doubt_of_depth` finds.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Shaped, UInt16

from gavo_jax.datasets.base import FrameError
from gavo_jax.datasets.base import Sequence as FrameSequence
from gavo_jax.datasets.depth_unit import doubt_of_scale, fault_of_scale, first_depths, reader_of, unit_of_file
from gavo_jax.datasets.images import without_invalid
from gavo_jax.number_types import NO_READING

MIN_READINGS = 1000
"""Minimum number of readings, or of pairs of neighbouring readings, for a judgement."""

SWAPPED = 8.0
"""Ratio of the mean step between neighbours to that after swapping the bytes, above which they count as swapped. The
steps of real depth are a hundred times smaller than those of its swapped numbers; those of noise are equal.
"""

STRETCHES, DISTINCT = (257, 256), 16
"""Factors by which programs stretch 8 bits to 16, and the minimum number of different values for a judgement."""

RAW_KINECT = 2047
"""Value of a missing reading in a Kinect's raw disparity, which has 11 bits."""

MUCH, GAP, CLAMPED = 0.05, 0.95, 0.8
"""The farthest reading is a limit if at least this share of the readings equals it, and the next one is nearer than
`GAP` of it, or fewer are between `CLAMPED` of it and it.
"""

ROUND_LIMIT = 5.0
"""Distance, metres, from which a whole number of metres is a limit, too: no scene has much at exactly that distance."""

SAMPLED_FOR_PLANES = 9
"""Number of frames, spread over the sequence, in which flat surfaces are looked for."""

PATCHES, FULL = (8, 5), 0.9
"""Patches along an image's width (they overlap by half), and the minimum share of a patch that has readings."""

WIDTH = 320
"""Width to which images are thinned out before patches are cut."""

RECEDING = 1.15
"""Ratio of the farthest to the nearest reading above which a patch distinguishes a plane's depth from its inverse."""

FLAT, FLATTER = 0.05, 1.5
"""Maximum deviation from a plane, as a share of the patch's standard deviation, and the minimum ratio of the deviation
of depth to that of its inverse, or the reverse.
"""

PLANES, MOST_OTHERS = 6, 0.1
"""Minimum number of flat patches for a judgement, and the maximum share of them that may contradict it."""


def fault_of_depth(sequence: FrameSequence) -> str | None:
    """Describe why the depth of a sequence is not depth, or in the wrong unit; None if it may be right.

    Judged by its first frames, except those that cannot be read.
    """
    return _fault(sequence, first_depths(sequence))


def _fault(sequence: FrameSequence, depths: list[np.ndarray]) -> str | None:
    return _fault_of_numbers([image for image in depths if image.dtype == np.uint16]) or fault_of_scale(
        sequence, depths
    )


def _fault_of_numbers(images: Sequence[UInt16[np.ndarray, "h w"]]) -> str | None:
    readings = (
        np.concatenate([image[(image > 0) & (image < NO_READING)] for image in images]) if images else np.empty(0)
    )
    if readings.size < MIN_READINGS:
        return None
    values = np.unique(readings)
    for factor in STRETCHES:
        if len(values) >= DISTINCT and not (values % factor).any():
            return (
                f"every number is a multiple of {factor}: an 8-bit picture of depth, stretched to 16 bits: write depth "
                "itself as 16 bits or floats"
            )
    if values[-1] == RAW_KINECT and np.mean(readings == RAW_KINECT) > MUCH and all(image.all() for image in images):
        return f"{RAW_KINECT} for missing readings: the raw disparity of a Kinect: write its depth in millimetres"
    as_stored, swapped = _mean_step(images), _mean_step([image.byteswap() for image in images])
    if as_stored > SWAPPED * swapped > 0:
        return (
            f"neighbouring pixels differ by {as_stored:.0f}, and by {swapped:.0f} once both bytes of each number are "
            "swapped: written in the wrong byte order: swap them (NumPy's byteswap)"
        )
    return None


def _mean_step(images: Sequence[UInt16[np.ndarray, "h w"]]) -> float:
    """Mean difference of horizontal neighbours that both have a reading; 0 if there are too few."""
    steps = []
    for image in images:
        left, right = image[:, :-1].astype(np.int32), image[:, 1:].astype(np.int32)
        has_both = (np.minimum(left, right) > 0) & (np.maximum(left, right) < NO_READING)
        steps.append(np.abs(left - right)[has_both])
    found = np.concatenate(steps)
    return float(found.mean()) if found.size >= MIN_READINGS else 0.0


def doubt_of_depth(sequence: FrameSequence) -> str | None:
    """Describe what is unusual in the depth of a sequence, besides a `fault_of_depth`; None if nothing is."""
    depths = first_depths(sequence)
    of_scale = None if _fault(sequence, depths) else doubt_of_scale(sequence, depths)
    doubts = (of_scale, doubt_of_limit(sequence, depths), _inverse(sequence))
    return "; ".join(filter(None, doubts)) or None


def doubt_of_limit(sequence: FrameSequence, depths: list[np.ndarray]) -> str | None:
    """Describe a maximum that stands for missing or farther readings, as simulators leave it; None if there is none.

    Args:
        sequence: The sequence.
        depths: Its `first_depths`.
    """
    scale, images = unit_of_file(sequence), [without_invalid(image) for image in depths]
    readings = np.concatenate([image[image > 0] for image in images]) if images else np.empty(0)
    if readings.size < MIN_READINGS:
        return None
    most = float(readings.max())
    nearer = readings[readings < most]
    share = 1.0 - nearer.size / readings.size
    if not nearer.size:
        return f"every reading is {most / scale:.4g} m"
    is_round = most / scale >= ROUND_LIMIT and most % scale == 0
    is_clamp = np.count_nonzero(nearer > CLAMPED * most) < share * readings.size
    if share < MUCH or not (is_round or is_clamp or nearer.max() < GAP * most):
        return None
    return (
        f"{100 * share:.0f} % of the readings are {most / scale:.4g} m, the farthest: if that is a limit, or stands "
        "for a missing reading, write 0"
    )


def _inverse(sequence: FrameSequence) -> str | None:
    """Describe disparity or inverse depth, recognised by flat surfaces; None if it is not.

    On a plane, the inverse of depth is a linear function of the pixel, and depth is not.
    """
    read, straight, opposite = reader_of(sequence), 0, 0
    for at in sorted({round(place) for place in np.linspace(0, len(sequence) - 1, SAMPLED_FOR_PLANES)}):
        try:
            of_numbers, of_inverse = _flat_patches(without_invalid(read(at)).astype(np.float64))
        except FrameError:
            continue
        straight, opposite = straight + of_numbers, opposite + of_inverse
    if straight < PLANES or opposite > MOST_OTHERS * straight:
        return None
    return (
        f"{straight} patches are flat in these numbers, and {opposite} in their inverse; of depth, the inverse is flat "
        "on planes: this looks like disparity or inverse depth, as MiDaS estimates it: write depth"
    )


def _flat_patches(image: Float[np.ndarray, "h w"]) -> tuple[int, int]:
    """Number of patches that are planes in the image's numbers alone, and in their inverse alone."""
    step = max(1, image.shape[1] // WIDTH)
    numbers, found = image[::step, ::step], [0, 0]
    for side in (max(numbers.shape[1] // patches, 4) for patches in PATCHES):
        y, x = (grid.ravel() for grid in np.mgrid[:side, :side])
        base = np.stack([np.ones(side * side), x, y], axis=1)
        rows, columns = (range(0, length - side + 1, side // 2) for length in numbers.shape)
        for top, left in itertools.product(rows, columns):
            patch = numbers[top : top + side, left : left + side].ravel()
            some = patch > 0
            near, far = np.percentile(patch[some], [2, 98]) if some.mean() >= FULL else (1.0, 0.0)
            if far < RECEDING * near:
                continue
            off = [_off_plane(base[some], values) for values in (patch[some], 1 / patch[some])]
            if min(off) < FLAT and max(off) > FLATTER * min(off):
                found[off[1] < off[0]] += 1
    return found[0], found[1]


def _off_plane(base: Float[np.ndarray, "n 3"], values: Shaped[np.ndarray, " n"]) -> float:
    """Deviation of values from their plane, as a share of their standard deviation."""
    plane, *_ = np.linalg.lstsq(base, values, rcond=None)
    return float(np.std(values - base @ plane) / np.std(values))
