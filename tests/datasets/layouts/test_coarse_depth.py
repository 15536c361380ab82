"""Depth of colour's view at a size of its own, as phones have it: colour is read coarser, and depth is moved to it."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from written_folders import CAMERA, DEPTHS, GREYS, LAYOUTS, METRES, image

from gavo_jax.calibration.estimate import CameraEstimate, Found
from gavo_jax.calibration.file import write_camera_file
from gavo_jax.camera_files.calibration import Calibration, load_calibration
from gavo_jax.cli.calibrate import calibration_of
from gavo_jax.datasets.base import FrameError
from gavo_jax.datasets.files import FileSequence, Reading, open_pair
from gavo_jax.datasets.registry import open_source
from gavo_jax.errors import GavoError

PHONES = ("stray", "scannet_plus_plus", "polycam", "scanner_app", "nerf", "nerfstudio", "rtabmap")


def enlarge(folder: Path, times: int) -> None:
    """Write colour larger, as it was taken, and its cameras with it; depth stays as it is."""
    for file in (file for form in ("rgb/*", "images/*", "frame_*.jpg") for file in folder.glob(form)):
        grey = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        image(file, cv2.resize(grey, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC))
    fx, _, cx, cy = CAMERA.scaled(times)
    numbers = {"131.0": fx, "79.5": cx, "59.5": cy, "160": 160 * times, "120": 120 * times}
    files = ("pose_intrinsic_imu.json", "transforms.json", "cameras/*.json", "frame_*.json", "calib/*.yaml")
    for file in (file for pattern in files for file in folder.glob(pattern)):
        if file.suffix == ".json":
            file.write_text(json.dumps(_replaced(json.loads(file.read_text()), numbers)))
        else:
            text = file.read_text()
            for old, new in {"131.": fx, "7.95e+01": cx, "79.5": cx, "59.5": cy}.items():
                text = text.replace(old, str(float(new)))
            text = text.replace("image_width: 160", f"image_width: {160 * times}")
            file.write_text(text.replace("image_height: 120", f"image_height: {120 * times}"))


def _replaced(values: object, numbers: dict[str, float]) -> object:
    if isinstance(values, dict):
        return {key: _replaced(value, numbers) for key, value in values.items()}
    if isinstance(values, list):
        return [_replaced(value, numbers) for value in values]
    return numbers.get(str(values), values)


def opened(folder: Path, name: str, times: int, reading: Reading | None = None) -> FileSequence:
    folder.mkdir()
    LAYOUTS[name][1](folder)
    enlarge(folder, times)
    sequence = open_source(folder, reading or Reading())
    assert isinstance(sequence, FileSequence)
    return sequence


@pytest.mark.parametrize("name", PHONES)
def test_colour_of_eight_times_the_size_is_read_at_twice_that_of_depth(tmp_path, name):
    sequence = opened(tmp_path / "scan", name, 8)
    camera, twice = sequence.camera, CAMERA.resized(320, 240)
    assert (camera.width, camera.height) == (320, 240)
    np.testing.assert_allclose(camera.matrix, twice.matrix, atol=1e-9)
    frame = sequence[1]
    assert frame.grey.shape == frame.depth.shape == (240, 320)
    expected = cv2.resize(GREYS[1], None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    assert np.abs(frame.grey.astype(int) - expected).mean() < 3
    metres = frame.depth / camera.depth_scale
    seen = METRES[1] > 0
    corners = np.stack([metres[i::2, j::2] for i in (0, 1) for j in (0, 1)])
    assert np.mean(corners[:, seen] > 0) > 0.99
    assert np.median(np.abs(corners - METRES[1])[:, seen]) < 1e-3


def test_colour_that_is_a_little_finer_stays_as_it_is(tmp_path):
    sequence = opened(tmp_path / "scan", "stray", 2)
    assert (sequence.camera.width, sequence.camera.height) == (320, 240)
    np.testing.assert_allclose(sequence.camera.matrix, CAMERA.resized(320, 240).matrix, atol=1e-9)


def test_columns_that_are_left_over_are_cut_off(tmp_path):
    """Colour of 1000 columns, depth of 100: each 5 x 5 pixels are one."""
    color = replace(CAMERA, fx=800.0, fy=800.0, cx=499.5, cy=381.5, width=1001, height=763)
    calibration = Calibration(color, replace(color.resized(100, 76), fx=80.0), np.eye(4))
    assert (color.binned(5).width, color.binned(5).height) == (200, 152)
    file, depth = tmp_path / "a.png", tmp_path / "b.png"
    image(file, np.tile(np.arange(1001) % 251, (763, 1)).astype(np.uint8))
    image(depth, np.full((76, 100), 2000, np.uint16))
    pair = open_pair([(file, depth)], calibration)
    assert pair.camera.cx == pytest.approx(99.5) and pair.camera.fx == 160.0
    frame = pair[0]
    assert frame.grey.shape == (152, 200)
    np.testing.assert_allclose(frame.grey[0, :50], 5 * np.arange(50) + 2)


def test_a_camera_that_is_named_is_that_of_both(tmp_path):
    sequence = opened(tmp_path / "scan", "stray", 8, Reading(camera=replace(CAMERA.resized(1280, 960), fx=1000.0)))
    assert sequence.camera.fx == 250.0
    assert sequence.calibration.depth is not None and sequence.calibration.depth.fx == 125.0


def test_what_is_found_of_frames_is_written_of_the_images(tmp_path):
    sequence = opened(tmp_path / "scan", "stray", 8)
    values = {"fx": 270.0, "fy": 268.0, "cx": 160.0, "cy": 120.0, "readout": 0.01}
    found = {name: Found(value, None, "", "") for name, value in values.items()}
    estimate = CameraEstimate(found, sequence.camera, 0.0, 12)
    calibration = calibration_of(sequence, estimate)
    assert (calibration.color.fx, calibration.color.fy, calibration.color.width) == (1080.0, 1072.0, 1280)
    assert (calibration.color.cx, calibration.color.readout) == (641.5, 0.01)
    write_camera_file(tmp_path / "found.toml", calibration)
    again = load_calibration(tmp_path / "found.toml")
    assert again.depth is not None and again.depth.fx == 135.0
    frames = open_source(tmp_path / "scan", Reading(camera=str(tmp_path / "found.toml"))).camera
    np.testing.assert_allclose([frames.fx, frames.fy, frames.cx, frames.cy], [270.0, 268.0, 160.0, 120.0])


def test_a_plain_folder_says_nothing_of_what_its_depth_shows(tmp_path):
    folder = tmp_path / "scan"
    folder.mkdir()
    LAYOUTS["plain"][1](folder)
    enlarge(folder, 8)
    (folder / "camera.yaml").write_text("fx: 1048\nfy: 1048\ncx: 639.5\ncy: 479.5\nwidth: 1280\nheight: 960\n")
    with pytest.raises((FrameError, GavoError), match="if it differs only in size"):
        open_source(folder)[0]
    assert DEPTHS[0].shape == (120, 160)
