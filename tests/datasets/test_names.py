"""Names as cameras and people give them: which number counts the frames, and what is a time."""

from pathlib import Path

import numpy as np
import pytest

from gavo_jax.datasets.clocks import told_stamp
from gavo_jax.datasets.names import Found, by_number, images_among, mask_numbers
from gavo_jax.datasets.names import stamps as read
from gavo_jax.errors import GavoError

STEP = 33.333e-3
TIMES = np.arange(6) * STEP
CLOCK = 1305031102.175304


def stamps(names: list[str], unit: float | None = None) -> list[float] | None:
    """Seconds alone."""
    found = read(names, unit)
    return found and found.seconds


def at(seconds: float, unit: float) -> list[str]:
    return [str(round((seconds + time) / unit)) for time in TIMES]


STAMPS = {
    "seconds": [f"rgb_{CLOCK + time:.6f}" for time in TIMES],
    "milliseconds": at(CLOCK, 1e-3),
    "microseconds": at(CLOCK, 1e-6),
    "nanoseconds": at(CLOCK, 1e-9),
    "milliseconds since switched on": at(123.456, 1e-3),
    "milliseconds of an uneven clock": ["1000", "1028", "1066", "1097", "1133", "1167"],
    "milliseconds with decimals": [f"clip_Color_{1e3 * (CLOCK + time):.8f}" for time in TIMES],
    "milliseconds with decimals since switched on": [f"{1e3 * (123.456 + time):.3f}" for time in TIMES],
    "microseconds since switched on": at(123.456, 1e-6),
    "nanoseconds since switched on": [f"frame-{name}" for name in at(123.456, 1e-9)],
    "nanoseconds since two days": at(2e5, 1e-9),
    "nanoseconds since twenty days": at(1.7e6, 1e-9),
    "from zero": at(0.0, 1e-6),
    "Redwood": [f"{i + 1:07}-{round(1e6 * time):012}" for i, time in enumerate(TIMES)],
    "a day": [f"cam 2024-05-01 12-30-59.{900 + round(1e3 * time):03}" for time in TIMES[:3]],
    "over a minute at once": [f"PXL_20230501_12{time}" for time in ("0059934", "0059967", "0100000", "0100033")],
    "over a minute in digits": [
        f"2023050112{time}" for time in ("0059934000", "0059967333", "0100000667", "0100034000")
    ],
    "milliseconds before a word": [f"{name}_color" for name in at(CLOCK, 1e-3)],
    "seconds before a word": [f"{CLOCK + time:.6f}_color_640x480" for time in TIMES],
    "a day before a word": [f"20240501T123059.{round(1e3 * time):03}-depth" for time in TIMES],
    "microseconds since switched on before a word": [f"{name}_color" for name in at(77.0, 1e-6)],
    "milliseconds after an index": [f"color_{i:05}_{name}" for i, name in enumerate(at(CLOCK, 1e-3), 8)],
    "seconds after an index": [f"{i}_{CLOCK + time:.6f}_v2" for i, time in enumerate(TIMES, 8)],
    "ticks since 1970": at(CLOCK, 1e-7),
    "ticks of Windows": [str(116444736000000000 + int(name)) for name in at(CLOCK, 1e-7)],
    "ticks of .NET": [f"color_{621355968000000000 + int(name)}" for name in at(CLOCK, 1e-7)],
    "microseconds with a zero, after an index": [f"{i}_077{round(1e6 * time):06}" for i, time in enumerate(TIMES)],
    "seconds and nanoseconds": [f"rgb_{int(CLOCK + time)}_{int((CLOCK + time) % 1 * 1e9):09}" for time in TIMES],
    "seconds and microseconds": [f"{int(CLOCK + time)}-{int((CLOCK + time) % 1 * 1e6):06}" for time in TIMES],
    "seconds and microseconds after an index": [
        f"{i}_{int(CLOCK + time)}_{int((CLOCK + time) % 1 * 1e6):06}" for i, time in enumerate(TIMES, 8)
    ],
    "seconds and nanoseconds since switched on": [
        f"{int(7.9 + time)}_{int((7.9 + time) % 1 * 1e9):09}" for time in TIMES
    ],
    "over a minute": ["20240501T123059,900", "20240501T123059,933", "20240501T123059,967", "20240501T123100,000"],
    "time of day": ["12_30_05_900", "12_30_05_934", "12_30_05_967", "12_30_06_000"],
    "time of day before a word": [f"cam1-09:59:59.{part}_rgb" for part in (900, 934, 967)] + ["cam1-10:00:00.000_rgb"],
    "time of day in one number": ["123059900", "123059934", "123059967", "123100000"],
    "a comma before four places": [f"{CLOCK + time:.4f}".replace(".", ",") for time in TIMES],
    "a comma before three, since switched on": [f"rgb_{7.9 + time:.3f}".replace(".", ",") for time in TIMES],
}


