"""The true trajectory that lies beside the frames, in every form that a dataset has it."""

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from written_folders import CAMERA, DEPTHS, GREYS, LAYOUTS, METRES, POSES, STRAY_STAMPS, image, raw

from gavo_jax.camera import Camera
from gavo_jax.datasets.files import Reading
from gavo_jax.datasets.registry import open_source
from gavo_jax.datasets.truth import MIRROR
from gavo_jax.errors import GavoError
from gavo_jax.inspection import left_out
from gavo_jax.trajectory import Trajectory

STAMPS = np.arange(4) / 30


def log(poses: np.ndarray, numbers: Iterable[int]) -> str:
    """Redwood's form; `numbers` are the third ones, which count from 1."""
    blocks = []
    for number, pose in zip(numbers, poses, strict=True):
        rows = "\n".join(" ".join(f"{value:.10f}" for value in row) for row in pose)
        blocks.append(f"{number - 1}\t{number - 1}\t{number}\n{rows}\n")
    return "".join(blocks)


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "clip").mkdir()
    LAYOUTS["open3d"][1](tmp_path / "clip")
    return tmp_path / "clip"


def truth_of(folder: Path, **reading: object) -> Trajectory:
    sequence = open_source(folder, Reading(**reading))  # pyright: ignore[reportArgumentType]
    assert sequence.ground_truth is not None
    return sequence.ground_truth


def renumber(folder: Path, first: int) -> None:
    for part in ("color", "depth"):
        files = sorted((folder / part).iterdir())
        for number, file in enumerate(files, first):
            file.rename(file.with_name(f"new{number:05}{file.suffix}"))


@pytest.mark.parametrize("first", [0, 1, 7])
def test_a_log_counts_from_one_whatever_the_images_do(folder, first):
    """Redwood's images are numbered from 1, Open3D's from 0; of a piece of a longer recording the log is one, too."""
    renumber(folder, first)
    (folder / "trajectory.log").write_text(log(POSES, range(1, 5)))
    for rate in (30.0, 7.0):
        truth = truth_of(folder, rate=rate)
        np.testing.assert_array_equal(truth.timestamps, (first + np.arange(4)) / rate)
        np.testing.assert_allclose(truth.world_T_camera, POSES, atol=1e-8)


@pytest.mark.parametrize(("first", "numbers"), [(0, [2, 4]), (1, [2, 4]), (100, [102, 104]), (101, [102, 104])])
def test_a_log_of_some_frames_says_which(folder, first, numbers):
    renumber(folder, first)
    (folder / "trajectory.log").write_text(log(POSES[[1, 3]], numbers))
    expected = np.array(numbers) - (first % 2 == 0)
    np.testing.assert_allclose(truth_of(folder).timestamps, expected / 30)


def test_a_log_counts_the_depth_images_where_names_are_stamps(tmp_path):
    """As Redwood has it: fewer colour images, and a number before the microseconds."""
    stamps = np.array([0.0, 0.033333, 0.066666, 0.099999])
    for i, stamp in enumerate(stamps):
        image(tmp_path / f"depth/{i + 1:07}-{round(1e6 * stamp):012}.png", raw(METRES[i], 1000))
        if i != 1:
            image(tmp_path / f"image/{i:07}-{round(1e6 * (stamp + 0.004)):012}.jpg", GREYS[i])
    (tmp_path / "trajectory.log").write_text(log(POSES, range(1, 5)))
    truth = truth_of(tmp_path, camera=CAMERA)
    np.testing.assert_allclose(truth.timestamps, stamps + [0.004, 0, 0.004, 0.004], atol=1e-9)
    np.testing.assert_allclose(truth.world_T_camera, POSES, atol=1e-8)


def test_frames_of_a_log_that_were_lost_have_no_pose(folder):
    poses = POSES.copy()
    poses[2] = np.nan
    (folder / "trajectory.log").write_text(log(poses, range(1, 5)))
    np.testing.assert_allclose(truth_of(folder).timestamps, (1 + np.array([0, 1, 3])) / 30)


def named_by_stamps(folder: Path, names: list[str]) -> None:
    """Four frames of these names, and their camera."""
    (folder / "intrinsics.txt").write_text("131 131 79.5 59.5\n")
    for part, pixels in (("rgb", GREYS), ("depth", DEPTHS)):
        for name, one in zip(names, pixels, strict=True):
            image(folder / f"{part}/{name}.png", one)


def listed(folder: Path, stamps: dict[str, str]) -> None:
    """TUM's lists of images, by their names."""
    for part in ("rgb", "depth"):
        rows = [f"{stamp} {part}/{name}.png" for name, stamp in stamps.items()]
        (folder / f"{part}.txt").write_text("\n".join(rows) + "\n")


