"""Trajectory files, interpolation and association."""

import os
from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from gavo_jax.errors import GavoError, GavoWarning
from gavo_jax.trajectory import (
    Trajectory,
    associate,
    format_tum_row,
    inverse,
    quaternion_from_rotation,
    rotation_from_quaternion,
    write_lines,
)
from gavo_jax.trajectory_rows import segment_comment

GOOD = "1.0 1 2 3 0 0 0 1\n"


def random_trajectory(count: int, seed: int, step: float = 0.01) -> Trajectory:
    rng = np.random.default_rng(seed)
    world_T_camera = np.tile(np.eye(4), (count, 1, 1))
    world_T_camera[:, :3, :3] = Rotation.from_quat(rng.normal(size=(count, 4))).as_matrix()
    world_T_camera[:, :3, 3] = rng.normal(size=(count, 3)) * 3
    return Trajectory(1305031102.175304 + np.arange(count) * step, world_T_camera)


def test_a_comment_that_names_the_quaternion_first_is_refused(tmp_path: Path):
    (tmp_path / "poses.txt").write_text("# timestamp qx qy qz qw tx ty tz\n" + GOOD)
    with pytest.raises(GavoError, match="qw tx ty tz: expected timestamp tx ty tz qx qy qz qw"):
        Trajectory.read_tum(tmp_path / "poses.txt")
    (tmp_path / "poses.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + GOOD)
    assert len(Trajectory.read_tum(tmp_path / "poses.txt")) == 1


def test_a_note_may_name_a_folder_whose_name_is_not_utf_8(tmp_path: Path):
    write_lines(tmp_path / "notes.txt", [os.fsdecode(b"# runs/caf\xe9")])
    assert (tmp_path / "notes.txt").read_bytes() == b"# runs/caf\xe9\n"


quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 1e-3)


@given(quaternion=quaternions)
def test_quaternions_and_rotations_agree_with_scipy(quaternion):
    quaternion = np.array(quaternion)
    rotation = rotation_from_quaternion(quaternion)
    np.testing.assert_allclose(rotation, Rotation.from_quat(quaternion).as_matrix(), atol=1e-12)
    back = quaternion_from_rotation(rotation)
    assert back[3] >= 0
    np.testing.assert_allclose(abs(back @ quaternion) / np.linalg.norm(quaternion), 1, atol=1e-12)
    np.testing.assert_allclose(rotation_from_quaternion(back), rotation, atol=1e-12)


@pytest.mark.parametrize("axis", np.eye(3))
def test_half_turns_have_quaternions(axis):
    rotation = Rotation.from_rotvec(np.pi * axis).as_matrix()
    np.testing.assert_allclose(rotation_from_quaternion(quaternion_from_rotation(rotation)), rotation, atol=1e-12)


@given(
    stamps=st.lists(st.floats(0, 2e9), min_size=1, max_size=5, unique=True),
    quaternion=quaternions,
    translation=st.tuples(*[st.floats(-1e3, 1e3)] * 3),
)
def test_tum_files_read_back_to_the_last_digit(tmp_path_factory, stamps, quaternion, translation):
    world_T_camera = np.eye(4)
    world_T_camera[:3, :3] = rotation_from_quaternion(np.array(quaternion))
    world_T_camera[:3, 3] = translation
    stamps = np.sort(stamps)
    path = tmp_path_factory.mktemp("trajectory") / "t.txt"
    Trajectory(stamps, np.tile(world_T_camera, (len(stamps), 1, 1))).write_tum(path)
    back = Trajectory.read_tum(path)
    np.testing.assert_array_equal(back.timestamps, stamps)
    np.testing.assert_array_equal(back.world_T_camera[:, :3, 3], np.tile(translation, (len(stamps), 1)))
    np.testing.assert_allclose(back.world_T_camera, np.tile(world_T_camera, (len(stamps), 1, 1)), atol=1e-12)


def test_the_row_format():
    assert format_tum_row(1305031102.175304, np.eye(4)) == " ".join(
        ["1305031102.175304", *["0.000000000"] * 6, "1.000000000"]
    )
    moved = np.eye(4)
    moved[:3, 3] = [1 / 3, -1e-7, -0.0]
    row = format_tum_row(1.5, moved).split()
    assert row[:4] == ["1.500000", "0.3333333333333333", "-0.0000001", "0.000000000"][:2] + [
        "-0.000000100",
        "0.000000000",
    ]