@pytest.mark.parametrize("name", STAMPS)
def test_stamps_of_every_unit_have_the_cameras_rate(name):
    found = stamps(STAMPS[name])
    assert found is not None
    np.testing.assert_allclose(np.diff(found), STEP, atol=6e-3 if "uneven" in name else 0.7e-3)


@pytest.mark.parametrize("places", [6, 9])
def test_zeros_that_are_missing_after_the_point_are_filled_in(places):
    """Whole seconds and the rest printed one after the other: 102.008 s is 102.8000000, between 102.7 s and 102.9 s."""
    times = CLOCK + np.arange(40) * STEP
    names = [f"{int(time)}.{round(time % 1 * 10**places)}" for time in times]
    assert len(set(map(len, names))) > 1
    np.testing.assert_allclose(np.array(stamps(names)), times, rtol=0, atol=1e-5)


def test_zeros_that_are_missing_at_the_end_are_not():
    times = np.round(CLOCK + np.arange(40) * STEP, 2)
    np.testing.assert_array_equal(np.array(stamps([str(time) for time in times])), times)


def test_a_number_cut_by_chance_does_not_shift_the_others():
    """Two of them lack a zero at the end; with one after the point their clock would look more even."""
    cut = ["2.19", "2.23", "2.26", "2.3", "2.33", "2.36", "2.4", "2.43"]
    np.testing.assert_array_equal(np.array(stamps(cut)), np.array(cut, float))


def test_a_frame_that_is_missing_changes_no_unit():
    """Two of them made a clip of 0.4 s one of 13 s."""
    found = stamps(["1000", "1033", "1066", "1100", "1133", "1166", "1233", "1266", "1300", "1333", "1400"])
    assert found is not None and found[-1] - found[0] == pytest.approx(0.4)


def test_a_long_gap_changes_no_unit():
    """Catches milliseconds that are taken for frame numbers where recording paused for half a second."""
    found = stamps(["1000", "1033", "1066", "1100", "1133", "1166", "1700", "1733", "1766", "1800", "1834"])
    assert found is not None and found[-1] - found[0] == pytest.approx(0.834)


@pytest.mark.parametrize("stamp", [True, "1.0", None, np.nan, 1e20, [1.0]])
def test_what_is_no_stamp_in_a_json_file_is_refused(stamp):
    with pytest.raises(GavoError, match=r"^f\.json: timestamp: expected seconds, found .*: pass --rate"):
        told_stamp("f.json", stamp)
    assert told_stamp("f.json", 3) == 3 and told_stamp("f.json", -0.5) == -0.5


@pytest.mark.parametrize(
    "names",
    [
        ["0", "1", "2"],
        ["000000", "000040", "000080", "000120"],
        ["1", "40", "55", "200"],
        ["10", "30", "41", "77", "90", "131", "150", "199"],
        [f"shot1.{i}" for i in range(1, 15)],
        *([f"rgb_{i:05}_640x480" for i in some] for some in (range(9, 20), range(0, 400, 40), (3, 4, 9, 10, 12))),
        [f"{i}_{name}" for i, name in zip([3, 2, 5, 4, 1, 6], at(CLOCK, 1e-3), strict=True)],
        [f"{1305031102 + i}_{175 + 33 * i}" for i in range(6)],
        [f"{i}_{5 * i}_color" for i in range(20)],
        ["scan1.0001", "scan1.0002", "scan1.0003"],
        ["20240501_123059_000", "20240501_123059_001"],
        [f"20240101_120000_{5 * i:03}" for i in range(20)],
        [f"20240101_120000_{50 * i:04}" for i in (0, 1, 2, 4, 5, 6)],
        [f"2024-01-01_12-00-00-{100 + 10 * i:03}_color" for i in range(20)],
        [f"{i // 10}_{i:06}" for i in range(30)],
        ["12-30-59.900", "12-30-59.933", "12-31-00.000"],
        [f"00_00_{i // 100:02}_{10 * (i % 100):03}" for i in range(150)],
        ["23_59_59_900", "23_59_59_934", "23_59_59_967", "00_00_00_000"],
        [f"23_59_59_{ms}" for ms in (701, 734, 768, 801, 834, 868, 901, 934, 968)]
        + [f"00_00_00_{ms:03}" for ms in (1, 34, 68, 101, 134, 168, 201, 234, 268)],
        ["20249901123059", "20249901123060"],
        [],
        ["a", "b"],
        [f"9{i:017}" for i in range(4)],
        [f"9{i:030}" for i in range(4)],
    ],
)
def test_what_is_no_stamp_is_not_taken_for_one(names):
    assert stamps(names) is None


