"""Whether a new frame can be trusted before it is aligned, by its own statistics and those of earlier frames.

Each check reads every fourth row, or every seventh pixel of depth, on the host; together they take well under a
millisecond. A failed check gives the frame an `AlignmentStatus` and says what it may still be used for (`Use`).
"""

import enum
import math
import warnings
import zlib
from statistics import median
from typing import NamedTuple

import cv2
import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame, FrameError, TimestampError
from gavo_jax.datasets.depth_unit import PLAUSIBLE, is_unusual
from gavo_jax.errors import GavoWarning
from gavo_jax.status import AlignmentStatus


class Use(enum.Enum):
    """What a frame may be used for."""

    NOTHING = "nothing"
    TARGET = "target"
    """It can be aligned with a reference, but makes a poor one itself."""
    GREY = "grey"
    """Its image can be aligned with a reference; its depth is unusable."""
    ALL = "all"


class Finding(NamedTuple):
    """What is known of a frame before it is aligned."""

    status: AlignmentStatus
    use: Use


class History(NamedTuple):
    """What the checks remember of earlier frames."""

    timestamp: float | None = None
    """Latest stamp, seconds."""
    checksum: int | None = None
    """Checksum of the last readable image."""
    thumbnail: tuple[int, ...] = ()
    """Some pixels of that image."""
    depth_checksum: int | None = None
    """Checksum of the last depth image; `depth_timestamp` is the stamp that came with it."""
    depth_timestamp: float | None = None
    intervals: tuple[float, ...] = ()
    """Intervals between the last frames, seconds."""
    clipped: tuple[float, ...] = ()
    """Shares of black or white pixels of the last good frames."""
    coverages: tuple[float, ...] = ()
    """Shares of pixels with depth of the last frames that had any."""
    ranges: tuple[float, ...] = ()
    """Depth of the last good frame at the `RANGE_QUANTILES`, metres; `range_timestamp` is that frame's stamp."""
    range_timestamp: float = 0.0
    units_known: bool = False
    """Whether some frame's depth was plausible; since then it has changed only as a scene's can."""
    has_relief: bool = False
    """Whether some frame's readings were not all equal."""
    doubts: int = 0
    """Consecutive frames that were refused only for being unlike those before."""


MIN_DEPTH_SHARE = 0.05
"""Share of an image's pixels, or a reference's points, with a reading below which a frame has no usable depth."""
FLAT = 1e-4
"""Readings count as equal if they differ by at most this share of the largest."""
REMEMBERED = 15
"""Number of last frames whose median defines what is usual."""
MAX_DOUBTS = 3
"""Consecutive frames refused for being unlike those before after which what was usual is forgotten."""
MIN_CONTRAST = 3.0
"""Standard deviation below which an image is blank, grey levels."""
BLACK, WHITE = 5, 250
"""Grey levels up to and from which a pixel counts as clipped."""
MAX_CLIPPED = 0.75
"""Share of clipped pixels above which an image is blank or saturated."""
MAX_CLIPPED_JUMP = 0.3
"""Rise of the clipped share above the usual one from which an image is blank: twice what the TUM clips show within half
a second (a lamp, a window)."""
MIN_CORRELATION = 0.7
"""Correlation of neighbouring pixels below which an image is noise. Scenes have 0.93 and more at a width of 160 pixels;
noise has 0, or up to 0.5 once undistortion has interpolated it."""
MIN_COVERAGE_RATIO = 0.7
"""Ratio of depth readings to their usual number below which depth is partial; the TUM clips stay above 0.92."""
RANGE_QUANTILES = (25.0, 50.0, 75.0)
"""Percentiles of depth that are compared. Other units scale all of them; a near body changes the lower ones alone.
Higher ones would often be at the end of the sensor's number range."""
MAX_RANGE_RATIO = 2.5
"""Factor between consecutive frames, at all `RANGE_QUANTILES`, above which depth is in other units; handheld motion
stays within 1.4."""
RANGE_AGE = 0.1
"""Seconds between two frames beyond which the logarithm of `MAX_RANGE_RATIO` grows with the time."""
MAX_DUPLICATE_DIFFERENCE = 2
"""Images that nowhere differ by more grey levels are duplicates; sensor noise alone makes larger differences."""
MIN_FROZEN_PART = 0.2
"""Part of an image is frozen if more than this share of the pixels beside edges, with their surroundings, is exactly
unchanged and as large a share has changed. Half-frozen real images have 0.26 and more, clean clips at most 0.01, or
0.11 if rendered without noise."""
MIN_SEEN = 40
"""Smallest number of pixels beside edges, out of some 1200, for a part to count as frozen."""
MIN_FAR = 0.8
"""Depth in metres that the highest percentile must exceed for the units to count as known. Millimetres misread as
units of 1/5000 m exceed it only beyond 4 m."""
MAX_INTERVAL_RATIO = 2.5
"""An interval longer than this many usual ones is a gap. Recordings often lack a single frame."""
MAX_USUAL_INTERVAL = 1.5
"""Ratio of an interval to the usual one above which it may span two frames."""
MIN_INTERVAL_RATIO, MIN_INTERVAL = 0.4, 1e-3
"""Ratio of an interval to the usual one, and seconds, below which it can't be right: a camera that changes from 15 to
30 images per second halves it."""
BURST_RATIO, EQUAL = 0.2, 0.2
"""Two intervals above this ratio that differ by less than this share are of a new rate: 30 images per second, after 7.5
in the dark."""
MIN_INTERVALS = 3
"""Number of known intervals before one can be unusual."""
LONGEST_INTERVAL = 10.0
"""If the first intervals are all longer than so many seconds, the timestamps are hardly in seconds. Milliseconds at 30
frames a second are 33 apart.
"""
ROW_STEP = 4
THUMBNAIL = 5
"""Smallest side of the thumbnail in pixels, if the image has as many."""
DEPTH_STEP = 7
"""Stride of the depth pixels that are read, row by row. Few widths are multiples of it, so all rows and columns are
sampled. Every fourth row, say, may be one that a spinning sensor leaves out."""


