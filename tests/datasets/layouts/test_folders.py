"""Folders of every dataset: recognised by what lies in them, and read to the same frames."""

import dataclasses
import json
import os
import shutil
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from written_folders import (
    AIRSIM_STAMPS,
    ARKIT_STAMPS,
    CAMERA,
    CAMERA_TOML,
    DEPTHS,
    GREYS,
    LAYOUTS,
    LORIS_STAMPS,
    MATRIX,
    METRES,
    PLUS_STAMPS,
    POLYCAM_STAMPS,
    POSES,
    RTABMAP_STAMPS,
    SCANNER_STAMPS,
    STRAY_STAMPS,
    image,
    kinect,
    raw,
)

from gavo_jax.camera import Camera
from gavo_jax.camera_files.calibration import load_calibration
from gavo_jax.datasets import registry
from gavo_jax.datasets.base import Frame, FrameError, Sequence
from gavo_jax.datasets.files import FileSequence, Reading
from gavo_jax.datasets.layouts.numbered import ScanNet, SevenScenes
from gavo_jax.datasets.layouts.plain_folder import PlainFolder
from gavo_jax.datasets.registry import open_source, recognise, register_dataset
from gavo_jax.datasets.selection import open_part
from gavo_jax.errors import GavoError
from gavo_jax.inspection import summary


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "clip").mkdir()
    return tmp_path / "clip"


def wrote(folder: Path, name: str) -> Path:
    shutil.rmtree(folder)
    if name != "tum":
        folder.mkdir()
    LAYOUTS[name][1](folder)
    return folder


@pytest.mark.parametrize("name", ["../camera-intrinsics.txt", "colorIntrinsics.txt"])
def test_a_folder_named_as_7_scenes_has_a_camera_of_its_own(folder, name):
    """3DMatch has it one folder up; VolumeDeform beside, in a file of each camera. The run took that of 7-Scenes."""
    wrote(folder, "seven_scenes")
    (folder / "camera-intrinsics.txt").unlink(missing_ok=True)
    for kind in ("color", "depth"):
        (folder / name.replace("color", kind)).write_text("140 0 79.5 0\n0 140 59.5 0\n0 0 1 0\n0 0 0 1\n")
    assert open_source(folder).camera.fx == 140


@pytest.mark.parametrize("layout", ["plain", "replica", "airsim", "seven_scenes"])
@pytest.mark.parametrize("way", [".", "..", "inner/..", "../clip", "../link"])
def test_one_folder_up_is_found_by_every_way_into_the_folder(folder, monkeypatch, layout, way):
    """From within, `.` had no folder above it, and the one above `..` was the one within."""
    wrote(folder, layout)
    for file in ("camera.yaml", "camera.toml", "cam_params.json", "camera-intrinsics.txt"):
        (folder / file).unlink(missing_ok=True)
    (folder / "inner").mkdir()
    (folder / "inner/camera.toml").write_text(CAMERA_TOML.replace("131", "150"))
    (folder.parent / "camera.toml").write_text(CAMERA_TOML.replace("131", "140"))
    (folder.parent / "apart").mkdir()
    (folder.parent / "apart/link").symlink_to(folder)
    inside = {"..": folder / "inner", "../link": folder.parent / "apart/here"}.get(way, folder)
    inside.mkdir(exist_ok=True)
    monkeypatch.chdir(inside)
    assert open_source(way).camera.fx == 140
    (folder.parent / "apart/camera.toml").write_text(CAMERA_TOML.replace("131", "145"))
    assert open_source(way).camera.fx == (145 if way == "../link" else 140)


def test_what_is_made_of_a_frame_is_not_the_frame(folder):
    """7-Scenes comes with depth projected into colour, 3RScan with rendered images: two of one number were refused."""
    wrote(folder, "seven_scenes")
    count = len(open_source(folder))
    for file in sorted(folder.glob("frame-*.depth.*")):
        shutil.copy(file, file.with_name(file.name.replace(".depth.", ".depth.proj.")))
    assert len(open_source(folder)) == count


@pytest.mark.parametrize("names", [("align_rgb", "align_depth"), ("rgb", "depth_png"), ("colour", "depth_noise")])
def test_one_folder_of_each_kind_is_enough(folder, names):
    wrote(folder, "plain")
    for new, kind in zip(names, ("rgb", "depth"), strict=True):
        next(child for child in folder.iterdir() if child.name == kind).rename(folder / new)
    (folder / "depth_confidence").mkdir()
    assert len(open_source(folder)) == len(GREYS)


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_gives_the_same_frames(folder, name):
    sequence = open_source(wrote(folder, name))
    sequence.check()
    assert recognise(folder).kind == LAYOUTS[name][0]
    assert sequence.name == "clip" and len(sequence) == 4
    camera = sequence.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height) == (131, 131, 79.5, 59.5, 160, 120)
    stamps = {
        "stray": STRAY_STAMPS,
        "arkit_scenes": ARKIT_STAMPS,
        "scannet_plus_plus": PLUS_STAMPS,
        "polycam": POLYCAM_STAMPS,
        "scanner_app": SCANNER_STAMPS,
        "open_loris": LORIS_STAMPS,
        "rtabmap": RTABMAP_STAMPS,
        "airsim": AIRSIM_STAMPS,
    }
    from_one = ("bop", "nerf", "nerfstudio", "open3d", "open3d_image", "rtabmap_export")
    first = 1 / 30 if name in from_one else float(stamps.get(name, [0.0])[0])
    rates = {"stray": 60, "scannet_plus_plus": 60, "scanner_app": 15, "tartan_air_2": 10, "virtual_kitti": 10}
    rates |= {"airsim": 20}
    expected = np.arange(4) / rates.get(name, 30)
    tolerance = 1e-3 if name == "arkit_scenes" else 1e-6
    np.testing.assert_allclose(sequence.timestamps - first, expected, atol=tolerance)
    is_lossy = bool([*folder.rglob("*.jpg")])
    for i, frame in enumerate(sequence):
        assert isinstance(frame, Frame)
        limit = 1.5 if is_lossy else 0.1
        assert np.abs(frame.grey.astype(int) - GREYS[i]).mean() < limit
        off = frame.depth / camera.depth_scale - METRES[i]
        assert np.abs(off).max() < 0.51 / min(camera.depth_scale, 1000 if "float" not in name else 5000) + 1e-6
        np.testing.assert_array_equal(frame.depth > 0, DEPTHS[i] > 0)
    part = sequence[1:4:2]
    np.testing.assert_array_equal(part[1].depth, sequence[3].depth)


def test_poses_of_a_room_that_is_numbered_from_one_begin_with_its_first_image(folder):
    wrote(folder, "replica")
    for kind, ending in (("frame", "jpg"), ("depth", "png")):
        for i in reversed(range(4)):
            path = folder / f"results/{kind}{i:06}.{ending}"
            path.rename(path.with_name(f"{kind}{i + 1:06}.{ending}"))
    truth = open_source(folder).ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth.timestamps, np.arange(1, 5) / 30)
    np.testing.assert_allclose(truth.world_T_camera, POSES, atol=1e-6)


def beside_depth(folder: Path, name: str) -> PlainFolder:
    """A folder with another one of depth, of 2 m everywhere, beside that of depth."""
    wrote(folder, "plain")
    (folder / name).mkdir()
    for file in (folder / "depth").iterdir():
        image(folder / name / file.name, np.full((120, 160), 2.0, np.float32))
    sequence = open_source(folder)
    assert isinstance(sequence, PlainFolder)
    return sequence


