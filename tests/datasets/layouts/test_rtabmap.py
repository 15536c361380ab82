"""What RTAB-Map exports: images, a camera for each of them, and poses that are its estimate."""

from pathlib import Path

import numpy as np
import pytest
from written_folders import POSES, RTABMAP_STAMPS, rtabmap, rtabmap_camera, rtabmap_export

from gavo_jax.datasets.layouts.rtabmap import RtabMap
from gavo_jax.datasets.registry import open_source
from gavo_jax.errors import GavoError
from gavo_jax.trajectory import Trajectory

ESTIMATE = "an estimate by the program that wrote the images, not the truth; gavo evaluate can compare a run with it"


@pytest.fixture
def clip(tmp_path) -> Path:
    (tmp_path / "lab").mkdir()
    return tmp_path / "lab"


def opened(clip: Path) -> RtabMap:
    sequence = open_source(clip)
    assert isinstance(sequence, RtabMap)
    return sequence


def test_the_camera_is_that_of_the_images_which_are_rectified(clip):
    rtabmap(clip)
    sequence = opened(clip)
    assert sequence.calibration.origin == f"{clip / 'calib'}, the median of 4"
    assert sequence.calibration.color.fx == 131 and not any(sequence.calibration.color.distortion)
    assert sequence.calibration.color.depth_scale == 1000 and sequence.times_guessed == ""


@pytest.mark.parametrize("poses", ["poses.txt", "map_poses.txt", "map_camera_poses.txt", "map_camera_poses_0.txt"])
def test_its_poses_are_no_truth(clip, poses):
    rtabmap(clip, poses=poses)
    sequence = opened(clip)
    assert sequence.ground_truth is None and sequence.left_out == (f"{poses}: {ESTIMATE}",)
    Trajectory(np.array(RTABMAP_STAMPS, float), POSES).write_tum(clip / "groundtruth.txt")
    sequence = opened(clip)
    assert sequence.ground_truth is not None and sequence.left_out == ()


def test_images_may_go_by_ids_and_folders_by_the_map_s_name(clip):
    rtabmap_export(clip)
    (clip / "map.db").write_bytes(b"SQLite")
    sequence = opened(clip)
    assert sequence.times_guessed == "names are numbers"
    assert sequence.left_out == (f"map_camera_poses.txt: {ESTIMATE}",)
    assert sequence.calibration.origin == f"{clip / 'map_calib'}, the median of 4"


def test_nodes_of_one_a_second_keep_their_stamps(clip):
    rtabmap(clip)
    for i, stamp in enumerate(RTABMAP_STAMPS):
        later = f"{float(stamp) + 1.013 * i:.6f}"
        for file in list(clip.glob(f"*/{stamp}.*")):
            file.rename(file.with_name(file.name.replace(stamp, later)))
    assert np.diff(opened(clip).timestamps).min() > 1


def test_one_camera_may_be_that_of_all_images(clip):
    rtabmap(clip)
    for stamp in RTABMAP_STAMPS[1:]:
        (clip / f"calib/{stamp}.yaml").unlink()
    assert opened(clip).calibration.origin == f"{clip / 'calib'}, the median of 1"
    (clip / f"calib/{RTABMAP_STAMPS[0]}.yaml").rename(clip / "calib.yaml")
    (clip / "calib").rmdir()
    sequence = opened(clip)
    assert sequence.calibration.origin.startswith(f"{clip / 'calib.yaml'}, without its lens")
    assert sequence.camera.fx == 131 and not any(sequence.calibration.color.distortion)


def test_a_camera_file_of_ones_own_goes_first(clip):
    rtabmap(clip)
    (clip / "camera.yaml").write_text("fx: 140\nfy: 140\ncx: 79.5\ncy: 59.5\nwidth: 160\nheight: 120\n")
    assert opened(clip).camera.fx == 140


def test_focus_may_move_and_lenses_may_not(clip):
    rtabmap(clip)
    rtabmap_camera(clip / "calib", RTABMAP_STAMPS[0], fx=132.0)
    assert opened(clip).camera.fx == 131
    rtabmap_camera(clip / "calib", RTABMAP_STAMPS[0], fx=140.0)
    with pytest.raises(GavoError, match=r"calib: the frames have different cameras: .* \(fx differs by 9"):
        opened(clip)


def test_images_of_several_cameras_are_refused(clip):
    rtabmap(clip)
    for stamp in RTABMAP_STAMPS:
        for i in range(2):
            rtabmap_camera(clip / "calib", f"{stamp}_{i}")
        (clip / f"calib/{stamp}.yaml").unlink()
    with pytest.raises(GavoError, match=rf"calib/{RTABMAP_STAMPS[0]}_1\.yaml: belongs to a second camera, whose "):
        opened(clip)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"projection_matrix": {"rows": 3, "cols": 4, "data": [1.0]}}, "the rows and columns of a matrix do not match"),
        ({"projection_matrix": 3}, "projection_matrix: must be twelve numbers"),
        ({"camera_matrix": 3}, "Looks like a ROS camera_info|camera_matrix"),
    ],
)
def test_malformed_cameras_are_refused(clip, changed, words):
    rtabmap(clip)
    rtabmap_camera(clip / "calib", RTABMAP_STAMPS[2], **changed)
    with pytest.raises(GavoError, match=rf"{RTABMAP_STAMPS[2]}\.yaml: .*(?:{words})"):
        opened(clip)


def test_a_camera_without_a_projection_is_that_of_its_matrix(clip):
    """As RTAB-Map itself has it."""
    rtabmap(clip)
    for file in (clip / "calib").iterdir():
        text = file.read_text()
        file.write_text(text[: text.index("projection_matrix")])
    assert opened(clip).camera.fx == 140
