"""Where bodies are, on disk: written as they are seen, read for maps, gone with the run."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gavo_jax.alignment.result import no_alignment
from gavo_jax.bodies.records import Body
from gavo_jax.errors import GavoError
from gavo_jax.odometry.driver import Step
from gavo_jax.odometry.progress import Progress
from gavo_jax.output.files import ODOMETRY
from gavo_jax.output.masks import MASKS, read_masks, remove_masks, write_masks
from gavo_jax.output.recorded_bodies import RecordedBodies
from gavo_jax.output.run_folder import RunFolder
from gavo_jax.settings import OdometryOptions
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import stamp_name

HEIGHT, WIDTH = 12, 16


def body(number: int, left: int, right: int) -> Body:
    """One that covers some columns of the image."""
    field = -np.ones((HEIGHT, WIDTH), np.float32)
    field[:, left:right] = 1.0
    unknown = np.full(3, np.nan)
    return Body(number, (right - left) / WIDTH, np.zeros(3), unknown, unknown, None, field, (HEIGHT, WIDTH))


def stepped(index: int, *bodies: Body) -> Step:
    found = no_alignment(AlignmentStatus.OK)
    return Step(index, index - 1.0, float(index), found, np.eye(4), 1.0, False, bodies=bodies)


@pytest.mark.parametrize(("number", "kind"), [(2, np.uint8), (300, np.uint16)])
def test_a_pixel_has_the_number_of_its_body(tmp_path: Path, number: int, kind: Any):
    step = stepped(3, body(1, 0, 4), body(number, 10, 12))
    write_masks(tmp_path, step)
    labels = cv2.imread(str(tmp_path / MASKS / "3.000000.png"), cv2.IMREAD_UNCHANGED)
    assert labels is not None and labels.dtype == kind
    np.testing.assert_array_equal(labels[0], [1] * 4 + [0] * 6 + [number] * 2 + [0] * 4)
    np.testing.assert_array_equal(read_masks(tmp_path, 3.0), step.moving)


def test_where_nothing_moves_there_is_no_file(tmp_path: Path):
    write_masks(tmp_path, stepped(1))
    assert not list(tmp_path.iterdir()) and read_masks(tmp_path, 1.0) is None and stepped(1).moving is None


def test_a_link_is_not_followed(tmp_path: Path):
    (tmp_path / "run").mkdir()
    (tmp_path / "others").mkdir()
    (tmp_path / "others" / "1.000000.png").touch()
    (tmp_path / "run" / MASKS).symlink_to(tmp_path / "others")
    with pytest.raises(GavoError, match="a link"):
        write_masks(tmp_path / "run", stepped(1, body(1, 0, 4)))
    remove_masks(tmp_path / "run")
    assert [path.name for path in (tmp_path / "others").iterdir()] == ["1.000000.png"]


@pytest.mark.parametrize("data", [b"", b"nothing", cv2.imencode(".png", np.zeros((4, 4, 3), np.uint8))[1].tobytes()])
def test_a_damaged_image_is_one_line(tmp_path: Path, data: bytes):
    write_masks(tmp_path, stepped(1, body(1, 0, 4)))
    (tmp_path / MASKS / "1.000000.png").write_bytes(data)
    with pytest.raises(GavoError, match=r"1\.000000\.png: not an image of bodies"):
        read_masks(tmp_path, 1.0)


def test_files_of_others_stay(tmp_path: Path):
    write_masks(tmp_path, stepped(1, body(1, 0, 4)))
    (tmp_path / MASKS / "mine.png").touch()
    (tmp_path / MASKS / "mine.png.1-2.partial").touch()
    remove_masks(tmp_path)
    assert sorted(path.name for path in (tmp_path / MASKS).iterdir()) == ["mine.png", "mine.png.1-2.partial"]


def test_what_a_kill_left_half_written_goes_too(tmp_path: Path):
    write_masks(tmp_path, stepped(1, body(1, 0, 4)))
    (tmp_path / MASKS / "1.000000.png.17-4.partial").touch()
    remove_masks(tmp_path)
    assert not (tmp_path / MASKS).exists()


OWN = ("masks/0001.png", "trajectory.csv", "config.json", "metrics.json", "frames.csv", "odometry.txt", "run.rrd")


@pytest.mark.parametrize("name", [*OWN, "loops.csv", "bodies.csv", "trajectory.png"])
def test_a_run_replaces_no_files_that_a_run_did_not_leave(tmp_path: Path, name: str):
    """A dataset's masks, and anybody's frames.csv, were taken for an earlier run's, and removed."""
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("{}")
    with RunFolder(tmp_path) as folder, pytest.raises(GavoError, match="is not from a run"):
        folder.start({"odometry": OdometryOptions()}, 0.0)
    assert (tmp_path / name).read_text() == "{}"
    (tmp_path / "config.json").write_text('{"odometry": {}}')
    with RunFolder(tmp_path) as folder:
        folder.start({"odometry": OdometryOptions()}, 0.0)
    assert not (tmp_path / "masks").exists()