@pytest.mark.parametrize(
    "name",
    [
        *("aligned_depth", "depth_registered", "aligned_depth_to_color", "Depth_Aligned", "depth_to_color"),
        *("registered_depth", "depth_aligned_to_rgb", "depth-to-colour", "depth_registered_images"),
    ],
)
def test_depth_that_is_registered_to_colour_goes_before_its_own_cameras(folder, name):
    sequence = beside_depth(folder, name)
    assert (sequence[0].depth == 2.0 * sequence.camera.depth_scale).all()
    assert sequence.left_out == (f"depth/: not read, depth comes from {name}/",)


@pytest.mark.parametrize("name", ["color_to_depth", "depth_to_color_vis", "rgb_aligned", "depth_mask", "depth_rect"])
def test_other_folders_do_not_go_before_depth(folder, name):
    sequence = beside_depth(folder, name)
    assert all(entry.depth and entry.depth.parent.name == "depth" for entry in sequence.entries)
    assert sequence.left_out == (("depth_rect/: not read, depth comes from depth/",) if name == "depth_rect" else ())


@pytest.mark.parametrize(
    ("color", "depth"),
    [
        *[(name, "depth") for name in ("rgb_raw", "color_images", "rgb_images", "Colour_images")],
        *[("rgb", name) for name in ("depth_raw", "depth_images", "aligned_depth_to_color", "depth_rect")],
        ("livingroom1-color", "livingroom1-depth-clean"),
        ("office_color", "office_depth"),
        *[("rgb_front", "depth_front"), ("front_rgb", "front_depth"), ("Colour0", "Depth0")],
    ],
)
def test_folders_of_images_have_many_names(folder, color, depth):
    wrote(folder, "plain")
    for old, new in (("rgb", "x"), ("depth", "y"), ("x", color), ("y", depth)):
        (folder / old).rename(folder / new)
    sequence = open_source(folder)
    assert isinstance(sequence, PlainFolder) and len(sequence) == 4 and sequence.left_out == ()


def test_of_two_scenes_in_one_folder_none_is_taken(folder):
    wrote(folder, "plain")
    for new in ("a-color", "b-color", "b-depth"):
        shutil.copytree(folder / ("rgb" if "color" in new else "depth"), folder / new)
    shutil.rmtree(folder / "rgb")
    (folder / "depth").rename(folder / "a-depth")
    with pytest.raises(GavoError, match=r"2 colour folders have a depth folder beside them \(a-color, b-color\): link"):
        open_source(folder)
    (folder / "b-depth").rename(folder / "c-depth")
    sequence = open_source(folder)
    assert isinstance(sequence, PlainFolder) and sequence.entries[0].color.parent.name == "a-color"


@pytest.mark.parametrize("name", ["oak_depthai_{}_{:04}", "indepth_{1:04}_{0}", "{}_{:04}", "scene{}{:04}"])
def test_the_word_depth_counts_as_a_part_of_its_own(folder, name):
    for i in range(2):
        image(folder / f"{name.format('rgb', i)}.png", GREYS[i])
        image(folder / f"{name.format('depth', i)}.png", raw(METRES[i], 1000))
    sequence = open_source(folder, Reading(camera=CAMERA))
    assert len(sequence) == 2
    np.testing.assert_array_equal(sequence[1].grey, GREYS[1])


def test_images_that_all_speak_of_depth_are_refused(folder):
    for i in range(2):
        for kind in ("rgb", "map"):
            image(folder / f"sunderdepth_{kind}_{i}.png", GREYS[i])
    with pytest.raises(GavoError, match=r"all images have depth in their names, such as sunderdepth_map_0\.png: "):
        open_source(folder, Reading(camera=CAMERA))


@pytest.mark.parametrize("factor", [20, 40])
def test_floats_that_may_be_centimetres_are_refused(folder, factor):
    wrote(folder, "plain")
    for i, metres in enumerate(METRES):
        image(folder / f"depth/{i}.tiff", (factor * metres).astype(np.float32))
    with pytest.raises(GavoError, match="fits neither metres nor millimetres: pass --depth-scale"):
        assert open_source(folder).camera


def test_what_open3d_says_of_depth_and_lens_counts(folder):
    """Its recorder writes both; 4000 to a metre were taken for millimetres."""
    wrote(folder, "open3d")
    path = folder / "camera_intrinsic.json"
    said = json.loads(path.read_text()) | {"depth_scale": 4000.0, "distortion": [0.1, -0.2, 0.0, 0.0]}
    path.write_text(json.dumps(said))
    calibration = load_calibration(path)
    assert calibration.color.depth_scale == 4000 and calibration.color.distortion[:2] == (0.1, -0.2)
    path.write_text(json.dumps(said | {"distortion": [0.0] * 5}))
    assert not any(load_calibration(path).color.distortion)


@pytest.mark.parametrize("row", ["318.6 255.3 517.3 516.5", "517.3 318.6 516.5 255.3"])
def test_numbers_of_a_camera_in_another_order_are_refused(tmp_path, row):
    (tmp_path / "k.txt").write_text(row)
    with pytest.raises(GavoError, match="does not look like fx fy cx cy"):
        load_calibration(tmp_path / "k.txt", (640, 480))


@pytest.mark.parametrize("step", [0.05, 1.3, 2.2, 9.0])
def test_polycams_names_are_microseconds_at_any_rate(folder, step):
    """Frames more than 1 s apart counted as numbered, or, beyond 2 s, as nanoseconds."""
    wrote(folder, "polycam")
    stamps = {round(stamp * 1e6): round((7.0 + step * i) * 1e6) for i, stamp in enumerate(POLYCAM_STAMPS)}
    for file in list(folder.glob("*/*")):
        file.rename(file.with_name(f"{stamps[int(file.stem)]}{file.suffix}"))
    (folder / f"depth/{max(stamps.values())}.png").unlink()
    sequence = open_source(folder)
    assert isinstance(sequence, FileSequence) and not sequence.times_guessed
    np.testing.assert_allclose(sequence.timestamps, 7.0 + step * np.arange(3))
    assert sequence.ground_truth is not None and len(sequence.ground_truth) == 3
    assert sequence.left_out == ("1 colour images: no depth image with the same name",)


@pytest.mark.parametrize(
    "name",
    [
        *("seven_scenes", "replica", "scannet", "stray", "arkit_scenes", "nerf", "open_loris", "tartan_air"),
        *("tartan_air_2", "scannet_plus_plus", "polycam", "scanner_app", "bop", "neural_rgbd", "semantic_replica"),
        "nerfstudio",
    ],
)
def test_poses_are_the_truth(folder, name):
    sequence = open_source(wrote(folder, name))
    truth = sequence.ground_truth
    assert truth is not None
    kept = [0, 1, 3] if name in ("scannet", "neural_rgbd") else [0, 1, 2, 3]
    np.testing.assert_array_equal(truth.timestamps, sequence.timestamps[kept])
    np.testing.assert_allclose(truth.world_T_camera, POSES[kept], atol=1e-6)


def test_a_room_of_semantic_nerf_was_rendered_with_a_view_of_90_degrees(folder):
    wrote(folder, "semantic_replica")
    (folder / "camera.toml").unlink()
    camera = open_source(folder).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.depth_scale) == (80, 80, 79.5, 59.5, 1000)


