"""Camera files of every make lead to the same camera; faulty ones are refused in one line."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gavo_jax.camera import Camera
from gavo_jax.camera_files.calibration import Calibration, load_calibration, load_camera
from gavo_jax.errors import GavoError

MATRIX = np.array([[500.0, 0, 319.5], [0, 510.0, 239.5], [0, 0, 1]])
RADTAN = [0.1, -0.2, 0.001, -0.002]
RATIONAL = [0.5, -2.0, 0.001, -0.002, 1.5, 0.4, -1.9, 1.4]
EQUIDISTANT = [-0.02, 0.01, -0.003, 0.001]
PINHOLE = Camera(500.0, 510.0, 319.5, 239.5, 640, 480)
TURN = cv2.Rodrigues(np.array([0.01, -0.02, 0.005]))[0]
COLOR_T_DEPTH = np.block([[TURN, np.array([[-0.025], [0.001], [0.002]])], [np.zeros((1, 3)), np.ones((1, 1))]])


def ros1(model: str, numbers: list[float]) -> str:
    """As `camera_calibration` saves it."""
    return f"""image_width: 640
image_height: 480
camera_name: rgb
camera_matrix:
  rows: 3
  cols: 3
  data: {MATRIX.ravel().tolist()}
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {len(numbers)}
  data: {numbers}
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [480, 0, 320, 0, 0, 490, 240, 0, 0, 0, 1, 0]
"""


def ros_echo(upper: bool, model: str, numbers: list[float]) -> str:
    """As `rostopic echo` (upper) or `ros2 topic echo` prints a message."""
    k, d = ("K", "D") if upper else ("k", "d")
    numbers_below = "".join(f"\n- {number!r}" for number in numbers)
    matrix = "".join(f"\n- {number!r}" for number in MATRIX.ravel().tolist())
    head = "header:\n  stamp:\n    sec: 3\n  frame_id: camera\n"
    lens = f"distortion_model: {model}\n{d}:{numbers_below}\n"
    return f"{head}height: 480\nwidth: 640\n{lens}{k}:{matrix}\nbinning_x: 0\n---\n"


def kalibr(model: str, numbers: list[float], second: bool = False) -> str:
    camera = f"""  camera_model: pinhole
  distortion_coeffs: {numbers}
  distortion_model: {model}
  intrinsics: [500.0, 510.0, 319.5, 239.5]
  resolution: [640, 480]
  rostopic: /camera/image
