"""The Bonn dataset: its truth is of the markers on the camera."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gavo_jax.datasets.layouts.bonn import markers_T_camera
from gavo_jax.datasets.layouts.tum_writing import write_tum
from gavo_jax.datasets.registry import open_source
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoWarning
from gavo_jax.trajectory import Trajectory, inverse


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """Three frames whose `groundtruth.txt` has the poses of the markers."""
    folder, sequence = tmp_path / "rgbd_bonn_balloon", SyntheticSequence(frames=3)
    write_tum(sequence, folder)
    (folder / "camera.toml").unlink()
    truth = sequence.ground_truth
    file = folder / "groundtruth.txt"
    replace(truth, world_T_camera=truth.world_T_camera @ inverse(markers_T_camera())).write_tum(file)
    rows = [line for line in file.read_text().splitlines() if not line.startswith("#")]
    file.write_text("\n".join(["# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw", *rows]))
    return folder


def steps(truth: Trajectory | None) -> np.ndarray:
    assert truth is not None
    return inverse(truth.world_T_camera[:-1]) @ truth.world_T_camera[1:]


def test_the_truth_of_the_markers_becomes_the_cameras(clip: Path) -> None:
    """Read as it stood, the drift of any run was that of another point, along other axes."""
    source = open_source(clip)
    true = SyntheticSequence(frames=3).ground_truth
    np.testing.assert_allclose(steps(source.ground_truth), steps(true), atol=1e-5)
    assert source.camera.fx == 542.822841


def test_a_camera_file_beside_the_truth_of_the_markers_changes_it_not(clip: Path) -> None:
    """With a camera file in the folder, the poses of the markers counted as those of the camera."""
    (clip / "camera.toml").write_text("fx = 525.0\nfy = 525.0\ncx = 319.5\ncy = 239.5\nwidth = 640\nheight = 480\n")
    with pytest.warns(GavoWarning, match=r"groundtruth\.txt: poses converted from the markers .* rename the folder"):
        source = open_source(clip)
    assert source.camera.fx == 525
    np.testing.assert_allclose(steps(source.ground_truth), steps(SyntheticSequence(frames=3).ground_truth), atol=1e-5)


def test_a_folder_that_was_written_from_the_dataset_reads_back(clip: Path, tmp_path: Path) -> None:
    source, copy = open_source(clip), tmp_path / "copies" / clip.name
    write_tum(source, copy)
    np.testing.assert_allclose(steps(open_source(copy).ground_truth), steps(source.ground_truth), atol=1e-9)


def test_the_markers_lie_a_finger_from_the_camera() -> None:
    moved = markers_T_camera()
    np.testing.assert_allclose(moved[:3, :3] @ moved[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(moved[:3, :3]) > 0 and np.linalg.norm(moved[:3, 3]) < 0.02