@pytest.mark.parametrize("as_file", [True, False])
def test_a_given_camera_leaves_the_unit_of_a_scene_of_bop(folder, tmp_path, as_file):
    """Depth was read in millimetres, as if the scene did not state its unit."""
    wrote(folder, "bop")
    (tmp_path / "mine.txt").write_text("131 131 79.5 59.5\n")
    given = str(tmp_path / "mine.txt") if as_file else CAMERA
    assert open_source(folder, Reading(camera=given)).camera.depth_scale == 10000
    file = folder / "scene_camera.json"
    file.write_text(file.read_text().replace('"depth_scale": 0.1', '"depth_scale": 1.0', 1))
    with pytest.raises(GavoError, match=r"scene_camera\.json: depth_scale: expected one number .*: pass --depth-scale"):
        open_source(folder, Reading(camera=given))
    for camera in (given, "auto"):
        assert open_source(folder, Reading(camera=camera, depth_scale=2000)).camera.depth_scale == 2000


def test_a_scene_in_grey_of_bop_has_its_images_in_gray(folder):
    wrote(folder, "bop")
    (folder / "rgb").rename(folder / "gray")
    assert len(open_source(folder)) == 4 and recognise(folder).kind == "BOP scene"


@pytest.mark.parametrize(("fps", "rate", "guess"), [(15.0, 15, ""), ("15", 30, "names are numbers")])
def test_the_rate_that_open3ds_reader_of_recordings_writes_is_taken(folder, fps, rate, guess):
    path = wrote(folder, "open3d") / "camera_intrinsic.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"fps": fps}))
    sequence = open_source(folder)
    np.testing.assert_allclose(np.diff(sequence.timestamps), 1 / rate)
    assert isinstance(sequence, FileSequence) and sequence.times_guessed == guess
    assert np.allclose(np.diff(open_source(folder, Reading(rate=10.0)).timestamps), 0.1)


@pytest.mark.parametrize(("scale", "is_guess"), [(None, True), (1000.0, False)])
def test_a_unit_that_nothing_says_is_called_a_guess(folder, scale, is_guess):
    """Depth in 5000 or 6553.5 to a metre was "in millimetres", without a word."""
    for i, (grey, metres) in enumerate(zip(GREYS, METRES, strict=True)):
        image(folder / f"rgb/{i}.png", grey)
        image(folder / f"depth/{i}.png", raw(metres, 6553.5))
    (folder / "camera.toml").write_text(CAMERA_TOML)
    sequence = open_source(folder, Reading(depth_scale=scale))
    assert ("millimetres, a guess: pass --depth-scale" in summary(sequence)) == is_guess


@pytest.mark.parametrize("name", ["seven_scenes", "plain", "associations", "tartan_air_2"])
def test_the_rate_can_be_said(folder, name):
    sequence = open_source(wrote(folder, name), Reading(rate=10.0))
    np.testing.assert_allclose(sequence.timestamps, np.arange(4) / 10)
    if sequence.ground_truth is not None:
        np.testing.assert_allclose(sequence.ground_truth.timestamps, np.arange(4) / 10)


def test_frames_keep_their_numbers_where_some_are_missing(folder):
    wrote(folder, "seven_scenes")
    (folder / "frame-000001.color.png").unlink()
    (folder / "frame-000003.depth.png").unlink()
    sequence = open_source(folder)
    assert isinstance(sequence, SevenScenes)
    np.testing.assert_allclose(sequence.timestamps, [0, 2 / 30])
    assert sequence.left_out == (
        "1 colour images: no depth image with the same number",
        "1 depth images: no colour image with the same number",
    )


@pytest.mark.parametrize(
    ("stems", "seconds"),
    [
        (["1305031102.175304", "1305031102.2113"], [1305031102.175304, 1305031102.2113]),
        (["1305031102175304", "1305031102211300"], [1305031102.175304, 1305031102.2113]),
        (["1305031102175", "1305031102211"], [1305031102.175, 1305031102.211]),
        (["rgb_1305031102175304000", "rgb_1305031102211300000"], [1305031102.175304, 1305031102.2113]),
        (["0.0", "0.04"], [0.0, 0.04]),
    ],
)
def test_names_that_are_stamps_are_paired_by_time(folder, stems, seconds):
    for stem in stems:
        image(folder / f"color/{stem}.png", GREYS[0])
    for stem, second in zip(stems, seconds, strict=True):
        later = f"{second + 0.01:.6f}" if "." in stem else stem
        image(folder / f"depth/{later}.png", raw(METRES[0], 1000))
    other_day = "1400000000.5" if "." in stems[0] else stems[0].replace("13", "14", 1)
    image(folder / f"depth/{other_day}.png", DEPTHS[0])
    sequence = open_source(folder, Reading(camera=CAMERA))
    np.testing.assert_allclose(sequence.timestamps, seconds, atol=1e-6)
    assert isinstance(sequence, PlainFolder) and sequence.left_out == ("1 depth images: no colour image within 0.02 s",)
    delay = sequence[1].depth_timestamp
    assert delay is not None and abs(delay - seconds[1] - (0.01 if "." in stems[0] else 0.0)) < 1e-6


@pytest.mark.parametrize("form", ["{stamp}_{kind}", "{kind}/{stamp}_{kind}", "{kind}_{i:05}_{stamp}"])
@pytest.mark.parametrize(("first", "unit"), [(1700000000123, 1e-3), (77033333, 1e-6)])
def test_stamps_may_stand_before_a_word_or_after_an_index(folder, form, first, unit):
    """They became numbers of frames, and steps of 33 ms those of a second and more."""
    numbers = [first + round(0.033 / unit) * i for i in range(4)]
    for i, stamp in enumerate(numbers):
        image(folder / f"{form.format(stamp=stamp, kind='color', i=i)}.png", GREYS[i])
        image(folder / f"{form.format(stamp=stamp + 3, kind='depth', i=i)}.png", raw(METRES[i], 1000))
    sequence = open_source(folder, Reading(camera=CAMERA))
    np.testing.assert_allclose(sequence.timestamps, unit * np.array(numbers), rtol=0, atol=1e-6)


@pytest.mark.parametrize("numbers", [(0, 1, 2, 3), (1, 2, 4, 9), (0, 5, 10, 15)])
def test_numbers_of_frames_before_a_word_are_no_stamps(folder, numbers):
    for i, number in enumerate(numbers):
        image(folder / f"{number:06}_color.png", GREYS[i])
        image(folder / f"{number:06}_depth.png", raw(METRES[i], 1000))
    np.testing.assert_allclose(open_source(folder, Reading(camera=CAMERA)).timestamps, np.array(numbers) / 30)


@pytest.mark.parametrize("unit", [1e-3, 1e-9])
def test_an_image_without_a_number_changes_no_stamp(folder, unit):
    """Milliseconds became numbers of frames by it; of nanoseconds no frame was left."""
    for i in range(3):
        stem = round((1305031102.175 + 0.033 * i) / unit)
        image(folder / f"color/{stem}.png", GREYS[i])
        image(folder / f"depth/{stem}.png", raw(METRES[i], 1000))
    image(folder / "color/preview.png", GREYS[0])
    sequence = open_source(folder, Reading(camera=CAMERA))
    np.testing.assert_allclose(np.diff(sequence.timestamps), 0.033, atol=1e-6)
    assert isinstance(sequence, PlainFolder)
    assert sequence.left_out == ("1 images: no number in their names, such as preview.png",)


def stamped(folder: Path, color: list[str], depth: list[str]) -> Sequence:
    """A folder of images of these names, opened."""
    for part, stems in (("rgb", color), ("depth", depth)):
        for stem in stems:
            image(folder / f"{part}/{stem}.png", GREYS[0] if part == "rgb" else raw(METRES[0], 1000))
    return open_source(folder, Reading(camera=CAMERA))