def test_evo_reads_our_files(tmp_path):
    trajectory = random_trajectory(20, 0)
    trajectory.write_tum(tmp_path / "tum.txt")
    theirs = file_interface.read_tum_trajectory_file(str(tmp_path / "tum.txt"))
    np.testing.assert_array_equal(theirs.timestamps, trajectory.timestamps)
    np.testing.assert_allclose(theirs.poses_se3, trajectory.world_T_camera, atol=1e-12)
    trajectory.write_kitti(tmp_path / "kitti.txt")
    theirs = file_interface.read_kitti_poses_file(str(tmp_path / "kitti.txt"))
    np.testing.assert_allclose(theirs.poses_se3, trajectory.world_T_camera, atol=1e-15)


def test_rows_are_sorted_comments_skipped_and_quaternions_normalised(tmp_path):
    path = tmp_path / "t.txt"
    path.write_text(
        "# head\n\n2.0 4 5 6 0 0 2 0 # no more\n".replace(" # no more", "") + "1.0,1,2,3,0,0,0,3\n1.0 1 2 3 1 0 0 0\n"
    )
    trajectory = Trajectory.read_tum(path)
    np.testing.assert_array_equal(trajectory.timestamps, [1, 2])
    np.testing.assert_array_equal(trajectory.world_T_camera[0, :3], [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3]])
    np.testing.assert_allclose(trajectory.world_T_camera[1, :3, :3], np.diag([-1, -1, 1]))


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "no rows"),
        ("# only a comment\n", "no rows"),
        (GOOD + "1 2 3\n", ":2: expected 8"),
        (GOOD + "1 2 3 4 5 6 7 8 9\n", ":2: expected 8"),
        (GOOD + "a b c d e f g h\n", ":2: "),
        ("nan nan nan nan nan nan nan nan\n", ":1: "),
        ("2.0 1 2 inf 0 0 0 1\n2.1 1 2 3 0 0 0 nan\n", ":1: no pose in this row or any other"),
        ("2.0 1 2 3 0 0 0 0\n2.1 1 2 3 1e-200 0 0 0\n", ":1: no pose in this row or any other"),
        (GOOD + "2.0 1e300 2 3 0 0 0 1\n", "absurd"),
    ],
)
def test_bad_files_are_refused_with_their_line(tmp_path, text, fault):
    path = tmp_path / "t.txt"
    path.write_text(text)
    with pytest.raises(GavoError) as caught:
        Trajectory.read_tum(path)
    message = str(caught.value)
    assert message.startswith(str(path)) and fault in message and len(message.splitlines()) == 1


NO_POSES = ["nan nan nan 0 0 0 1", "inf inf inf 0 0 0 1", "-1.#IND 0 0 0 0 0 1", "0 0 0 0 0 0 0", "1 2 3 1e-200 0 0 0"]


@pytest.mark.parametrize("none", NO_POSES)
def test_rows_without_a_pose_are_left_out_and_counted(tmp_path, none):
    """As motion capture writes them while it does not see the camera."""
    path = tmp_path / "t.txt"
    lost = f"2.0 {none}\n"
    path.write_text(f"{GOOD}{lost}{segment_comment(1, 2.0, 3.0)}\n3.0 1 2 3 0 0 0 1\n")
    with pytest.warns(GavoWarning, match=r"t\.txt: 1 of 3 rows left out: .*not finite"):
        trajectory = Trajectory.read_tum(path)
    assert trajectory.timestamps[-1] == 3 and len(trajectory) == 2 and trajectory.segments.tolist() == [0, 1]


def test_a_stamp_with_two_places_is_told(tmp_path):
    """As in a log that a second run was appended to; rounding is none."""
    path = tmp_path / "t.txt"
    path.write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n1 0 0 0.0001 0 0 0 1\n2 0 0 7 0 0 0 1\n")
    with pytest.warns(GavoWarning, match=r"t\.txt: 1 of 4 rows left out: an earlier row has their stamp and another"):
        trajectory = Trajectory.read_tum(path)
    assert trajectory.world_T_camera[:, 2, 3].tolist() == [0, 0]