"""
    if not second:
        return f"cam0:\n{camera}"
    return f"cam0:\n{camera}cam1:\n{camera}  T_cn_cnm1: {np.linalg.inv(COLOR_T_DEPTH).tolist()}\n"


def storage(ending: str, names: dict[str, str], fisheye: bool = False, numbers: list[float] = RADTAN) -> str:
    file = cv2.FileStorage(ending, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    file.write(names["K"], MATRIX)
    file.write(names["D"], np.array([numbers]))
    file.write(names["width"], 640)
    file.write(names["height"], 480)
    if fisheye:
        file.write("fisheye_model", 1)
    return file.releaseAndGetString()


OPENCV = {"K": "camera_matrix", "D": "distortion_coefficients", "width": "image_width", "height": "image_height"}
OTHER = {"K": "K", "D": "D", "width": "width", "height": "height"}
OPEN3D = {"width": 640, "height": 480, "intrinsic_matrix": MATRIX.T.ravel().tolist()}
REPLICA = {"camera": {"w": 640, "h": 480, "fx": 500.0, "fy": 510.0, "cx": 319.5, "cy": 239.5, "scale": 6553.5}}
REALSENSE = {
    "width": 640,
    "height": 480,
    "fx": 500.0,
    "fy": 510.0,
    "ppx": 319.5,
    "ppy": 239.5,
    "model": "distortion.inverse_brown_conrady",
    "coeffs": [0.0] * 5,
}
NERF = {"fl_x": 500.0, "fl_y": 510.0, "cx": 319.5, "cy": 239.5, "w": 640, "h": 480.0, "k1": 0.0}
LENS = dict(zip(("k1", "k2", "p1", "p2"), RADTAN, strict=True))
FISH_LENS = dict(zip(("k1", "k2", "k3", "k4"), EQUIDISTANT, strict=True))
ORB = """%YAML:1.0
Camera.type: "PinHole"
Camera.fx: 500.0
Camera.fy: 510.0
Camera.cx: 319.5
Camera.cy: 239.5
Camera.k1: 0.1
Camera.k2: -0.2
Camera.p1: 0.001
Camera.p2: -0.002
Camera.width: 640
Camera.height: 480
DepthMapFactor: 1000.0
"""
ORB_FISH = "%YAML:1.0\n" + "\n".join(
    f"Camera1.{key}: {value!r}"
    for key, value in zip(
        ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"), (500.0, 510.0, 319.5, 239.5, *EQUIDISTANT), strict=True
    )
)
ORB_FISH += '\nCamera.type: "KannalaBrandt8"\nCamera.width: 640\nCamera.height: 480\n'
ROWS, COLUMNS = MATRIX.ravel().tolist(), MATRIX.T.ravel().tolist()
LIST_OF_OPENCV = f"%YAML:1.0\nimage_width: 640\nimage_height: 480\ncamera_matrix: {ROWS}\nD: {RADTAN}\n"
TOML = "fx=500\nfy=510\ncx=319.5\ncy=239.5\nwidth=640\nheight=480\n"

NONE, BROWN, RATIO, FISH, IDEAL_FISH = (
    PINHOLE,
    replace(PINHOLE, distortion=(*RADTAN, 0.0)),
    replace(PINHOLE, distortion=tuple(RATIONAL)),
    replace(PINHOLE, distortion=tuple(EQUIDISTANT), model="fisheye"),
    replace(PINHOLE, distortion=(0.0,) * 4, model="fisheye"),
)
FILES = {
    "ros plumb_bob.yaml": (ros1("plumb_bob", [*RADTAN, 0.0]), BROWN),
    "ros rational.yml": (ros1("rational_polynomial", RATIONAL), RATIO),
    "ros fisheye.yaml": (ros1("equidistant", EQUIDISTANT), FISH),
    "ros without.yaml": (ros1("''", []), NONE),
    "ros1 echo.yaml": (ros_echo(True, "plumb_bob", [*RADTAN, 0.0]), BROWN),
    "ros2 echo.yaml": (ros_echo(False, "rational_polynomial", RATIONAL), RATIO),
    "kalibr radtan.yaml": (kalibr("radtan", RADTAN), BROWN),
    "kalibr equi.yaml": (kalibr("equidistant", EQUIDISTANT), FISH),
    "kalibr none.yaml": (kalibr("none", []), NONE),
    "opencv.yaml": (storage(".yml", OPENCV), BROWN),
    "opencv.yml": (storage(".yml", OTHER, numbers=RATIONAL), RATIO),
    "opencv.xml": (storage(".xml", OPENCV), BROWN),
    "opencv.json": (storage(".json", OPENCV), BROWN),
    "opencv fisheye.yml": (storage(".yml", OPENCV, True, EQUIDISTANT), FISH),
    "orb.yaml": (ORB, replace(BROWN, depth_scale=1000.0)),
    "open3d.json": (json.dumps(OPEN3D), NONE),
    "open3d pose.json": (json.dumps({"extrinsic": [1], "intrinsic": OPEN3D}), NONE),
    "replica.json": (json.dumps(REPLICA), replace(NONE, depth_scale=6553.5)),
    "own.json": (json.dumps({"fx": 500, "fy": 510, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480}), NONE),
    "ros fisheye without numbers.yaml": (ros1("equidistant", []), IDEAL_FISH),
    "ros columns.yaml": (ros1("plumb_bob", RADTAN).replace(str(ROWS), str(COLUMNS)), BROWN),
    "kalibr fisheye without numbers.yaml": (kalibr("equidistant", []), IDEAL_FISH),
    "opencv lists.yaml": (LIST_OF_OPENCV, BROWN),
    "opencv fisheye without numbers.yml": (storage(".yml", OPENCV, True, []), IDEAL_FISH),
    "orb fisheye.yaml": (ORB_FISH, FISH),
    "open3d rows.json": (json.dumps({**OPEN3D, "intrinsic_matrix": ROWS}), NONE),
    "realsense.json": (json.dumps(REALSENSE), NONE),
    "realsense brown.json": (json.dumps({**REALSENSE, "model": "Brown Conrady", "coeffs": [*RADTAN, 0.0]}), BROWN),
    "realsense number.json": (json.dumps({**REALSENSE, "model": 4, "coeffs": [*RADTAN, 0.0]}), BROWN),
    "transforms.json": (json.dumps({**NERF, "frames": [{"file_path": 300 * "x"}] * 1000}), NONE),
    "transforms opencv.json": (json.dumps({**NERF, "camera_model": "OPENCV", **LENS}), BROWN),
    "transforms fisheye.json": (json.dumps({**NERF, "camera_model": "OPENCV_FISHEYE", **FISH_LENS}), FISH),
    "transforms of autofocus.json": (
        json.dumps({"frames": [NERF, {**NERF, "fl_x": 504.5}, {**NERF, "fl_x": 498.0}]}),
        NONE,
    ),
    "transforms of frames.json": (json.dumps({"frames": [NERF, {**NERF, "sharpness": 3}]}), NONE),
    "record3d.json": (json.dumps({"w": 640, "h": 480, "K": MATRIX.T.ravel().tolist(), "poses": [[0.0] * 7]}), NONE),
    "stray scanner.csv": ("500.0, 0.0, 319.5\n0.0, 510.0, 239.5\n0.0, 0.0, 1.0\n", NONE),
    "with its size.txt": ("640 480 500.0 510.0 319.5 239.5\n", NONE),
    "arkitscenes.pincam": ("640 480 500.0 510.0 319.5 239.5\n", NONE),
    "own.toml": (TOML + f"distortion={RATIONAL}\nmodel='rational'\n", RATIO),
    "own fisheye.toml": (TOML + f"distortion={EQUIDISTANT}\nmodel='fisheye'\n", FISH),
}


@pytest.mark.parametrize("name", FILES)
def test_every_make_leads_to_the_same_camera(tmp_path, name):
    text, camera = FILES[name]
    (tmp_path / name).write_text(text)
    found = load_calibration(tmp_path / name, (640, 480) if name.endswith(".csv") else None)
    np.testing.assert_allclose(found.color.distortion, camera.distortion, atol=1e-12)
    assert (
        replace(found.color, distortion=camera.distortion) == camera
        and found.depth is None
        and found.origin == str(tmp_path / name)
    )
    assert found.states_depth_scale == (name in ("orb.yaml", "replica.json"))
    assert name.endswith(".csv") or load_camera(tmp_path / name) == found.color


@pytest.mark.parametrize(
    ("key", "unit"),
    [
        ("integer_depth_scale", 10 / 65535),
        ("depth_unit_scale_factor", 10 / 65535),
        ("depth_scale", 6553.5),
        ("png_depth_scale", 10 / 65535),
        ("depth_units", 10 / 65535),
    ],
)
def test_transforms_say_the_unit_of_depth(tmp_path, key, unit):
    """Except by the names of nerfstudio and instant-ngp, it was left aside without a word."""
    (tmp_path / "transforms.json").write_text(json.dumps({**NERF, key: unit}))
    found = load_calibration(tmp_path / "transforms.json")
    assert found.states_depth_scale and found.color.depth_scale == pytest.approx(6553.5)


def test_transforms_with_an_unknown_unit_of_depth_are_refused(tmp_path):
    """It was left aside without a word."""
    (tmp_path / "transforms.json").write_text(json.dumps({**NERF, "depth_factor_16": 6553.5}))
    with pytest.raises(GavoError, match=r"transforms\.json: 'depth_factor_16': unknown, but looks like"):
        load_calibration(tmp_path / "transforms.json")


@pytest.mark.parametrize("place", ["top", "frames", "frames without a focal length"])
def test_transforms_say_a_lens_in_other_words(tmp_path, place):
    """A fisheye by its flag alone, and coefficients in a list, were read as a pinhole without distortion."""
    path = tmp_path / "transforms.json"

    def write(**lens: object) -> None:
        frames = [{**({} if place.endswith("length") else NERF), **lens}] * 2
        path.write_text(json.dumps({**NERF, **lens} if place == "top" else {**NERF, "frames": frames}))

    write(is_fisheye=True, **FISH_LENS)
    assert load_calibration(path).color == FISH
    write(is_fisheye=False, distortion_params=[0.0] * 6, **LENS)
    assert load_calibration(path).color == BROWN
    for faulty, words in (
        ({"distortion_params": RADTAN}, "distortion_params: their order is not certain: write them as"),
        ({"is_fisheye": True, "camera_model": "OPENCV"}, "is_fisheye contradicts camera_model 'OPENCV'"),
    ):
        write(**faulty)
        with pytest.raises(GavoError, match=rf"transforms\.json: {words}"):
            load_calibration(path)


K = {"K": MATRIX.tolist(), "width": 640, "height": 480}
SDK = {key: value for key, value in REALSENSE.items() if key not in ("model", "coeffs")}
FLAT = {"fx": 500.0, "fy": 510.0, "cx": 319.5, "cy": 239.5}
EUROC = f"""sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
rate_hz: 20
resolution: [640, 480]
camera_model: pinhole
intrinsics: [500, 510, 319.5, 239.5]
distortion_model: radial-tangential
distortion_coefficients: {RADTAN}
"""
VINS = """%YAML:1.0
---
model_type: PINHOLE
camera_name: camera
image_width: 640
image_height: 480
distortion_parameters:
   k1: 0.1
   k2: -0.2
   p1: 0.001
   p2: -0.002
