"""Folders whose `transforms.json` names depth: what it pairs, in which order, and what it says of the poses."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from written_folders import LAYOUTS, METRES, POSES

from gavo_jax.datasets.files import FileSequence, Reading
from gavo_jax.datasets.registry import open_source, recognise
from gavo_jax.errors import GavoError
from gavo_jax.inspection import left_out

FRAME = {"file_path": "images/frame_00001.png", "depth_file_path": "lidar/8.png"}


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "clip").mkdir()
    LAYOUTS["nerfstudio"][1](tmp_path / "clip")
    return tmp_path / "clip"


def change(folder: Path, what: Callable[[dict[str, Any]], object]) -> None:
    path = folder / "transforms.json"
    values = json.loads(path.read_text())
    what(values)
    path.write_text(json.dumps(values))


def each(what: Callable[[dict[str, Any]], object]) -> Callable[[dict[str, Any]], object]:
    return lambda values: [what(frame) for frame in values["frames"]]


def opened(folder: Path, rate: float | None = None) -> FileSequence:
    sequence = open_source(folder, Reading(rate=rate))
    assert isinstance(sequence, FileSequence) and sequence.kind == "nerfstudio folder"
    sequence.check()
    return sequence


def check_frames(folder: Path) -> FileSequence:
    sequence = opened(folder)
    assert len(sequence) == 4
    for frame, metres in zip(sequence, METRES, strict=True):
        np.testing.assert_allclose(frame.depth / sequence.camera.depth_scale, metres, atol=1e-3)
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.world_T_camera, POSES, atol=1e-6)
    return sequence


def test_depth_may_lie_beside_colour_as_spectacular_ai_has_it(folder):
    for i in range(1, 5):
        (folder / f"lidar/{9 - i}.png").rename(folder / f"images/depth_{i:05}.png")
    change(folder, each(lambda frame: frame.update(depth_file_path=frame["file_path"].replace("frame", "depth"))))
    assert check_frames(folder).left_out == ()


def test_the_ending_of_colour_may_be_left_out_as_nerfcapture_has_it(folder):
    """And depth goes by the name that instant-ngp has for it."""
    change(folder, each(lambda frame: frame.update(file_path=frame["file_path"].removesuffix(".png"))))
    change(folder, each(lambda frame: frame.update(depth_path=frame.pop("depth_file_path"))))
    check_frames(folder)


def test_names_of_colour_are_stamps_as_in_any_folder(folder):
    """Depth has a stamp of its own where its name says one that is near; another is of another clock."""
    stamps = [1305031102.1 + i / 30 for i in range(4)]

    def rename(frame: dict[str, Any]) -> None:
        at = int(frame["file_path"][-9:-4]) - 1
        names = {"file_path": stamps[at], "depth_file_path": stamps[at] + (0.01 if at else 5.0)}
        for key, stamp in names.items():
            file = folder / frame[key]
            frame[key] = str(file.rename(file.with_name(f"{stamp:.6f}.png")).relative_to(folder))

    change(folder, each(rename))
    sequence = check_frames(folder)
    np.testing.assert_allclose(sequence.timestamps, stamps, atol=1e-6, rtol=0)
    delays = [frame.depth_timestamp and frame.depth_timestamp - frame.timestamp for frame in sequence]
    assert delays == [None, *[pytest.approx(0.01, abs=1e-5)] * 3]


def test_a_rate_that_is_said_counts(folder):
    sequence = opened(folder, rate=10)
    np.testing.assert_allclose(sequence.timestamps, np.arange(1, 5) / 10)
    assert not sequence.times_guessed and opened(folder).times_guessed == "names are numbers"


def stamped(folder: Path, stamp: Callable[[int], object]) -> Path:
    """The frames with stamps as NeRFCapture has them, by their places from 0."""
    change(folder, each(lambda frame: frame.update(timestamp=stamp(int(frame["file_path"][-9:-4]) - 1))))
    return folder


def test_stamps_of_frames_say_when(folder):
    """NeRFCapture has seconds since the phone was switched on; the run took 30 frames per second for granted."""
    stamps = [5021.25, 5021.75, 5023.0, 5023.5]
    sequence = check_frames(stamped(folder, stamps.__getitem__))
    np.testing.assert_allclose(sequence.timestamps, stamps)
    assert sequence.ground_truth is not None and not sequence.times_guessed
    np.testing.assert_allclose(sequence.ground_truth.timestamps, stamps)
    np.testing.assert_allclose(opened(folder, rate=10).timestamps, np.arange(1, 5) / 10)


def test_frames_go_by_their_stamps_and_not_by_their_names(folder):
    sequence = opened(stamped(folder, lambda at: 10.5 - at))
    assert [entry.color.name[-5] for entry in sequence.entries] == ["4", "3", "2", "1"]
    np.testing.assert_allclose(sequence[3].depth / sequence.camera.depth_scale, METRES[0], atol=1e-3)


@pytest.mark.parametrize(("start", "unit"), [(1716900000123456789, 1e-9), (1716900000123, 1e-3)])
def test_stamps_may_be_whole_numbers_of_a_clock(folder, start, unit):
    sequence = opened(stamped(folder, lambda at: start + round(at / 30 / unit)))
    np.testing.assert_allclose(np.diff(sequence.timestamps), 1 / 30, atol=1e-3)
    assert 1716900000 <= sequence.timestamps[0] < 1716900001


def test_stamps_that_count_frames_are_told(folder):
    sequence = opened(stamped(folder, lambda at: at))
    np.testing.assert_allclose(sequence.timestamps, np.arange(1, 5) / 30)
    assert sequence.times_guessed == "names are numbers"
    assert left_out(sequence) == ["timestamps in transforms.json: whole numbers that cannot be times of a camera"]


@pytest.mark.parametrize(
    ("stamp", "fault"),
    [
        (lambda at: None if at else 1.5, r"frames\[0\]: timestamp: expected seconds, found None: pass --rate"),
        (lambda at: "soon", "timestamp: expected seconds, found 'soon'"),
        (lambda at: True, "timestamp: expected seconds, found True"),
        (lambda at: float("nan"), "timestamp: expected seconds, found nan"),
        (lambda at: 10**400, "timestamp: expected seconds, found"),
        (lambda at: [7.5], r"timestamp: expected seconds, found \[7.5\]"),
        (lambda at: 7.5, r"timestamp: 7.5 is also frame_0000\d.png's: pass --rate"),
    ],
)
def test_stamps_that_are_none_are_refused(folder, stamp, fault):
    stamped(folder, stamp)
    with pytest.raises(GavoError, match=rf"transforms\.json: .*{fault}"):
        open_source(folder)
    assert len(opened(folder, rate=10)) == 4


def test_an_image_with_two_stamps_is_refused(folder):
    stamped(folder, lambda at: at + 0.5)
    change(folder, lambda values: values["frames"].append({**values["frames"][0], "timestamp": 9.5}))
    with pytest.raises(GavoError, match=r"frames\[4\]: timestamp: frame_00004.png appears twice, also with 3.5"):
        open_source(folder)


def test_frames_redefine_the_camera_above_them(folder):
    """As instant-ngp and NeRFCapture have it: above is the first frame's, and focus moves."""
    change(folder, each(lambda frame: frame.update(fl_x=132.0, fl_y=132.0)))
    assert opened(folder).camera.fx == 132 and opened(folder).camera.cx == 79.5
    change(folder, lambda values: values["frames"][0].update(fl_x=140.0))
    with pytest.raises(GavoError, match=r"transforms\.json: the frames have different cameras.*fl_x differs by 8"):
        open_source(folder)