@pytest.mark.parametrize("rate", [5, 20, 25, 30])
def test_a_burst_within_one_second_keeps_its_fractions(rate):
    found = stamps([f"20240101_120000_{round(1000 * i / rate):03}" for i in range(5)])
    assert found is not None
    np.testing.assert_allclose(np.diff(found), 1 / rate, atol=2e-3)


def test_a_point_says_that_fractions_are_those():
    found = stamps([f"20240101_120000.{10 * i:03}" for i in range(5)])
    assert found is not None and found[1] - found[0] == pytest.approx(0.01) and found[0] > CLOCK


@pytest.mark.parametrize("step", [5000, 33333, 83334, 200000, 333333])
def test_since_a_device_was_switched_on_microseconds_may_be_of_every_tenth_frame(step):
    """Ticks of 100 ns would give the usual rate, and nothing tells."""
    found = stamps([str(77000000 + step * i) for i in range(8)])
    assert found is not None
    np.testing.assert_allclose(np.diff(found), 1e-6 * step)


@pytest.mark.parametrize("step", [1_300_000, 2_200_000, 7_000_000])
def test_long_numbers_in_slow_steps_are_microseconds(step):
    """Beyond 1 s they counted as frame numbers, or, beyond 2 s, as nanoseconds at hundreds of frames per second."""
    found = stamps([str(110565131966 + step * i + 7919 * i % 1000) for i in range(8)])
    assert found is not None
    np.testing.assert_allclose(np.diff(found), 1e-6 * step, atol=2e-3)
    assert stamps([str(1000000 + step * i) for i in range(8)]) is None


def test_nanoseconds_keep_the_rate_of_fast_cameras():
    found = stamps([str(110565131966 + 8333333 * i) for i in range(8)])
    assert found is not None
    np.testing.assert_allclose(np.diff(found), 1 / 120, atol=1e-5)


def test_stamps_of_windows_count_from_1970():
    for name in ("ticks of Windows", "ticks of .NET"):
        found = stamps(STAMPS[name])
        assert found is not None
        np.testing.assert_allclose(found, CLOCK + TIMES, rtol=0, atol=2e-6)


def test_even_numbers_count_what_the_other_kind_counts():
    even = [f"{50 * i:06}" for i in range(20)]
    assert stamps(even) is None
    np.testing.assert_allclose(stamps(even, 1e-3) or [], np.arange(20) / 20)
    assert stamps([str(i) for i in range(20)], 1e-3) is None and stamps(["50"], 1e-3) is not None


def test_the_form_of_a_name_is_what_its_numbers_leave():
    assert mask_numbers("a_5") == mask_numbers("a_17") != mask_numbers("b_5")
    assert mask_numbers("1305031102175") != mask_numbers("17")
    assert mask_numbers("a_1305031102175") == mask_numbers("a_1305031102209")


def test_a_stray_file_changes_no_unit():
    found = stamps([*STAMPS["microseconds"], "1400000000000000"])
    assert found is not None
    np.testing.assert_allclose(np.diff(found)[:5], STEP, atol=1e-5)


def paths(*names: str) -> list[Path]:
    return [Path("clip") / name for name in names]


@pytest.mark.parametrize(
    ("color", "depth"),
    [
        (paths("9.jpg", "10.jpg"), paths("9.png", "10.png")),
        (paths("rgb_9_640x480.jpg", "rgb_10_640x480.jpg"), paths("depth_9_320x240.png", "depth_10_320x240.png")),
        (paths("9 (1).JPG", "10 (1).JPG"), paths("0009_v2.png", "0010_v2.png")),
        (paths("9-000.jpg", "10-033.jpg"), paths("9-005.png", "10-041.png")),
        (paths("9.jpg", "10.jpg", "cover.jpg"), paths("9.png", "10.png", "legend.png")),
        (paths("rgb_9.png", "rgb_10.png"), paths("depth_9_16bit.png", "depth_10_16bit.png")),
        (paths("9.jpg", "10.jpg"), paths("9_640x480.png", "10_640x480.png")),
        (paths("9_rgb.png", "10_rgb.png"), paths("9_depth_v2.png", "10_depth_v2.png")),
        (paths("cam1_9_8bit.png", "cam1_10_8bit.png"), paths("9.png", "10.png")),
    ],
)
def test_the_number_that_tells_frames_apart_counts(color, depth):
    """One that is the same in all names of a kind was set against the other kind's number of the frame."""
    found = by_number(color, depth)
    assert list(found.color) == list(found.depth) == [9, 10]


