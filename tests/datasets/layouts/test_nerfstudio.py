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


def test_images_that_are_not_named_with_depth_are_told(folder):
    change(folder, lambda values: values["frames"].pop())
    change(folder, lambda values: values["frames"][0].pop("depth_file_path"))
    assert len(opened(folder)) == 2
    assert left_out(opened(folder)) == ["2 images: not named with depth in transforms.json, as frame_00001.png"]


def test_names_without_a_number_are_told(folder):
    (folder / "images/frame_00004.png").rename(folder / "images/last.png")
    change(folder, lambda values: values["frames"][0].update(file_path="images/last.png"))
    assert len(opened(folder)) == 3
    assert left_out(opened(folder)) == ["1 frames: names of another form than most, as last.png"]


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
            r"frames\[1\]: frame_00001.png is there twice",
        ),
        ({"frames": []}, "no frame of these names a depth image"),
        ({"applied_scale": 0}, "applied_scale: expected a number above 0, found 0"),
        ({"applied_scale": 10**400}, "applied_scale: expected a number above 0"),
        ({"applied_scale": "small"}, "applied_scale: expected a number above 0, found 'small'"),
        (
            {"applied_transform": np.diag([1, 1, -1, 1]).tolist()},
            "applied_transform: the pose is no rotation and shift",
        ),
        ({"applied_transform": "none"}, "applied_transform: expected a pose"),
    ],
)
def test_what_is_malformed_is_refused_with_its_place(folder, entries, fault):
    change(folder, lambda values: values.update({**entries, "note": {"depth_path": "x"}}))
    with pytest.raises(GavoError, match=rf"transforms\.json: {fault}"):
        open_source(folder)