@pytest.mark.parametrize("unit", [1, 1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("layout", ["plain", "tum"])
def test_the_stamps_of_a_truth_may_count_what_a_clock_does(tmp_path, layout, unit):
    """As of a recording that was taken apart: images named by nanoseconds, poses written as they come."""
    nanoseconds = [1305031102175304000 + 33333333 * i for i in range(4)]
    named_by_stamps(tmp_path, [str(stamp) for stamp in nanoseconds])
    if layout == "tum":
        listed(tmp_path, {f"{stamp}": f"{stamp / 1e9:.6f}" for stamp in nanoseconds})
    rows = [f"{stamp * 1e-9 / unit:.6f} 0 0 0 0 0 0 1" for stamp in nanoseconds]
    (tmp_path / "groundtruth.txt").write_text("\n".join(rows) + "\n")
    sequence = open_source(tmp_path)
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.timestamps, sequence.timestamps, rtol=0, atol=2e-6)


@pytest.mark.parametrize("unit", [1e-3, 1e-6, 1e-9])
def test_truth_in_the_unit_of_stamps_that_are_names_has_their_times(folder, unit):
    first, step = round(1305031102.175 / unit), round(0.033 / unit)
    for part in ("color", "depth"):
        for i, file in enumerate(sorted((folder / part).iterdir())):
            file.rename(file.with_name(f"{first + i * step}{file.suffix}"))
    rows = (f"{first + i * step // 3} 0 0 0 0 0 0 1\n" for i in range(10))
    (folder / "groundtruth.txt").write_text("".join(rows))
    np.testing.assert_allclose(truth_of(folder).timestamps[::3], open_source(folder).timestamps, atol=1e-6)


@pytest.mark.parametrize("kind", ["microseconds", "nanoseconds", "milliseconds with decimals"])
@pytest.mark.parametrize("layout", ["plain", "tum"])
@pytest.mark.parametrize("minutes", [0.1, 20, 60])
def test_a_truth_counts_what_its_images_do_since_a_device_was_switched_on(tmp_path, layout, kind, minutes):
    """A number of 16 to 68 minutes in micro- or nanoseconds could be one of seconds since 1970, too."""
    times = [60 * minutes + 0.0333 * i for i in range(4)]
    unit, digits = {"microseconds": (1e-6, 0), "nanoseconds": (1e-9, 0)}.get(kind, (1e-3, 3))
    stamps = [f"{time / unit:.{digits}f}" for time in times]
    named_by_stamps(tmp_path, stamps)
    if layout == "tum":
        listed(tmp_path, dict(zip(stamps, stamps, strict=True)))
    rows = [f"{time / unit:.{digits}f} 0 0 0 0 0 0 1" for time in np.arange(times[0], times[-1] + 0.01, 0.01)]
    (tmp_path / "groundtruth.txt").write_text("\n".join(rows) + "\n")
    sequence = open_source(tmp_path)
    np.testing.assert_allclose(sequence.timestamps, times, rtol=0, atol=2e-6)
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.timestamps[[0, -1]], times[::3], rtol=0, atol=0.01)


def icl(folder: Path, name: str = "livingRoom2.gt.freiburg", first: int = 2) -> None:
    """ICL-NUIM's: frames and poses by number, the first without a pose; its world's and its cameras' y points up."""
    rows = []
    for i, (grey, depth) in enumerate(zip(GREYS, DEPTHS, strict=True), 1):
        image(folder / f"rgb/{i}.png", grey)
        image(folder / f"depth/{i}.png", depth)
        rows.append(f"{i} depth/{i}.png {i} rgb/{i}.png\n")
    (folder / "associations.txt").write_text("".join(rows))
    up = Trajectory(np.arange(first, 5), (MIRROR @ POSES @ MIRROR)[first - 1 :])
    up.write_tum(folder / name)
    (folder / name).write_text("\n".join((folder / name).read_text().splitlines()[1:]) + "\n\n")


@pytest.mark.parametrize("layout", ["associations", "folders"])
@pytest.mark.parametrize("rate", [None, 5.0])
def test_the_trajectories_of_icl_are_mirrored(tmp_path, layout, rate):
    icl(tmp_path)
    if layout == "folders":
        (tmp_path / "associations.txt").unlink()
    truth = truth_of(tmp_path, camera=CAMERA, rate=rate)
    np.testing.assert_allclose(truth.timestamps, np.arange(2, 5) / (rate or 30))
    np.testing.assert_allclose(truth.world_T_camera, POSES[1:], atol=1e-8)