projection_parameters:
   fx: 500.0
   fy: 510.0
   cx: 319.5
   cy: 239.5
"""
COMMON_NAMES: dict[str, tuple[str | dict[str, Any], Camera]] = {
    **{
        f"{name}.json": ({**K, name: [[*RADTAN, 0.0]]}, BROWN)
        for name in ("dist", "dist_coeff", "dist_coeffs", "distCoeffs", "distortion", "distortion_coefficients", "d")
    },
    "tutorial.yaml": (
        f"camera_matrix: {MATRIX.tolist()}\ndist_coeff: [{[*RADTAN, 0.0]}]\nimage_size: [640, 480]\n",
        BROWN,
    ),
    "storage.yml": (storage(".yml", {**OTHER, "D": "dist_coeffs"}), BROWN),
    "storage fisheye.yml": (storage(".yml", OTHER, False, EQUIDISTANT) + "model: fisheye\n", FISH),
    "storage factor.yml": (storage(".yml", OTHER) + "DepthMapFactor: 1000.\n", replace(BROWN, depth_scale=1000.0)),
    "open3d.json": ({**OPEN3D, "distortion_coefficients": RADTAN}, BROWN),
    "replica.json": ({"camera": {**REPLICA["camera"], **LENS}}, replace(BROWN, depth_scale=6553.5)),
    "nice-slam.yaml": (
        "cam:\n  H: 480\n  W: 640\n  fx: 500\n  fy: 510\n  cx: 319.5\n  cy: 239.5\n  png_depth_scale: 6553.5\n",
        replace(NONE, depth_scale=6553.5),
    ),
    "splatam.json": (
        {"camera_params": {**FLAT, "image_width": 640, "image_height": 480, "png_depth_scale": 1000.0}},
        replace(NONE, depth_scale=1000.0),
    ),
    "realsense.json": ({**SDK, "distortion": "brown_conrady", "distortion_coeffs": [*RADTAN, 0.0]}, BROWN),
    "model.json": ({**K, "D": EQUIDISTANT, "model": "fisheye"}, FISH),
    "camera model.json": ({**K, "D": EQUIDISTANT, "camera_model": "fisheye"}, FISH),
    "flag.json": ({**K, "D": EQUIDISTANT, "fisheye": True}, FISH),
    "device.json": ({**K, "D": RADTAN, "model": "D435"}, BROWN),
    "delay.yaml": (ros1("plumb_bob", RADTAN) + "depth_delay: -0.02\n", BROWN),
    "factor.json": ({**K, "depth_factor": 1000}, replace(NONE, depth_scale=1000.0)),
    "metres.json": ({**K, "depth_scale": 0.001}, replace(NONE, depth_scale=1000.0)),
    "units.json": ({**K, "depth_units": 0.00025}, replace(NONE, depth_scale=4000.0)),
    "units of realsense.json": ({**REALSENSE, "depth_units": 0.00025}, replace(NONE, depth_scale=4000.0)),
    "unit.yaml": (ros1("plumb_bob", RADTAN) + "depth_unit: mm\n", replace(BROWN, depth_scale=1000.0)),
    "kalibr.yaml": (kalibr("radtan", RADTAN) + "  depth_scale: 1000\n", replace(BROWN, depth_scale=1000.0)),
    "euroc.yaml": (EUROC, BROWN),
    "vins.yaml": (VINS, BROWN),
    "flat.json": ({**FLAT, "w": 640, "h": 480, **LENS}, BROWN),
    "camera matrix.json": ({"cameraMatrix": MATRIX.tolist(), "image_size": [640, 480]}, NONE),
}


@pytest.mark.parametrize("name", COMMON_NAMES)
def test_lens_and_unit_go_by_all_their_common_names(tmp_path, name):
    """They were left aside without a word."""
    said, camera = COMMON_NAMES[name]
    (tmp_path / name).write_text(said if isinstance(said, str) else json.dumps(said))
    found = load_calibration(tmp_path / name)
    np.testing.assert_allclose(found.color.distortion, camera.distortion, atol=1e-12)
    assert replace(found.color, distortion=camera.distortion) == camera
    assert found.depth_delay == (-0.02 if name == "delay.yaml" else 0.0)


@pytest.mark.parametrize("name", ["distortion", "D"])
@pytest.mark.parametrize("by", [{"distortion_model": "kannala_brandt"}, {"distortion_type": "KB4"}])
@pytest.mark.parametrize("ending", ["json", "yaml"])
def test_a_lens_model_holds_whatever_the_coefficients_are_called(tmp_path, name, by, ending):
    """Beside `distortion` itself an unknown model was dropped, and the lens taken for a pinhole's."""
    path, size = tmp_path / f"camera.{ending}", {"width": 640, "height": 480}
    path.write_text(json.dumps({**FLAT, **size, name: EQUIDISTANT, **by}))
    with pytest.raises(GavoError, match=rf"camera\.{ending}: model: '{next(iter(by.values()))}' is not one of"):
        load_calibration(path)
    for known in ({"distortion_model": "equidistant"}, {"camera_model": "fisheye"}, {"is_fisheye": True}):
        path.write_text(json.dumps({**FLAT, **size, name: EQUIDISTANT, **known}))
        assert load_calibration(path).color == FISH
    path.write_text(json.dumps({**FLAT, **size, name: RADTAN, "distortion_model": "radtan"}))
    assert load_calibration(path).color == BROWN


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"my_distortion": RADTAN}, "'my_distortion': unknown, but looks like lens"),
        ({"dist_params": {"k1": 0.1}}, "'dist_params': unknown"),
        ({"kc": RADTAN}, "'kc': unknown"),
        ({"lens_coefficients": RADTAN}, "'lens_coefficients': unknown"),
        ({"depth_unit_scale": 0.001}, "'depth_unit_scale': unknown"),
        ({"depth_unit_m": 0.001}, "'depth_unit_m': unknown"),
        ({"depth_unit": 1.0}, "the unit of depth: expected metres per unit, below 0.05, or mm or m, found 1.0: write"),
        ({"depth_units": "inch"}, "the unit of depth: expected .* found 'inch'"),
    ],
)
def test_what_looks_like_a_lens_and_is_not_known_is_refused(tmp_path, more, words):
    path = tmp_path / "camera.json"
    for known in (K, OPEN3D, {"camera": {**FLAT, "w": 640, "h": 480}}):
        whole = {"camera": {**known["camera"], **more}} if "camera" in known else {**known, **more}
        path.write_text(json.dumps(whole))
        with pytest.raises(GavoError, match=words):
            load_calibration(path)
    path.write_text(json.dumps({**K, "max_distance": 5.0, "undistorted": True, "my_distortion": [0.0] * 5}))
    assert load_calibration(path).color == NONE