@pytest.mark.parametrize("unit", [1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("first", [1305031102.175, 123.456])
@pytest.mark.parametrize("stray", ["preview1", "{} (1)", "{} - Copy", "{}_vis", "a_{}"])
def test_a_few_names_of_another_form_change_no_stamp(folder, unit, first, stray):
    """All became numbers of frames by one of them: years, and of some no frame was left."""
    names = [str(round((first + i / 30) / unit)) for i in range(12)]
    sequence = stamped(folder, [*names, stray.format(names[3])], names)
    assert isinstance(sequence, PlainFolder) and len(sequence) == 12
    np.testing.assert_allclose(sequence.timestamps, first + np.arange(12) / 30, atol=1e-3)
    assert sequence.left_out == (f"1 images: names of another form than most, such as {stray.format(names[3])}.png",)


def test_many_names_of_another_form_are_refused(folder):
    names = [f"{'ab'[i > 5]}_{1305031102175 + 33 * i}" for i in range(12)]
    with pytest.raises(GavoError, match=r"a_\d+\.png: its name is a time, but 6 of 12 have another form, such as b_"):
        stamped(folder, names, names)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ((0, 12, 25, 37), " at 83.33 frames/s (names taken for milliseconds)"),
        ((0, 33333, 66667, 100000), " at 30 frames/s (names taken for microseconds)"),
        ((0, 10, 20, 30), " at 3 frames/s (names are numbers)"),
        (("1700000000123", "1700000000156", "1700000000190", "1700000000223"), ""),
    ],
)
def test_a_rate_that_is_a_guess_is_told(folder, numbers, words):
    """Every so many frames, picked evenly, have names that may be milliseconds."""
    for number in numbers:
        image(folder / f"rgb/{number}.png", GREYS[0])
        image(folder / f"depth/{number}.png", raw(METRES[0], 1000))
    assert f", 4 frames of 160x120{words}; camera" in summary(open_source(folder, Reading(camera=CAMERA)))
    assert "(" not in summary(open_source(folder, Reading(camera=CAMERA, rate=25.0))).partition("; camera")[0]


def test_kinds_of_two_rates_count_the_same(folder):
    """Even steps have a common factor; colour alone was times, so that both were numbers of frames."""
    color = [f"{round(1000 * i / 30):06}" for i in range(30)]
    sequence = stamped(folder, color, [f"{50 * i:06}" for i in range(20)])
    np.testing.assert_allclose(np.diff(sequence.timestamps), 0.05, atol=0.02)
    assert len(sequence) == 20


def test_times_beside_other_numbers_are_refused(folder):
    color = [f"{1000 + round(1000 * i / 30):06}" for i in range(30)]
    with pytest.raises(GavoError, match=r"clip: names such as 001967\.png are times, but .*, such as 1039\.png, "):
        stamped(folder, color, [str(1000 + i) for i in range(40)])
    chosen = ["3", "9", "15", "21", "28", "34"]  # of frames, as the other kind has them all
    shutil.rmtree(folder / "rgb")
    assert len(stamped(folder, chosen, [str(i) for i in range(40)])) == 6


def test_folders_may_be_written_large_and_hold_what_systems_leave(folder):
    for i in range(4):
        image(folder / f"RGB/{i}.PNG", GREYS[i])
        image(folder / f"Depth/{i}.PNG", raw(METRES[i], 1000))
        for kind in ("RGB", "Depth"):
            (folder / f"{kind}/._{i}.png").write_bytes(b"\0\5\x16\7")
    sequence = open_source(folder, Reading(camera=CAMERA))
    assert isinstance(sequence, PlainFolder) and len(sequence) == 4 and sequence.left_out == ()
    np.testing.assert_array_equal(sequence[3].grey, GREYS[3])


def test_colour_is_what_is_named_so(folder):
    """Beside confidence and masks, whose names sort before and after."""
    for i in range(2):
        for kind, pixels in (("conf", GREYS[3]), ("rgb", GREYS[i]), ("mask", GREYS[3])):
            image(folder / f"frame_{kind}_{i}.png", pixels)
        image(folder / f"frame_depth_{i}.png", raw(METRES[i], 1000))
    sequence = open_source(folder, Reading(camera=CAMERA))
    np.testing.assert_array_equal(sequence[1].grey, GREYS[1])


def test_colour_beside_depth_of_a_stereo_camera_is_left(folder):
    """As ZED's export names both."""
    for i in range(2):
        image(folder / f"left{i:06}.png", GREYS[i])
        image(folder / f"right{i:06}.png", GREYS[3])
        image(folder / f"depth{i:06}.png", raw(METRES[i], 1000))
    np.testing.assert_array_equal(open_source(folder, Reading(camera=CAMERA))[1].grey, GREYS[1])


def test_colour_may_be_a_number_beside_depth(folder):
    for i in range(2):
        image(folder / f"{i:03}.jpg", GREYS[i])
        image(folder / f"{i:03}_depth.png", raw(METRES[i], 1000))
        image(folder / f"{i:03}_mask.png", GREYS[3])
    sequence = open_source(folder, Reading(camera=CAMERA))
    assert isinstance(sequence, PlainFolder) and [entry.color.name for entry in sequence.entries] == [
        "000.jpg",
        "001.jpg",
    ]


@pytest.mark.parametrize("layout", ["scannet", "seven_scenes", "open3d"])
def test_two_images_of_one_number_are_refused(folder, layout):
    color = next(wrote(folder, layout).rglob("*.color.png" if layout == "seven_scenes" else "*.jpg"))
    image(color.with_suffix(".bmp"), np.zeros_like(GREYS[0]))
    with pytest.raises(GavoError, match="has the same number as"):
        open_source(folder)


def test_truth_by_the_numbers_of_frames_has_their_times(folder):
    wrote(folder, "plain")
    (folder / "groundtruth.txt").write_text("".join(f"{i} 0 0 {i} 0 0 0 1\n" for i in range(4)))
    for rate in (None, 10.0):
        sequence = open_source(folder, Reading(rate=rate))
        assert sequence.ground_truth is not None
        np.testing.assert_allclose(sequence.ground_truth.timestamps, sequence.timestamps)


def counted(folder: Path, images: range, poses: range) -> Sequence:
    """A folder of images of these numbers, whose truth has those, opened."""
    rows = "".join(f"{i} {0.01 * i:.2f} 0 0 0 0 0 1\n" for i in poses)
    (folder / "groundtruth.txt").write_text(rows)
    return stamped(folder, [f"{i:06}" for i in images], [f"{i:06}" for i in images])


@pytest.mark.parametrize("first", [(1, 0), (0, 1), (100, 0), (5, 5)])
def test_as_many_poses_as_images_are_theirs_in_order(folder, first):
    """Counted from 0 beside images from 1, each pose was that of the next image."""
    sequence = counted(folder, *(range(start, start + 12) for start in first))
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.timestamps, sequence.timestamps)


@pytest.mark.parametrize(
    ("images", "poses", "refused"),
    [
        (range(1, 21), range(15), "poses are numbered 0 to 14, images 1 to 20: give"),
        (range(20), range(1, 31), "poses are numbered 1 to 30, images 0 to 19: give"),
        (range(1, 21), range(21), None),
        (range(100, 120), range(300), None),
        (range(20), range(5, 20), None),
        (range(0, 40, 2), range(1, 30), None),
    ],
)
def test_a_truth_that_may_be_one_frame_off_is_refused(folder, images, poses, refused):
    if refused:
        with pytest.raises(GavoError, match=rf"groundtruth\.txt: {refused}"):
            counted(folder, images, poses)
        return
    truth = counted(folder, images, poses).ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth.timestamps, np.array(poses) / 30)