@pytest.mark.parametrize("folder", ["any", "traj0_frei_png", "living_room_traj2_frei_png"])
def test_the_trajectory_or_the_name_says_that_the_camera_is_icl(tmp_path, folder):
    for i in range(2):
        image(tmp_path / folder / f"rgb/{i}.png", np.zeros((480, 640), np.uint8))
        image(tmp_path / folder / f"depth/{i}.png", np.full((480, 640), 9000, np.uint16))
    if folder == "any":
        (tmp_path / folder / "traj0.gt.freiburg").write_text("1 0 0 0 0 0 0 1\n")
    assert open_source(tmp_path / folder).camera == Camera.preset("icl")


def test_the_numbers_of_frames_are_the_times_of_frames_to_the_last_bit(folder):
    """Else a pose lies beside its frame, and at a low rate no other is near enough."""
    for i in range(1, 5):
        (folder / f"depth/{i:06}.png").rename(folder / f"depth/{i + 2:06}.png")
        (folder / f"color/{i:06}.jpg").rename(folder / f"color/{i + 2:06}.jpg")
    rows = [f"{i} 0 0 {i} 0 0 0 1\n" for i in range(10)]
    (folder / "groundtruth.txt").write_text("".join(rows))
    for rate in (3.0, 7.0, 0.3):
        sequence = open_source(folder, Reading(rate=rate))
        assert sequence.ground_truth is not None
        assert sequence.ground_truth.interpolate(sequence.timestamps)[1].all()