@pytest.mark.parametrize(
    ("text", "camera"),
    [
        ("500 0 319.5\n0 510 239.5\n0 0 1\n", NONE),
        ("\n".join(" ".join(map(str, row)) for row in np.block([[MATRIX, np.zeros((3, 1))], [np.eye(4)[3:]]])), NONE),
        ("500 0 0\n0 510 0\n319.5 239.5 1\n", NONE),
        ("500 510 319.5 239.5\n", NONE),
        ("500 0 319.5 0 510 239.5 0 0 1\n", NONE),
        ("[[500, 0, 319.5],\n [0, 510, 239.5],\n [0, 0, 1]]\n", NONE),
        (json.dumps({"K": ROWS}), NONE),
        ("# fx fy cx cy\n500, 510, 319.5, 239.5, 0.1, -0.2, 0.001, -0.002\n", BROWN),
    ],
)
def test_numbers_alone_need_the_images_size(tmp_path, text, camera):
    path = tmp_path / ("intrinsics.json" if text.startswith("{") else "intrinsics.txt")
    path.write_text(text)
    assert load_calibration(path, (640, 480)).color == camera
    with pytest.raises(GavoError, match=f"{path.name}: width: missing"):
        load_calibration(path)
    with pytest.raises(GavoError, match=f"{path.name}: width: must be a whole number from 16 to 8192, not 8"):
        load_calibration(path, (8, 8))