def test_a_camera_that_is_turned_in_its_device_is_refused(folder):
    wrote(folder, "scannet")
    np.savetxt(folder / "intrinsic/extrinsic_color.txt", np.eye(4) + 0.05 * np.eye(4, k=3))
    with pytest.raises(GavoError, match=r"extrinsic_color\.txt: is not the identity: pass --camera"):
        open_source(folder)


def test_images_without_a_number_are_left_out_by_name(folder):
    wrote(folder, "seven_scenes")
    (folder / "frame-000001.color.png").rename(folder / "frame-abc.color.png")
    sequence = open_source(folder)
    assert isinstance(sequence, SevenScenes)
    assert sequence.left_out == (
        "1 depth images: no colour image with the same number",
        "1 images: no number in their names, such as frame-abc.color.png",
    )
    wrote(folder, "plain")
    image(folder / "depth/legend.png", DEPTHS[0])
    image(folder / "depth/scale.png", DEPTHS[0])
    sequence = open_source(folder)
    assert isinstance(sequence, PlainFolder)
    assert sequence.left_out == ("2 images: no number in their names, such as legend.png",)


def test_folders_of_other_names_say_which_are_known(folder):
    wrote(folder, "plain")
    (folder / "rgb").rename(folder / "left")
    with pytest.raises(
        GavoError, match=r"left/, and no folder of colour beside depth/; colour is looked for in color, colour, rgb, "
    ):
        open_source(folder)
    (folder / "depth").rename(folder / "right")
    with pytest.raises(
        GavoError, match=r"right/: .*; colour is looked for in color, colour, rgb, .* depth in aligned_depth, "
    ):
        open_source(folder)
    (folder / "left").rename(folder / "RGB")
    with pytest.raises(GavoError, match=r"no folder of depth beside RGB/; depth is looked for in .*, depth, depths, "):
        open_source(folder)


def test_a_published_camera_stands_in_for_a_file(folder):
    wrote(folder, "seven_scenes")
    (folder / "camera-intrinsics.txt").unlink()
    for file in folder.glob("frame-*.*.png"):
        file.unlink()
    for i in range(2):
        image(folder / f"frame-{i:06}.color.png", np.zeros((480, 640), np.uint8))
        image(folder / f"frame-{i:06}.depth.png", np.full((480, 640), 1500, np.uint16))
    assert open_source(folder).camera == Camera(585, 585, 320, 240, 640, 480, depth_scale=1000)


def sens(color: Camera, depth: Camera, shift: float = 0.0) -> str:
    """The info.txt of a scan."""
    lines = ["m_versionNumber = 4", f"m_depthShift = {color.depth_scale:g}"]
    for kind, camera in (("Color", color), ("Depth", depth)):
        matrix, pose = np.eye(4), np.eye(4)
        matrix[:3, :3], pose[0, 3] = camera.matrix, shift
        lines += [f"m_{kind.lower()}Width = {camera.width}", f"m_{kind.lower()}Height = {camera.height}"]
        for what, numbers in (("Intrinsic", matrix), ("Extrinsic", pose)):
            lines.append(f"m_calibration{kind}{what} = {' '.join(map(str, numbers.ravel()))} ")
    return "\n".join(lines) + "\n"


def test_an_info_of_a_scan_has_the_cameras(folder):
    """As BundleFusion and 3RScan have it, whose frames are named as those of 7-Scenes."""
    wrote(folder, "seven_scenes")
    (folder / "camera-intrinsics.txt").unlink()
    mine = Camera(130.0, 130.5, 80.0, 60.0, 160, 120, depth_scale=1000.0)
    (folder / "info.txt").write_text(sens(mine, dataclasses.replace(mine, fx=130.2)))
    sequence = open_source(folder)
    assert isinstance(sequence, SevenScenes) and sequence.calibration.color == mine
    assert sequence.calibration.depth is None
    (folder / "info.txt").write_text(sens(mine, dataclasses.replace(mine, fx=140.0)))
    other = open_source(folder)
    assert isinstance(other, SevenScenes) and other.calibration.depth is not None
    assert other.calibration.depth.fx == 140 and other[0].depth.any()
    for text, fault in (
        (sens(mine, mine, 0.03), "Extrinsic: must be the identity"),
        (sens(mine, mine).replace("m_depthWidth", "m_width"), "m_depthWidth"),
        (sens(mine, mine)[:-150], "info.txt of a scan"),
    ):
        (folder / "info.txt").write_text(text)
        with pytest.raises(GavoError, match=fault):
            open_source(folder)


def test_an_info_of_a_scan_may_lie_one_folder_up(folder):
    """As 12-Scenes has it; another file of the name says nothing."""
    (folder / "data").mkdir()
    wrote(folder / "data", "seven_scenes")
    (folder / "data/camera-intrinsics.txt").unlink()
    (folder / "info.txt").write_text(sens(CAMERA, dataclasses.replace(CAMERA, fx=140.0)))
    sequence = open_source(folder / "data")
    assert isinstance(sequence, SevenScenes) and sequence.calibration.depth is not None
    assert (sequence.camera.fx, sequence.calibration.depth.fx) == (131, 140)
    (folder / "info.txt").write_text("taken in the kitchen\n")
    with pytest.raises(GavoError, match="the camera's images are 640x480"):
        open_part(str(folder / "data"))


@pytest.mark.parametrize("name", ["intrinsics", "intrinsic"])
def test_frames_that_scannet_exports_have_their_cameras_beside_them(folder, name):
    wrote(folder, "scannet")
    for camera in ("color", "depth"):
        (folder / f"intrinsic/intrinsic_{camera}.txt").rename(folder / f"{name}_{camera}.txt")
    (folder / f"{name}_depth.txt").write_text("130 0 79.5 0\n0 130 59.5 0\n0 0 1 0\n0 0 0 1\n")
    sequence = open_source(folder)
    assert isinstance(sequence, ScanNet) and sequence.ground_truth is not None
    assert sequence.calibration.depth is not None and sequence.calibration.depth.fx == 130


def test_the_folders_name_may_say_the_camera(tmp_path):
    """A benchmark's images without its lists."""
    for i in range(2):
        image(tmp_path / f"fr3_walk/rgb/{i}.png", np.zeros((480, 640), np.uint8))
        image(tmp_path / f"fr3_walk/depth/{i}.png", np.full((480, 640), 9000, np.uint16))
    assert open_source(tmp_path / "fr3_walk").camera == Camera.preset("fr3").rectified()


def test_sun3d_counts_eight_to_a_millimetre(folder):
    """And names its images by number and microseconds."""
    for i in range(4):
        name = f"{i + 1:07}-{33333 * i:012}"
        image(folder / f"image/{name}.jpg", GREYS[i])
        image(folder / f"depth/{name}.png", 8 * kinect(np.geomspace(0.8, 3.0, 120 * 160).reshape(120, 160), 1000))
    np.savetxt(folder / "intrinsics.txt", MATRIX)
    sequence = open_part(str(folder))
    assert sequence.camera.depth_scale == 8000 and sequence.camera.fx == CAMERA.fx
    np.testing.assert_allclose(sequence.timestamps, np.arange(4) * 0.033333, atol=1e-9)