@pytest.mark.parametrize(
    ("names", "fault"),
    [
        (("1.jpg", "2.jpg", "1.png"), r"clip/1\.png: has the same number as 1\.jpg"),
        (("rgb_1.png", "seg_1.png"), r"clip/seg_1\.png: has the same number as rgb_1\.png"),
        (("12-30-59.900.png", "12-30-59.933.png", "12-31-00.000.png"), "more than one number"),
    ],
)
def test_names_that_leave_the_order_open_are_refused(names, fault):
    with pytest.raises(GavoError, match=fault):
        by_number(paths(*names), paths("1.png", "2.png"))


def test_numbers_that_no_float_tells_apart_are_none():
    found = by_number(paths(*(f"9{i:017}.png" for i in range(3))), paths(*(f"9{i:017}.png" for i in range(3))))
    assert found[:2] == Found({}, {})[:2] and len(found.others) == 6


@pytest.mark.parametrize(("first", "refused"), [((0, 1), True), ((1, 0), True), ((5, 9), True), ((3, 3), False)])
def test_colour_and_depth_that_count_from_other_numbers_are_refused(first, refused):
    """Without a gap: the same frames under other numbers, or one late by some?"""
    color, depth = (paths(*(f"{start + i:03}.png" for i in range(12))) for start in first)
    for fewer in (0, 1, 2):
        some = color[: 12 - fewer]
        if not refused:
            assert len(by_number(some, depth).color) == 12 - fewer
            continue
        last = first[0] + 11 - fewer
        if last == first[1] + 11:  # they end together
            assert len(by_number(some, depth).color) == len(some)
            continue
        words = rf"colour images are {first[0]} to {last}, depth images {first[1]} to {first[1] + 11}: give"
        with pytest.raises(GavoError, match=words):
            by_number(some, depth)
    assert by_number(color[:9], depth)


@pytest.mark.parametrize(
    ("color", "depth", "refused"),
    [
        (range(1, 21), [n for n in range(20) if n != 7], True),
        ([n for n in range(21) if n != 7], range(1, 22), True),
        (range(0, 100, 5), range(5, 105, 5), True),
        ([n for n in range(1, 21) if n not in (7, 12)], [n for n in range(20) if n not in (7, 12)], False),
        (range(1, 21), [n for n in range(1, 21) if n != 7], False),
    ],
)
def test_a_missing_image_does_not_settle_from_which_number_the_others_count(color, depth, refused):
    """Colour 1 to 20 and depth 0 to 19 were paired off by one where an image was missing."""
    both = (paths(*(f"{n:03}.png" for n in numbers)) for numbers in (color, depth))
    if not refused:
        assert len(by_number(*both).color) == len(color)
        return
    with pytest.raises(
        GavoError, match=rf"colour images are {min(color)} to {max(color)}, depth images {min(depth)} to"
    ):
        by_number(*both)


@pytest.mark.parametrize(
    ("fewer", "refused"), [(30, True), (29, True), (31, True), (20, True), (40, False), (59, False)]
)
def test_twice_as_many_images_of_one_kind_may_be_of_two_rates(fewer, refused):
    """A film's frames beside depth that was taken at half its rate: equal numbers are of other moments."""
    many, few = (paths(*(f"{i:03}.png" for i in range(count))) for count in (60, fewer))
    for color, depth in ((many, few), (few, many)):
        if not refused:
            assert len(by_number(color, depth).color.keys() & by_number(color, depth).depth.keys()) == fewer
            continue
        with pytest.raises(
            GavoError, match=r"colour images are 0 to \d+, depth images 0 to \d+: give those of one frame"
        ):
            by_number(color, depth)


def test_hidden_files_and_others_are_no_images():
    files = paths("._1.png", ".hidden.png", "Thumbs.db", "2.PNG", "1.png")
    assert images_among(files, (".png",)) == paths("1.png", "2.PNG")