def test_a_segment_of_a_number_that_no_file_has_is_a_comment(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text(f"1 0 0 0 0 0 0 1\n# segment {10**22}\n2 0 0 0 0 0 0 1\n")
    assert Trajectory.read_tum(path).segments.tolist() == [0, 0]


@pytest.mark.parametrize("segments", [[0, 0, 1, 1, 0, 0], [1, 1, 2, 2, 2, 4], [0, 0, 0, 0, 0, 0]])
def test_segments_come_back_by_their_numbers(tmp_path, segments):
    """A stretch that was found in the map goes on with the first segment: read back, it was a third one."""
    one = random_trajectory(6, 0)
    Trajectory(one.timestamps, one.world_T_camera, np.array(segments)).write_tum(tmp_path / "t.txt")
    assert Trajectory.read_tum(tmp_path / "t.txt").segments.tolist() == segments


def test_missing_files_and_folders_are_refused(tmp_path):
    for path in (tmp_path / "none.txt", tmp_path):
        with pytest.raises(GavoError, match=str(path)):
            Trajectory.read_tum(path)
    with pytest.raises(GavoError, match="cannot be written"):
        random_trajectory(2, 0).write_tum(tmp_path / "no" / "t.txt")
    (tmp_path / "folder").mkdir()
    with pytest.raises(GavoError, match="cannot be written"):
        random_trajectory(2, 0).write_kitti(tmp_path / "folder")
    with pytest.raises(GavoError, match="pose 1 of 2 is not a rigid transform"):
        Trajectory(np.arange(2.0), np.stack([np.eye(4), 2 * np.eye(4)])).write_kitti(tmp_path / "kitti.txt")
    assert not (tmp_path / "kitti.txt").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder"]


number = st.one_of(st.floats().map(str), st.integers().map(str), st.text(max_size=5))
line = st.lists(number, min_size=7, max_size=9).map(" ".join)


@pytest.mark.filterwarnings("ignore:.* left out")
@given(
    content=st.one_of(st.binary(max_size=200), st.lists(line, max_size=4).map(lambda rows: "\n".join(rows).encode()))
)
def test_reading_raises_nothing_else(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("trajectory") / "t.txt"
    path.write_bytes(content)
    try:
        trajectory = Trajectory.read_tum(path)
    except GavoError as error:
        assert len(str(error).splitlines()) == 1
    else:
        assert len(trajectory) > 0 and np.isfinite(trajectory.world_T_camera).all()


def test_shapes_that_do_not_match_are_refused():
    with pytest.raises(ValueError, match="shapes"):
        Trajectory(np.zeros(2), np.zeros((3, 4, 4)))


def test_interpolation_agrees_with_scipy():
    trajectory = random_trajectory(30, 1)
    shuffled = np.random.default_rng(0).permutation(30)
    stamps = np.random.default_rng(1).uniform(trajectory.timestamps[0], trajectory.timestamps[-1], 200)
    ours, valid = Trajectory(trajectory.timestamps[shuffled], trajectory.world_T_camera[shuffled]).interpolate(stamps)
    assert valid.all()
    slerp = Slerp(trajectory.timestamps, Rotation.from_matrix(trajectory.world_T_camera[:, :3, :3]))
    np.testing.assert_allclose(ours[:, :3, :3], slerp(stamps).as_matrix(), atol=1e-9)
    for axis in range(3):
        linear = np.interp(stamps, trajectory.timestamps, trajectory.world_T_camera[:, axis, 3])
        np.testing.assert_allclose(ours[:, axis, 3], linear, atol=1e-9)


def test_interpolation_returns_the_samples_and_knows_its_limits():
    trajectory = random_trajectory(4, 2)
    stamps = np.array([0.0, 0.05, 0.3, 0.35])
    trajectory = Trajectory(stamps, trajectory.world_T_camera)
    ours, valid = trajectory.interpolate(np.array([-0.01, 0.0, 0.02, 0.05, 0.1, 0.3, 0.35, 0.36]), max_gap=0.1)
    np.testing.assert_array_equal(valid, [False, True, True, True, False, True, True, False])
    np.testing.assert_allclose(ours[[1, 3, 5, 6]], trajectory.world_T_camera, atol=1e-12)
    assert np.isnan(ours[~valid]).all()
    assert not Trajectory(np.zeros(0), np.zeros((0, 4, 4))).interpolate(stamps)[1].any()


def test_samples_a_tenth_of_a_second_apart_are_bridged_and_unknown_ones_are_not():
    """Of stamps that were rounded, half of the stretches were longer than 0.1 s."""
    stamps = 1305031102 + np.round(np.arange(100) * 0.10004, 4)
    poses = np.tile(np.eye(4), (100, 1, 1))
    asked = np.arange(stamps[0], stamps[-1], 0.033)
    assert Trajectory(stamps, poses).interpolate(asked)[1].all()
    poses[50] = np.nan
    found, valid = Trajectory(stamps, poses).interpolate(asked)
    np.testing.assert_array_equal(valid, np.isfinite(found).all(axis=(1, 2)))
    assert 90 < valid.sum() * 0.033 * 10 < 99


def test_interpolation_at_one_stamp_is_one_pose():
    trajectory = random_trajectory(4, 2)
    stamps = trajectory.timestamps[:1] + 0.001
    poses, valid = trajectory.interpolate(stamps)
    pose, is_valid = trajectory.interpolate(float(stamps[0]))
    assert pose.shape == (4, 4) and is_valid and valid.all()
    np.testing.assert_array_equal(pose, poses[0])
    assert trajectory.interpolate(stamps.reshape(1, 1))[0].shape == (1, 1, 4, 4)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("1.0",), "timestamps: expected numbers of seconds, got '1.0'"),
        ((None,), "timestamps: expected numbers of seconds, got None"),
        (([[1.0], [1.0, 2.0]],), "timestamps: expected numbers of seconds"),
        (([0.0], "1"), "max_gap: expected a number, got '1'"),
        (([0.0], None), "max_gap: expected a number, got None"),
    ],
)
def test_interpolation_at_what_is_no_stamp_is_refused(arguments: tuple, words: str):
    with pytest.raises(GavoError, match=f"^interpolate: {words}"):
        random_trajectory(4, 2).interpolate(*arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        (["a"], [np.eye(4)]),
        ([0.0], [["a"]]),
        ([0.0, 1.0], [[1.0], [1.0, 2.0]]),
        ([0.0], [np.eye(4)], ["first"]),
        (np.array(["2026-01-01"], "datetime64[ns]"), [np.eye(4)]),
        (np.array([1], "timedelta64[ms]"), [np.eye(4)]),
        ([0.0], [np.eye(4)], [0.5]),
    ],
)
def test_what_is_no_number_makes_no_trajectory(arguments: tuple):
    with pytest.raises(GavoError, match="^Trajectory: expected (whole )?numbers: "):
        Trajectory(*arguments)