def check_frame(
    frame: Frame | FrameError | None, timestamp: float, camera: Camera, history: History
) -> tuple[Finding, History]:
    """Check whether the next frame can be trusted.

    Args:
        frame: The frame, or why there is none.
        timestamp: Its colour stamp, seconds.
        camera: Gives the image size and the depth units.
        history: What is remembered of earlier frames; `History()` at first.

    Returns:
        The finding, and the updated history.
    """
    late = _check_timestamp(frame, timestamp, history)
    if late.use is Use.NOTHING:
        return _doubt(late, history, timestamp if math.isfinite(timestamp) else None)
    history = _with_timestamp(history, timestamp)
    if not isinstance(frame, Frame) or any(
        np.shape(image) != (camera.height, camera.width) for image in (frame.grey, frame.depth)
    ):
        return _refused(AlignmentStatus.UNREADABLE), history
    grey = np.asarray(frame.grey)[::ROW_STEP]
    repeated, checksum = history.checksum, zlib.crc32(grey.tobytes())
    history = history._replace(checksum=checksum)
    status, clipped = _check_image(grey)
    if status is not AlignmentStatus.OK:
        return _refused(status), history
    rows, columns = _steps(grey)
    thumbnail = grey[::rows, ::columns].astype(int)
    before = np.array(history.thumbnail)
    near = before.size == thumbnail.size and np.abs(thumbnail.ravel() - before).max() <= MAX_DUPLICATE_DIFFERENCE
    if checksum == repeated or near:  # the thumbnail stays, so that small changes add up
        return _refused(AlignmentStatus.FROZEN), history
    history = history._replace(thumbnail=tuple(thumbnail.ravel().tolist()))
    if history.clipped and clipped - median(history.clipped) > MAX_CLIPPED_JUMP:
        return _doubt(_refused(AlignmentStatus.BLANK), history, timestamp)
    part_frozen = before.size == thumbnail.size and _is_part_frozen(grey, thumbnail, before.reshape(thumbnail.shape))
    frozen, history = _is_depth_frozen(frame, history)
    if frozen:
        return Finding(AlignmentStatus.FROZEN, Use.GREY), history
    depth, history = _check_depth(some_of(frame.depth), camera.depth_scale, history)
    if depth.use is Use.NOTHING:
        return _doubt(depth, history, timestamp)
    history = history._replace(clipped=_remember(history.clipped, clipped), doubts=0)
    finding = late if depth.status is AlignmentStatus.OK else depth
    if part_frozen and finding.status is AlignmentStatus.OK:
        finding = Finding(AlignmentStatus.MOVING_BODY, Use.ALL)
    return finding, history


def seconds_late(timestamp: float, history: History) -> float:
    """Seconds by which the last stamp was too late, if a stamp that is too early casts doubt on it, or 0.

    A frame that was stamped late, and two frames with exchanged stamps, look like this.

    Args:
        timestamp: Stamp of the new frame, seconds.
        history: History of the frames before.
    """
    *before, last = (0.0, 0.0) if len(history.intervals) <= MIN_INTERVALS else history.intervals
    early = history.timestamp is not None and history.timestamp - last < timestamp < history.timestamp
    usual = median(before)
    return last - usual if early and last > MAX_USUAL_INTERVAL * usual else 0.0


