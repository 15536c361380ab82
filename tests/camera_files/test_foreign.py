"""Camera files of other programs: COLMAP's is read, and others are refused in words that help."""

import json
from pathlib import Path

import numpy as np
import pytest

from gavo_jax.camera_files.calibration import load_calibration
from gavo_jax.errors import GavoError

CAMERA = {"fx": 500.0, "fy": 510.0, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480}
MATRIX = [[500.0, 0, 319.5], [0, 510.0, 239.5], [0, 0, 1]]
HEAD = "# Camera list\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"

COLMAP: dict[str, tuple[str, tuple[float, ...], str]] = {
    "PINHOLE": ("500 510 320 240", (), "pinhole"),
    "OPENCV": ("500 510 320 240 0.1 -0.2 0.001 -0.002", (0.1, -0.2, 0.001, -0.002, 0), "pinhole"),
    "FULL_OPENCV": (
        "500 510 320 240 0.1 -0.2 0.001 -0.002 0.3 0.4 0.5 0.6",
        (0.1, -0.2, 0.001, -0.002, 0.3, 0.4, 0.5, 0.6),
        "pinhole",
    ),
    "OPENCV_FISHEYE": ("500 510 320 240 0.1 -0.2 0.01 0", (0.1, -0.2, 0.01, 0), "fisheye"),
    "SIMPLE_PINHOLE": ("500 320 240", (), "pinhole"),
    "SIMPLE_RADIAL": ("500 320 240 0.1", (0.1, 0, 0, 0, 0), "pinhole"),
    "RADIAL": ("500 320 240 0.1 -0.2", (0.1, -0.2, 0, 0, 0), "pinhole"),
    "RADIAL_FISHEYE": ("500 320 240 0.1 -0.2", (0.1, -0.2, 0, 0), "fisheye"),
}


@pytest.mark.parametrize("model", COLMAP)
@pytest.mark.parametrize("cameras", [1, 2])
def test_colmaps_cameras_are_read(tmp_path: Path, model: str, cameras: int) -> None:
    """Its first pixel has its centre at a half."""
    numbers, lens, kind = COLMAP[model]
    rows = [f"{i + 1} {model} 640 480 {numbers}\n" for i in range(cameras)]
    (tmp_path / "cameras.txt").write_text(HEAD + "".join(rows))
    found = load_calibration(tmp_path / "cameras.txt").color
    fy = 500.0 if "SIMPLE" in model or "RADIAL" in model else 510.0
    assert (found.fx, found.fy, found.cx, found.cy) == (500, fy, 319.5, 239.5)
    assert (found.width, found.height, found.model) == (640, 480, kind)
    np.testing.assert_array_equal(found.distortion, lens or np.zeros(5))


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("1 PINHOLE 640 480 500 510 320 240\n2 PINHOLE 640 480 400 400 320 240\n", "2 cameras of COLMAP: leave that"),
        ("1 THIN_PRISM_FISHEYE 640 480 500 510 320 240 0 0 0 0 0 0 0 0\n", "model THIN_PRISM_FISHEYE is not read: SIM"),
        ("1 PINHOLE 640 480 500 320 240\n", "COLMAP's PINHOLE has the numbers fx fy cx cy, not '500 320 240'"),
        ("1 PINHOLE 640 480 500 x 320 240\n", "COLMAP's PINHOLE has the numbers fx fy cx cy, not '500 x 320 240'"),
    ],
)
def test_other_cameras_of_colmap_are_refused(tmp_path: Path, rows: str, words: str) -> None:
    (tmp_path / "cameras.txt").write_text(HEAD + rows)
    with pytest.raises(GavoError, match=rf"cameras\.txt: .*{words}"):
        load_calibration(tmp_path / "cameras.txt")


READ = {
    "rows.json": json.dumps(MATRIX),
    "rows.yaml": str(MATRIX),
    "matlab.txt": "[500 0 319.5; 0 510 239.5; 0 0 1]\n",
    "storage.yml": "%YAML:1.0\n" + "".join(f"{key}: {value}\n" for key, value in CAMERA.items()),
    "size of floats.json": json.dumps({**CAMERA, "width": 640.0, "height": 480.0}),
}