def test_a_trajectory_does_not_change_with_the_arrays_that_it_was_made_of():
    stamps, poses = np.arange(3.0), np.tile(np.eye(4), (3, 1, 1))
    trajectory = Trajectory(stamps, poses, segments := np.zeros(3, int))
    stamps[:], poses[:], segments[:] = 7.0, np.nan, 7
    assert trajectory.timestamps[2] == 2.0 and np.isfinite(trajectory.world_T_camera).all()
    assert not trajectory.segments.any()


def test_one_place_of_a_trajectory_is_no_trajectory():
    trajectory = random_trajectory(4, 2)
    assert len(trajectory[[1]]) == len(trajectory[1:2]) == 1
    for which in (1, np.int64(1), "1", None):
        with pytest.raises(TypeError, match=r"expected a slice, a mask or a list of indices, .*world_T_camera\[i\]"):
            trajectory[which]
    with pytest.raises(TypeError, match="a slice, a mask"):
        list(trajectory)  # pyright: ignore[reportArgumentType]


def test_interpolation_between_equal_and_opposite_rotations_stays_finite():
    world_T_camera = np.tile(np.eye(4), (3, 1, 1))
    world_T_camera[2, :3, :3] = np.diag([-1.0, -1.0, 1.0])
    ours, valid = Trajectory(np.array([0.0, 0.01, 0.02]), world_T_camera).interpolate(np.array([0.005, 0.015]))
    assert valid.all()
    np.testing.assert_allclose(ours[0], np.eye(4))
    np.testing.assert_allclose(ours[1, :3, :3] @ ours[1, :3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(ours[1, 2, 2], 1)
    np.testing.assert_allclose(ours[1, 0, 0], 0, atol=1e-12)


def greedy_by_sorting_all_pairs(a, b, limit):
    """TUM's rule, literally: sort every candidate pair by its difference and take what is still free."""
    candidates = sorted(
        (abs(x - y), x, y, i, j) for i, x in enumerate(a) for j, y in enumerate(b) if abs(x - y) < limit
    )
    free_a, free_b, pairs = set(range(len(a))), set(range(len(b))), []
    for _, x, _, i, j in candidates:
        if i in free_a and j in free_b:
            free_a.remove(i)
            free_b.remove(j)
            pairs.append((x, i, j))
    return [(i, j) for _, i, j in sorted(pairs)]


stamp_lists = st.lists(st.integers(0, 60), unique=True, max_size=20)


@given(a=stamp_lists, b=stamp_lists, limit=st.integers(1, 70))
def test_association_is_greedy_and_one_to_one(a, b, limit):
    i, j = associate(np.array(a, float), np.array(b, float), limit)
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == greedy_by_sorting_all_pairs(a, b, limit)
    assert len(set(i.tolist())) == len(i) and len(set(j.tolist())) == len(j)


def test_association_takes_the_nearest_first_and_excludes_the_limit():
    i, j = associate(np.array([0.0, 0.015, 5.0]), np.array([0.014, 5.03]), 0.02)
    assert (i.tolist(), j.tolist()) == ([1], [0])
    i, j = associate(np.array([1.0]), np.array([1.5]), 0.5)
    assert len(i) == len(j) == 0


def test_inverse_undoes():
    world_T_camera = random_trajectory(5, 3).world_T_camera
    np.testing.assert_allclose(inverse(world_T_camera) @ world_T_camera, np.tile(np.eye(4), (5, 1, 1)), atol=1e-12)


@pytest.mark.parametrize(
    ("comment", "w_first"),
    [
        ("#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []", True),
        ("# t x y z qw qx qy qz", True),
        ("# converted from (qw qx qy qz): timestamp tx ty tz qx qy qz qw", False),
        ("# qw is last: qx qy qz qw", False),
    ],
)
def test_a_comment_that_ends_with_the_names_of_columns_says_where_w_stands(
    tmp_path: Path, comment: str, w_first: bool
) -> None:
    (tmp_path / "poses.txt").write_text(f"{comment}\n0.0 0 0 0 0 0 0 1\n")
    turned = np.diag([-1.0, -1.0, 1.0]) if w_first else np.eye(3)
    np.testing.assert_allclose(Trajectory.read_tum(tmp_path / "poses.txt").world_T_camera[0, :3, :3], turned)


@pytest.mark.parametrize("heading", ["timestamp,tx,ty,tz,qx,qy,qz,qw", "t x y z qw qx qy qz"])
def test_a_first_row_may_name_the_columns(tmp_path, heading):
    w_first = heading.endswith("qz")
    quaternion = "0.8 0.6 0 0" if w_first else "0.6 0 0 0.8"
    (tmp_path / "t.txt").write_text(f"{heading}\n1.0 1 2 3 {quaternion}\n")
    read = Trajectory.read_tum(tmp_path / "t.txt")
    np.testing.assert_allclose(read.world_T_camera[0, :3, 3], [1, 2, 3])
    np.testing.assert_allclose(
        read.world_T_camera[0, :3, :3], [[1, 0, 0], [0, 0.28, -0.96], [0, 0.96, 0.28]], atol=1e-12
    )


@pytest.mark.parametrize("heading", ["timestamp qx qy qz qw tx ty tz", "time a b c d e f g"])
def test_columns_in_another_order_are_refused(tmp_path, heading):
    (tmp_path / "t.txt").write_text(f"{heading}\n1.0 1 2 3 0 0 0 1\n")
    with pytest.raises(GavoError, match=r"t\.txt: columns .*: expected timestamp tx ty tz qx qy qz qw"):
        Trajectory.read_tum(tmp_path / "t.txt")


def test_segments_below_zero_are_refused():
    """They were lost in a file."""
    with pytest.raises(ValueError, match="numbered from 0, but"):
        Trajectory(np.arange(2.0), np.stack([np.eye(4)] * 2), np.array([0, -1]))