@pytest.mark.parametrize("scale", [1000.0, 5000.0])
def test_the_unit_of_a_plain_folder_is_seen_where_nobody_says_it(folder, scale):
    wrote(folder, "plain")
    for i in range(4):
        (folder / f"depth/{i}.tiff").unlink()
        image(folder / f"depth/{i}.png", kinect(np.geomspace(0.8, 3.0, 120 * 160).reshape(120, 160), scale))
    assert open_part(str(folder)).camera.depth_scale == scale
    (folder / "camera.yaml").write_text((folder / "camera.yaml").read_text() + f"depth_scale: {6000 - scale}\n")
    with pytest.raises(GavoError, match=f"--depth-scale {scale:g}"):
        open_part(str(folder))


@pytest.mark.parametrize("name", ["tum", "plain", "seven_scenes"])
def test_a_camera_of_numbers_alone_takes_the_images_size(folder, tmp_path, name):
    (tmp_path / "mine.txt").write_text("130 130 80 60\n")
    camera = open_source(wrote(folder, name), Reading(camera=str(tmp_path / "mine.txt"))).camera
    assert (camera.fx, camera.width, camera.height) == (130, 160, 120)


def test_a_camera_that_is_named_goes_before_the_folders_own(folder):
    mine = Camera(130.0, 130.0, 80.0, 60.0, 160, 120, depth_scale=1000.0)
    assert open_source(wrote(folder, "open3d"), Reading(camera=mine)).camera == mine
    assert open_source(folder, Reading(camera=mine, depth_scale=2000)).camera.depth_scale == 2000


def test_a_room_of_replica_needs_no_truth(folder):
    wrote(folder, "replica")
    frames = len(open_source(folder))
    (folder / "traj.txt").unlink()
    sequence = open_source(folder)
    assert recognise(folder).kind == "Replica room" and len(sequence) == frames and sequence.ground_truth is None


@pytest.mark.parametrize("name", ["plain", "replica", "seven_scenes"])
def test_one_image_of_another_size_is_not_the_size_of_all(folder, name):
    """Whose camera file does not say it, or does: the odd image is named."""
    wrote(folder, name)
    first = {"plain": "rgb/0.png", "replica": "results/frame000000.jpg", "seven_scenes": "frame-000000.color.png"}[name]
    image(folder / first, GREYS[0][:60])
    if name == "plain":
        (folder / "camera.yaml").unlink()
        (folder / "camera.txt").write_text("131 131 79.5 59.5")
        (folder / "camera.txt").rename(folder / "intrinsics.txt")
    with pytest.raises(GavoError, match=rf"{first}: is 160x60 pixels, but the camera's images are 160x120"):
        open_part(str(folder))


@pytest.mark.parametrize("raw_value", [0, 65535])
def test_a_source_without_any_depth_is_refused(folder, raw_value):
    wrote(folder, "plain")
    for i in range(4):
        (folder / f"depth/{i}.tiff").unlink()
        image(folder / f"depth/{i}.png", np.full((120, 160), raw_value, np.uint16))
    with pytest.raises(GavoError, match=r"clip: no depth readings in the 4 frames .*--force"):
        open_part(str(folder))
    assert len(open_part(str(folder), force=True)) == 4
    image(folder / "depth/3.png", np.full((120, 160), 1500, np.uint16))
    assert len(open_part(str(folder))) == 4  # a sensor may start late


@pytest.mark.parametrize("turn", [[1.0, 1.0, 1.0], [-1.0, 1.0, -1.0]])
def test_depth_that_falls_nowhere_into_the_image_is_refused(folder, turn):
    """By a shift in another unit, or a camera that looks the other way."""
    wrote(folder, "plain")
    pose = np.diag([*turn, 1.0])
    pose[0, 3] = 9.0 if turn[0] > 0 else 0.03
    mine = "\n".join(f"{k} = {getattr(CAMERA, k)}" for k in ("fx", "fy", "cx", "cy", "width", "height"))
    (folder / "camera.yaml").unlink()
    (folder / "camera.toml").write_text(f"{mine}\ncolour_T_depth = {pose.tolist()}\n[depth]\n{mine}\n")
    with pytest.raises(GavoError, match=r"clip: no depth reading of the 4 frames .* colour_T_depth .*--force"):
        open_part(str(folder))
    assert len(open_part(str(folder), force=True)) == 4


def test_colour_may_be_arrays(folder):
    for i in range(3):
        image(folder / f"rgb/{i}.npy", np.dstack([GREYS[i]] * 3))
        image(folder / f"depth/{i}.npy", METRES[i].astype(np.float32))
    sequence = open_source(folder, Reading(camera=CAMERA))
    np.testing.assert_array_equal(sequence[2].grey, GREYS[2])


def test_what_lacks_images_says_which(folder):
    wrote(folder, "plain")
    for i in range(4):
        (folder / f"rgb/{i}.png").rename(folder / f"rgb/{i}.raw")
    with pytest.raises(
        GavoError, match=r"clip: no colour images in rgb \(0\.raw, 1\.raw.*\): expected .* ending in \.png, "
    ):
        open_source(folder)
    shutil.rmtree(folder / "depth")
    (folder / "depth").mkdir()
    for i in range(4):
        (folder / f"rgb/{i}.raw").rename(folder / f"rgb/{i}.png")
    with pytest.raises(GavoError, match=r"clip: no depth images in depth \(empty\): expected names ending in \.png, "):
        open_source(folder)


@pytest.mark.parametrize("inside", ["rgb", "rgb/0.png", "camera.yaml"])
def test_a_part_of_a_source_names_its_folder(folder, inside):
    wrote(folder, "plain")
    with pytest.raises(
        GavoError, match=rf"{inside}: a (file|folder) inside a source: pass (its folder|the source), {folder}$"
    ):
        open_source(folder / inside)