def test_the_size_may_stand_first_or_last_in_a_row(tmp_path):
    for name, row in (("first", "640 480 500 510 319.5 239.5"), ("last", "500 510 319.5 239.5 640 480")):
        (tmp_path / f"{name}.txt").write_text(f"{row}\n")
        assert load_calibration(tmp_path / f"{name}.txt").color == NONE


@pytest.mark.parametrize("make", ["ros", "open3d"])
def test_a_matrix_may_be_a_list_of_rows(tmp_path, make):
    path = tmp_path / ("a.yaml" if make == "ros" else "a.json")
    if make == "ros":
        path.write_text(ros1("plumb_bob", RADTAN).replace(str(ROWS), str(MATRIX.tolist())))
    else:
        path.write_text(json.dumps({**OPEN3D, "intrinsic_matrix": MATRIX.tolist()}))
    assert load_camera(path).matrix.tolist() == MATRIX.tolist()


def test_the_depth_scale_of_a_file_goes_before_that_of_a_kind_of_source(tmp_path):
    (tmp_path / "a.toml").write_text(TOML)
    (tmp_path / "b.toml").write_text(TOML + "depth_scale=2000\n")
    assert [load_calibration(tmp_path / f"{x}.toml", None, 1000.0).color.depth_scale for x in "ab"] == [1000, 2000]


@pytest.mark.parametrize("place", ["top", "inside", "kalibr", "american"])
def test_two_cameras(tmp_path, place):
    key = "color_T_depth" if place == "american" else "colour_T_depth"
    pose = f"{key} = {COLOR_T_DEPTH.tolist()}\n"
    depth = f"[depth]\n{TOML.replace('500', '580')}distortion={RADTAN}\n"
    path = tmp_path / ("rig.yaml" if place == "kalibr" else "rig.toml")
    text = TOML + depth + pose if place == "inside" else TOML + pose + depth
    path.write_text(kalibr("radtan", RADTAN, True) if place == "kalibr" else text)
    found = load_calibration(path)
    assert found.depth == replace(BROWN, fx=500.0 if place == "kalibr" else 580.0)
    assert found.color_T_depth is not None
    np.testing.assert_allclose(found.color_T_depth, COLOR_T_DEPTH, atol=1e-12)


