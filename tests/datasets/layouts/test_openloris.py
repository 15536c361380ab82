"""Sequences of OpenLORIS-Scene: lists of other names, the camera among a robot's sensors, poses of its body."""

from pathlib import Path

import numpy as np
import pytest
from written_folders import CAMERA, LASER_T_COLOR, POSES, loris_sensors, loris_transforms, open_loris

from gavo_jax.camera_files.calibration import load_calibration
from gavo_jax.datasets.files import Reading
from gavo_jax.datasets.layouts.openloris import OpenLoris
from gavo_jax.datasets.registry import open_source
from gavo_jax.errors import GavoError


@pytest.fixture
def clip(tmp_path) -> Path:
    (tmp_path / "cafe1-1").mkdir()
    open_loris(tmp_path / "cafe1-1")
    return tmp_path / "cafe1-1"


def opened(clip: Path, reading: Reading | None = None) -> OpenLoris:
    sequence = open_source(clip, reading)
    assert isinstance(sequence, OpenLoris)
    return sequence


def test_registered_depth_is_read_and_that_of_the_depth_camera_is_not(clip):
    sequence = opened(clip)
    assert sequence.left_out == () and sequence.calibration.origin == str(clip / "sensors.yaml")
    assert all(entry.depth and entry.depth.parent.name == "aligned_depth" for entry in sequence.entries)
    assert sequence.calibration.color == load_calibration(clip / "sensors.yaml", depth_scale=1000.0).color
    delay = sequence[1].depth_timestamp
    assert delay is not None and abs(delay - sequence.timestamps[1] - 0.004) < 1e-6


def test_a_camera_file_of_ones_own_goes_first(clip):
    (clip / "camera.yaml").write_text("fx: 140\nfy: 140\ncx: 79.5\ncy: 59.5\nwidth: 160\nheight: 120\n")
    sequence = opened(clip)
    assert sequence.camera.fx == 140 and sequence.camera.depth_scale == 1000
    (clip / "sensors.yaml").unlink()
    assert opened(clip).camera.fx == 140


def test_a_camera_that_is_named_counts_in_millimetres(clip):
    (clip / "sensors.yaml").unlink()
    assert opened(clip, Reading(camera=CAMERA)).camera.depth_scale == 1000
    with pytest.raises(GavoError, match=r"sensors\.yaml: no such file, which describes the camera: restore it, or "):
        opened(clip)


def test_poses_of_the_body_need_to_know_where_the_camera_lies(clip):
    truth = opened(clip).ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth.world_T_camera, POSES, atol=1e-6)
    body = "it belongs to the robot's body"
    unused = f"groundtruth.txt: not used: {body}, and there is no trans_matrix.yaml that leads from "
    for moves in ([("marker", "d400_color_optical_frame", LASER_T_COLOR)], None):
        if moves:
            loris_transforms(clip, moves)
        else:
            (clip / "trans_matrix.yaml").unlink()
        sequence = opened(clip)
        assert sequence.ground_truth is None
        assert sequence.left_out == (f"{unused}base_link to d400_color_optical_frame",)
    (clip / "groundtruth.txt").unlink()
    assert opened(clip).left_out == ()


def test_transforms_in_a_circle_lead_nowhere(clip):
    color = "d400_color_optical_frame"
    loris_transforms(clip, [("laser", color, LASER_T_COLOR), (color, "laser", np.eye(4))])
    assert opened(clip).ground_truth is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("%YAML:1.0\ntrans_matrix: 3\n", "trans_matrix: expected a list of parent_frame"),
        ("%YAML:1.0\ntrans_matrix:\n   - 3\n", r"trans_matrix\[0\]: expected parent_frame, child_frame and matrix"),
        ("%YAML:1.0\nother: 3\n", "trans_matrix: expected a list"),
        ("%YAML:1.0\ntrans_matrix: [", "not readable by OpenCV"),
        ("hello", "not (readable by|transforms of) OpenCV|expected a list"),
    ],
)
def test_malformed_transforms_are_refused(clip, text, words):
    (clip / "trans_matrix.yaml").write_text(text)
    with pytest.raises(GavoError, match=rf"trans_matrix\.yaml: .*(?:{words})|trans_matrix\.yaml: {words}"):
        opened(clip)


@pytest.mark.parametrize("matrix", [2 * np.eye(4), np.eye(3), np.full((4, 4), 0.5)])
def test_a_matrix_that_is_no_transform_is_refused(clip, matrix):
    loris_transforms(clip, [("base_link", "d400_color_optical_frame", matrix)])
    with pytest.raises(GavoError, match=r"trans_matrix\.yaml: trans_matrix\[0\]: (the pose is not|expected a pose of)"):
        opened(clip)


def test_numbers_of_the_sensors_in_another_order_are_refused(clip):
    loris_sensors(clip, "fx fy cx cy")
    with pytest.raises(GavoError, match=r"sensors\.yaml: d400_color_optical_frame: .* does not look like fx cx fy cy"):
        opened(clip)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"model": "omnidirectional"}, "model 'omnidirectional': only pinhole is supported"),
        ({"intrinsics": np.ones((1, 3))}, "Looks like the sensors of OpenLORIS-Scene. Entries are missing"),
        ({"intrinsics": "wide"}, "Looks like the sensors of OpenLORIS-Scene. Entries are missing"),
        ({"width": 3}, "width: must be a whole number"),
        ({"distortion_model": "spherical"}, "model: 'spherical' is not one of"),
    ],
)
def test_malformed_sensors_are_refused(clip, changed, words):
    loris_sensors(clip, **changed)
    with pytest.raises(GavoError, match=rf"sensors\.yaml: .*{words}|sensors\.yaml: {words}"):
        opened(clip)


def test_registered_depth_that_was_not_unpacked_is_asked_for(clip):
    (clip / "aligned_depth.txt").unlink()
    with pytest.raises(GavoError, match=r"aligned_depth\.txt: no such file: unpack it and its images, or create"):
        opened(clip)