FAULTS = {
    "empty log": ("trajectory.log", "", "contains no trajectory"),
    "log of prose": ("trajectory.log", "this is no log\n", "trajectory.log:1: expected three whole numbers"),
    "a log of two numbers": ("trajectory.log", "0 1\n", "trajectory.log:1: expected three whole numbers"),
    "torn log": ("trajectory.log", log(POSES, range(1, 5))[:-90], "trajectory.log:16: expected four rows"),
    "log of short rows": (
        "trajectory.log",
        log(POSES, range(1, 5)).replace(f"{POSES[1][0][3]:.10f}", ""),
        "trajectory.log:6: expected",
    ),
    "log of the inverse of size": ("trajectory.log", log(3 * POSES, range(1, 5)), "trajectory.log:1: the pose is not"),
    "log on its side": (
        "trajectory.log",
        log(np.swapaxes(POSES, 1, 2), range(1, 5)),
        "trajectory.log:1: the pose is not",
    ),
    "log in millimetres of a light year": (
        "trajectory.log",
        "0 0 1\n1 0 0 1e30\n0 1 0 0\n0 0 1 0\n0 0 0 1\n",
        "trajectory.log:1: ",
    ),
    "a number twice": ("trajectory.log", log(POSES, [1, 2, 2, 3]), "trajectory.log:11: frame 2 appears twice"),
    "another's numbers": ("trajectory.log", log(POSES[:2], [70, 80]), "trajectory.log: none of its frames"),
    "icl of prose": ("x.gt.freiburg", "x y\n", "x.gt.freiburg:1: expected 8 numbers"),
    "icl of stamps": ("x.gt.freiburg", "0.5 0 0 0 0 0 0 1\n", "x.gt.freiburg: expected frame numbers"),
    "icl, empty": ("x.gt.freiburg", "", "x.gt.freiburg: contains no trajectory"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_faulty_truth_is_refused_in_one_line(folder, name):
    file, text, fault = FAULTS[name]
    (folder / file).write_text(text)
    with pytest.raises(GavoError) as caught:
        open_source(folder)
    assert str(folder) in str(caught.value) and fault in str(caught.value), caught.value


@pytest.mark.parametrize("none", ["-inf", "nan", "-1.#INF", "1.#QNAN"])
def test_infinity_is_no_pose_however_it_is_written(tmp_path, none):
    LAYOUTS["seven_scenes"][1](tmp_path)
    (tmp_path / "frame-000001.pose.txt").rename(tmp_path / "frame-000001.pose.TXT")
    (tmp_path / "frame-000002.pose.txt").write_text(f"{none} {none} {none} {none}\n" * 4)
    np.testing.assert_allclose(truth_of(tmp_path).timestamps, np.array([0, 1, 3]) / 30)
    (tmp_path / "frame-000002.pose.txt").write_text("1 0 0 x " * 4)
    with pytest.raises(GavoError, match=r"frame-000002\.pose\.txt: expected a pose of .*: '1 0 0 x 1"):
        open_source(tmp_path)


@pytest.mark.parametrize("layout", ["plain", "tum"])
@pytest.mark.parametrize(
    "name",
    ["gt.txt", "poses.txt", "groundTruth.csv", "pose_left.txt", "trajectory.tum"]
    + ["room1-traj.txt", "room_trajectory.log", "01.pose", "poses/0.txt", "camera_poses/0.txt"],
)
def test_a_truth_by_another_name_is_told(tmp_path, layout, name):
    LAYOUTS[layout][1](tmp_path / "clip")
    truth = tmp_path / "clip" / "groundtruth.txt"
    truth.unlink(missing_ok=True)
    (tmp_path / "clip" / name).parent.mkdir(exist_ok=True)
    (tmp_path / "clip" / name).write_text("0 0 0 0 0 0 0 1\n")
    name = name.partition("/")[0]
    sequence = open_source(tmp_path / "clip")
    assert sequence.ground_truth is None
    assert [line for line in left_out(sequence) if line.startswith(f"{name}: if it is the true trajectory")]
    truth.write_text("0 0 0 0 0 0 0 1\n")
    assert not left_out(open_source(tmp_path / "clip"))


def test_poses_of_each_frame_are_told_in_one_line(tmp_path):
    """As panoptic mapping's flat folders have them: a line for each of hundreds hid all other words."""
    LAYOUTS["plain"][1](tmp_path)
    for i in range(5):
        (tmp_path / f"{i:06}_pose.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    (line,) = left_out(open_source(tmp_path))
    assert line.startswith("000000_pose.txt and 4 more: if they are the true trajectory, write it as rows of")


def test_what_a_run_found_is_not_proposed_as_the_truth(tmp_path):
    """`gavo run clip --output clip` writes both; the estimate under the truth's name has no errors at all."""
    LAYOUTS["plain"][1](tmp_path)
    (tmp_path / "trajectory.txt").write_text("0 0 0 0 0 0 0 1\n")
    assert len(left_out(open_source(tmp_path))) == 1
    (tmp_path / "metrics.json").write_text("{}")
    assert not left_out(open_source(tmp_path))


def test_two_trajectories_of_icl_are_refused(tmp_path):
    icl(tmp_path)
    icl(tmp_path, "livingRoom3.gt.freiburg")
    with pytest.raises(GavoError, match=r"livingRoom2\.gt\.freiburg and livingRoom3\.gt\.freiburg: keep only one"):
        open_source(tmp_path, Reading(camera=CAMERA))


@pytest.mark.parametrize("layout", ["seven_scenes", "scannet", "replica"])
@pytest.mark.parametrize("fault", ["on its side", "far away"])
def test_what_is_no_pose_is_refused_in_every_dataset(tmp_path, layout, fault):
    LAYOUTS[layout][1](tmp_path)
    pose = POSES[1].copy()
    pose[:3, 3] = (1, 2, 3) if fault == "on its side" else (0, 0, 1e12)
    pose = pose.T if fault == "on its side" else pose
    if layout == "replica":
        np.savetxt(tmp_path / "traj.txt", np.stack([POSES[0], pose]).reshape(-1, 16))
    else:
        np.savetxt(tmp_path / ("frame-000001.pose.txt" if layout == "seven_scenes" else "pose/1.txt"), pose)
    with pytest.raises(
        GavoError, match=r"(traj\.txt:2|pose\.txt|pose/1\.txt): the pose is not a rotation and translation"
    ):
        open_source(tmp_path)


def test_frames_of_a_phone_have_its_stamps_unless_the_rate_is_said(tmp_path):
    """Frames without a row have none, and are left out."""
    LAYOUTS["stray"][1](tmp_path)
    rows = (tmp_path / "odometry.csv").read_text().splitlines()
    (tmp_path / "odometry.csv").write_text("\n".join(rows[:2] + rows[3:]))
    sequence = open_source(tmp_path)
    np.testing.assert_allclose(sequence.timestamps, np.array(STRAY_STAMPS)[[0, 2, 3]])
    assert left_out(sequence) == ["1 frames: no row in odometry.csv"]
    np.testing.assert_allclose(open_source(tmp_path, Reading(rate=10.0)).timestamps, np.arange(4) / 10)


def test_a_phones_first_poses_had_no_stamps(tmp_path):
    LAYOUTS["stray"][1](tmp_path)
    rows = [row.split(",")[2:] for row in (tmp_path / "odometry.csv").read_text().splitlines()[1:]]
    (tmp_path / "odometry.csv").write_text("\n".join(map(",".join, rows)))
    truth = truth_of(tmp_path)
    np.testing.assert_allclose(truth.timestamps, np.arange(4) / 30)
    np.testing.assert_allclose(truth.world_T_camera, POSES, atol=1e-6)


def test_newer_rows_of_a_phone_have_a_camera_as_well(tmp_path):
    """And columns that are empty."""
    LAYOUTS["stray"][1](tmp_path)
    names, *rows = (tmp_path / "odometry.csv").read_text().splitlines()
    more = ", fx, fy, cx, cy, distortion_center_x, distortion_center_y"
    rows = [f"{row}, 1572.0, 1572.0, 959.5, 719.5, , " for row in rows]
    (tmp_path / "odometry.csv").write_text("\n".join([names + more, *rows]))
    truth = truth_of(tmp_path)
    np.testing.assert_allclose(truth.timestamps, STRAY_STAMPS)
    np.testing.assert_allclose(truth.world_T_camera, POSES, atol=1e-6)


def test_the_truth_of_a_phone_is_in_order_where_its_stamps_are_not(tmp_path):
    LAYOUTS["stray"][1](tmp_path)
    text = (tmp_path / "odometry.csv").read_text()
    (tmp_path / "odometry.csv").write_text(text.replace(str(STRAY_STAMPS[1]), str(STRAY_STAMPS[3] + 1)))
    truth = truth_of(tmp_path)
    np.testing.assert_array_equal(truth.timestamps, [*np.array(STRAY_STAMPS)[[0, 2, 3]], STRAY_STAMPS[3] + 1])
    np.testing.assert_allclose(truth.world_T_camera, POSES[[0, 2, 3, 1]], atol=1e-6)
    (tmp_path / "odometry.csv").write_text(text.replace(str(STRAY_STAMPS[1]), str(STRAY_STAMPS[0])))
    np.testing.assert_array_equal(truth_of(tmp_path).timestamps, np.array(STRAY_STAMPS)[[0, 2, 3]])


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "contains no trajectory"),
        ("1, 2, 3\n", "odometry.csv:1: expected 9"),
        ("0, 0, 1e200, 0, 0, 0, 0, 0, 1\n", "odometry.csv:1: contains an absurdly large value"),
    ],
)
def test_faulty_poses_of_a_phone_are_refused(tmp_path, text, fault):
    LAYOUTS["stray"][1](tmp_path)
    (tmp_path / "odometry.csv").write_text(text)
    with pytest.raises(GavoError, match=fault):
        open_source(tmp_path)


