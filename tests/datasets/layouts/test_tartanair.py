"""Trajectories of TartanAir, of either version: the camera they were rendered with, depth in metres, NED poses."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from written_folders import GREYS, METRES, image, packed, tartan_air, tartan_air_2, tartan_poses

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import FrameError
from gavo_jax.datasets.files import Reading
from gavo_jax.datasets.images import read_depth
from gavo_jax.datasets.layouts.tartanair import TartanAir
from gavo_jax.datasets.registry import open_source
from gavo_jax.errors import GavoError, GavoWarning
from gavo_jax.inspection import summary

SIZES = {"left": (640, 480), "lcam_front": (640, 640)}


@pytest.fixture
def clip(tmp_path) -> Path:
    (tmp_path / "P000").mkdir()
    return tmp_path / "P000"


def write(clip: Path, camera: str, size: tuple[int, int] | None = None, first: int = 0, scale: float = 1.0) -> None:
    """Frames at the size they were rendered at."""
    for i in range(2):
        grey, metres = (cv2.resize(pixels, size or SIZES[camera]) for pixels in (GREYS[i], METRES[i]))
        stem = f"{first + i:06}_{camera}"
        depth = (scale * metres).astype(np.float32)
        image(clip / f"image_{camera}/{stem}.png", grey)
        if camera == "left":
            image(clip / f"depth_{camera}/{stem}_depth.npy", depth)
        else:
            image(clip / f"depth_{camera}/{stem}_depth.png", packed(depth))


def opened(clip: Path, reading: Reading | None = None) -> TartanAir:
    sequence = open_source(clip, reading)
    assert isinstance(sequence, TartanAir)
    return sequence


@pytest.mark.parametrize("camera", SIZES)
def test_the_camera_is_the_one_that_it_was_rendered_with(clip, camera):
    write(clip, camera)
    sequence = opened(clip)
    width, height = SIZES[camera]
    found = sequence.camera
    assert (found.fx, found.fy, found.cx, found.cy) == (320, 320, width / 2, height / 2)
    assert (found.width, found.height) == SIZES[camera] and not any(found.distortion)
    expected = cv2.resize(METRES[1], SIZES[camera])
    np.testing.assert_allclose(sequence[1].depth / found.depth_scale, expected, atol=2e-4)
    assert "depth in metres" in summary(sequence) and sequence.ground_truth is None


@pytest.mark.parametrize("camera", SIZES)
def test_depth_is_in_metres_whatever_the_sky_is(clip, camera):
    """Of mostly sky, 10 km away, the median looked like millimetres."""
    write(clip, camera)
    sky = np.full(SIZES[camera][::-1], 10000.0, np.float32)
    sky[-100:] = 20.0
    for file in (clip / f"depth_{camera}").iterdir():
        image(file, sky if file.suffix == ".npy" else packed(sky))
    sequence = opened(clip)
    with pytest.warns(GavoWarning, match="than frames of this source can store: depth beyond 65.5 m is left out"):
        depth = sequence[0].depth / sequence.camera.depth_scale
    assert (depth[-100:] == 20).all() and not depth[:-100].any()


def test_the_second_version_has_ten_frames_per_second_and_of_the_first_nobody_knows(clip):
    tartan_air_2(clip)
    sequence = opened(clip)
    assert sequence.times_guessed == ""
    np.testing.assert_allclose(sequence.timestamps, np.arange(4) / 10)
    for file in clip.iterdir():
        file.rename(file.with_name(file.name.replace("lcam_front", "other")))
    tartan_air(clip)
    assert opened(clip).times_guessed == "names are numbers"


def test_a_part_of_a_trajectory_has_the_poses_of_its_numbers(clip):
    write(clip, "left", first=2)
    tartan_poses(clip, "left")
    truth, whole = opened(clip).ground_truth, np.loadtxt(clip / "pose_left.txt")
    assert truth is not None
    np.testing.assert_allclose(truth.world_T_camera[:, :3, 3], whole[2:, :3], atol=1e-6)
    np.savetxt(clip / "pose_left.txt", whole[2:])
    alone = opened(clip).ground_truth
    assert alone is not None
    np.testing.assert_allclose(alone.world_T_camera, truth.world_T_camera, atol=1e-6)


def test_a_pose_looks_along_the_body_s_first_axis(clip):
    write(clip, "left")
    np.savetxt(clip / "pose_left.txt", [[1, 2, 3, 0, 0, 0, 1], [1, 2, 3, 0, 0, 0, 1]])
    truth = opened(clip).ground_truth
    assert truth is not None
    np.testing.assert_array_equal(truth.world_T_camera[0] @ [0, 0, 5, 1], [6, 2, 3, 1])
    np.testing.assert_array_equal(truth.world_T_camera[0] @ [0, 5, 0, 1], [1, 2, 8, 1])


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("", "contains no trajectory"),
        ("left, then right\n", r"1: expected 7 numbers, found 'left then right'"),
        ("0.0 1 2 3 0 0 0 1\n", r"1: expected 7 numbers, found '0.0 1 2 3 0 0 0 1'"),
        ("1e30 2 3 0 0 0 1\n", r"1: contains an absurdly large value"),
    ],
)
def test_malformed_poses_are_refused(clip, rows, words):
    write(clip, "left")
    (clip / "pose_left.txt").write_text(rows)
    with pytest.raises(GavoError, match=rf"pose_left\.txt: ?{words}"):
        opened(clip)


def test_poses_that_are_none_are_left_out(clip):
    write(clip, "left")
    (clip / "pose_left.txt").write_text("nan 0 0 0 0 0 1\n1 0 0 0 0 0 1\n")
    truth = opened(clip).ground_truth
    assert truth is not None and len(truth) == 1
    (clip / "pose_left.txt").write_text("1 0 0 0 0 0 0\n1 0 0 0 0 0 0\n")
    assert opened(clip).ground_truth is None


def test_images_of_another_size_need_a_camera(clip):
    write(clip, "lcam_front", (320, 320))
    with pytest.raises(GavoError, match="images of 320x320, but it was rendered at 640x480 or 640x640: pass --camera"):
        opened(clip)
    camera = Camera(160.0, 160.0, 159.5, 159.5, 320, 320)
    sequence = opened(clip, Reading(camera=camera))
    assert sequence.camera.fx == 160 and np.median(sequence[0].depth) / sequence.camera.depth_scale > 1


@pytest.mark.parametrize(("kind", "other"), [("depth", "image"), ("image", "depth")])
def test_a_modality_that_was_not_downloaded_is_asked_for(clip, kind, other):
    write(clip, "lcam_front")
    (clip / f"{kind}_lcam_front").rename(clip / "elsewhere")
    with pytest.raises(GavoError, match=rf"{kind}_lcam_front: no such folder beside {other}_lcam_front: download it"):
        opened(clip)


def test_a_stereo_camera_of_ones_own_is_none_of_them(clip):
    write(clip, "left")
    for file in (clip / "depth_left").iterdir():
        file.rename(file.with_name(file.name.replace("_left_depth", "")))
    assert not TartanAir.recognises(clip)


def test_four_channels_are_floats_unless_they_are_a_picture(tmp_path):
    depth = np.array([[0.0, 1.5, 20.25], [1e4, 0.25, np.inf]], np.float32)
    image(tmp_path / "floats.png", packed(depth))
    np.testing.assert_array_equal(read_depth(tmp_path / "floats.png"), depth)
    for alpha in (0, 255):
        picture = np.dstack([np.arange(6, dtype=np.uint8).reshape(2, 3)] * 3 + [np.full((2, 3), alpha, np.uint8)])
        image(tmp_path / "picture.png", picture)
        with pytest.raises(FrameError, match=r"picture\.png: not a depth image.*found 4 channels of 8 bits"):
            read_depth(tmp_path / "picture.png")
