"""Recordings of ROS 1 and ROS 2, raw and compressed: the frames that were recorded, whatever the order of asking."""

import gc
import os
import re
import struct
import sys
import threading
import tracemalloc
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from written_bags import COLOR, COMPRESSIONS, DEPTH, KINDS, STYLES, Recorder, Shot, record
from written_folders import CAMERA, GREYS, METRES

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import FrameError
from gavo_jax.datasets.files import Reading
from gavo_jax.datasets.recordings import recording
from gavo_jax.datasets.recordings.bags import BagSequence
from gavo_jax.datasets.recordings.messages import HALVED, LAYOUTS, color_of, depth_of, encoding_of, is_depth
from gavo_jax.datasets.registry import open_source
from gavo_jax.errors import GavoError
from gavo_jax.inspection import summary

MILLIMETRES = [np.round(metres * 1000).astype(np.uint16) for metres in METRES]
STAMPS = [1305031102.175304 + i / 30 for i in range(4)]
LENS = replace(CAMERA, distortion=(0.05, -0.1, 0.001, 0.0, 0.02))
BGRS = [cv2.applyColorMap(grey, cv2.COLORMAP_BONE) for grey in GREYS]

SUFFIX = {"ros1": ".bag", "sqlite": "", "mcap": ""}
"""Ending of a recording's name, by its kind."""


def shots(depths: list[np.ndarray] = MILLIMETRES, delay: float = 0.004) -> list[Shot]:
    return [Shot(*parts, parts[0] + delay) for parts in zip(STAMPS, BGRS, depths, strict=True)]


@pytest.fixture(scope="module")
def bags(tmp_path_factory) -> dict[tuple[str, str, str], Path]:
    """Every kind, style and type of depth."""
    folder = tmp_path_factory.mktemp("bags")
    floats = [metres.astype(np.float32) for metres in METRES]
    return {
        (kind, style, name): record(folder / f"{kind}_{style}_{name}", kind, style, shots(depths), CAMERA)
        for kind in KINDS
        for style in STYLES
        for name, depths in (("u16", MILLIMETRES), ("f32", floats))
    }


@pytest.mark.parametrize("name", ["u16", "f32"])
@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("kind", KINDS)
def test_frames_come_as_recorded(bags, kind, style, name):
    sequence = open_source(bags[kind, style, name], Reading(color=True))
    sequence.check()
    assert isinstance(sequence, BagSequence) and len(sequence) == 4 and sequence.left_out == []
    np.testing.assert_allclose(sequence.timestamps, STAMPS, atol=1e-6)
    expected = replace(CAMERA, depth_scale=5000.0 if name == "f32" else 1000.0)
    assert sequence.camera == expected and sequence.calibration.origin.endswith("/camera_info")
    for i, frame in enumerate(sequence):
        assert frame.depth_timestamp == pytest.approx(STAMPS[i] + 0.004, abs=1e-6) and frame.color is not None
        assert np.abs(frame.color[..., ::-1].astype(int) - BGRS[i]).mean() < (3 if style == "jpeg" else 0.01)
        tolerance = 0.0006 if style == "raw" or name == "u16" else 0.004
        assert np.abs(frame.depth / sequence.camera.depth_scale - METRES[i]).max() < tolerance