REFUSED = {
    "an empty folder": (lambda f: shutil.rmtree(f / "rgb") or shutil.rmtree(f / "depth"), "plain", "camera.yaml"),
    "no camera": (lambda f: (f / "camera.yaml").unlink(), "plain", "--camera"),
    "a pose of text": (
        lambda f: (f / "frame-000001.pose.txt").write_text("a b\n"),
        "seven_scenes",
        "000001.pose.txt: ",
    ),
    "a pose of zeros": (
        lambda f: np.savetxt(f / "frame-000001.pose.txt", np.zeros((4, 4))),
        "seven_scenes",
        "not a rotation",
    ),
    "no pose": (lambda f: (f / "traj.txt").write_text("# none\n"), "replica", "traj.txt: contains no trajectory"),
    "half a pose": (lambda f: (f / "traj.txt").write_text("1 0 0 0 1\n"), "replica", "traj.txt:1: "),
    "a matrix of text": (lambda f: (f / "camera-intrinsics.txt").write_text("x"), "seven_scenes", "intrinsics.txt: "),
    "no number in common": (
        lambda f: [file.rename(file.with_name(f"7{file.name}")) for file in list((f / "depth").iterdir())],
        "scannet",
        "no two with the same number",
    ),
    "an intrinsics file of something else": (
        lambda f: (f / "camera_intrinsic.json").write_text('{"width": 3}'),
        "open3d",
        "camera_intrinsic.json: ",
    ),
    "a torn intrinsics file": (lambda f: (f / "camera_intrinsic.json").write_text("{"), "open3d", "not JSON"),
    "a camera of another size": (
        lambda f: (f / "cam_params.json").write_text((f / "cam_params.json").read_text().replace("160", "320")),
        "replica",
        "160x120",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_faulty_folder_is_refused_in_one_line(folder, name):
    damage, layout, fault = REFUSED[name]
    damage(wrote(folder, layout))
    with pytest.raises(GavoError) as caught:
        open_part(str(folder))
    message = str(caught.value)
    assert str(folder) in message and fault in message and len(message.splitlines()) == 1, message


def test_what_is_no_source_says_what_is_there(tmp_path):
    with pytest.raises(GavoError, match=r"nowhere: no such folder or file"):
        open_source(tmp_path / "nowhere")
    with pytest.raises(GavoError, match=r"an empty folder, not one of: .*TUM RGB-D folder"):
        open_source(tmp_path)
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(GavoError, match=r"a folder of notes\.txt: not one of"):
        open_source(tmp_path)
    with pytest.raises(GavoError, match=r"notes\.txt: a file of 5 bytes"):
        open_source(tmp_path / "notes.txt")
    (tmp_path / "walk.bag").write_bytes(b"")
    with pytest.raises(GavoError, match=r"not a source itself, but a folder of one: pass .*/walk\.bag$"):
        open_source(tmp_path)
    (tmp_path / "walk.bag").unlink()
    LAYOUTS["replica"][1](tmp_path / "room0")
    with pytest.raises(GavoError, match=r"traj\.txt: a file inside a source: pass its folder, .*room0$"):
        open_source(tmp_path / "room0/traj.txt")
    with pytest.raises(GavoError, match=r"not a source itself, but a folder of one: pass .*/room0$"):
        open_source(tmp_path)


@pytest.mark.parametrize("names", ["arkitscenes", "tartanair"])
def test_folders_and_files_as_other_datasets_name_them(folder, names):
    for i, (grey, metres) in enumerate(zip(GREYS, METRES, strict=True)):
        if names == "arkitscenes":
            for kind, pixels in (("wide", grey), ("depth", raw(metres, 1000))):
                image(folder / f"lowres_{kind}/41069021_{4097.9 + i / 30:.3f}.png", pixels)
        else:
            image(folder / f"image_left/{i:06}_left.png", grey)
            image(folder / f"depth_left/{i:06}_left_depth.npy", metres.astype(np.float32))
    sequence = open_source(folder, Reading(camera=CAMERA, depth_scale=1000.0 if names == "arkitscenes" else None))
    first = 4097.9 if names == "arkitscenes" else 0.0
    np.testing.assert_allclose(sequence.timestamps, first + np.arange(4) / 30, atol=1e-3)
    depth, camera = sequence[2].depth, sequence.camera
    np.testing.assert_allclose(depth / camera.depth_scale, METRES[2], atol=1e-3)


@pytest.mark.parametrize("name", ["intrinsics.json", "intrinsics.yaml", "calibration.json", "transforms.json"])
def test_a_camera_file_is_found_by_any_of_its_usual_names(folder, name):
    wrote(folder, "plain")
    (folder / "camera.yaml").unlink()
    (folder / name).write_text(json.dumps({"K": MATRIX.tolist(), "width": 160, "height": 120}))
    sequence = open_source(folder)
    assert sequence.camera.fx == 131 and sequence.calibration.origin.endswith(name)  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("up", ["", "../"])
@pytest.mark.parametrize("name", ["camera_intrinsics.txt", "intrinsics_color.txt", "intrinsic/intrinsic_color.txt"])
def test_a_camera_of_colour_is_found_and_that_of_depth_has_to_agree(folder, name, up):
    (folder / "scene").mkdir()
    wrote(folder / "scene", "plain")
    (folder / "scene/camera.yaml").unlink()
    file = folder / "scene" / up / name
    file.parent.mkdir(exist_ok=True)
    file.write_text("131 0 79.5 0\n0 131 59.5 0\n0 0 1 0\n0 0 0 1\n")
    assert open_source(folder / "scene").camera.fx == 131
    if "color" not in name:
        return
    depth = file.with_name(file.name.replace("color", "depth"))
    depth.write_text(file.read_text())
    assert open_source(folder / "scene").camera.fx == 131
    depth.write_text("140 0 79.5 0\n0 140 59.5 0\n0 0 1 0\n0 0 0 1\n")
    with pytest.raises(
        GavoError, match=r"_color\.txt: intrinsics?_depth\.txt beside it belongs to another camera: pass --cam"
    ):
        open_source(folder / "scene")


@pytest.mark.parametrize("name", ["intrinsic.txt", "cam_K.txt", "K.txt"])
def test_a_matrix_by_its_short_names_is_the_camera(folder, name):
    """It was not found; other camera files go before it."""
    wrote(folder, "plain")
    (folder / name).write_text("140 0 79.5\n0 140 59.5\n0 0 1\n")
    assert open_source(folder).camera.fx == 131
    (folder / "camera.yaml").unlink()
    assert open_source(folder).camera.fx == 140


@pytest.mark.parametrize("name", ["rgb_intrinsics.txt", "Calib_left.yaml", "K_rgb.txt", "my_camera.JSON"])
def test_a_file_that_may_be_the_cameras_is_named(folder, name):
    """Nothing told that it had been seen."""
    wrote(folder, "plain")
    (folder / "camera.yaml").rename(folder / name)
    for other in ("camera_poses.txt", "calibration.pdf", "Kitchen.txt", "extrinsics_cam.txt"):
        (folder / other).touch()
    with pytest.raises(GavoError, match=rf"no camera file in it, .*; if it is in {name}: --camera .*/{name}$"):
        open_source(folder)


def test_the_camera_of_record3d_is_found_and_no_other_metadata(folder):
    wrote(folder, "plain")
    (folder / "camera.yaml").unlink()
    (folder / "metadata.json").write_text(json.dumps({"title": "a walk", "fps": 30}))
    with pytest.raises(GavoError, match="no camera file in it"):
        open_source(folder)
    recorded = {"w": 160, "h": 120, "K": MATRIX.T.ravel().tolist(), "fps": 30, "poses": []}
    (folder / "metadata.json").write_text(json.dumps(recorded))
    assert open_source(folder).camera.fx == 131
    assert recognise(folder).kind == "export of Record3D"


@pytest.mark.parametrize(
    ("told", "rate", "expected"),
    [
        ({"fps": 60}, None, np.arange(4) / 60),
        ({"fps": 60}, 10.0, np.arange(4) / 10),
        ({"fps": "fast"}, None, np.arange(4) / 30),
        ({"fps": 60, "frameTimestamps": [7.0, 7.02, 7.1, 7.13, 7.2]}, None, [7.0, 7.02, 7.1, 7.13]),
        ({"frameTimestamps": [7.0, 7.02]}, None, "only 2 times, but there is a frame 2"),
        ({"frameTimestamps": [7.0, 7.0, 7.1, 7.2]}, None, "expected increasing seconds"),
        ({"frameTimestamps": [7.0, "x", 7.1, 7.2]}, None, "expected increasing seconds"),
    ],
)
def test_frames_of_record3d_have_the_times_that_it_tells(folder, told, rate, expected):
    wrote(folder, "plain")
    (folder / "camera.yaml").unlink()
    for part in ("rgb", "depth"):
        for i, file in enumerate(sorted((folder / part).iterdir())):
            file.rename(file.with_name(f"{i}{file.suffix}"))
    recorded = {"w": 160, "h": 120, "K": MATRIX.T.ravel().tolist(), **told}
    (folder / "metadata.json").write_text(json.dumps(recorded))
    if isinstance(expected, str):
        with pytest.raises(GavoError, match=expected):
            open_source(folder, Reading(rate=rate))
    else:
        np.testing.assert_allclose(open_source(folder, Reading(rate=rate)).timestamps, expected, atol=1e-9)


def test_a_film_beside_depth_says_how_its_frames_become_images(folder):
    """As a phone's recorder leaves them."""
    (folder / "depth").mkdir()
    image(folder / "depth/000000.png", raw(METRES[0], 1000))
    (folder / "rgb.mp4").write_bytes(b"hello")
    with pytest.raises(GavoError, match=r"clip: rgb\.mp4: a film: .*into rgb/ beside depth/ \(ffmpeg"):
        open_source(folder)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
def test_a_pipe_is_no_recording(tmp_path):
    """To open it would wait for ever."""
    os.mkfifo(tmp_path / "x.bag")
    with pytest.raises(GavoError, match=r"x\.bag: a file of 0 bytes, not one of"):
        open_source(tmp_path / "x.bag")


@pytest.mark.parametrize("name", ["depth_scale", "rate", "max_difference"])
@pytest.mark.parametrize("value", ["30", [], float("nan"), 0, -1.0, True])
def test_a_reading_of_no_positive_number_is_refused_by_name(name, value):
    with pytest.raises(GavoError, match=f"Reading: {name}: "):
        Reading(**{name: value})


def test_a_camera_in_place_of_a_reading_is_told(tmp_path):
    with pytest.raises(GavoError, match=r"expected a Reading, got str: use gavo\.Reading\(camera=…\)"):
        open_source(tmp_path, "fr1")  # pyright: ignore[reportArgumentType]


class Lines:
    """A dataset of somebody else's: files that name a room's frames."""

    kind: ClassVar[str] = "a file of lines"

    @staticmethod
    def recognises(path: Path) -> bool:
        return path.suffix == ".lines"

    @staticmethod
    def open(path: Path, reading: Reading) -> Sequence:
        from written_folders import ROOM

        return ROOM


class Entry:
    name, value = "lines", "own_package:Lines"

    @staticmethod
    def load() -> type[Lines]:
        return Lines


@pytest.fixture
def no_plugins(monkeypatch):
    """Forget what is registered, before and after."""
    monkeypatch.setattr(registry, "_registered", [])
    registry.faulty_plugins.cache_clear()
    yield monkeypatch
    registry.faulty_plugins.cache_clear()


@pytest.mark.parametrize("by_entry_point", [True, False])
def test_other_packages_bring_datasets(tmp_path, no_plugins, by_entry_point):
    (tmp_path / "x.lines").write_text("")
    if by_entry_point:
        no_plugins.setattr(registry, "entry_points", lambda group: [Entry] * (group == "gavo_jax.datasets"))
    else:
        register_dataset(Lines)
    assert len(open_source(tmp_path / "x.lines")) == 4


@pytest.mark.parametrize("fault", ["load", "recognises"])
def test_a_faulty_dataset_of_others_is_named(tmp_path, no_plugins, fault):
    def raises(*arguments: object) -> None:
        raise RuntimeError("no\nway")

    broken = type("Broken", (Entry if fault == "load" else Lines,), {fault: staticmethod(raises), "kind": "odd"})
    if fault == "load":
        no_plugins.setattr(registry, "entry_points", lambda group: [broken])
    else:
        register_dataset(broken)  # pyright: ignore[reportArgumentType]
    with pytest.raises(GavoError, match="(own_package:Lines.*|'odd'.*): no way"):
        open_source(tmp_path)
    (tmp_path / "room").mkdir()  # what others recognise does not ask for it
    LAYOUTS["plain"][1](tmp_path / "room")
    assert len(open_source(tmp_path / "room")) == len(GREYS)


@pytest.mark.parametrize(
    ("opened", "words"),
    [
        (lambda *_: None, "open returns NoneType, not a Sequence: it has no camera, "),
        (lambda path, reading: [path], "open returns list, not a Sequence: it has no camera, timestamps, name, "),
        (lambda *_: 1 / 0, "division by zero"),
    ],
)
def test_a_dataset_of_others_that_opens_no_sequence_is_named(tmp_path, no_plugins, opened, words):
    (tmp_path / "x.lines").write_text("")
    register_dataset(type("Broken", (Lines,), {"open": staticmethod(opened)}))  # pyright: ignore[reportArgumentType]
    with pytest.raises(GavoError, match=rf"^dataset 'a file of lines': .*x\.lines: {words}"):
        open_source(tmp_path / "x.lines")


class Unbound:
    """Its methods want an object of the class."""

    kind = "unbound"

    def recognises(self, path: Path) -> bool:
        return path.suffix == ".lines"

    def open(self, path: Path, reading: Reading) -> Sequence:
        return Lines.open(path, reading)


@pytest.mark.parametrize(
    ("dataset", "words"),
    [
        (type("Empty", (), {}), "Empty: kind"),
        (type("Named", (), {"kind": "named"}), r"Named: has no recognises\(path\)"),
        (type("Half", (), {"kind": "half", "recognises": staticmethod(len)}), r"Half: has no open\(path, reading\)"),
        (Unbound, r"Unbound: cannot be called as recognises\(path\): make it a classmethod"),
    ],
)
def test_what_is_no_dataset_is_refused_at_once(no_plugins, dataset, words):
    with pytest.raises(GavoError, match=f"^dataset {words}"):
        register_dataset(dataset)
    assert not registry._registered
    register_dataset(Unbound())
    assert registry._registered


def test_red_kitchen_by_its_folder_alone(data_dir):
    sequence = open_part(str(data_dir / "redkitchen_7scenes"))
    assert len(sequence) == 60 and sequence.camera == Camera(585, 585, 320, 240, 640, 480, depth_scale=1000)
    frame = sequence[0]
    assert 0.5 < np.median(frame.depth[frame.depth > 0]) / 1000 < 4 and frame.depth.max() < 65535
    assert sequence.ground_truth is not None and len(sequence.ground_truth) == 60
    with pytest.raises((IndexError, FrameError)):
        sequence[60]


@pytest.mark.parametrize("name", LAYOUTS)
def test_links_to_folders_and_files_are_followed(folder, name):
    """Everything that lies in the folder is moved to another place, and linked from there."""
    wrote(folder, name)
    disk = folder.parent / "disk"
    disk.mkdir()
    for part in list(folder.iterdir()):
        part.rename(disk / part.name)
        part.symlink_to(disk / part.name)
    (folder.parent / "link").symlink_to(folder)
    sequence = open_source(folder.parent / "link")
    sequence.check()
    assert recognise(folder.parent / "link").kind == LAYOUTS[name][0] and len(sequence) == 4
    assert (sequence.ground_truth is None) == (open_source(folder).ground_truth is None)


def test_a_camera_that_says_no_unit_has_that_of_the_source(tmp_path):
    """A camera made in Python always has one: TUM's, where nobody said another."""
    bare = Camera(131.0, 131.0, 79.5, 59.5, 160, 120)
    file = tmp_path / "bare.toml"
    file.write_text("fx = 131.0\nfy = 131.0\ncx = 79.5\ncy = 59.5\nwidth = 160\nheight = 120\n")
    for name, scale in (("seven_scenes", 1000.0), ("replica", 6553.5)):
        folder = tmp_path / name
        folder.mkdir()
        LAYOUTS[name][1](folder)
        for camera in (bare, str(file)):
            assert open_source(folder, Reading(camera=camera)).camera.depth_scale == scale, (name, camera)
        said = Reading(camera=dataclasses.replace(bare, depth_scale=2000.0))
        assert open_source(folder, said).camera.depth_scale == 2000