def test_depth_that_is_named_goes_before_a_folder_of_depth_beside_intrinsics(folder):
    """The file of Open3D's reconstruction took `depth/`, which is another's, for it."""
    intrinsics = {"width": 160, "height": 120, "intrinsic_matrix": [150.0, 0, 0, 0, 150.0, 0, 79.5, 59.5, 1]}
    (folder / "camera_intrinsic.json").write_text(json.dumps(intrinsics))
    assert check_frames(folder).camera.fx == 150


def test_images_that_are_not_named_with_depth_are_told(folder):
    change(folder, lambda values: values["frames"].pop())
    change(folder, lambda values: values["frames"][0].pop("depth_file_path"))
    assert len(opened(folder)) == 2
    assert left_out(opened(folder)) == ["2 images: not listed with depth in transforms.json, such as frame_00001.png"]


@pytest.mark.parametrize("moved", ["cam1", "/data/cam1"])
def test_poses_are_those_of_the_images_that_are_named(folder, moved):
    """An image of another camera with the same name gave its pose to this one."""
    change(folder, lambda values: values["frames"].extend([{**values["frames"][0]} for _ in range(4)]))
    for i in range(4):
        frame = {"file_path": f"{moved}/frame_{i + 1:05}.png", "transform_matrix": np.eye(4).tolist()}
        change(folder, lambda values, i=i, frame=frame: values["frames"].__setitem__(4 + i, frame))
    assert check_frames(folder).left_out == ()


def test_poses_of_images_with_the_same_name_are_not_used(tmp_path):
    """Of two poses that may be an image's, the last counted, without a word."""
    LAYOUTS["nerf"][1](tmp_path)

    def rename(values: dict[str, Any]) -> None:
        for frame in values["frames"]:
            frame["file_path"] = frame["file_path"].replace("images", "cam0")
        values["frames"].append({"file_path": "cam1/frame_00002.png", "transform_matrix": np.eye(4).tolist()})

    change(tmp_path, rename)
    sequence = open_source(tmp_path)
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.world_T_camera, POSES[[0, 2, 3]], atol=1e-6)
    why = "several of its paths end alike, such as ./cam0/frame_00002.png and cam1/frame_00002.png"
    assert left_out(sequence) == [f"transforms.json: no poses for 1 images: {why}"]