@pytest.mark.parametrize("kind", KINDS)
def test_frames_can_be_asked_for_in_any_order_and_from_any_thread(bags, kind):
    sequence = open_source(bags[kind, "raw", "u16"])
    depths = [frame.depth for frame in sequence]
    for index in (2, 0, 3, 3, 1, -1, 0):
        np.testing.assert_array_equal(sequence[index].depth, depths[index])
    np.testing.assert_array_equal(sequence[1:4:2][1].depth, depths[3])
    with pytest.raises(IndexError):
        sequence[4]
    found = []
    threads = [threading.Thread(target=lambda i=i: found.append((i, sequence[i].depth))) for i in (3, 1, 2, 0)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 4 and all(np.array_equal(depth, depths[i]) for i, depth in found)


@pytest.mark.parametrize("kind", KINDS)
def test_far_frames_are_gone_to(tmp_path, kind):
    """Messages that come in the order of their arrival, not of their stamps, and frames far from one another."""
    recorder = Recorder(tmp_path / ("x.bag" if kind == "ros1" else "x"), kind)
    recorder.info("/camera/color/camera_info", 0.5, CAMERA)
    for i in range(300):
        pixels = np.full((120, 160), i, np.uint16)
        for at, (topic, encoding) in enumerate(((COLOR, "mono16"), (DEPTH, "16UC1"))):
            late = 1.0 + i / 30 + (0.1 if i % 7 == at else 0.0)
            recorder.image(topic, 1.0 + i / 30, pixels, encoding, late)
    recorder.close()
    sequence = open_source(recorder.writer.path)
    assert len(sequence) == 300
    for index in (0, 1, 250, 251, 3, 299, 7, 8, 9, 150):
        assert np.all(sequence[index].depth == index)
    for index in range(0, 300, 40):
        assert np.all(sequence[::40][index // 40].depth == index)


def test_a_single_file_of_ros_2_will_do(bags):
    for kind, ending in (("mcap", ".mcap"), ("sqlite", ".db3")):
        file = next(bags[kind, "raw", "u16"].glob(f"*{ending}"))
        assert len(open_source(file)) == 4


def test_the_lens_is_the_recordings(tmp_path):
    path = record(tmp_path / "lens", "mcap", "raw", shots(), LENS)
    sequence = open_source(path)
    assert isinstance(sequence, BagSequence) and sequence.calibration.color.distortion == LENS.distortion
    assert not sequence.camera.is_distorted and (sequence[0].depth == 0).mean() > 0.02
    assert open_source(path, Reading(undistort=False)).camera.distortion == LENS.distortion


@pytest.mark.parametrize(("scale", "expected"), [(1000.0, 1000.0), (5000.0, 5000.0)])
def test_a_presets_scale_is_that_of_its_files(tmp_path, scale, expected):
    """Messages have millimetres, by convention; the images of a benchmark that were recorded as they are look so."""
    big = Camera.preset("fr3")
    step = 2.85e-3
    metres = np.tile(1 / (np.round(1 / np.geomspace(0.8, 3.0, 640) / step) * step), (480, 1))
    depth, color = np.round(metres * scale).astype(np.uint16), np.zeros((480, 640, 3), np.uint8)
    path = record(tmp_path / "kinect", "ros1", "compressed", [Shot(t, color, depth) for t in (1.0, 1.1)], None)
    assert open_source(path, Reading(camera="fr3")).camera == replace(big, depth_scale=expected)
    assert open_source(path, Reading(camera="fr3", depth_scale=2000.0)).camera.depth_scale == 2000


def test_topics_are_found_by_type_or_named(tmp_path):
    recorder = Recorder(tmp_path / "many", "mcap")
    for stamp in (1.0, 1.1):
        for name in ("color", "infra1", "infra2"):
            recorder.image(f"/cam/{name}/image_rect_raw", stamp, GREYS[0], "mono8")
            recorder.info(f"/cam/{name}/camera_info", stamp, LENS)
        for name in ("depth", "aligned_depth_to_color"):
            recorder.image(f"/cam/{name}/image_rect_raw", stamp, MILLIMETRES[0], "16UC1")
        recorder.info("/cam/depth/camera_info", stamp, replace(CAMERA, fx=150.0), frame="depth_optical")
    recorder.close()
    sequence = open_source(tmp_path / "many")
    assert isinstance(sequence, BagSequence) and not sequence.calibration.color.is_distorted, "images are rectified"
    reading = Reading(color_topic="/cam/infra1/image_rect_raw")
    assert isinstance(other := open_source(tmp_path / "many", reading), BagSequence)
    assert other.calibration.origin == "/cam/infra1/camera_info"
    with pytest.raises(GavoError, match=r"another camera than .*/tf_static.*--camera with a file for both"):
        open_source(tmp_path / "many", Reading(depth_topic="/cam/depth/image_rect_raw"))
    with pytest.raises(GavoError, match=r"--depth-topic: no images on '/nowhere'; there are images on /cam/aligned"):
        open_source(tmp_path / "many", Reading(depth_topic="/nowhere"))


def test_the_topics_of_azure_kinect_are_those_of_the_colour_camera(tmp_path):
    """Its driver publishes each image in the frame of either camera."""
    recorder = Recorder(tmp_path / "azure", "mcap")
    for stamp in (1.0, 1.1):
        for name in ("rgb", "rgb_to_depth", "depth", "depth_to_rgb", "ir"):
            is_depth, is_wide = name.startswith("depth"), name in ("rgb", "depth_to_rgb")
            frame = "rgb_camera_link" if is_wide else "depth_camera_link"
            pixels, encoding = (MILLIMETRES[0], "16UC1") if is_depth else (GREYS[0], "mono8")
            recorder.image(f"/{name}/image_raw", stamp, pixels, encoding, frame=frame)
            camera = CAMERA if is_wide else replace(CAMERA, fx=150.0)
            recorder.info(f"/{name}/camera_info", stamp, camera, frame=frame)
    recorder.close()
    sequence = open_source(tmp_path / "azure")
    assert isinstance(sequence, BagSequence) and sequence.calibration.depth is None
    assert [topic.name for topic in sequence._topics] == ["/rgb/image_raw", "/depth_to_rgb/image_raw"]


def test_a_recording_of_realsenses_own_tools_is_understood(tmp_path):
    """Capital letters, depth as mono16, and camera_info in a folder of its own; its depth is not registered."""
    for fx in (131.0, 150.0):
        recorder = Recorder(tmp_path / f"{fx:g}.bag", "ros1")
        for stamp in (1.0, 1.1):
            for at, name in enumerate(("Depth_0", "Color_0", "Infrared_1")):
                pixels, encoding = (MILLIMETRES[0], "mono16") if at == 0 else (GREYS[0], "mono8")
                recorder.image(f"/device_0/sensor_{at}/{name}/image/data", stamp, pixels, encoding, frame="0")
                camera = replace(CAMERA, fx=fx) if at == 0 else CAMERA
                recorder.info(f"/device_0/sensor_{at}/{name}/info/camera_info", stamp, camera, frame="")
        recorder.close()
    sequence = open_source(tmp_path / "131.bag")
    assert isinstance(sequence, BagSequence)
    assert [topic.name.split("/")[3] for topic in sequence._topics] == ["Color_0", "Depth_0"]
    assert sequence.calibration.origin == "/device_0/sensor_1/Color_0/info/camera_info"
    with pytest.raises(
        GavoError, match=r"Depth_0/image/data belongs to another camera than .*Color_0.* a file for both"
    ):
        open_source(tmp_path / "150.bag")


def of_realsense(path: Path, kind: str, units: list[float], name: str = "Depth_Units") -> Path:
    recorder = Recorder(path.with_suffix(".bag") if kind == "ros1" else path, kind)
    for unit in units:
        message = ("Float32", unit) if kind == "ros1" else ("String", str(unit))
        recorder.write(f"/device_0/sensor_0/option/{name}/value", message[0], 0.5, "std_msgs", data=message[1])
        recorder.write("/device_0/sensor_1/option/Depth_Units/value", message[0], 0.5, "std_msgs", data=message[1])
    for stamp in (1.0, 1.1):
        for at, sensor in enumerate(("Depth_0", "Color_0")):
            pixels, encoding = (MILLIMETRES[0], "mono16") if at == 0 else (GREYS[0], "mono8")
            recorder.image(f"/device_0/sensor_{at}/{sensor}/image/data", stamp, pixels, encoding, frame="0")
            recorder.info(f"/device_0/sensor_{at}/{sensor}/info/camera_info", stamp, CAMERA, frame="")
    recorder.close()
    return recorder.writer.path


@pytest.mark.parametrize(("kind", "name"), [("ros1", "Depth_Units"), ("ros1", "Depth Units"), ("mcap", "Depth_Units")])
def test_the_unit_of_depth_is_that_of_the_device(tmp_path, kind, name):
    """Depth of RealSense's SDK counted as millimetres whatever unit the recording states."""
    path = of_realsense(tmp_path / "l515", kind, [0.00025, 0.00025], name)
    sequence = open_source(path)
    assert isinstance(sequence, BagSequence) and not sequence.unit_is_assumed
    assert sequence.camera.depth_scale == sequence.depth_unit.file == 4000
    assert open_source(path, Reading(camera=CAMERA)).camera.depth_scale == 4000
    assert open_source(path, Reading(depth_scale=2000.0)).camera.depth_scale == 2000
    file = tmp_path / "own.toml"
    file.write_text("fx=131\nfy=131\ncx=79\ncy=60\nwidth=160\nheight=120\ndepth_scale=500\n")
    assert open_source(path, Reading(camera=str(file))).camera.depth_scale == 500


def test_a_unit_of_depth_that_a_device_does_not_state_is_a_guess(tmp_path):
    """Depth of RealSense's SDK counted as known to be in millimetres, even where nothing says so."""
    sequence = open_source(of_realsense(tmp_path / "silent", "ros1", []))
    assert isinstance(sequence, BagSequence) and sequence.unit_is_assumed and sequence.camera.depth_scale == 1000
    stated = open_source(tmp_path / "silent.bag", Reading(depth_scale=1000.0))
    assert isinstance(stated, BagSequence) and not stated.unit_is_assumed


@pytest.mark.parametrize(
    ("units", "words"),
    [
        ([0.001, 0.0001], "the unit of depth changes"),
        ([0.0], "expected metres per unit, found 0"),
        ([1000.0], "found 1000"),
    ],
)
def test_a_unit_of_depth_that_is_none_is_refused(tmp_path, units, words):
    """Such a unit was ignored."""
    path = of_realsense(tmp_path / "odd", "ros1", units)
    with pytest.raises(GavoError, match=rf"Depth_Units/value: .*{words}.*pass --depth-scale"):
        open_source(path)
    assert open_source(path, Reading(depth_scale=1000.0)).camera.depth_scale == 1000


@pytest.mark.parametrize("kind", KINDS)
def test_depth_of_another_camera_is_registered_by_the_recordings_transforms(tmp_path, kind):
    """Colour and depth hang on one link, turned and shifted; the chain between them is followed."""
    recorder = Recorder(tmp_path / ("rig.bag" if kind == "ros1" else "rig"), kind)
    small = replace(CAMERA, fx=65.0, fy=66.0, cx=39.0, cy=30.0, width=80, height=60)
    for stamp in (1.0, 1.1):
        recorder.image("/cam/color/image_raw", stamp, GREYS[0], "mono8")
        recorder.info("/cam/color/camera_info", stamp, CAMERA, frame="color_optical")
        recorder.image("/cam/depth/image_raw", stamp, np.full((60, 80), 2000, np.uint16), "16UC1")
        recorder.info("/cam/depth/camera_info", stamp, small, frame="depth_optical")
    path = recorder.writer.path
    recorder.fixed(1.0, {("link", "depth_optical"): ([0.0, 0.0, 0.1], [0.0, 0.0, 0.0, 1.0])})
    recorder.fixed(1.0, {("/link", "color_optical"): ([0.03, 0.01, 0.0], [0.0, 0.0, np.sin(0.1), np.cos(0.1)])})
    recorder.close()
    sequence = open_source(path)
    assert isinstance(sequence, BagSequence) and sequence.calibration.color_T_depth is not None
    link_T_color = np.eye(4)
    link_T_color[:2, :2] = [[np.cos(0.2), -np.sin(0.2)], [np.sin(0.2), np.cos(0.2)]]
    link_T_color[:3, 3] = 0.03, 0.01, 0.0
    link_T_depth = np.eye(4)
    link_T_depth[2, 3] = 0.1
    np.testing.assert_allclose(
        sequence.calibration.color_T_depth, np.linalg.inv(link_T_color) @ link_T_depth, atol=1e-9
    )
    depth = sequence[0].depth
    assert depth.shape == (120, 160) and 0.5 < (depth > 0).mean() < 1 and np.all(depth[depth > 0] == 2100)


def with_transforms(path: Path, topic: str, transforms: list[tuple[list[float], list[float]]]) -> BagSequence:
    """A recording of colour and of depth of another camera, whose place in colour's frame is said again and again."""
    recorder = Recorder(path, "mcap")
    for i, transform in enumerate(transforms):
        stamp = 1 + i / 10
        recorder.image("/cam/color/image_raw", stamp, GREYS[0], "mono8")
        recorder.info("/cam/color/camera_info", stamp, CAMERA, frame="color")
        recorder.image("/cam/depth/image_raw", stamp, MILLIMETRES[0], "16UC1")
        recorder.info("/cam/depth/camera_info", stamp, replace(CAMERA, fx=120.0), frame="depth")
        recorder.fixed(stamp, {("color", "depth"): transform, ("map", "color"): ([i, 0, 0], [0, 0, 0, 1])}, topic)
    recorder.close()
    sequence = open_source(path)
    assert isinstance(sequence, BagSequence)
    return sequence


UPRIGHT = [0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize("topic", ["/tf", "/tf_static"])
def test_transforms_that_never_change_are_fixed_wherever_they_stand(tmp_path, topic):
    sequence = with_transforms(tmp_path / "still", topic, [([0.02, 0.0, 0.0], UPRIGHT)] * 3)
    moved = sequence.calibration.color_T_depth
    assert moved is not None and moved[0, 3] == 0.02 and sequence.calibration.origin.endswith(topic)


@pytest.mark.parametrize("topic", ["/tf", "/tf_static"])
@pytest.mark.parametrize(
    "transforms",
    [
        [([0.02, 0.0, 0.0], UPRIGHT), ([0.03, 0.0, 0.0], UPRIGHT), ([0.02, 0.0, 0.0], UPRIGHT)],
        [([0.02, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0])] * 2,
        [([0.02, 0.0, 0.0], [0.0, 0.0, np.nan, 1.0])] * 2,
        [([np.nan, 0.0, 0.0], UPRIGHT)] * 2,
    ],
)
def test_transforms_that_change_or_are_none_say_nothing(tmp_path, topic, transforms):
    with pytest.raises(GavoError, match="and neither /tf_static nor /tf contains a fixed transform between them: pass"):
        with_transforms(tmp_path / "none", topic, transforms)


@pytest.mark.parametrize(
    ("whole", "roi", "binning", "expected"),
    [
        (replace(CAMERA, fx=262.0, fy=264.0, cx=159.5, cy=119.5, width=320, height=240), (0, 0, 0, 0), 2, (131, 79.5)),
        (replace(CAMERA, cx=159.5, cy=119.5, width=320, height=240), (80, 60, 160, 120), 1, (131, 79.5)),
        (
            replace(CAMERA, fx=262.0, cx=319.5, cy=239.5, width=640, height=480),
            *((160, 120, 320, 240), 2, (131, 79.5)),
        ),
        (CAMERA, (0, 0, 160, 120), 0, (131, 79.5)),
        (CAMERA, (0, 0, 0, 0), 2, (131, 79.5)),
    ],
)
def test_a_camera_info_of_the_whole_sensor_becomes_that_of_the_images(tmp_path, whole, roi, binning, expected):
    recorder = Recorder(tmp_path / "part", "mcap")
    recorder.image(COLOR, 1.0, BGRS[0], "bgr8")
    recorder.image(DEPTH, 1.0, MILLIMETRES[0], "16UC1")
    for topic in (COLOR, DEPTH):
        recorder.info(topic.replace("image_raw", "camera_info"), 1.0, whole, roi=roi, binning=binning)
    recorder.close()
    sequence = open_source(tmp_path / "part")
    camera = sequence.camera
    assert (camera.fx, camera.cx, camera.cy, camera.width, camera.height) == (*expected, 59.5, 160, 120)
    assert isinstance(sequence, BagSequence) and sequence.calibration.depth is None and sequence[0].depth.any()


def test_a_region_of_the_size_of_the_whole_is_refused(tmp_path):
    recorder = Recorder(tmp_path / "part", "mcap")
    recorder.image(COLOR, 1.0, BGRS[0], "bgr8")
    recorder.image(DEPTH, 1.0, MILLIMETRES[0], "16UC1")
    recorder.info(COLOR.replace("image_raw", "camera_info"), 1.0, CAMERA, roi=(0, 60, 160, 120))
    recorder.close()
    with pytest.raises(GavoError, match=r"camera_info: a region \(roi\) starts at 0 60, but images have .* 160x120; "):
        open_source(tmp_path / "part")


def with_topics(path: Path, frames: dict[str, str], infos: bool = True) -> Path:
    """A recording of topics, each in its frame, with depth where the name's last words say so and a camera_info."""
    recorder = Recorder(path, "mcap")
    for stamp in (1.0, 1.1):
        for topic, frame in frames.items():
            is_depth = "depth" in topic.replace("depth_camera", "") and not topic.endswith(
                ("colored", "overlay", "rgb_to_depth/image_raw")
            )
            pixels, encoding = (MILLIMETRES[0], "16UC1") if is_depth else (BGRS[0], "bgr8")
            recorder.image(topic, stamp, pixels, encoding, frame=frame)
            if infos:
                recorder.info(f"{topic.rpartition('/')[0]}/camera_info", stamp, CAMERA, frame=frame)
    recorder.close()
    return path


def topics_of(path: Path, reading: Reading | None = None) -> list[str]:
    sequence = open_source(path, reading or Reading(camera=CAMERA))
    assert isinstance(sequence, BagSequence)
    return [topic.name for topic in sequence._topics]


@pytest.mark.parametrize("frames", [("front", "rear"), ("optical", "optical"), ("", "")])
@pytest.mark.parametrize(
    ("color", "depth"),
    [
        ("/front/color/image_raw", "/rear/aligned_depth_to_color/image_raw"),
        ("/robot/front/image_raw", "/robot/rear/depth_registered/image"),
        ("/device_0/sensor_1/Color_0/image/data", "/device_1/sensor_0/depth_0/image/data"),
        ("/usb_cam/image_raw", "/camera/depth/image_raw"),
        ("/front_rgb", "/rear_depth"),
    ],
)
def test_colour_of_one_camera_and_depth_of_another_are_no_pair(tmp_path, color, depth, frames):
    """The word aligned says of depth that it lies on the colour of its own camera."""
    path = with_topics(tmp_path / "rig", dict(zip((color, depth), frames, strict=True)))
    for reading in (Reading(), Reading(color_topic=color), Reading(depth_topic=depth), Reading(camera=CAMERA)):
        with pytest.raises(
            GavoError, match=f"{color} and {depth} belong to two cameras.*--colour-topic and --depth-topic"
        ):
            open_source(path, reading)
    both = Reading(color_topic=color, depth_topic=depth)
    assert topics_of(path, replace(both, camera=CAMERA)) == [color, depth]
    if color.count("/") > 1 and frames == ("front", "rear"):
        with pytest.raises(GavoError, match=f"{depth} belongs to another camera than {color}"):
            open_source(path, both)


def test_two_cameras_that_the_recordings_transforms_join_are_a_pair(tmp_path):
    color, depth = "/wide/color/image_raw", "/tof/aligned_depth/image_raw"
    recorder = Recorder(tmp_path / "rig", "mcap")
    recorder.fixed(1.0, {("wide", "tof"): ([0.1, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])})
    for stamp in (1.0, 1.1):
        for topic, pixels, encoding in ((color, BGRS[0], "bgr8"), (depth, MILLIMETRES[0], "16UC1")):
            place = topic.split("/")[1]
            recorder.image(topic, stamp, pixels, encoding, frame=place)
            recorder.info(f"{topic.rpartition('/')[0]}/camera_info", stamp, CAMERA, frame=place)
    recorder.close()
    sequence = open_source(tmp_path / "rig")
    assert isinstance(sequence, BagSequence) and sequence.calibration.color_T_depth is not None
    assert sequence.calibration.color_T_depth[0, 3] == 0.1


@pytest.mark.parametrize(
    ("front", "rear"),
    [
        (("/front/rgb/image_raw", "/front/depth/image_raw"), ("/rear/image_raw", "/rear/depth_registered/image_raw")),
        (("/front_rgb", "/front_depth"), ("/rear_image", "/rear_depth_registered")),
        (
            ("/cam1/color/image_raw", "/cam1/aligned_depth_to_color/image_raw"),
            ("/cam2/color/image", "/cam2/depth/image"),
        ),
    ],
)
def test_of_two_cameras_one_is_to_be_named(tmp_path, front, rear):
    path = with_topics(tmp_path / "two", dict.fromkeys(front + rear, "camera"), infos=False)
    told = f"2 cameras, {' with '.join(front)}; {' with '.join(rear)}: pass --colour-topic or --depth-topic of one"
    with pytest.raises(GavoError, match=re.escape(told)):
        open_source(path, Reading(camera=CAMERA))
    for pair in (front, rear):
        assert topics_of(path, Reading(camera=CAMERA, color_topic=pair[0])) == list(pair)
        assert topics_of(path, Reading(camera=CAMERA, depth_topic=pair[1])) == list(pair)


@pytest.mark.parametrize(
    ("color", "depth", "others"),
    [
        ("/camera/image_raw", "/camera/depth/image_raw", ["/camera/depth/image_colored"]),
        ("/camera/image_raw", "/camera/depth/image_raw", ["/detector/rgb_overlay"]),
        ("/depth_camera/image_raw", "/depth_camera/depth/image_raw", ["/depth_camera/image_depth_colored"]),
        ("/depth_camera/rgb/image", "/depth_camera/depth_image", ["/camera/image_raw", "/map/colored"]),
        ("/cam/color/image_raw", "/cam/depth/image_rect", ["/cam/infra1/image_raw", "/cam/confidence/overlay"]),
        ("/kinect/rgb_to_depth/image_raw", "/kinect/depth/image_raw", []),
        ("/front/rgb", "/front/depth", ["/rear/aligned_depth_to_color/image_raw"]),
    ],
)
def test_colour_is_that_of_the_depth_topics_camera(tmp_path, color, depth, others):
    """A picture of depth, drawn in colours, is none; nor is one that another program has drawn upon."""
    path = with_topics(tmp_path / "many", dict.fromkeys([color, depth, *others], "camera"), infos=False)
    assert topics_of(path) == [color, depth]


def test_a_picture_of_depth_is_colour_where_it_is_named(tmp_path):
    picture, depth = "/camera/depth/image_colored", "/camera/depth/image_raw"
    path = with_topics(tmp_path / "picture", {picture: "camera", depth: "camera"})
    with pytest.raises(
        GavoError, match=f"no colour images; there are images on {picture}, {depth}: pass --colour-topic"
    ):
        open_source(path)
    assert topics_of(path, Reading(color_topic=picture)) == [picture, depth]


@pytest.mark.parametrize("encoding", ["Z16", "16SC1", "32SC1", "mono16"])
def test_depth_of_another_encoding_is_called_by_it(tmp_path, encoding):
    pixels = MILLIMETRES[0].astype({"16SC1": np.int16, "32SC1": np.int32}.get(encoding, np.uint16))
    recorder = Recorder(tmp_path / "z", "mcap")
    for stamp in (1.0, 1.1):
        recorder.image("/camera/rgb/image", stamp, BGRS[0], "bgr8")
        recorder.image("/camera/depth/image", stamp, pixels, encoding)
    recorder.close()
    if encoding in ("Z16", "mono16"):
        np.testing.assert_array_equal(open_source(tmp_path / "z", Reading(camera=CAMERA))[0].depth, pixels)
        return
    told = rf"no depth images: /camera/depth/image has '{encoding}', and not 16UC1, .*pass --depth-topic"
    with pytest.raises(GavoError, match=told):
        open_source(tmp_path / "z", Reading(camera=CAMERA))


def test_brightness_of_16_bits_is_no_depth(tmp_path):
    recorder = Recorder(tmp_path / "ir", "mcap")
    for stamp in (1.0, 1.1):
        recorder.image(COLOR, stamp, BGRS[0], "bgr8")
        recorder.image("/camera/ir/image_raw", stamp, MILLIMETRES[0], "16UC1")
        recorder.image("/camera/depth/image_raw", stamp, MILLIMETRES[0], "16UC1")
    recorder.close()
    sequence = open_source(tmp_path / "ir", Reading(camera=CAMERA))
    assert isinstance(sequence, BagSequence) and sequence._topics[1].name == "/camera/depth/image_raw"


def test_of_a_topic_and_its_compressed_copy_the_former_is_read(tmp_path):
    recorder = Recorder(tmp_path / "all", "mcap")
    for shot in shots():
        for style in (STYLES["raw"], STYLES["jpeg"]):
            style(recorder, shot, shot.stamp)
    recorder.close()
    sequence = open_source(tmp_path / "all", Reading(camera=CAMERA))
    assert isinstance(sequence, BagSequence) and [topic.name for topic in sequence._topics] == [COLOR, DEPTH]


@pytest.mark.parametrize("kind", KINDS)
def test_a_camera_that_changes_within_the_recording_is_refused(tmp_path, kind):
    """As one that zooms, or whose mode was switched; rounding is no change."""
    for name, others in (("rounded", CAMERA.fx + 0.01), ("zoomed", 0.8 * CAMERA.fx)):
        recorder = Recorder(tmp_path / f"{name}{SUFFIX[kind]}", kind)
        for index, shot in enumerate(shots()):
            STYLES["raw"](recorder, shot, shot.stamp)
            camera = replace(CAMERA, fx=CAMERA.fx if index < 2 else others)
            recorder.info("/camera/color/camera_info", shot.stamp, camera)
        recorder.close()
    rounded, zoomed = (tmp_path / f"{name}{SUFFIX[kind]}" for name in ("rounded", "zoomed"))
    assert open_source(rounded).camera.fx == CAMERA.fx
    with pytest.raises(GavoError, match=r"color/camera_info: the camera changes within the recording \(fx is .*pass"):
        open_source(zoomed)
    assert open_source(zoomed, Reading(camera=CAMERA)).camera.fx == CAMERA.fx


@pytest.mark.parametrize("kind", KINDS)
def test_topics_without_messages_are_told_from_none(tmp_path, kind):
    recorder = Recorder(tmp_path / f"empty{SUFFIX[kind]}", kind)
    for topic in (COLOR, DEPTH):
        name = "sensor_msgs/msg/Image"
        recorder.connections[topic] = recorder.writer.add_connection(topic, name, typestore=recorder.store)
    recorder.info("/camera/color/camera_info", 1.0, CAMERA)
    recorder.close()
    with pytest.raises(GavoError, match=f"contains no images: no messages on {DEPTH}, {COLOR}$"):
        open_source(tmp_path / f"empty{SUFFIX[kind]}")


def test_the_files_of_a_recording_come_with_its_first_frame(bags):
    sequence = open_source(bags["mcap", "raw", "u16"])
    assert isinstance(sequence, BagSequence)
    first, *others = sequence.files
    assert others == [()] * 3 and [path.suffix for path in first] == [".mcap"] and len(sequence[:0].files) == 0


def test_a_camera_info_of_zeros_is_none(tmp_path):
    """Some drivers send some before they know better, and some never do."""
    zeros = replace(CAMERA, fx=0.0, fy=0.0, cx=0.0, cy=0.0)
    for name, cameras in (("late", [zeros, CAMERA]), ("never", [zeros, zeros])):
        recorder = Recorder(tmp_path / name, "mcap")
        for stamp, camera in zip((1.0, 1.1), cameras, strict=True):
            recorder.image(COLOR, stamp, BGRS[0], "bgr8")
            recorder.image(DEPTH, stamp, MILLIMETRES[0], "16UC1")
            camera = SimpleNamespace(**vars(camera), matrix=camera.matrix if camera.fx else np.zeros((3, 3)))
            recorder.info("/camera/color/camera_info", stamp, camera)  # pyright: ignore[reportArgumentType]
        recorder.close()
    assert open_source(tmp_path / "late").camera.fx == CAMERA.fx
    with pytest.raises(GavoError, match=r"color/camera_info: all zero, as the camera was never calibrated: pass"):
        open_source(tmp_path / "never")


@pytest.mark.parametrize(
    ("topic", "model", "lens"),
    [
        ("/direct/image", "plumb_bob", LENS),
        ("/camera/image", "equidistant", replace(CAMERA, distortion=(0.0,) * 4, model="fisheye")),
        ("/camera/image_rect_color", "plumb_bob", CAMERA),
    ],
)
def test_the_lens_goes_by_the_model_and_by_whole_words_of_the_topic(tmp_path, topic, model, lens):
    recorder = Recorder(tmp_path / "lens", "mcap")
    for stamp in (1.0, 1.1):
        recorder.image(topic, stamp, BGRS[0], "bgr8")
        recorder.image("/depth", stamp, MILLIMETRES[0], "16UC1")
        recorder.info("/".join([*topic.split("/")[:-1], "camera_info"]), stamp, LENS if lens is CAMERA else lens, model)
    recorder.close()
    sequence = open_source(tmp_path / "lens")
    assert isinstance(sequence, BagSequence)
    assert sequence.calibration.color == replace(lens, depth_scale=1000.0)


@pytest.mark.parametrize("known", [True, False])
def test_depth_of_another_frame_without_a_camera_is_not_taken_for_registered(tmp_path, known):
    recorder = Recorder(tmp_path / "apart", "mcap")
    for stamp in (1.0, 1.1):
        recorder.image("/cam/color/image_raw", stamp, BGRS[0], "bgr8", frame="color_optical")
        recorder.info("/cam/color/camera_info", stamp, CAMERA, frame="color_optical")
        recorder.image("/cam/depth/image_raw", stamp, MILLIMETRES[0], "16UC1", frame="depth_optical")
    if known:
        recorder.fixed(1.0, {("color_optical", "depth_optical"): ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])})
    recorder.close()
    if known:
        assert len(open_source(tmp_path / "apart")) == 2
        return
    with pytest.raises(GavoError, match=r"no camera_info for /cam/depth/image_raw, .*'depth_optical'.*--camera"):
        open_source(tmp_path / "apart")
    assert len(open_source(tmp_path / "apart", Reading(camera=CAMERA))) == 2


def test_one_camera_is_one_for_all_rounding(tmp_path):
    recorder = Recorder(tmp_path / "rounded", "mcap")
    for stamp in (1.0, 1.1):
        recorder.image("/cam/color/image_raw", stamp, BGRS[0], "bgr8")
        recorder.info("/cam/color/camera_info", stamp, CAMERA)
        recorder.image("/cam/depth_registered/image", stamp, MILLIMETRES[0], "16UC1")
        recorder.info("/cam/depth_registered/camera_info", stamp, replace(CAMERA, fx=131.0001), frame="other")
    recorder.close()
    sequence = open_source(tmp_path / "rounded")
    assert isinstance(sequence, BagSequence) and sequence.calibration.depth is None


@pytest.mark.parametrize("said", [True, False])
def test_two_cameras_alike_that_lie_apart_are_two(tmp_path, said):
    """A driver that nobody calibrated gives both the same numbers."""
    recorder = Recorder(tmp_path / "alike", "mcap")
    for stamp in (1.0, 1.1):
        recorder.image("/cam/rgb/image_raw", stamp, BGRS[0], "bgr8")
        recorder.info("/cam/rgb/camera_info", stamp, CAMERA, frame="rgb")
        recorder.image("/cam/depth/image_raw", stamp, MILLIMETRES[0], "16UC1")
        recorder.info("/cam/depth/camera_info", stamp, CAMERA, frame="depth")
    apart = np.eye(4)
    apart[0, 3] = -0.025
    if said:
        recorder.fixed(1.0, {("rgb", "depth"): ([-0.025, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])})
    recorder.close()
    if said:
        sequence = open_source(tmp_path / "alike")
        assert isinstance(sequence, BagSequence) and (calibration := sequence.calibration).color_T_depth is not None
        np.testing.assert_allclose(calibration.color_T_depth, apart, atol=1e-9)
    else:
        with pytest.raises(GavoError, match="to another camera"):
            open_source(tmp_path / "alike")


CAMERA_INFO = f"""image_width: 160
image_height: 120
camera_matrix: {{rows: 3, cols: 3, data: {LENS.matrix.ravel().tolist()}}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: {list(LENS.distortion)}}}
projection_matrix: {{rows: 3, cols: 4, data: [120, 0, 80, 0, 0, 121, 60, 0, 0, 0, 1, 0]}}
"""


@pytest.mark.parametrize("topic", ["image_raw", "image_rect", "image_rect_color", "image_rect/compressed"])
def test_images_that_are_rectified_are_not_undistorted_by_the_file_of_their_camera(tmp_path, topic):
    """ROS's image_proc has done it, into the camera of the projection matrix."""
    recorder = Recorder(tmp_path / "rect", "mcap")
    for stamp in (1.0, 1.1):
        if "/" in topic:
            recorder.compressed(f"/cam/rgb/{topic}", stamp, cv2.imencode(".png", BGRS[0])[1].tobytes(), "png")
        else:
            recorder.image(f"/cam/rgb/{topic}", stamp, BGRS[0], "bgr8")
        recorder.image("/cam/depth/image_raw", stamp, MILLIMETRES[0], "16UC1")
    recorder.close()
    file, bare = tmp_path / "info.yaml", tmp_path / "bare.yaml"
    file.write_text(CAMERA_INFO)
    bare.write_text("".join(CAMERA_INFO.splitlines(True)[:-1]))
    found, without = (open_source(tmp_path / "rect", Reading(camera=str(path))) for path in (file, bare))
    assert isinstance(found, BagSequence) and isinstance(without, BagSequence)
    if topic == "image_raw":
        assert found.calibration.color == without.calibration.color == replace(LENS, depth_scale=1000.0)
        assert found.calibration.origin == str(file)
        return
    assert found.calibration.color == replace(CAMERA, fx=120.0, fy=121.0, cx=80.0, cy=60.0, depth_scale=1000.0)
    assert found.calibration.origin == f"{file}, without its lens: the images are rectified"
    assert without.calibration.color == replace(CAMERA, depth_scale=1000.0)
    np.testing.assert_array_equal(found[0].grey, cv2.cvtColor(BGRS[0], cv2.COLOR_BGR2GRAY))


def test_a_camera_of_numbers_alone_has_the_recordings_size(tmp_path):
    recorder = Recorder(tmp_path / "bare", "mcap")
    for stamp in (1.0, 1.1):
        recorder.image("/cam/rgb/image_raw", stamp, BGRS[0], "bgr8")
        recorder.image("/cam/depth/image_raw", stamp, MILLIMETRES[0], "16UC1")
        recorder.image("/cam/disparity", stamp, METRES[0].astype(np.float32), "32FC1")
    recorder.close()
    (tmp_path / "k.txt").write_text("131 131 79.5 59.5")
    camera = open_source(
        tmp_path / "bare", Reading(camera=str(tmp_path / "k.txt"), color_topic="/cam/rgb/image_raw")
    ).camera
    assert (camera.width, camera.height) == (160, 120)


def test_what_a_recording_lacks_is_said(tmp_path):
    recorder = Recorder(tmp_path / "two", "sqlite")
    recorder.image("/left", 1.0, GREYS[0], "mono8")
    recorder.image("/right", 1.0, GREYS[0], "mono8")
    recorder.image("/z", 9.0, MILLIMETRES[0], "16UC1")
    recorder.close()
    for reading, fault in (
        (Reading(), "colour images on /left, /right; there are images on /left, /right, /z: pass --colour-topic"),
        (
            Reading(color_topic="/left"),
            "no stamps within 0.02 s of each other: /left goes from 1.000 to 1.000 and /z",
        ),
        (Reading(color_topic="/left", max_difference=10.0), "no camera_info for /left: pass --camera"),
    ):
        with pytest.raises(GavoError) as caught:
            open_source(tmp_path / "two", reading)
        assert fault in str(caught.value) and str(tmp_path / "two") in str(caught.value)
    for reading, fault in (
        (Reading(), "no depth images; there are images on /left, /right: pass --depth-topic"),
        (Reading(depth_topic="/right"), "/right at 1.000000: encoding 'mono8' is not depth: expected 16UC1"),
    ):
        recorder = Recorder(tmp_path / f"grey{len(fault)}", "sqlite")
        for name in ("/left", "/right"):
            recorder.image(name, 1.0, GREYS[0], "mono8")
        recorder.close()
        with pytest.raises(GavoError, match=re.escape(fault)):
            open_source(recorder.writer.path, replace(reading, camera=CAMERA)).check()
    recorder = Recorder(tmp_path / "none.bag", "ros1")
    recorder.info("/camera_info", 1.0, CAMERA)
    recorder.close()
    with pytest.raises(GavoError, match=r"none\.bag: contains no images: no topic of sensor_msgs/msg/Image"):
        open_source(tmp_path / "none.bag")


def test_messages_without_partners_are_counted(tmp_path):
    some = shots()
    some[3] = some[3]._replace(depth_stamp=STAMPS[3] + 5)
    sequence = open_source(record(tmp_path / "gap", "sqlite", "raw", some, CAMERA))
    assert isinstance(sequence, BagSequence) and len(sequence) == 3
    assert sequence.left_out == [
        f"1 of {COLOR}: none of {DEPTH} within 0.02 s",
        f"1 of {DEPTH}: none of {COLOR} within 0.02 s",
    ]


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_messages_that_come_twice_count_once(tmp_path, kind):
    """All frames were there twice, each pair of them lost."""
    path = tmp_path / ("twice.bag" if kind == "ros1" else "twice")
    recorder = Recorder(path, kind)
    for shot in shots():
        for late in (0.0, 0.001):
            recorder.image(COLOR, shot.stamp, shot.bgr, "bgr8", shot.stamp + late)
            recorder.image(DEPTH, shot.stamp, shot.depth, "16UC1", shot.stamp + late)
    recorder.close()
    sequence = open_source(path, Reading(camera=CAMERA))
    assert isinstance(sequence, BagSequence)
    np.testing.assert_allclose(sequence.timestamps, STAMPS, atol=1e-6)
    assert sequence.left_out == [f"4 of {topic}: the same stamp as an earlier one" for topic in (COLOR, DEPTH)]
    for frame, shot in zip(sequence, shots(), strict=True):
        np.testing.assert_array_equal(frame.depth, shot.depth)


def of_stamps(path: Path, kind: str, stamps: list[float], start: float = 100.0) -> BagSequence:
    """A recording whose depth has the number of its message; colour and depth arrive every tenth of a second."""
    recorder = Recorder(path.with_suffix(".bag") if kind == "ros1" else path, kind)
    for number, stamp in enumerate(stamps):
        for topic, encoding in ((COLOR, "mono16"), (DEPTH, "16UC1")):
            recorder.image(topic, stamp, np.full((12, 16), number + 1, np.uint16), encoding, start + number / 10)
    recorder.close()
    camera = replace(CAMERA, width=16, height=12, cx=7.5, cy=5.5)
    sequence = open_source(recorder.writer.path, Reading(camera=camera))
    assert isinstance(sequence, BagSequence)
    return sequence


TENTHS = [1 + number / 10 for number in range(20)]


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
@pytest.mark.parametrize(
    ("stamps", "kept", "back", "at"),
    [
        (TENTHS + TENTHS[:8], range(20), 1.9, 21),
        (TENTHS[:8] + TENTHS, range(8, 28), 0.7, 9),
        (TENTHS[:8] + [stamp + 0.02 for stamp in TENTHS], range(8, 28), 0.7, 9),
        (TENTHS + [1.06, 1.16] + TENTHS[:5], range(20), 1.8, 21),
        (TENTHS[:5] + [99.0] + TENTHS[6:], [*range(5), *range(6, 20)], 97.4, 7),
        (TENTHS[:9] + [1.0] + TENTHS[10:], [*range(9), *range(10, 20)], 0.8, 10),
        (TENTHS + [stamp + 1.55 for stamp in TENTHS[:15]], range(20), 0.4, 21),
        (TENTHS[:8] + [stamp + 0.43 for stamp in TENTHS], range(8, 28), 0.3, 9),
    ],
)
def test_of_a_clock_that_is_set_back_one_run_is_used(tmp_path, kind, stamps, kept, back, at):
    """They were sorted together: frames of one place amid those of another."""
    sequence = of_stamps(tmp_path / "reset", kind, stamps)
    assert [int(frame.depth[0, 0]) - 1 for frame in sequence] == list(kept)
    count = len(stamps) - len(kept)
    why = f"the stamps go back by {back:.1f} s at message {at}; only the longest stretch is used"
    assert sequence.left_out == [f"{count} of {topic}: {why}" for topic in (COLOR, DEPTH)]


def test_messages_that_arrive_out_of_order_are_sorted(tmp_path):
    stamps = [*TENTHS[:5], *TENTHS[9:4:-1], *TENTHS[10:]]
    sequence = of_stamps(tmp_path / "late", "mcap", stamps)
    assert sequence.left_out == [] and sequence.topics == (COLOR, DEPTH)
    assert summary(sequence).startswith(f"late: ROS bag of {COLOR} and {DEPTH}, 20 frames of 16x12; camera fx")
    np.testing.assert_allclose(sequence.timestamps, TENTHS, atol=1e-9)


@pytest.mark.parametrize(
    "late", [[(5, 6), (6, 5)], [(5, 9), (6, 5), (7, 6), (8, 7), (9, 8)], [(5, 8), (6, 9), (8, 5), (9, 6)]]
)
def test_messages_that_come_late_set_no_clock_back(tmp_path, late):
    stamps = list(TENTHS)
    for place, number in late:
        stamps[place] = TENTHS[number]
    sequence = of_stamps(tmp_path / "late", "mcap", stamps)
    assert sequence.left_out == []
    np.testing.assert_allclose(sequence.timestamps, TENTHS, atol=1e-9)


@pytest.mark.parametrize("stamp", [0.0, 77.0])
def test_stamps_of_zero_stand_for_the_time_of_arrival(tmp_path, stamp):
    """Of both topics, even where one has stamps."""
    recorder = Recorder(tmp_path / "zero", "mcap")
    for received in (5.0, 5.1):
        recorder.image(COLOR, stamp, BGRS[0], "bgr8", received)
        recorder.image(DEPTH, 0.0, MILLIMETRES[0], "16UC1", received)
    recorder.close()
    np.testing.assert_allclose(open_source(tmp_path / "zero", Reading(camera=CAMERA)).timestamps, [5.0, 5.1])


def test_stamps_before_zero_are_read_as_such(tmp_path):
    """Seconds of ROS 2 have a sign: half of such a bag was dropped, and its clock read 4294967294."""
    recorder = Recorder(tmp_path / "early", "mcap")
    for stamp in (-2.0, -1.0, 1.0):
        recorder.image(COLOR, stamp, BGRS[0], "bgr8", stamp + 10)
        recorder.image(DEPTH, stamp, MILLIMETRES[0], "16UC1", stamp + 10)
    recorder.close()
    np.testing.assert_allclose(open_source(tmp_path / "early", Reading(camera=CAMERA)).timestamps, [-2.0, -1.0, 1.0])


def test_stamps_that_stand_still_stand_for_none(tmp_path):
    recorder = Recorder(tmp_path / "still", "mcap")
    for received in (5.0, 5.1, 5.2):
        recorder.image(COLOR, 77.0, BGRS[0], "bgr8", received)
        recorder.image(DEPTH, 77.0, MILLIMETRES[0], "16UC1", received)
    recorder.close()
    np.testing.assert_allclose(open_source(tmp_path / "still", Reading(camera=CAMERA)).timestamps, [5.0, 5.1, 5.2])


@pytest.mark.parametrize(
    "reading", [Reading(color_topic=DEPTH), Reading(depth_topic=COLOR), Reading(color_topic=COLOR, depth_topic=COLOR)]
)
def test_one_topic_is_not_both(bags, reading):
    with pytest.raises(GavoError, match=r"image_raw: chosen as both colour and depth; there are images on /camera/al"):
        open_source(bags["mcap", "raw", "u16"], reading)


def test_a_film_in_messages_is_called_one(tmp_path):
    recorder = Recorder(tmp_path / "film", "mcap")
    for stamp in (1.0, 1.1):
        recorder.compressed(f"{COLOR}/compressed", stamp, b"\0\0\0\1" + bytes(90), "h264")
        recorder.image(DEPTH, stamp, MILLIMETRES[0], "16UC1")
    recorder.close()
    with pytest.raises(FrameError, match=r"color/image_raw/compressed at 1\.0+: a film \('h264'\), .*JPEG or PNG"):
        open_source(tmp_path / "film", Reading(camera=CAMERA)).check()


def test_an_ending_in_capitals_is_to_be_written_small(tmp_path, bags):
    (tmp_path / "WALK.BAG").write_bytes(bags["ros1", "raw", "u16"].read_bytes())
    with pytest.raises(GavoError, match=r"WALK\.BAG: the suffix must be in lower case \(\.bag\): rename it"):
        open_source(tmp_path / "WALK.BAG")


def test_a_folder_of_ros_2_may_not_be_called_a_file_of_ros_1(tmp_path):
    path = record(tmp_path / "walk", "mcap", "raw", shots(), CAMERA).rename(tmp_path / "walk.bag")
    with pytest.raises(GavoError, match=r"walk\.bag: a ROS 2 folder .*: rename it"):
        open_source(path)


def test_a_message_without_a_stamp_is_left_out(tmp_path):
    recorder = Recorder(tmp_path / "one", "mcap")
    for stamp in (5.0, 0.0, 5.1):
        recorder.image(COLOR, stamp, BGRS[0], "bgr8", stamp or 5.05)
        recorder.image(DEPTH, stamp, MILLIMETRES[0], "16UC1", stamp or 5.05)
    recorder.close()
    np.testing.assert_allclose(open_source(tmp_path / "one", Reading(camera=CAMERA)).timestamps, [5.0, 5.1])


@pytest.mark.parametrize("kind", KINDS)
def test_a_torn_or_empty_recording_is_refused_in_one_line(tmp_path, kind):
    path = record(tmp_path / "torn", kind, "raw", shots(), CAMERA)
    file = path if path.is_file() else next(path.glob("*.mcap" if kind == "mcap" else "*.db3"))
    whole = file.read_bytes()
    for content in (whole[: len(whole) // 2], whole[:100], b"", b"hello" * 100):
        file.write_bytes(content)
        with pytest.raises(GavoError) as caught:
            open_source(path).check()
        assert str(path) in str(caught.value) and len(str(caught.value).splitlines()) == 1
    (tmp_path / "metadata.yaml").write_text("hello")
    with pytest.raises(GavoError):
        open_source(tmp_path)


@pytest.mark.parametrize(("kind", "compression"), COMPRESSIONS)
def test_compressed_recordings_are_read_as_others(tmp_path, bags, kind, compression):
    path = record(tmp_path / "small", kind, "raw", shots(), CAMERA, compression)
    for ours, theirs in zip(open_source(path), open_source(bags[kind, "raw", "u16"]), strict=True):
        np.testing.assert_array_equal(ours.grey, theirs.grey)
        np.testing.assert_array_equal(ours.depth, theirs.depth)
        assert ours.timestamp == theirs.timestamp


@pytest.mark.parametrize(("kind", "compression"), COMPRESSIONS)
def test_a_damaged_compressed_recording_is_one_line(tmp_path, kind, compression):
    path = record(tmp_path / "small", kind, "raw", shots(), CAMERA, compression)
    file = path if path.is_file() else next(one for one in path.iterdir() if one.suffix != ".yaml")
    whole = file.read_bytes()
    middle = len(whole) // 2
    for content in (whole[:middle], whole[:middle] + bytes(middle // 2) + whole[middle + middle // 2 :], b""):
        file.write_bytes(content)
        with pytest.raises(GavoError, match=f"^{path}: .*; download or copy it again, or repair it with") as caught:
            list(open_source(path))
        assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("kind", ["sqlite", "mcap"])
def test_what_is_compressed_says_how_it_is_to_be_named(tmp_path, kind):
    path = record(tmp_path / "messages", kind, "raw", shots(), CAMERA, "MESSAGE")
    file = next(one for one in path.iterdir() if one.suffix != ".yaml")
    with pytest.raises(GavoError, match=r"its messages are compressed \(zstd\).*metadata\.yaml.*pass the folder"):
        open_source(file)
    path = record(tmp_path / "file", kind, "raw", shots(), CAMERA, "FILE")
    file = next(one for one in path.iterdir() if one.suffix != ".yaml")
    with pytest.raises(GavoError, match=f"a file inside a source: pass its folder, {path}"):
        open_source(file)
    (path / "metadata.yaml").unlink()
    for place in (file, path):
        with pytest.raises(GavoError, match=rf"{file.name}: packed: unpack it first \(zstd -d\)"):
            open_source(place)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("walk.bag.active", ".*never closed.*rosbag reindex"),
        ("walk.zip", r"packed: unpack it first \(unzip\)"),
        ("walk.tgz", r"packed: unpack it first \(tar -xf\)"),
        ("walk.tar.gz", r"packed: unpack it first \(tar -xf\)"),
        ("walk.bag.gz", r"packed: unpack it first \(gunzip\)"),
        ("walk.sens", "a packed ScanNet scan: export it"),
        ("walk.mp4", "a film.*frames as images"),
        ("walk.mkv", "a film or an Azure Kinect recording: .*Open3D"),
        ("walk.SVO", "a ZED recording"),
        ("walk.xyz", "a file of 5 bytes, not one of"),
    ],
)
def test_files_that_hold_a_source_say_how_to_get_it_out(tmp_path, name, words):
    (tmp_path / name).write_bytes(b"hello")
    with pytest.raises(GavoError, match=f"{name}: {words}"):
        open_source(tmp_path / name)


@pytest.mark.parametrize(
    ("kind", "tool"), [("ros1", "rosbag reindex"), ("sqlite", "ros2 bag reindex"), ("mcap", "mcap recover")]
)
def test_a_torn_recording_names_what_mends_it(tmp_path, kind, tool):
    path = record(tmp_path / "torn", kind, "raw", shots(), CAMERA)
    file = path if path.is_file() else next(one for one in path.iterdir() if one.suffix != ".yaml")
    file.write_bytes(file.read_bytes()[:-5000])
    for place in {path, file}:
        with pytest.raises(GavoError, match=f"cannot be read as a bag: .*{tool}"):
            open_source(place)


@pytest.mark.parametrize(
    ("profile", "words"),
    [
        ("", "names no profile, .*ros2 bag convert"),
        ("ros1", r"its profile is 'ros1', .*pass the \.bag"),
        ("x", "its profile is 'x', and the library reads only 'ros2'"),
    ],
)
def test_an_mcap_of_another_profile_is_not_called_torn(tmp_path, profile, words):
    path = record(tmp_path / "walk", "mcap", "raw", shots(), CAMERA)
    file = next(path.glob("*.mcap"))
    whole = file.read_bytes()
    (size,) = struct.unpack_from("<I", whole, 17)
    (length,) = struct.unpack_from("<I", whole, 21 + size)
    library = whole[25 + size : 25 + size + length].decode().ljust(length + size - len(profile))
    header = b"".join(struct.pack("<I", len(text)) + text.encode() for text in (profile, library))
    file.write_bytes(whole[:17] + header + whole[17 + len(header) :])
    for place in (file, path):
        with pytest.raises(GavoError, match=f"cannot be read as a bag: .*{words}") as caught:
            open_source(place)
        assert "recover" not in str(caught.value)


def test_without_the_library_it_is_said_what_to_install(bags, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(GavoError, match=r"\[bag\]"):
        open_source(bags["ros1", "raw", "u16"])


@pytest.mark.parametrize("kind", KINDS)
def test_memory_does_not_grow_with_the_recording(tmp_path, kind):
    peaks = []
    for count in (60, 240):
        some = [Shot(1 + i / 30, BGRS[i % 4], MILLIMETRES[i % 4]) for i in range(count)]
        sequence = open_source(record(tmp_path / f"long{count}", kind, "raw", some, CAMERA))
        assert sequence[0].grey.size
        tracemalloc.start()
        assert sum(int(frame.grey[0, 0]) >= 0 for frame in sequence) == count
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]


def message(pixels: np.ndarray, encoding: str, **changes: object) -> SimpleNamespace:
    rows = np.ascontiguousarray(pixels)
    fields = {"height": pixels.shape[0], "width": pixels.shape[1], "step": rows.strides[0], "is_bigendian": 0}
    return SimpleNamespace(encoding=encoding, data=rows.view(np.uint8).ravel(), **{**fields, **changes})


IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
PLAIN = np.full((8, 12, 3), (30, 90, 200), np.uint8)


@pytest.mark.parametrize(
    ("spelled", "usual"), [("RGB8", "rgb8"), ("Mono8", "mono8"), ("Y8", "mono8"), ("BAYER_RGGB8", "bayer_rggb8")]
)
def test_encodings_are_known_by_other_spellings(spelled, usual):
    pixels = BGRS[0] if usual == "rgb8" else GREYS[0]
    image, expected = (color_of(IMAGE, message(pixels, encoding), "image") for encoding in (spelled, usual))
    assert np.array_equal(image, expected)
    assert encoding_of(IMAGE, message(pixels, spelled)) == usual


@pytest.mark.parametrize("spelled", ["16uc1", "z16", "MONO16"])
def test_encodings_of_depth_are_known_by_other_spellings(spelled):
    assert np.array_equal(depth_of(IMAGE, message(MILLIMETRES[0], spelled), "image"), MILLIMETRES[0])
    assert is_depth(IMAGE, message(MILLIMETRES[0], spelled), "/depth/image")


@pytest.mark.parametrize("encoding", [name for name, layout in LAYOUTS.items() if layout[0] in ("u1", "u2")])
def test_every_encoding_of_colour_becomes_bgr(encoding):
    number, channels, _ = LAYOUTS[encoding]
    blue, green, red = 30, 90, 200
    order = {"rgb": (red, green, blue), "bgr": (blue, green, red)}.get(encoding[:3], (blue, green, red))
    if channels >= 3:
        pixels = np.full((8, 12, channels), (*order, 255)[:channels], np.uint8).astype(number)
        expected = np.full((8, 12, 3), (blue, green, red))
    elif encoding.startswith("bayer"):
        tile = np.array([{"r": red, "g": green, "b": blue}[letter] for letter in encoding[6:10]], np.uint8)
        pixels, expected = np.tile(tile.reshape(2, 2).astype(number), (4, 6)), np.full((8, 12, 3), (blue, green, red))
    elif channels == 2:
        luma = (90, 128) if "yuy" in encoding else (128, 90)
        pixels, expected = np.full((8, 12, 2), luma, np.uint8), np.full((8, 12, 3), round(1.164 * (90 - 16)))
    else:
        pixels, expected = np.full((8, 12), 77, number), np.full((8, 12, 3), 77)
    changes = {}
    if encoding in HALVED:
        bgr = np.full((8, 12, 3), (blue, green, red), np.uint8)
        planar = cv2.cvtColor(bgr, cv2.COLOR_BGR2YUV_I420)
        colors = planar[8:].reshape(2, -1)[:: 1 if encoding == "nv12" else -1]
        pixels, expected = np.vstack([planar[:8], colors.T.reshape(4, 12)]), bgr
        changes = {"height": 8}
    found = color_of(IMAGE, message(pixels, encoding, **changes), "x")
    assert found.shape == (8, 12, 3)
    assert np.abs(found[2:-2, 2:-2].astype(int) - expected[2:-2, 2:-2]).max() <= 2


def test_a_mosaic_that_was_compressed_as_it_is_becomes_bgr():
    """It was taken for grey: a chequerboard."""
    blue, green, red = 30, 90, 200
    tile = np.array([[green, red], [blue, green]], np.uint8)
    data = cv2.imencode(".png", np.tile(tile, (4, 6)))[1].tobytes()
    for words in ("bayer_grbg8; png compressed ", "bayer_grbg8; jpeg compressed "):
        found = color_of(COMPRESSED, SimpleNamespace(format=words, data=data), "x")
        assert np.abs(found[2:-2, 2:-2].astype(int) - (blue, green, red)).max() <= 2
    plain = cv2.imencode(".png", PLAIN)[1].tobytes()
    for words in ("bgr8; png compressed bgr8", "png", ""):
        np.testing.assert_array_equal(color_of(COMPRESSED, SimpleNamespace(format=words, data=plain), "x"), PLAIN)


@pytest.mark.parametrize("words", ["bayer_rggb8; jpeg compressed bgr8", "bayer_grbg8; png compressed bgr8"])
def test_a_mosaic_that_became_bgr_before_it_was_compressed_is_none(words):
    data = cv2.imencode(".png", PLAIN)[1].tobytes()
    np.testing.assert_array_equal(color_of(COMPRESSED, SimpleNamespace(format=words, data=data), "x"), PLAIN)
    tile = np.tile(np.array([[200, 90], [90, 30]], np.uint8), (4, 6))
    mosaic = SimpleNamespace(
        format="bayer_rggb8; png compressed bayer_rggb8", data=cv2.imencode(".png", tile)[1].tobytes()
    )
    assert np.abs(color_of(COMPRESSED, mosaic, "x")[2:-2, 2:-2].astype(int) - (30, 90, 200)).max() <= 2


@pytest.mark.parametrize(
    ("form", "slope", "inverse"),
    [
        ("32FC1; compressedDepth png", 10000.0, True),
        ("compressedDepth png", 10000.0, True),
        ("compressedDepth", 10000.0, True),
        ("png", 10000.0, True),
        ("png", 0.0, False),
        ("compressedDepth png", 0.0, False),
        ("16UC1; compressedDepth png", 10000.0, False),
        ("compressedDepth png", float("nan"), False),
    ],
)
def test_inverse_depth_is_known_by_its_coefficients_where_the_format_is_silent(form, slope, inverse):
    metres = np.linspace(0.5, 4, 96).reshape(8, 12)
    stored = np.round(10000.0 / metres - 100.0).astype(np.uint16)
    data = np.frombuffer(struct.pack("<iff", 0, slope, -100.0) + cv2.imencode(".png", stored)[1].tobytes(), np.uint8)
    found = depth_of(COMPRESSED, SimpleNamespace(format=form, data=data), "x")
    if inverse:
        np.testing.assert_allclose(found, metres, atol=0.002)
    else:
        np.testing.assert_array_equal(found, stored)


def test_rows_may_be_padded_and_numbers_of_either_end():
    depth = np.arange(96, dtype=np.uint16).reshape(8, 12) * 300
    wide = np.zeros((8, 20), np.uint16)
    wide[:, :12] = depth
    np.testing.assert_array_equal(depth_of(IMAGE, message(wide, "16UC1", width=12), "x"), depth)
    short = message(wide, "16UC1", width=12)
    short.data = short.data[:-16]
    np.testing.assert_array_equal(depth_of(IMAGE, short, "x"), depth)
    swapped = message(depth.byteswap(), "16UC1", is_bigendian=1)
    np.testing.assert_array_equal(depth_of(IMAGE, swapped, "x"), depth)
    doubles = depth_of(IMAGE, message(depth.astype(np.float64) / 1000, "64FC1"), "x")
    np.testing.assert_allclose(doubles, depth / 1000, rtol=1e-6)


@pytest.mark.parametrize(
    ("reader", "kind", "faulty"),
    [
        (color_of, IMAGE, message(PLAIN, "nv24")),
        (color_of, IMAGE, message(PLAIN, "bgr8", height=9)),
        (color_of, IMAGE, message(PLAIN, "bgr8", step=3)),
        (color_of, IMAGE, message(PLAIN, "bgr8", height=0)),
        (color_of, IMAGE, message(np.zeros((12, 12), np.uint8), "nv12", height=9)),
        (color_of, IMAGE, message(np.zeros((12, 12), np.uint8), "nv12", height=10)),
        (color_of, IMAGE, message(np.zeros((4, 4), np.float32), "32FC1")),
        (color_of, IMAGE, message(np.zeros((8, 11, 2), np.uint8), "yuv422")),
        (depth_of, IMAGE, message(PLAIN, "bgr8")),
        (color_of, COMPRESSED, SimpleNamespace(format="jpeg", data=b"\xff\xd8\xff")),
        (depth_of, COMPRESSED, SimpleNamespace(format="16UC1; compressedDepth rvl", data=bytes(40))),
        (depth_of, COMPRESSED, SimpleNamespace(format="16UC1; compressedDepth png", data=b"x")),
    ],
)
def test_faulty_messages_are_refused_in_one_line(reader, kind, faulty):
    with pytest.raises(FrameError, match="^x: ") as caught:
        reader(kind, faulty, "x")
    assert len(str(caught.value).splitlines()) == 1


def test_a_file_of_ros_1_is_closed_however_it_is_let_go(bags, monkeypatch):
    """The library closes a ROS 1 file's last chunk first, which fails while a message of it is held."""
    monkeypatch.setattr(recording, "_close", lambda reader: None)
    before = set(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").is_dir() else None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sequence = open_source(bags["ros1", "raw", "u16"])
        assert sequence[2].depth.size
        del sequence
        gc.collect()  # the sequence lets go of its reader,
        gc.collect()  # which holds itself
    assert not [one for one in caught if issubclass(one.category, ResourceWarning)]
    assert before is None or set(os.listdir("/proc/self/fd")) <= before


@pytest.mark.parametrize(("color", "depth"), [("image_raw", "image_rect"), ("image_rect", "image_raw")])
@pytest.mark.parametrize("frame", ["camera", ""])
def test_one_camera_whose_lens_is_out_of_one_image_alone(tmp_path, color, depth, frame):
    """The depth of its driver is as the sensor saw it, and image_proc rectifies one of the two."""
    recorder = Recorder(tmp_path / "half", "mcap")
    for stamp in (1.0, 1.1):
        for place, name, pixels, kind in (
            ("rgb", color, BGRS[0], "bgr8"),
            ("depth_registered", depth, MILLIMETRES[0], "16UC1"),
        ):
            recorder.info(f"/camera/{place}/camera_info", stamp, LENS, frame=frame)
            recorder.image(f"/camera/{place}/{name}", stamp, pixels, kind, frame=frame)
    recorder.close()
    sequence = open_source(tmp_path / "half")
    assert isinstance(sequence, BagSequence)
    calibration = sequence.calibration
    assert calibration.depth is not None and calibration.color_T_depth is not None
    assert calibration.color.is_distorted != calibration.depth.is_distorted
    np.testing.assert_array_equal(calibration.color_T_depth, np.eye(4))