def change_transforms(folder: Path, **entries: object) -> None:
    path = folder / "transforms.json"
    values = json.loads(path.read_text())
    for frame in values["frames"]:
        frame |= entries
    path.write_text(json.dumps(values))


def test_poses_of_structure_from_motion_are_no_truth(tmp_path):
    """How long their unit is, is open."""
    LAYOUTS["nerf"][1](tmp_path)
    change_transforms(tmp_path, colmap_im_id=3)
    sequence = open_source(tmp_path)
    assert sequence.ground_truth is None
    assert left_out(sequence) == ["transforms.json: its poses come from structure from motion, whose unit is unknown"]


@pytest.mark.parametrize("entries", [{"file_path": "train/r_0"}, {"transform_matrix": [[float("nan")] * 4] * 4}])
def test_poses_of_other_images_are_told(tmp_path, entries):
    """And those that are not finite."""
    LAYOUTS["nerf"][1](tmp_path)
    change_transforms(tmp_path, **entries)
    sequence = open_source(tmp_path)
    assert sequence.ground_truth is None
    assert left_out(sequence) == ["transforms.json: contains no pose for any of these images"]


def test_no_pose_of_nerf_is_refused_with_its_place(tmp_path):
    LAYOUTS["nerf"][1](tmp_path)
    change_transforms(tmp_path, transform_matrix=[[3.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0]])
    with pytest.raises(GavoError, match=r"transforms\.json: frames\[0\]: the pose is not a rotation and translation"):
        open_source(tmp_path)


@pytest.mark.parametrize("layout", ["stray", "seven_scenes", "scannet", "arkit_scenes", "nerf"])
def test_a_groundtruth_of_ones_own_goes_before_the_datasets_poses(tmp_path, layout):
    """As of motion capture, beside what a phone's own tracking found."""
    LAYOUTS[layout][1](tmp_path)
    stamps = open_source(tmp_path).timestamps
    (tmp_path / "groundtruth.txt").write_text("".join(f"{stamp!r} 1 2 3 0 0 0 1\n" for stamp in stamps.tolist()))
    truth = truth_of(tmp_path)
    np.testing.assert_array_equal(truth.timestamps, stamps)
    np.testing.assert_array_equal(truth.world_T_camera[:, :3, 3], np.tile([1.0, 2, 3], (4, 1)))
