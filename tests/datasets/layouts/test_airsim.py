"""Recordings of AirSim: what a row names, which way its PFM run, its stamps, and what it does not say."""

from pathlib import Path

import numpy as np
import pytest
from written_folders import AIRSIM_COLUMNS, AIRSIM_STAMPS, CAMERA, METRES, airsim, pfm_from_top

from gavo_jax.datasets.files import FileSequence, Reading
from gavo_jax.datasets.registry import open_source
from gavo_jax.errors import GavoError, GavoWarning
from gavo_jax.inspection import left_out

POSES = "airsim_rec.txt: its poses are the vehicle's, and the camera's place on it is unknown"


@pytest.fixture
def clip(tmp_path) -> Path:
    (tmp_path / "2022-01-24-04-55-23").mkdir()
    airsim(tmp_path / "2022-01-24-04-55-23")
    return tmp_path / "2022-01-24-04-55-23"


def opened(clip: Path, reading: Reading | None = None) -> FileSequence:
    sequence = open_source(clip, reading)
    assert isinstance(sequence, FileSequence) and sequence.kind == "recording of AirSim"
    sequence.check()
    return sequence


def change(clip: Path, old: str, new: str, count: int = -1) -> None:
    file = clip / "airsim_rec.txt"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, count))


def test_depth_runs_from_the_top_whoever_reads_it(clip):
    """Read as the format says, it would be upside down."""
    sequence = opened(clip)
    np.testing.assert_array_equal(sequence.raw_depth(1), METRES[1].astype(np.float32))
    np.testing.assert_allclose(sequence[1].depth / sequence.camera.depth_scale, METRES[1], atol=1e-3)
    assert sequence.depth_unit.file == 1 and left_out(sequence) == [POSES]


def test_the_sky_leaves_the_unit_alone(clip):
    """What is beyond the far plane is 65504, the most that a float of 16 bits holds."""
    for file in sorted(clip.glob("images/*.pfm")):
        sky = np.full((120, 160), 65504.0, np.float32)
        sky[-20:] = 20.0
        pfm_from_top(file, sky)
    with pytest.warns(GavoWarning, match="than frames of this source can store: depth beyond 65.5 m is left out"):
        depth = opened(clip)[0].depth
    assert (depth[-20:] == 20000).all() and not depth[:-20].any()


def test_stamps_are_milliseconds_unless_a_rate_is_said(clip):
    np.testing.assert_allclose(opened(clip).timestamps, AIRSIM_STAMPS)
    assert not opened(clip).times_guessed
    np.testing.assert_allclose(opened(clip, Reading(rate=10)).timestamps, np.arange(4) / 10)


def test_a_truth_of_ones_own_is_taken(clip):
    rows = [f"{stamp} {i} 0 0 0 0 0 1" for i, stamp in enumerate(AIRSIM_STAMPS)]
    (clip / "groundtruth.txt").write_text("\n".join(rows) + "\n")
    sequence = opened(clip)
    assert sequence.ground_truth is not None and len(sequence.ground_truth) == 4 and left_out(sequence) == []


def test_names_of_older_recordings_have_no_vehicle(clip):
    for file in clip.glob("images/*"):
        file.rename(file.with_name(file.name.replace("SimpleFlight_", "")))
    change(clip, "img_SimpleFlight_", "img_")
    change(clip, "VehicleName\t", "")
    change(clip, "SimpleFlight\t", "")
    assert len(opened(clip)) == 4


def test_a_car_has_more_columns(clip):
    change(clip, "ImageFile", "Throttle\tSteering\tBrake\tGear\tHandbrake\tRPM\tSpeed\tImageFile")
    change(clip, "img_SimpleFlight_0_0_", "0\t0\t0\t1\t0\t0\t0\timg_SimpleFlight_0_0_")
    assert len(opened(clip)) == 4


def test_what_is_not_read_is_told(clip):
    """Another camera, another vehicle, and a moment of which depth was not written."""
    change(
        clip,
        ";img_SimpleFlight_0_5_",
        ";img_SimpleFlight_3_0_1.png;img_SimpleFlight_3_1_1.pfm;img_SimpleFlight_0_5_",
        1,
    )
    change(clip, "SimpleFlight\t1643000650", "Other\t1643000650")
    file = clip / "airsim_rec.txt"
    lines = file.read_text().splitlines()
    lines[3] = lines[3].replace("0_1_", "0_2_")
    file.write_text("\n".join(lines) + "\n")
    assert len(opened(clip)) == 2
    assert left_out(opened(clip)) == [
        "images of SimpleFlight_3: not read, those of SimpleFlight_0 are",
        "1 rows: no colour with depth of SimpleFlight_0",
        "1 rows: not of SimpleFlight",
        POSES,
    ]


def test_a_camera_is_asked_for(clip):
    """Its view is said in settings elsewhere, and may be any."""
    (clip / "camera.toml").unlink()
    with pytest.raises(GavoError, match="no camera file in it: pass --camera.*fx and fy are half the width"):
        opened(clip)
    assert opened(clip, Reading(camera=CAMERA)).camera.fx == 131


@pytest.mark.parametrize(("old", "new"), [(".pfm", ".png"), ("_0_1_", "_0_2_"), ("_0_0_", "_0_7_")])
def test_depth_that_is_none_is_refused(clip, old, new):
    """A picture of depth, depth along rays, or infrared in place of colour."""
    change(clip, old, new)
    with pytest.raises(GavoError, match=r"airsim_rec\.txt: no camera has both colour \(ImageType 0\) and planar depth"):
        opened(clip)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ": expected tab-separated column names first, including TimeStamp and ImageFile"),
        ("TimeStamp,ImageFile\n", ": expected tab-separated column names first"),
        (f"{AIRSIM_COLUMNS}\n", ": contains no rows: nothing was recorded"),
        (f"{AIRSIM_COLUMNS}\na\t1\n", ":2: expected 10 tab-separated values, found 2: remove an incomplete row"),
        ("TimeStamp\tImageFile\nnan\tx.png\n", ":2: TimeStamp: expected milliseconds, found 'nan'"),
        ("TimeStamp\tImageFile\n-1\tx.png\n", ":2: TimeStamp: expected milliseconds, found '-1'"),
        ("TimeStamp\tImageFile\n1\tx.png\n", ": no camera has both colour"),
        (
            "TimeStamp\tImageFile\n" + 2 * "1\timg_0_0_1.png;img_0_1_1.pfm\n",
            r":3: has the same TimeStamp as .*:2: pass --rate",
        ),
        ("TimeStamp\tImageFile\n1\timg_/../../a_0_1.png;img_/../../a_1_1.pfm\n", ": no camera has both colour"),
    ],
)
def test_malformed_recordings_are_refused(clip, text, words):
    (clip / "airsim_rec.txt").write_text(text)
    with pytest.raises(GavoError, match=rf"airsim_rec\.txt{words}"):
        opened(clip)


def test_images_that_are_missing_or_torn_are_named(clip):
    files = sorted(clip.glob("images/*.pfm"))
    files[2].unlink()
    with pytest.raises(GavoError, match=f"{files[2].name}: image is missing"):
        opened(clip)
    files[2].write_bytes(files[1].read_bytes()[:-9])
    with pytest.raises(GavoError, match=files[2].name):
        opened(clip)[2]
