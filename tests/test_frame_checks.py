"""What is told of a frame before it is aligned, and what it may still be used for."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame, FrameError, TimestampError
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.rendered.sensor_noise import NONE
from gavo_jax.datasets.rendered.synthetic import DEFAULT_CAMERA, SyntheticSequence
from gavo_jax.frame_checks import MAX_DOUBTS, Finding, History, Use, check_frame, credible_time, seconds_late
from gavo_jax.status import AlignmentStatus as Status

CAMERA = DEFAULT_CAMERA.level(1)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return list(SyntheticSequence(frames=8, camera=CAMERA))


def look(history: History, *frames: Frame) -> tuple[list[Finding], History]:
    findings = []
    for frame in frames:
        finding, history = check_frame(frame, frame.timestamp, CAMERA, history)
        findings.append(finding)
    return findings, history


@pytest.fixture(scope="module")
def seen(frames) -> History:
    """What is remembered after five good frames."""
    findings, history = look(History(), *frames[:5])
    assert findings == [Finding(Status.OK, Use.ALL)] * 5
    return history


def random_image(shape: tuple[int, ...], low: int = 0, high: int = 256) -> np.ndarray:
    return np.random.default_rng(0).integers(low, high, shape).astype(np.uint8)


def half(depth: np.ndarray) -> np.ndarray:
    return np.where(np.arange(depth.shape[0])[:, None] < depth.shape[0] // 2, 0, depth)


def with_nan(grey: np.ndarray) -> np.ndarray:
    values = grey.astype(np.float32)
    values[:8, 3] = np.nan
    return values


GREY = {
    "black": (np.zeros_like, Status.BLANK),
    "black with the sensor's noise": (lambda grey: random_image(grey.shape, 0, 5), Status.BLANK),
    "white": (lambda grey: np.full_like(grey, 255), Status.BLANK),
    "grey": (lambda grey: np.full_like(grey, 128), Status.BLANK),
    "saturated": (lambda grey: np.minimum(grey.astype(int) * 4, 255), Status.BLANK),
    "lower half black": (lambda grey: np.where(half(grey) == 0, grey, 0), Status.BLANK),
    "noise": (lambda grey: random_image(grey.shape), Status.NOISE),
    "a few pixels that are not numbers": (with_nan, Status.NOT_FINITE),
    "another size": (lambda grey: grey[:-1], Status.UNREADABLE),
}


@pytest.mark.parametrize("name", GREY)
def test_a_damaged_image_is_used_for_nothing(frames, seen, name):
    make, status = GREY[name]
    (finding,), _ = look(seen, replace(frames[5], grey=make(frames[5].grey)))
    assert finding == Finding(status, Use.NOTHING)


DEPTH = {
    "none": (np.zeros_like, Status.NO_DEPTH, Use.TARGET),
    "nothing but NaN": (lambda depth: np.full(depth.shape, np.nan, np.float32), Status.NO_DEPTH, Use.TARGET),
    "half": (half, Status.PARTIAL_DEPTH, Use.TARGET),
    "millimetres": (lambda depth: depth // 5, Status.DEPTH_UNITS, Use.NOTHING),
    "tenths of a millimetre": (lambda depth: depth.astype(np.int64) * 10, Status.DEPTH_UNITS, Use.NOTHING),
}


@pytest.mark.parametrize("name", DEPTH)
def test_damaged_depth(frames, seen, name):
    make, status, use = DEPTH[name]
    (finding,), _ = look(seen, replace(frames[5], depth=make(frames[5].depth)))
    assert finding == Finding(status, use)


def test_depth_in_other_units_throughout_is_told_but_used(frames):
    wrong = [replace(frame, depth=frame.depth // 10) for frame in frames]
    findings, _ = look(History(), *wrong)
    assert findings == [Finding(Status.DEPTH_UNITS, Use.ALL)] * len(frames)


@pytest.mark.parametrize(
    ("scale", "metres", "is_told"),
    [
        (1000, 0.25, False),
        (1000, 0.1, True),
        (5000, 0.25, True),
        (1, 0.25, True),
        (1, 25.0, False),
        (5000, 12.0, False),
    ],
)
def test_a_near_scene_is_doubted_only_where_another_unit_would_explain_it(frames, scale, metres, is_told):
    """All frames of a wrist's camera, 0.25 m from what it sees, were `depth_units` though in millimetres."""
    camera = replace(CAMERA, depth_scale=float(scale))
    median = float(np.median(frames[0].depth[frames[0].depth > 0]))
    dtype = np.float32 if scale == 1 else np.uint16
    near = [replace(frame, depth=(frame.depth * (metres * scale / median)).astype(dtype)) for frame in frames[:3]]
    status = Status.DEPTH_UNITS if is_told else Status.OK
    history = History()
    for frame in near:
        finding, history = check_frame(frame, frame.timestamp, camera, history)
        assert finding == Finding(status, Use.ALL)


