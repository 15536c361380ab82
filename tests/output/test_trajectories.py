import csv
import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from evo.tools import file_interface
from rosbags.highlevel import AnyReader

from gavo_jax.errors import GavoError
from gavo_jax.output.trajectories import (
    FILES,
    POSES,
    formats,
    remove_trajectories,
    write_trajectories,
    write_trajectory,
)
from gavo_jax.se3 import exp
from gavo_jax.trajectory import Trajectory

STAMPS = 1305031102.175304 + np.arange(4) / 30
TRAJECTORY = Trajectory(
    STAMPS,
    np.stack([np.asarray(exp(jnp.array([0.1 * k, 0.2, -0.3, 0.05 * k, 0.4, -0.2])), np.float64) for k in range(4)]),
    np.array([0, 0, 1, 1]),
)


def test_euroc_is_what_we_read_ourselves(tmp_path):
    """Its header says that w goes first; stamps are nanoseconds."""
    write_trajectory(TRAJECTORY, tmp_path / "t.csv", "euroc")
    read = Trajectory.read_tum(tmp_path / "t.csv")
    np.testing.assert_allclose(read.world_T_camera, TRAJECTORY.world_T_camera, atol=1e-8)
    np.testing.assert_allclose(1e-9 * read.timestamps, TRAJECTORY.timestamps, atol=1e-6)


def test_nanoseconds_have_no_digits_that_seconds_since_1970_do_not_hold(tmp_path):
    times = Trajectory(np.array([1305031102.175304, 1305031102.211214]), np.tile(np.eye(4), (2, 1, 1)))
    write_trajectory(times, tmp_path / "t.csv", "euroc")
    rows = [row.split(",")[0] for row in (tmp_path / "t.csv").read_text().splitlines() if row[0].isdigit()]
    assert rows == ["1305031102175304000", "1305031102211214000"]


def test_euroc_is_what_evo_reads(tmp_path):
    write_trajectory(TRAJECTORY, tmp_path / "t.csv", "euroc")
    read = file_interface.read_euroc_csv_trajectory(str(tmp_path / "t.csv"))
    np.testing.assert_allclose(read.timestamps, STAMPS, atol=1e-6)
    np.testing.assert_allclose(np.stack(read.poses_se3), TRAJECTORY.world_T_camera, atol=1e-6)
    with (tmp_path / "t.csv").open() as file:
        rows = list(csv.reader(file))
    assert rows[1][0] == "1305031102175304000"[: len(rows[1][0])] or abs(int(rows[1][0]) - 1305031102175304000) < 1000


def test_kitti_is_what_evo_reads(tmp_path):
    write_trajectory(TRAJECTORY, tmp_path / "t.txt", "kitti")
    read = file_interface.read_kitti_poses_file(str(tmp_path / "t.txt"))
    np.testing.assert_allclose(np.stack(read.poses_se3), TRAJECTORY.world_T_camera, atol=1e-9)


def test_json_holds_every_digit_and_the_segments(tmp_path):
    write_trajectory(TRAJECTORY, tmp_path / "t.json", "json")
    poses = json.loads((tmp_path / "t.json").read_text())["poses"]
    assert [pose["timestamp"] for pose in poses] == STAMPS.tolist()
    np.testing.assert_array_equal([pose["translation"] for pose in poses], TRAJECTORY.world_T_camera[:, :3, 3])
    assert [pose["segment"] for pose in poses] == [0, 0, 1, 1]


def test_formats_that_do_not_show_breaks_are_named(tmp_path, capsys):
    write_trajectories(TRAJECTORY, tmp_path, ["tum", "json", "kitti", "euroc"])
    assert "trajectory.kitti.txt, trajectory.csv: not shown there" in capsys.readouterr().out
    for trajectory, form in ((TRAJECTORY, "json"), (TRAJECTORY[:2], "kitti")):
        write_trajectories(trajectory, tmp_path, [form])
    assert not capsys.readouterr().out


def test_bag_holds_the_poses_and_is_replaced(tmp_path):
    for trajectory in (TRAJECTORY[:2], TRAJECTORY):
        write_trajectory(trajectory, tmp_path / "bag", "bag")
    with AnyReader([tmp_path / "bag"]) as reader:
        messages: list[tuple[int, Any]] = [
            (stamp, reader.deserialize(raw, c.msgtype)) for c, stamp, raw in reader.messages()
        ]
        assert {c.topic for c in reader.connections} == {POSES}
    stamps = [m.header.stamp.sec + m.header.stamp.nanosec * 1e-9 for _, m in messages]
    np.testing.assert_allclose(stamps, STAMPS, atol=1e-6)
    places = [[m.pose.position.x, m.pose.position.y, m.pose.position.z] for _, m in messages]
    np.testing.assert_array_equal(places, TRAJECTORY.world_T_camera[:, :3, 3])
    assert [path.name for path in tmp_path.iterdir()] == ["bag"]


def test_what_cannot_be_written_is_one_line(tmp_path):
    with pytest.raises(GavoError, match="expected a Trajectory, got ndarray"):
        write_trajectory(TRAJECTORY.world_T_camera, tmp_path / "t.txt", "tum")  # pyright: ignore[reportArgumentType]
    with pytest.raises(GavoError, match="not one of tum, kitti, euroc, json, bag"):
        formats("tum,klm")
    (tmp_path / "bag").mkdir()
    with pytest.raises(GavoError, match="is not a bag"):
        write_trajectory(TRAJECTORY, tmp_path / "bag", "bag")
    early = Trajectory(STAMPS - 2e9, TRAJECTORY.world_T_camera)
    with pytest.raises(GavoError, match="stamps from 0"):
        write_trajectory(early, tmp_path / "early", "bag")


def test_an_earlier_runs_files_are_removed(tmp_path):
    assert formats("json,bag,json") == ["json", "bag"]
    for form, name in FILES.items():
        write_trajectory(TRAJECTORY, tmp_path / name, form)
    remove_trajectories(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [FILES["tum"]]


@pytest.mark.parametrize("form", [form for form in FILES if form != "bag"])
@pytest.mark.parametrize(
    ("stamp", "scale", "words"), [(1.0, 2.0, "not a rigid transform"), (np.nan, 1.0, "not a number")]
)
def test_what_is_no_trajectory_is_not_written(tmp_path, form, stamp, scale, words):
    trajectory = Trajectory(np.array([0.0, stamp]), scale * np.stack([np.eye(4)] * 2))
    with pytest.raises(GavoError, match=words):
        write_trajectory(trajectory, tmp_path / "poses", form)
    assert not (tmp_path / "poses").exists()


@pytest.mark.parametrize("form", [None, ["tum"], "xyz"])
def test_an_unknown_format_is_refused(form: Any, tmp_path: Path) -> None:
    with pytest.raises(GavoError, match="trajectory format .*: not one of tum, "):
        write_trajectory(TRAJECTORY, tmp_path / "t", form)