def test_a_run_folder_has_those_of_its_run(tmp_path: Path):
    config = {"odometry": OdometryOptions()}
    with RunFolder(tmp_path) as folder:
        folder.start(config, 0.0)
        folder.add(stepped(1, body(1, 0, 4)))
        folder.add(stepped(2))
        assert folder.moving(stepped(1)) is not None and folder.moving(stepped(2)) is None
    with RunFolder(tmp_path) as folder:
        folder.start(config, 0.0)
    assert not (tmp_path / MASKS).exists()


def test_a_recorded_run_gets_its_bodies_back(tmp_path: Path):
    """`gavo view` showed none, and took them for the scene."""
    seen = replace(body(2, 4, 9), centroid=np.array([1.0, 2.0, 3.0]), displacement=np.array([0.1, 0.0, 0.0]))
    config = {"odometry": OdometryOptions()}
    with RunFolder(tmp_path, trajectory=ODOMETRY) as folder:
        folder.start(config, 0.0)
        folder.add(stepped(1, seen, body(5, 12, 14)))
        folder.add(stepped(2))
    bodies = RecordedBodies(tmp_path)
    corrected = np.eye(4)
    corrected[0, 3] = 10.0
    step = bodies.restore(replace(stepped(1), world_T_camera=corrected))
    assert [found.number for found in step.bodies] == [2, 5] and bodies.restore(stepped(2)).bodies == ()
    again = step.bodies[0]
    np.testing.assert_array_equal(again.mask, seen.mask)
    np.testing.assert_allclose(again.centroid, [11.0, 2.0, 3.0])
    np.testing.assert_allclose(again.displacement, seen.displacement)
    (tmp_path / "bodies.csv").write_text("timestamp\n1.0,2,x\n")
    with pytest.raises(GavoError, match=r"bodies\.csv: not a table of a run's bodies"):
        RecordedBodies(tmp_path)


def test_a_comment_names_the_last_pose_and_not_the_reference(tmp_path: Path):
    """Of a frame that a keyframe was found for it named that: what is known was called unknown."""
    with RunFolder(tmp_path) as folder:
        folder.start({"odometry": OdometryOptions()}, 100.0)
        folder.add(replace(stepped(1), timestamp=101.0))
        folder.add(replace(stepped(2), timestamp=102.0, reference_timestamp=0.0, segment=1))
    assert "from 101.000000 to 102.000000 is unknown" in (tmp_path / "trajectory.txt").read_text()


def test_a_body_goes_with_the_camera_into_another_world():
    turned = np.array([[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    moving = replace(body(1, 0, 4), centroid=np.array([1.0, 0, 0]), displacement=np.array([0.1, 0, 0]))
    after = moving.moved(turned)
    np.testing.assert_allclose(after.centroid, [1.0, 1.0, 0.0])
    np.testing.assert_allclose(after.displacement, [0.0, 0.1, 0.0])
    np.testing.assert_array_equal(after.mask, moving.mask)


def test_what_came_after_a_checkpoint_is_removed(tmp_path: Path):
    """The last frame's own was removed where its stamp had been rounded up."""
    stamps = [index / 30 for index in (2, 3, 4)]
    for stamp in stamps:
        write_masks(tmp_path, replace(stepped(1, body(1, 0, 4)), timestamp=stamp))
    remove_masks(tmp_path, kept={stamp_name(stamps[0])})
    assert [path.name for path in (tmp_path / MASKS).iterdir()] == ["0.066667.png"]


def test_a_run_whose_clock_was_set_back_goes_on_with_its_masks(tmp_path: Path):
    """Those from before the clock was set back were taken for later than the checkpoint, and removed."""
    config = {"odometry": OdometryOptions()}
    with RunFolder(tmp_path) as folder:
        folder.start(config, 1000.0)
        folder.add(replace(stepped(1, body(1, 0, 4)), timestamp=1001.0))
        folder.add(replace(stepped(2, body(1, 0, 4)), timestamp=500.0), Progress(last_index=2))
        folder.save_checkpoint()
        folder.add(replace(stepped(3, body(1, 0, 4)), timestamp=501.0))
    with RunFolder(tmp_path) as folder:
        assert folder.resume(config, {}) is not None
    assert sorted(path.name for path in (tmp_path / MASKS).iterdir()) == ["1001.000000.png", "500.000000.png"]