@pytest.mark.parametrize(
    ("first", "second", "is_depth_first"),
    [
        ("/camera/infra1/image_rect_raw", "/camera/color/image_raw", True),
        ("/camera/ir/image_raw", "/camera/rgb/image_raw", True),
        ("/k4a/depth/image", "/k4a/Colour/image", True),
        ("/camera/color/image_raw", "/camera/infra1/image_rect_raw", False),
        ("/first/image", "/second/image", False),
        ("/first/image", "/depth/image", False),
        ("/depth_to_rgb/left", "/right", False),
    ],
)
def test_the_topics_of_two_cameras_say_which_is_of_colour(tmp_path, first, second, is_depth_first):
    """The first camera counted as that of colour, whatever its topic."""
    text = kalibr("radtan", RADTAN, True).replace("500.0, 510.0", "580.0, 590.0", 1)
    text = text.replace("/camera/image", first, 1).replace("/camera/image\n  T", f"{second}\n  T")
    (path := tmp_path / "rig.yaml").write_text(text)
    found = load_calibration(path)
    assert found.depth is not None and found.color_T_depth is not None
    cameras = (found.depth, found.color) if is_depth_first else (found.color, found.depth)
    assert [camera.fx for camera in cameras] == [580, 500]
    second_T_first = np.linalg.inv(COLOR_T_DEPTH)
    expected = second_T_first if is_depth_first else COLOR_T_DEPTH
    np.testing.assert_allclose(found.color_T_depth, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        *(("/infra1/image", "/infra2/image"), ("/ir/image", "/image"), ("/rgb/left", "/rgb/right")),
        ("/stereo/left/image_raw", "/stereo/right/image_raw"),
    ],
)
def test_two_cameras_of_one_kind_are_refused(tmp_path, first, second):
    """Of two infrared cameras, the first counted as that of colour."""
    text = kalibr("radtan", RADTAN, True).replace("/camera/image", first, 1)
    (path := tmp_path / "rig.yaml").write_text(text.replace("/camera/image\n  T", f"{second}\n  T"))
    with pytest.raises(
        GavoError, match=rf"rig\.yaml: cam0 and cam1 are {first} and {second}: expected colour and depth"
    ):
        load_calibration(path)


def rig(pose: object) -> str:
    return TOML + f"colour_T_depth = {pose}\n[depth]\n{TOML}"