@pytest.mark.parametrize("name", READ)
def test_cameras_in_other_forms_are_read(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(READ[name])
    found = load_calibration(tmp_path / name, (640, 480)).color
    assert (found.fx, found.fy, found.cx, found.cy, found.width, found.height) == tuple(CAMERA.values())


@pytest.mark.parametrize("unit", [0.001, 0.0002])
@pytest.mark.parametrize("ending", ["json", "yaml"])
def test_a_unit_of_depth_in_metres_is_one_beside_single_numbers_too(tmp_path: Path, ending: str, unit: float) -> None:
    """It made a kilometre of a millimetre."""
    (tmp_path / f"camera.{ending}").write_text(json.dumps({**CAMERA, "depth_scale": unit}))
    assert load_calibration(tmp_path / f"camera.{ending}").color.depth_scale == pytest.approx(1 / unit)


INTRINSICS = {"ppx": 319.5, "ppy": 239.5, **CAMERA}
REFUSED = {
    "bop.json": ({**CAMERA, "depth_scale": 0.1}, "depth_scale: 0.1: .*BOP's is in millimetres per unit: write 10000"),
    "depthai.json": ({"cameraData": [[0, {}]], "version": 7}, r"DepthAI's calibration.*getCameraIntrinsics\(socket"),
    "k4a.json": ({"CalibrationInformation": {"Cameras": []}}, "Azure Kinect's raw .* azure_kinect_mkv_reader"),
    "viewer.json": ({"device": {}, "parameters": {}, "schema version": 1}, "settings of RealSense's viewer.*enumerate"),
    "two.json": ({"color": INTRINSICS, "depth": INTRINSICS}, "a camera in color, depth: write that of colour alone"),
    "monogs.yaml": ({"Dataset": {"Calibration": CAMERA}}, r"a camera in Dataset\.Calibration: write that"),
    "frame.json": ({"cameraPoseARFrame": [1], "intrinsics": [1]}, "metadata of a frame: omit --camera"),
    "scene_camera.json": ({"0": {"cam_K": [1]}}, "one camera per frame: .*omit --camera"),
    "pose_intrinsic_imu.json": ({"frame_000000": {"intrinsic": MATRIX}}, "one camera per frame"),
    "habitat.json": ({"width": 640, "height": 480, "hfov": 90}, r"an angle of view .* width / \(2 tan\(angle / 2\)\)"),
    "isaac.json": ({"cameraFocalLength": 18, "cameraAperture": [20, 15]}, "width [*] focal length / aperture"),
    "transforms.json": ({"camera_angle_x": 0.7, "frames": []}, r"write fl_x = w / \(2 tan\(camera_angle_x / 2\)\)"),
    "enumerate.txt": ("  Width: 640\n  PPX: 319.5\n  Fx: 500\n", "of RealSense: write width, height"),
    "kitti.txt": ("P0: 7e2 0 6e2 0 0 7e2 1e2 0 0 0 1 0\n", "of KITTI: write the first, sixth, third"),
    "freenect.txt": ("fx 500\nfy 510\n", "if its values have names, put = behind each and rename it to .toml"),
    "K.npy": ("x", r"K\.npy: a camera file ends in .* or \.pincam: write it as text: numpy\.savetxt"),
    "SN1234.conf": ("[LEFT_CAM_HD]\nfx=700\n", r"a ZED's applies to unrectified images"),
    "camera.odd": ("x", r"camera\.odd: a camera file ends in \.toml, .* or \.pincam$"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_cameras_that_are_not_read_are_told_in_words_that_help(tmp_path: Path, name: str) -> None:
    content, words = REFUSED[name]
    (tmp_path / name).write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(GavoError, match=words) as caught:
        load_calibration(tmp_path / name, (640, 480))
    assert str(caught.value).startswith(f"{tmp_path / name}: ") and len(str(caught.value).splitlines()) == 1