def credible_time(elapsed: float, history: History) -> float:
    """The time between two frames in seconds, or the usual one if a camera of this rate can't be that fast.

    A rate that has changed shows in two equal intervals; those of a burst are shorter.
    """
    usual = median(history.intervals) if len(history.intervals) > MIN_INTERVALS else MIN_INTERVAL
    before, last = history.intervals[-2:] if len(history.intervals) > 1 else (0.0, 0.0)
    has_changed = min(before, last) > BURST_RATIO * usual and abs(last - before) < EQUAL * last
    is_credible = elapsed >= (BURST_RATIO if has_changed else MIN_INTERVAL_RATIO) * usual
    return elapsed if is_credible else max(usual, MIN_INTERVAL)


def doubt_unit_of_time(index: int, history: History) -> None:
    """Warn, at the fourth frame of a run alone, if its timestamps are hardly in seconds.

    Args:
        index: Index of the frame in the run.
        history: History with that frame.
    """
    intervals = history.intervals
    if index == MIN_INTERVALS == len(intervals) and (least := min(intervals)) > LONGEST_INTERVAL:
        fault = f"timestamps: expected seconds, but the first frames are {least:.0f} s and more apart"
        warnings.warn(f"{fault}: motions are not checked for being too fast", GavoWarning, stacklevel=4)


def check_images(grey: np.ndarray, depth: np.ndarray, depth_scale: float) -> tuple[AlignmentStatus, ...]:
    """Return the faults of an image [H, W] and its depth by themselves, without earlier frames.

    A single scene may be unusually near, which the checks of a run report.
    """
    depths = some_of(depth)
    status, _ = _check_image(np.asarray(grey)[::ROW_STEP])
    if status is AlignmentStatus.NOT_FINITE:
        return (status,)
    found, readings = [status], _readings(depths)
    if readings.size < MIN_DEPTH_SHARE * depths.size:
        found.append(AlignmentStatus.NO_DEPTH)
    elif not PLAUSIBLE[0] < float(np.median(readings[::ROW_STEP])) / depth_scale < PLAUSIBLE[1]:
        found.append(AlignmentStatus.DEPTH_UNITS)
    return tuple(status for status in found if status is not AlignmentStatus.OK)


def _refused(status: AlignmentStatus) -> Finding:
    return Finding(status, Use.NOTHING)


def _doubt(finding: Finding, history: History, timestamp: float | None) -> tuple[Finding, History]:
    """Refuse a frame for being unlike those before; if that goes on, only its stamp and checksum are remembered.

    Then the next frame can pass, and a clock that was set back goes on from here.
    """
    if history.doubts + 1 < MAX_DOUBTS:
        return finding, history._replace(doubts=history.doubts + 1)
    return finding, History(timestamp=timestamp, checksum=history.checksum)


def _check_timestamp(frame: Frame | FrameError | None, timestamp: float, history: History) -> Finding:
    early = history.timestamp is not None and timestamp <= history.timestamp
    if isinstance(frame, TimestampError) or early or not math.isfinite(timestamp):
        return _refused(AlignmentStatus.BAD_TIMESTAMP)
    if isinstance(frame, Frame) and not math.isfinite(frame.depth_timestamp or 0.0):
        return _refused(AlignmentStatus.BAD_TIMESTAMP)
    if history.timestamp is not None and len(history.intervals) >= MIN_INTERVALS:
        if timestamp - history.timestamp > MAX_INTERVAL_RATIO * median(history.intervals):
            return Finding(AlignmentStatus.GAP, Use.ALL)
    return Finding(AlignmentStatus.OK, Use.ALL)


def _with_timestamp(history: History, timestamp: float) -> History:
    if history.timestamp is None:
        return history._replace(timestamp=timestamp)
    intervals = _remember(history.intervals, timestamp - history.timestamp)
    return history._replace(timestamp=timestamp, intervals=intervals)


def _check_image(grey: np.ndarray) -> tuple[AlignmentStatus, float]:
    """Status of an image by itself, and its share of clipped pixels."""
    if not _is_finite(grey).all():
        return AlignmentStatus.NOT_FINITE, 0.0
    clipped = np.count_nonzero((grey <= BLACK) | (grey >= WHITE)) / grey.size
    values = grey.astype(np.float32)
    values -= values.mean()
    variance = float(np.vdot(values, values)) / values.size
    if variance < MIN_CONTRAST**2 or clipped > MAX_CLIPPED:
        return AlignmentStatus.BLANK, clipped
    neighbours = float(np.einsum("ij,ij->", values[:, 1:], values[:, :-1])) / max(values[:, 1:].size, 1)
    if neighbours < MIN_CORRELATION * variance:
        return AlignmentStatus.NOISE, clipped
    return AlignmentStatus.OK, clipped