FAULTS = {
    "pose without camera.toml": (TOML + f"colour_T_depth = {np.eye(4).tolist()}\n", "[depth]"),
    "pose of three rows.toml": (rig(np.eye(4)[:3].tolist()), "four rows"),
    "pose of huge numbers.toml": (rig(f"[[{10**400}, 0, 0, 0]]"), "four rows"),
    "pose of text.toml": (rig('["a"]'), "four rows"),
    "skewed pose.toml": (rig((2 * np.eye(4)).tolist()), "rigid"),
    "mirrored pose.toml": (rig(np.diag([-1.0, 1, 1, 1]).tolist()), "rigid"),
    "pose in mm.toml": (rig((np.eye(4) + 25 * np.eye(4, k=3)).tolist()), "metres"),
    "depth of text.toml": ("depth = 3\n" + TOML, "[depth]"),
    "depth without fx.toml": (TOML + "[depth]\nfy=3\n", "depth.fx: missing"),
    "depth of odd keys.toml": (TOML + "[depth]\n" + TOML + "fz=3\n", "depth.fz"),
    "fisheye of five.toml": (TOML + "model='fisheye'\ndistortion=[0,0,0,0,0]\n", "4 numbers"),
    "unknown model.toml": (TOML + "model='magic'\n", "model"),
    "model of number.toml": (TOML + "model=3\n", "model"),
    "ros six.yaml": (ros1("plumb_bob", [0.0] * 6), "distortion"),
    "ros other model.yaml": (ros1("thin_plate", RADTAN), "model"),
    "ros short matrix.yaml": (ros1("plumb_bob", RADTAN).replace("500.0, 0.0, ", ""), "ROS camera_info"),
    "ros no size.yaml": (ros1("plumb_bob", RADTAN).replace("image_width", "breadth"), "width"),
    "kalibr omni.yaml": (
        kalibr("radtan", RADTAN).replace("pinhole", "omni"),
        "camera_model 'omni': only pinhole is supported",
    ),
    "kalibr fov.yaml": (kalibr("fov", RADTAN), "model: 'fov' is not one of pinhole"),
    "ros of text.yaml": (ros1("plumb_bob", RADTAN).replace(str(ROWS), "wide"), "have the wrong type"),
    "kalibr no size.yaml": (kalibr("radtan", RADTAN).replace("resolution", "size"), "Kalibr"),
    "open3d short.json": (json.dumps({**OPEN3D, "intrinsic_matrix": [1, 2]}), "Open3D"),
    "open3d list.json": ("[1, 2]", "not a camera file"),
    "realsense ftheta.json": (json.dumps({**REALSENSE, "model": "ftheta", "coeffs": RADTAN}), "the lens model is fth"),
    "realsense short.json": (json.dumps({"ppx": 3}), "RealSense's SDK. Its entry 'fx' is missing"),
    "realsense of two.json": (json.dumps({**REALSENSE, "coeffs": [1.0, 2.0]}), "and five finite coefficients"),
    "realsense of 0.json": (
        json.dumps({**REALSENSE, "fx": 0, "coeffs": [0.1] * 5}),
        "needs a focal length other than 0",
    ),
    "region.yaml": (
        ros_echo(False, "plumb_bob", []).replace("---", "roi:\n  x_offset: 0\n  y_offset: 60"),
        "roi: starts",
    ),
    "transforms of lenses.json": (
        json.dumps({"frames": [NERF, {**NERF, "k1": 0.2}]}),
        "the frames have different cameras",
    ),
    "transforms of many.json": (json.dumps({"frames": [NERF, {**NERF, "fl_x": 3}]}), "have different cameras"),
    "transforms of huge numbers.json": (
        json.dumps({"frames": [{**NERF, "fl_x": 10**400}] * 2}),
        "fx: must be a number",
    ),
    "transforms of text.json": (json.dumps({"frames": [{**NERF, "fl_x": "long"}]}), "fx: must be a number"),
    "transforms of poses.json": (json.dumps({"frames": [{"file_path": "a"}] * 2}), "Its entry 'fl_x' is missing"),
    "transforms round.json": (json.dumps({**NERF, "camera_model": "EQUIRECTANGULAR"}), "'EQUIRECTANGULAR'"),
    "torn.json": ('{"width": 3', "not JSON"),
    "torn.yaml": ("a: [1, 2", "not YAML"),
    "tag.yaml": ("!!python/object/apply:os.system ['true']", "not YAML"),
    "torn opencv.yaml": (storage(".yml", OPENCV)[:90], "opencv"),
    "rows of another matrix.yaml": (storage(".yml", OPENCV).replace("rows: 3", "rows: 2"), "rows and columns"),
    "endless size.json": (
        storage(".json", OPENCV).replace('"image_width": 640', '"image_size": [1e999, 3]'),
        "endless",
    ),
    "opencv of text.xml": ("<opencv_storage><camera_matrix>a b</camera_matrix></opencv_storage>", "xml"),
    "other.xml": ("<html></html>", "opencv_storage"),
    "opencv without.json": (
        '{"a": {"type_id": "opencv-matrix", "rows": 1, "cols": 1, "dt": "d", "data": [1.0]}}',
        "camera_matrix",
    ),
    "orb without.yaml": (ORB.replace("Camera.cx", "Camera.cz"), "cx: missing"),
    "orb text.yaml": (ORB.replace("0.1\n", '"0.1"\n'), "Camera.k1: not a number"),
    "orb odd.yaml": (ORB.replace("PinHole", "Scaramuzza"), "Scaramuzza"),
    "opencv text.yaml": (LIST_OF_OPENCV.replace("500.0", '"x"'), "fx: must be a number"),
    "kalibr alone.yaml": (kalibr("radtan", RADTAN, True).split("  T_cn")[0], "T_cn_cnm1"),
    "ros zero.yaml": (ros1("plumb_bob", RADTAN).replace(str(ROWS), str([0.0] * 9)), "never calibrated"),
    "ros skewed.yaml": (ros1("plumb_bob", RADTAN).replace("500.0, 0.0", "500.0, 9.0"), "not a camera matrix"),
    "a pose.txt": ("1 0 0 2\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "neither a 3x3"),
    "a turn.txt": ("1 0 0\n0 1 0\n0 0 1\n", "cx, cy: 0 0"),
    "size first.txt": ("640 480 500 510 319.5 239.5 0 0\n", "distortion"),
    "tangential.toml": (TOML + "distortion=[0.1, 0.1, 40, 0]\n", "distortion: p1 or p2 is 40, more than a lens has"),
    "k3 before p1.toml": (TOML + "distortion=[0.1, 0.1, 0.3, 0, 0]\n", "distortion: p1 or p2 is 0.3, more than a"),
    "pincushion.toml": (TOML + "distortion=[20.0, 0, 0, 0]\n", "of the undistorted image would lie outside"),
    "vignetting of pixels.toml": (
        TOML + "vignetting=[0.9, 90.0]\n",
        "vignetting: multiplies parts of the image by 1 to",
    ),
    "black corners.toml": (TOML + "vignetting=[-1.0]\n", "vignetting: multiplies parts of the image by 0."),
    "vignetting.toml": (TOML + "vignetting=0.9\n", "vignetting: must be a list of up to 6 numbers"),
    "words of vignetting.toml": (TOML + "vignetting=['much']\n", "vignetting: must be a number"),
    "larger image.txt": ("1170 1170 647 483\n", "middle of an image of about 1294x966, not of 640x480"),
    "columns first.txt": ("500 319.5 510 239.5\n", "does not look like fx fy cx cy"),
    "columns of a wide image.txt": ("910.5 640.2 910.1 360.3\n", "does not look like fx fy cx cy"),
    "smaller image.toml": (TOML.replace("640", "1280").replace("480", "960"), "about 639x479, not of 1280x960"),
    "landscape.txt": ("500 510 239.5 319.5\n", "middle of an image of about 479x639, not of 640x480: rotate fx"),
    "exchanged.toml": (TOML.replace("cx=319.5", "cx=500").replace("cy=239.5", "cy=510"), "far from the middle of an"),
    "wide.txt": ("920 0 640\n0 920 360\n0 0 1\n", "cx, cy: 640 360 is far from the middle of an image of 640x480"),
    "corner.toml": (TOML.replace("319.5", "0").replace("239.5", "0"), "middle of an image of about 0x0"),
    "negative.toml": (TOML.replace("510", "-510"), "fy: negative (-510), as in ICL-NUIM"),
    "negative.txt": ("481.2 -480.0 319.5 239.5\n", "fy: negative (-480.0), as in ICL-NUIM"),
    "millimetres.toml": (TOML.replace("500", "3.6"), "fx: must be a number from 64 to 12800, not 3.6"),
    "names.txt": ("fx: 500\nfy: 510\n", "nor a row of fx fy cx cy: if its values have names, rename it to .yaml"),
    "toml.txt": (TOML, "nor a row of fx fy cx cy: if its values have names, rename it to .toml"),
    "underscores.txt": ("5_00 510 319.5 239.5\n", "neither a 3x3"),
    "numbers.txt": ("1 2 3\n4 5 6\n", "neither a 3x3"),
    "text.txt": ("hello\n", "neither a 3x3"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faulty_files_are_refused_in_one_line(tmp_path, name, capfd):
    text, fault = FAULTS[name]
    (tmp_path / name).write_text(text)
    with pytest.raises(GavoError) as caught:
        load_calibration(tmp_path / name, (640, 480) if name.endswith(".txt") else None)
    message = str(caught.value)
    assert message.startswith(str(tmp_path / name)) and fault in message and len(message.splitlines()) == 1, message
    assert capfd.readouterr() == ("", "")


def test_no_yaml_is_too_clever(tmp_path):
    """Numbers as people write them, and aliases that would grow."""
    (tmp_path / "a.yaml").write_text("fx: 5e2\nfy: 510\ncx: 319.5\ncy: 239.5\nwidth: 640\nheight: 480\nreadout: 2e-2\n")
    assert load_camera(tmp_path / "a.yaml") == replace(PINHOLE, readout=0.02)
    lines = ["a0: &a0 [1, 1]", *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 30))]
    (tmp_path / "b.yaml").write_text("\n".join(lines) + "\n")
    with pytest.raises(GavoError, match="unknown key"):
        load_camera(tmp_path / "b.yaml")


TEXTS = [text for text, _ in FILES.values()]


@settings(max_examples=400)
@given(
    text=st.sampled_from(TEXTS),
    at=st.floats(0, 1),
    cut=st.integers(0, 40),
    put=st.sampled_from(
        ["", "nan", "-", "[", "{", "]", ":", "\n", "  ", "1e999", "<", ">", '"', "\t", "&a ", "*a", "%", "0"]
    ),
    suffix=st.sampled_from([".yaml", ".json", ".xml", ".toml", ".txt"]),
)
def test_damage_anywhere_raises_nothing_else(tmp_path_factory, text, at, cut, put, suffix):
    place = int(at * len(text))
    path: Path = tmp_path_factory.mktemp("camera") / f"camera{suffix}"
    path.write_text(text[:place] + put + text[place + cut :])
    try:
        camera = load_camera(path)
        assert np.isfinite(camera.matrix).all()
    except GavoError as error:
        assert len(str(error).splitlines()) == 1 and str(path) in str(error)


def source_of(camera: Camera, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Where undistorted pixels come from in the recorded image, as OpenCV projects points through the lens."""
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    points = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 1, 3)
    project = cv2.fisheye.projectPoints if camera.model == "fisheye" else cv2.projectPoints
    if camera.model == "fisheye":
        found, _ = project(points, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion))
    else:
        found, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion))
    return found.reshape(*u.shape, 2)


@pytest.mark.parametrize("camera", [BROWN, RATIO, FISH, replace(FISH, distortion=(0.0,) * 4)], ids=str)
def test_undistortion_of_every_model_samples_where_the_lens_put_the_light(camera):
    v, u = np.mgrid[:480, :640].astype(float)

    def scene(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return 127 + 60 * np.sin(u / 40) + 60 * np.cos(v / 50)

    assert camera.is_distorted and not camera.rectified().is_distorted
    source = source_of(camera, u, v)
    inside = (source[..., 0] > 0) & (source[..., 0] < 639) & (source[..., 1] > 0) & (source[..., 1] < 479)
    undistorted = camera.undistort_image(np.round(scene(u, v)).astype(np.uint8))
    assert np.abs(undistorted - scene(source[..., 0], source[..., 1]))[inside].max() < 1.6
    columns = np.broadcast_to(np.arange(1, 641, dtype=np.uint16), (480, 640)).copy()
    found = camera.undistort_depth(columns)
    kept = found > 0
    assert kept.mean() > 0.5 and np.abs(found - 1 - source[..., 0])[kept].max() < 0.55


@pytest.mark.parametrize(
    ("place", "words"),
    [
        (None, "or neither"),
        (COLOR_T_DEPTH.T, "a rotation and a translation"),
        (TURN, "4x4"),
        (np.full((4, 4), np.nan), "a rotation and a translation"),
    ],
    ids=["none", "transposed", "without a shift", "not finite"],
)
def test_a_calibration_of_two_cameras_says_where_they_are(place, words):
    """Depth went to other pixels without a word, or a run ended in a traceback."""
    assert Calibration(PINHOLE, PINHOLE, COLOR_T_DEPTH).depth is PINHOLE
    with pytest.raises(GavoError, match=words):
        Calibration(PINHOLE, PINHOLE, place)