@pytest.mark.parametrize("name", ["rgb/1305031102.{}", "{}.png", ".", "/", "a\0b/{}"])
def test_the_decimals_of_a_stamp_are_no_ending(tmp_path, name):
    """Poses of rgb/1305031102.175304, without an ending, were taken to be those of no image."""
    LAYOUTS["nerf"][1](tmp_path)
    for i in range(4):
        for part in ("images", "depths"):
            (tmp_path / f"{part}/frame_{i + 1:05}.png").rename(tmp_path / f"{part}/1305031102.{i}00000.png")

    def rename(frame: dict[str, Any]) -> None:
        frame["file_path"] = name.format(f"{int(frame['file_path'][-9:-4]) - 1}00000")

    change(tmp_path, each(rename))
    sequence = open_source(tmp_path)
    assert sequence.ground_truth is None if "rgb" not in name else len(sequence.ground_truth or ()) == 4


def test_names_without_a_number_are_told(folder):
    (folder / "images/frame_00004.png").rename(folder / "images/last.png")
    change(folder, lambda values: values["frames"][0].update(file_path="images/last.png"))
    assert len(opened(folder)) == 3
    assert left_out(opened(folder)) == ["1 frames: names of another form than most, such as last.png"]


def test_a_name_that_no_disk_holds_is_an_image_that_is_missing(folder):
    """The system's own error for it came through."""
    change(folder, lambda values: values["frames"][0].update(depth_file_path=f"lidar/{300 * '9'}.png"))
    with pytest.raises(GavoError, match=r"999\.png: image is missing"):
        opened(folder)
    change(folder, lambda values: values["frames"][0].update(file_path=f"images/{300 * 'a'}4"))
    with pytest.raises(GavoError, match="aaa4: image is missing"):
        opened(folder)


def test_a_file_that_names_no_depth_leaves_it_to_the_names_of_folders(folder):
    change(folder, each(lambda frame: frame.update(depth_file_path=None)))
    assert recognise(folder).kind == "folder of colour and depth images"


@pytest.mark.parametrize("name", ["nerf", "nerfstudio"])
def test_shifts_that_were_scaled_are_scaled_back(tmp_path, name):
    """The world may have been turned, which changes no motion."""
    LAYOUTS[name][1](tmp_path)
    turned = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])

    def scale(frame: dict[str, Any]) -> None:
        pose = turned @ np.array(frame["transform_matrix"])
        pose[:3, 3] *= 0.2
        frame["transform_matrix"] = pose.tolist()

    change(tmp_path, each(scale))
    change(tmp_path, lambda values: values.update(applied_scale=0.2, applied_transform=turned[:3].tolist()))
    truth = open_source(tmp_path).ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth.world_T_camera, turned @ POSES, atol=1e-6)


@pytest.mark.parametrize(
    ("entries", "fault"),
    [
        ({"frames": {}}, r"frames: expected a list, found \{\}"),
        ({"frames": [FRAME, 3]}, r"frames\[1\]: expected names and values, found 3"),
        ({"frames": [{**FRAME, "file_path": None}]}, r"frames\[0\]: file_path: expected a path, found None"),
        ({"frames": [{**FRAME, "depth_file_path": 3}]}, r"frames\[0\]: depth_file_path: expected a path, found 3"),
        ({"frames": [{**FRAME, "file_path": "/etc/passwd"}]}, r"frames\[0\]: file_path: path leaves"),
        (
            {"frames": [FRAME, {**FRAME, "depth_file_path": "lidar/7.png"}]},
            r"frames\[1\]: frame_00001.png appears twice",
        ),
        ({"frames": []}, "none of its frames names a depth image"),
        ({"applied_scale": 0}, "applied_scale: expected a number above 0, found 0"),
        ({"applied_scale": 10**400}, "applied_scale: expected a number above 0"),
        ({"applied_scale": "small"}, "applied_scale: expected a number above 0, found 'small'"),
        (
            {"applied_transform": np.diag([1, 1, -1, 1]).tolist()},
            "applied_transform: the pose is not a rotation and translation",
        ),
        ({"applied_transform": "none"}, "applied_transform: expected a pose"),
    ],
)
def test_what_is_malformed_is_refused_with_its_place(folder, entries, fault):
    change(folder, lambda values: values.update({**entries, "note": {"depth_path": "x"}}))
    with pytest.raises(GavoError, match=rf"transforms\.json: {fault}"):
        open_source(folder)