def _steps(grey: np.ndarray) -> tuple[int, int]:
    """Row and column strides between the pixels of a thumbnail; smaller for small images."""
    height, width = grey.shape
    return max(1, min(ROW_STEP, height // THUMBNAIL)), max(1, min(ROW_STEP**2, width // THUMBNAIL))


def _is_part_frozen(grey: np.ndarray, thumbnail: np.ndarray, before: np.ndarray) -> bool:
    """Whether much of an image, among pixels beside edges, is exactly unchanged while much has changed."""
    rows, step = _steps(grey)
    beside = grey[::rows, min(ROW_STEP // 2, step - 1) :: step]
    columns = beside.shape[1]
    now, was = thumbnail[:, :columns], before[:, :columns]
    seen, change = np.abs(beside - now) > 2 * MAX_DUPLICATE_DIFFERENCE, np.abs(now - was)
    near_change = cv2.dilate((seen & (change > 0)).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    still, moved = np.count_nonzero(seen & ~near_change), np.count_nonzero(seen & (change > MAX_DUPLICATE_DIFFERENCE))
    count = np.count_nonzero(seen)
    return bool(count >= MIN_SEEN and min(still, moved) > MIN_FROZEN_PART * count)


def is_one_number(readings: np.ndarray) -> bool:
    """Whether readings of depth, or of its inverse, are all equal."""
    return bool(np.ptp(readings) <= FLAT * readings.max())


def _is_depth_frozen(frame: Frame, history: History) -> tuple[bool, History]:
    """Whether depth repeats the last frame's, though it claims another timestamp.

    An empty depth image doesn't count, nor does a flat wall that an exact sensor has faced since the first frame.
    """
    some, stamp = some_of(frame.depth), frame.depth_timestamp
    checksum = zlib.crc32(some.tobytes())
    repeated = checksum == history.depth_checksum and (stamp is None or stamp != history.depth_timestamp)
    readings = _readings(some)
    has_relief = history.has_relief or (readings.size > 0 and not is_one_number(readings))
    history = history._replace(depth_checksum=checksum, depth_timestamp=stamp, has_relief=has_relief)
    return repeated and has_relief and readings.size > 0, history


def _check_depth(depth: np.ndarray, depth_scale: float, history: History) -> tuple[Finding, History]:
    """Check the coverage and range of depth against what was usual."""
    readings = _readings(depth)
    coverage = readings.size / depth.size
    if coverage < MIN_DEPTH_SHARE:
        return Finding(AlignmentStatus.NO_DEPTH, Use.TARGET), history
    usual = median(history.coverages) if history.coverages else coverage
    history = history._replace(coverages=_remember(history.coverages, coverage))
    ranges = np.percentile(readings[::ROW_STEP], RANGE_QUANTILES) / depth_scale
    if history.ranges:
        age = (history.timestamp or 0.0) - history.range_timestamp
        changes = np.log(ranges / np.array(history.ranges))
        limit = math.log(MAX_RANGE_RATIO) * max(age / RANGE_AGE, 1.0)
        if np.all(changes > limit) or np.all(changes < -limit):
            return _refused(AlignmentStatus.DEPTH_UNITS), history
    likely = not is_unusual(float(ranges[1]), float(readings.max()) / depth_scale, depth_scale)
    known = history.units_known or (likely and bool(ranges[-1] > MIN_FAR))
    stamp = history.timestamp or 0.0
    history = history._replace(ranges=tuple(ranges.tolist()), range_timestamp=stamp, units_known=known)
    if not (likely or known):
        return Finding(AlignmentStatus.DEPTH_UNITS, Use.ALL), history
    if coverage < MIN_COVERAGE_RATIO * usual:
        return Finding(AlignmentStatus.PARTIAL_DEPTH, Use.TARGET), history
    return Finding(AlignmentStatus.OK, Use.ALL), history


def some_of(depth: np.ndarray) -> np.ndarray:
    """Return a sample of pixels from all over a depth image, flattened."""
    return np.asarray(depth).ravel()[::DEPTH_STEP]


def _readings(depth: np.ndarray) -> np.ndarray:
    return depth[(depth > 0) & _is_finite(depth)]


def _is_finite(image: np.ndarray) -> np.ndarray:
    """`np.isfinite` that skips integers, which it would convert to floats first."""
    return np.isfinite(image) if image.dtype.kind == "f" else np.ones((), bool)


def _remember(values: tuple[float, ...], value: float) -> tuple[float, ...]:
    return (*values, value)[-REMEMBERED:]
