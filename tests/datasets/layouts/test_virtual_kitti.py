"""Drives of Virtual KITTI 2: the camera and the poses of its texts, centimetres, and what lacks or is malformed."""

from pathlib import Path

import numpy as np
import pytest
from written_folders import CAMERA_TOML, METRES, POSES, image, kitti_rows, raw, virtual_kitti

from gavo_jax.datasets.files import FileSequence, Reading
from gavo_jax.datasets.registry import open_source
from gavo_jax.errors import GavoError
from gavo_jax.inspection import left_out

CAMERA_ROW = "131 131 79.5 59.5"


@pytest.fixture
def clip(tmp_path) -> Path:
    """The first scene as it was recorded; other variations lie beside."""
    folder = tmp_path / "Scene01/clone"
    folder.mkdir(parents=True)
    virtual_kitti(folder)
    return folder


def opened(clip: Path, reading: Reading | None = None) -> FileSequence:
    sequence = open_source(clip, reading)
    assert isinstance(sequence, FileSequence) and sequence.kind == "drive of Virtual KITTI 2"
    return sequence


def test_poses_are_turned_round(clip):
    sequence = opened(clip)
    assert sequence.ground_truth is not None and sequence.times_guessed == ""
    np.testing.assert_allclose(sequence.ground_truth.world_T_camera, POSES, atol=1e-6)
    np.testing.assert_allclose(sequence.ground_truth.timestamps, np.arange(4) / 10)


def test_the_sky_is_no_reading(clip):
    depth = raw(METRES[0], 100)
    depth[:20] = 65535
    image(clip / "frames/depth/Camera_0/depth_00000.png", depth)
    assert not opened(clip)[0].depth[:20].any()


def test_a_street_is_no_room_in_another_unit(clip):
    """A street of 15 m has numbers that a room has in millimetres."""
    for i, metres in enumerate(METRES):
        image(clip / f"frames/depth/Camera_0/depth_{i:05}.png", raw(6 * metres, 100))
    frame, camera = opened(clip)[0], opened(clip).camera
    np.testing.assert_allclose(frame.depth / camera.depth_scale, 6 * METRES[0], atol=0.006)


def test_a_gap_is_one_in_time_and_poses_go_by_numbers(clip):
    (clip / "frames/rgb/Camera_0/rgb_00001.jpg").unlink()
    sequence = opened(clip)
    np.testing.assert_allclose(sequence.timestamps, [0, 0.2, 0.3])
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.world_T_camera, POSES[[0, 2, 3]], atol=1e-6)
    assert len(left_out(sequence)) == 1 and "depth" in left_out(sequence)[0]


def test_what_is_said_goes_before(clip):
    np.testing.assert_allclose(opened(clip, Reading(rate=20)).timestamps, np.arange(4) / 20)
    (clip / "camera.toml").write_text(CAMERA_TOML.replace("131", "150"))
    assert opened(clip).camera.fx == 150 and opened(clip).camera.depth_scale == 100


def test_what_is_not_finite_is_left_out(clip):
    rows = ["nan 131 79.5 59.5", *[CAMERA_ROW] * 3]
    kitti_rows(clip, "intrinsic.txt", rows)
    poses = [" ".join(map(str, np.linalg.inv(pose).ravel())) for pose in POSES]
    kitti_rows(clip, "extrinsic.txt", [*poses[:3], poses[3].replace("1.0", "inf")])
    truth = opened(clip).ground_truth
    assert opened(clip).camera.fx == 131 and truth is not None and len(truth) == 3


def test_poses_that_are_not_there_are_no_truth(clip):
    (clip / "extrinsic.txt").unlink()
    assert opened(clip).ground_truth is None


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("intrinsic.txt", "", r"intrinsic\.txt: contains no row for any frame of Camera_0"),
        ("intrinsic.txt", "frame cameraID\n0 1 131 131 79.5 59.5\n", "contains no row for any frame of Camera_0"),
        ("intrinsic.txt", "0 0 131 131 79.5\n", r"intrinsic\.txt:1: expected 4 numbers, found '131 131 79.5'"),
        ("intrinsic.txt", "0 0 131 131 79.5 a\n", r":1: expected 4 numbers, found '131 131 79.5 a'"),
        ("intrinsic.txt", "0 0 nan nan nan nan\n", "contains no camera for any frame: pass --camera"),
        ("intrinsic.txt", "0 0 131 131 79.5 59.5\n1 0 231 231 79.5 59.5\n", "the frames have different cameras"),
        ("intrinsic.txt", "0\n", r":1: expected the numbers of a frame and a camera first, found '0'"),
        ("extrinsic.txt", 5000 * "1" + " 0 1 0 0 0\n", r":1: expected the numbers of a frame and a camera first"),
        ("extrinsic.txt", "a b 1 0 0 0\n", r":1: expected the numbers of a frame and a camera first"),
        (
            "extrinsic.txt",
            "0 0 1 0 0 0 0 1 0 0 0 0 1 0\n",
            r":1: expected a pose of four rows of four numbers",
        ),
        ("extrinsic.txt", "0 0 2 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n", r":1: the pose is not a rotation and translation"),
        ("extrinsic.txt", 2 * "0 0 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n", r":2: frame 0 appears twice"),
        (
            "extrinsic.txt",
            "frame cameraID\n",
            r"extrinsic\.txt: contains no row for any frame of Camera_0",
        ),
    ],
)
def test_malformed_texts_are_refused(clip, name, text, words):
    (clip / name).write_text(text)
    with pytest.raises(GavoError, match=words):
        opened(clip)


@pytest.mark.parametrize(("lacking", "other"), [("rgb", "depth"), ("depth", "rgb")])
def test_images_that_were_not_unpacked_are_asked_for(clip, lacking, other):
    (clip / f"frames/{lacking}").rename(clip / "elsewhere")
    with pytest.raises(GavoError, match=f"no such folder beside that of {other}: unpack {lacking}, too"):
        opened(clip)


def test_texts_that_were_not_unpacked_are_asked_for(clip):
    (clip / "intrinsic.txt").unlink()
    with pytest.raises(GavoError, match=r"intrinsic\.txt: no such file: it is in .*textgt.*; or pass --camera"):
        opened(clip)