def test_a_near_body_does_not_change_the_units(frames, seen):
    def behind_a_body(frame: Frame) -> Frame:
        depth = frame.depth.copy()
        depth[:, : depth.shape[1] * 7 // 10] = int(0.3 * CAMERA.depth_scale)
        return replace(frame, depth=depth)

    findings, _ = look(seen, *map(behind_a_body, frames[5:7]), frames[7])
    assert findings == [Finding(Status.OK, Use.ALL)] * 3


def test_a_frozen_image(frames, seen):
    frozen = replace(frames[4], timestamp=frames[5].timestamp, depth=frames[5].depth)
    findings, _ = look(seen, frozen, frames[6])
    assert findings == [Finding(Status.FROZEN, Use.NOTHING), Finding(Status.OK, Use.ALL)]


@pytest.mark.parametrize("stamp", [-1.0, 0.0, float("nan"), float("inf")])
def test_a_stamp_that_is_not_later(frames, seen, stamp):
    bad = replace(frames[5], timestamp=frames[4].timestamp + stamp)
    findings, _ = look(seen, bad, frames[6])
    assert findings == [Finding(Status.BAD_TIMESTAMP, Use.NOTHING), Finding(Status.OK, Use.ALL)]


def test_frames_that_are_not_there(frames, seen):
    stamp = frames[5].timestamp
    for frame, status in (
        (None, Status.UNREADABLE),
        (FrameError("x.png: torn"), Status.UNREADABLE),
        (TimestampError("rgb.txt:3: out of order"), Status.BAD_TIMESTAMP),
        (replace(frames[5], depth_timestamp=float("nan")), Status.BAD_TIMESTAMP),
    ):
        assert check_frame(frame, stamp, CAMERA, seen)[0] == Finding(status, Use.NOTHING)


def test_a_gap_is_told_a_single_missing_frame_is_not(frames, seen):
    interval = frames[1].timestamp - frames[0].timestamp
    for missing, status in ((1, Status.OK), (2, Status.GAP), (100, Status.GAP)):
        later = replace(frames[5], timestamp=frames[4].timestamp + (missing + 1) * interval)
        assert look(seen, later)[0] == [Finding(status, Use.ALL)]


def test_a_gap_is_told_whatever_gaps_there_were_before(frames, seen):
    """Catches an interval that counts as usual because it came once."""
    interval, stamp, statuses = frames[1].timestamp - frames[0].timestamp, frames[4].timestamp, []
    history = seen
    for frame, intervals in zip(frames[:4], (10, 1, 1, 9), strict=True):
        stamp += intervals * interval
        finding, history = check_frame(replace(frame, timestamp=stamp), stamp, CAMERA, history)
        statuses.append(finding.status)
    assert statuses == [Status.GAP, Status.OK, Status.OK, Status.GAP]


CHANGES = {
    "a clock that was set back": (lambda frame: replace(frame, timestamp=frame.timestamp - 50.0), Status.BAD_TIMESTAMP),
    "depth three times nearer": (lambda frame: replace(frame, depth=frame.depth // 3), Status.DEPTH_UNITS),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_lasts_becomes_usual(frames, seen, name):
    change, status = CHANGES[name]
    more = [replace(frame, timestamp=frame.timestamp + 1.0) for frame in frames[:3]]
    findings, _ = look(seen, *map(change, [*frames[5:], *more]))
    doubted, rest = findings[:MAX_DOUBTS], findings[MAX_DOUBTS:]
    assert doubted == [Finding(status, Use.NOTHING)] * MAX_DOUBTS
    assert all(finding.use is Use.ALL for finding in rest)


@pytest.mark.parametrize("first", [0.0, 1e300])
def test_stamps_that_stay_the_same_are_never_usual(frames, first):
    """Every fourth frame with one and the same stamp was good; after a stamp far ahead frames pass again."""
    history, uses = History(), []
    for place, frame in enumerate(frames):
        stamp = first if place == 0 else 0.0 if first == 0.0 else 0.03 * place
        finding, history = check_frame(frame, stamp, CAMERA, history)
        uses.append(finding.use)
    later = len(frames) - 1
    lost = later if first == 0.0 else MAX_DOUBTS
    assert uses == [Use.ALL, *lost * [Use.NOTHING], *(later - lost) * [Use.ALL]]


def test_the_stamp_of_a_first_frame_out_of_order_is_not_the_last_one(frames):
    """The frames after it would be too early."""
    _, history = check_frame(TimestampError("out of order"), frames[0].timestamp + 9, CAMERA, History())
    assert [finding.use for finding in look(history, *frames[1:4])[0]] == [Use.ALL] * 3


@pytest.mark.parametrize("clip", ["fr1_xyz", "fr1_desk", "fr1_rpy"])
def test_no_false_alarms_on_real_clips(data_dir, clip):
    sequence = TumSequence(data_dir / clip)
    history = History()
    for frame in sequence:
        finding, history = check_frame(frame, frame.timestamp, sequence.camera, history)
        assert finding == Finding(Status.OK, Use.ALL)


@pytest.mark.parametrize(
    ("last", "new", "late"),
    [
        (2.0, -1.0, 1.0),  # two frames that changed their stamps
        (3.0, -1.0, 2.0),
        (1.0, -0.3, 0.0),  # the last one came when it should
        (2.0, 1.0, 0.0),  # in order
        (2.0, -2.5, 0.0),  # older than both
        (2.0, float("nan"), 0.0),
    ],
)
def test_a_stamp_out_of_order_tells_of_the_one_before_that_came_late(last: float, new: float, late: float) -> None:
    history = History(timestamp=100.0, intervals=(1.0, 1.1, 0.9, 1.0, last))
    assert seconds_late(100.0 + new, history) == pytest.approx(late)
    assert not seconds_late(100.0 + new, history._replace(intervals=(1.0, last))), "nothing is usual yet"


def test_a_time_that_no_camera_of_this_rate_needs_is_replaced_by_the_usual_one() -> None:
    """A rate that doubles is real; a stamp that nearly repeats the last one is not."""
    usual = History(intervals=(0.1, 0.03, 0.03, 0.03, 0.002))
    assert [credible_time(seconds, usual) for seconds in (0.002, 0.015, 0.03, 0.5)] == [0.03, 0.015, 0.03, 0.5]
    assert credible_time(0.002, History(intervals=(0.03, 0.03))) == 0.002, "nothing is usual yet"
    assert credible_time(1e-9, History()) == 1e-3


def test_a_rate_that_quadruples_is_believed_from_its_second_frame_on() -> None:
    slow = (0.132,) * 5
    told = [credible_time(0.033, History(intervals=(*slow, *fast))) for fast in ((0.033,), (0.033, 0.034))]
    assert told == [0.132, 0.033]
    assert credible_time(0.01, History(intervals=(*slow, 0.01, 0.01))) == 0.132, "a burst"
    assert credible_time(0.033, History(intervals=(*slow, 0.045, 0.033))) == 0.132, "no rate yet"


@pytest.mark.parametrize("size", [(1, 1), (1, 16), (16, 1), (2, 2), (50, 3)])
def test_images_of_a_few_pixels_are_no_fault(size: tuple[int, int]) -> None:
    camera, history = replace(CAMERA, height=size[0], width=size[1]), History()
    for i in range(3):
        grey = (np.add.outer(np.arange(size[0]), np.arange(size[1])) * 9 % 200 + 20 + 7 * i).astype(np.uint8)
        _, history = check_frame(Frame(grey, np.full(size, 5000 + i, np.uint16), i / 30), i / 30, camera, history)


def test_an_image_of_which_half_stands_still_is_told(frames: list[Frame]) -> None:
    def half_of_the_first(frame: Frame) -> Frame:
        grey = frame.grey.copy()
        grey[:, : grey.shape[1] // 2] = frames[0].grey[:, : grey.shape[1] // 2]
        return replace(frame, grey=grey)

    findings, _ = look(History(), frames[0], *map(half_of_the_first, frames[1:4]), *frames[4:6])
    assert [finding.status for finding in findings] == [Status.OK, *[Status.MOVING_BODY] * 3, Status.OK, Status.OK]
    assert all(finding.use is Use.ALL for finding in findings)


@pytest.mark.parametrize("speed", [0.1, 0.3, 3.0])
@pytest.mark.parametrize("level", [0, 2])
def test_nothing_stands_still_in_images_without_noise(speed: float, level: int) -> None:
    """Where they change slowly many a pixel stays as it was, here and there."""
    camera, history = DEFAULT_CAMERA.level(level), History()
    for frame in SyntheticSequence(frames=12, camera=camera, noise=NONE, speed=speed):
        finding, history = check_frame(frame, frame.timestamp, camera, history)
        assert finding.status is Status.OK


@pytest.mark.parametrize("clip", ["fr1_xyz", "fr1_desk", "fr1_rpy"])
def test_no_part_of_a_real_image_stands_still(data_dir: Path, clip: str) -> None:
    sequence = TumSequence(data_dir / clip)
    findings, history = [], History()
    for frame in sequence[:40]:
        finding, history = check_frame(frame, frame.timestamp, sequence.camera, history)
        findings.append(finding.status)
    assert Status.MOVING_BODY not in findings


@pytest.mark.parametrize("size", [(16, 16), (32, 24), (64, 48)])
def test_small_images_are_not_frozen(size: tuple[int, int]) -> None:
    """Of 16x16 pixels one was looked at."""
    width, height = size
    camera = Camera(0.8 * width, 0.8 * width, (width - 1) / 2, (height - 1) / 2, width, height)
    walk = list(SyntheticSequence(frames=12, camera=camera))
    history, statuses = History(), []
    for frame in walk:
        finding, history = check_frame(frame, frame.timestamp, camera, history)
        statuses.append(finding.status)
    assert Status.FROZEN not in statuses


def test_a_slow_camera_without_noise_is_not_frozen_for_ever() -> None:
    """Each frame was compared with the one before it, refused or not: the camera could move on unseen by a hair."""
    y, x = np.mgrid[:240, :400]
    texture = (128 + 60 * np.sin(x / 9) * np.cos(y / 7)).astype(np.float32)
    depth = np.full((240, 320), 10000, np.uint16)
    columns = np.arange(320, dtype=np.float32)
    history, findings = History(), []
    for index in range(200):
        shifted = cv2.remap(texture, *np.meshgrid(columns + 0.04 * index, np.float32(y[:, 0])), cv2.INTER_LINEAR)
        frame = Frame(np.rint(shifted).astype(np.uint8), depth + (index % 7), index / 30)
        finding, history = check_frame(frame, frame.timestamp, CAMERA, history)
        findings.append(finding.status)
    usable = [place for place, status in enumerate(findings) if status is not Status.FROZEN]
    assert len(usable) > 20 and max(np.diff(usable)) < 12


def test_depth_that_is_missing_throughout_is_missing_not_frozen(frames: list[Frame]) -> None:
    empty = [replace(frame, depth=np.zeros_like(frame.depth)) for frame in frames[:3]]
    findings, _ = look(History(), *empty)
    assert [finding.status for finding in findings] == [Status.NO_DEPTH] * 3


def test_a_wall_from_straight_before_it_is_not_frozen_and_depth_that_becomes_one_is(frames: list[Frame]) -> None:
    """Of an exact sensor each such depth image is the last one's, to the digit."""
    flat = [replace(frame, depth=np.full_like(frame.depth, 10000)) for frame in frames]
    findings, _ = look(History(), *flat[:4])
    assert [finding.status for finding in findings] == [Status.OK] * 4
    findings, _ = look(History(), frames[0], *flat[1:4])
    assert [finding.status for finding in findings][2:] == [Status.FROZEN] * 2
