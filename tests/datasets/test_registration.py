"""Depth of another camera, registered: against a scene cast from both cameras, with what hides what."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from written_folders import image

from gavo_jax.camera import Camera
from gavo_jax.camera_files.calibration import Calibration
from gavo_jax.datasets.base import FrameError
from gavo_jax.datasets.files import Reading, open_pair
from gavo_jax.datasets.layouts.numbered import ScanNet
from gavo_jax.datasets.registration import Registration, _without_cracks
from gavo_jax.datasets.registry import open_source
from gavo_jax.errors import GavoError
from gavo_jax.trajectory import inverse

COLOR = Camera(260.0, 262.0, 158.0, 121.0, 320, 240, depth_scale=5000.0)
NARROW = Camera(290.0, 288.0, 161.0, 118.0, 320, 240)
COARSE = Camera(130.0, 131.0, 79.0, 61.0, 160, 120)
FINE = Camera(520.0, 521.0, 320.0, 241.0, 640, 480)
LENS = replace(NARROW, distortion=(0.2, -0.5, 0.001, -0.002, 0.3))
FISHEYE = replace(NARROW, distortion=(-0.02, 0.01, 0.0, 0.0), model="fisheye")
TURN = cv2.Rodrigues(np.array([0.01, -0.03, 0.02]))[0]
COLOR_T_DEPTH = np.block([[TURN, np.array([[-0.05], [0.01], [0.02]])], [np.zeros((1, 3)), np.ones((1, 1))]])


def rays_of(camera: Camera) -> np.ndarray:
    """Where each recorded pixel looks, [h, w, 3], z = 1."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
    undistort = cv2.fisheye.undistortPoints if camera.model == "fisheye" else cv2.undistortPoints
    ends = undistort(pixels, camera.matrix, np.array(camera.distortion)).reshape(*u.shape, 2)
    return np.concatenate([ends, np.ones((*u.shape, 1))], -1)


def cast(camera: Camera, color_T_camera: np.ndarray) -> np.ndarray:
    """Depth, metres: a slanted wall two metres off, a board before it at one metre (in the colour camera's axes)."""
    rays = rays_of(camera) @ color_T_camera[:3, :3].T
    start = color_T_camera[:3, 3]
    normal = np.array([0.3, 0.1, 1.0])
    wall = (2.0 - start @ normal) / (rays @ normal)
    board = (1.0 - start[2]) / rays[..., 2]
    x, y = (start[i] + board * rays[..., i] for i in (0, 1))
    return np.where((np.abs(x - 0.05) < 0.2) & (np.abs(y) < 0.15), board, wall)


@pytest.mark.parametrize(
    "camera", [NARROW, COARSE, FINE, LENS, FISHEYE], ids=["narrow", "coarse", "fine", "lens", "fisheye"]
)
def test_registered_depth_is_what_the_colour_camera_would_measure(camera):
    raw = np.round(cast(camera, COLOR_T_DEPTH) * 5000).astype(np.uint16)
    registered = Registration(camera, COLOR, COLOR_T_DEPTH)(raw, 5000.0)
    truth = cast(COLOR, np.eye(4))
    assert registered.shape == (240, 320) and registered.dtype == np.uint16
    board = (truth < 1.5).astype(np.uint8)
    near_edge = cv2.dilate(board, np.ones((25, 25))) != cv2.erode(board, np.ones((9, 9)))
    middle = np.zeros_like(near_edge)
    middle[30:-30, 40:-60] = True  # what both cameras see
    clear = middle & ~near_edge
    assert (registered[clear] > 0).mean() > 0.9995, "no cracks"
    off = np.abs(registered / 5000 - truth)[clear & (registered > 0)]
    # a reading stands for a pixel that it is up to half a pixel away from, on the slanted wall
    assert off.max() < 0.012 * max(1, COLOR.fx / camera.fx) and np.median(off) < 0.003 * max(1, COLOR.fx / camera.fx)


@pytest.mark.parametrize("degrees", [5.0, 20.0, 45.0, 90.0, 135.0, 180.0, -90.0])
def test_a_depth_camera_may_be_mounted_at_any_angle(degrees):
    """Of one on its side no reading was drawn, and a fifth of them were missing at 45 degrees."""
    color_T_depth = np.eye(4)
    color_T_depth[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.0, np.radians(degrees)]))[0]
    camera = Camera(260.0, 260.0, 199.5, 199.5, 400, 400)
    raw = np.round(cast(camera, color_T_depth) * 5000).astype(np.uint16)
    registered = Registration(camera, COLOR, color_T_depth)(raw, 5000.0)[40:-40, 60:-60] / 5000
    off = np.abs(registered - cast(COLOR, np.eye(4))[40:-40, 60:-60])
    assert (registered > 0).all() and np.median(off) < 0.003 and np.mean(off > 0.012) < 0.03


def test_a_crack_is_closed_only_where_both_sides_are_one_surface():
    """Catches readings that are made up across an edge, or that lie off the surface whose crack they close."""
    row = np.array([[1000, 0, 1020, 0, 2000, 0, 0, 2000]], np.uint16)
    np.testing.assert_array_equal(_without_cracks(row.copy()), [[1000, 1010, 1020, 0, 2000, 0, 0, 2000]])
    np.testing.assert_array_equal(_without_cracks(row.T.copy()).T, [[1000, 1010, 1020, 0, 2000, 0, 0, 2000]])


def test_what_is_hidden_stays_hidden():
    """The colour camera sees the board where the depth camera saw wall and board; and nothing where it saw neither."""
    raw = np.round(cast(NARROW, COLOR_T_DEPTH) * 5000).astype(np.uint16)
    registered = Registration(NARROW, COLOR, COLOR_T_DEPTH)(raw, 5000.0) / 5000
    truth = cast(COLOR, np.eye(4))
    board = cv2.erode((truth < 1.5).astype(np.uint8), np.ones((3, 3))) > 0
    assert np.all((registered[board] < 1.5) & (registered[board] > 0))
    wall = cv2.erode((truth > 1.5).astype(np.uint8), np.ones((5, 5))) > 0
    assert np.all((registered[wall] > 1.5) | (registered[wall] == 0))
    shadow = (registered == 0)[30:-30, 40:-40]
    assert 100 < shadow.sum() < 3000


def test_the_same_camera_changes_nothing():
    raw = np.round(cast(COLOR, np.eye(4)) * 5000).astype(np.uint16)
    raw[50:60, 70:90] = 0
    np.testing.assert_array_equal(Registration(COLOR, COLOR, np.eye(4))(raw, 5000.0), raw)


def test_into_a_lens_with_distortion():
    """Frames that are not undistorted get depth as it lies in the recorded image."""
    raw = np.round(cast(NARROW, COLOR_T_DEPTH) * 5000).astype(np.uint16)
    lens = replace(COLOR, distortion=(0.2, -0.5, 0.001, -0.002, 0.3))
    for camera in (lens, replace(COLOR, distortion=(-0.02, 0.01, 0.0, 0.0), model="fisheye")):
        registered = Registration(NARROW, camera, COLOR_T_DEPTH)(raw, 5000.0) / 5000
        truth = cast(camera, np.eye(4))
        both = (registered > 0) & (cv2.Laplacian(truth, cv2.CV_64F, ksize=5) ** 2 < 0.01)
        assert both.mean() > 0.5 and np.percentile(np.abs(registered - truth)[both], 99) < 0.012


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_readings_beyond_the_reach_of_a_lens_do_not_fold_into_the_image(model):
    """They landed amid what the lens does show: those 60 degrees off its axis near the centre."""
    lens = replace(COLOR, distortion=(-0.4, 0.0, 0.0, 0.0, 0.0)[: 4 if model == "fisheye" else 5], model=model)
    wide = Camera(40.0, 40.0, 79.5, 59.5, 160, 120)
    rays = np.hypot(*(axis.reshape(120, 160) for axis in Registration(wide, wide, np.eye(4))._rays[:2]))
    raw = np.where(rays > 1.5, 2000, 0).astype(np.uint16)
    assert raw.any() and not Registration(wide, lens, np.eye(4))(raw, 1000.0).any()


def test_rays_of_a_wide_lens_are_followed_to_the_end():
    """By OpenCV's usual five iterations those of a wide barrel lens were off by pixels."""
    lens = Camera(240.0, 240.0, 319.5, 239.5, 640, 480, (-0.26, 0.05, 0.0, 0.0, 0.0))
    rays = Registration(lens, lens, np.eye(4))._rays.T.astype(float)
    seen, _ = cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), lens.matrix, np.array(lens.distortion))
    v, u = np.mgrid[:480, :640]
    off = np.linalg.norm(seen[:, 0] - np.stack([u.ravel(), v.ravel()], -1), axis=1).reshape(480, 640)
    assert np.quantile(off[60:-60, 80:-80], 0.999) < 0.02


def test_readings_behind_or_beyond_are_dropped():
    raw = np.full((240, 320), 60000, np.uint16)
    back = np.eye(4)
    back[2, 3] = -20.0
    assert not Registration(COLOR, COLOR, back)(raw, 5000.0).any()
    back[2, 3] = 2.0
    assert not Registration(COLOR, COLOR, back)(raw, 5000.0).any()


RIG = """fx = 260.0
fy = 262.0
cx = 158.0
cy = 121.0
width = 320
height = 240
distortion = [0.1, -0.2, 0.0, 0.0]
depth_scale = 1000
colour_T_depth = {pose}
[depth]
fx = 130.0
fy = 131.0
cx = 79.0
cy = 61.0
width = 160
height = 120
"""


@pytest.fixture
def folder(tmp_path) -> Path:
    for i in range(2):
        image(tmp_path / f"color/{i}.png", np.random.default_rng(i).integers(0, 255, (240, 320), dtype=np.uint8))
        image(tmp_path / f"depth/{i}.png", np.round(cast(COARSE, COLOR_T_DEPTH) * 1000).astype(np.uint16))
    (tmp_path / "camera.toml").write_text(RIG.format(pose=COLOR_T_DEPTH.tolist()))
    return tmp_path


def test_a_folder_with_both_cameras(folder):
    sequence = open_source(folder)
    frame, truth = sequence[0], cast(COLOR, np.eye(4))
    assert frame.depth.shape == frame.grey.shape == (240, 320) and not sequence.camera.is_distorted
    seen = frame.depth > 0
    assert 0.5 < seen.mean() < 0.99 and np.median(np.abs(frame.depth / 1000 - truth)[seen]) < 0.006
    raw = open_source(folder, Reading(undistort=False))[0]
    assert raw.depth.shape == (240, 320) and not np.array_equal(raw.depth, frame.depth)


def test_depth_of_another_size_asks_for_its_camera(folder):
    plain = Reading(camera=COLOR)
    with pytest.raises(
        FrameError, match=r"0\.png: is 160x120 pixels, but the colour .* 320x240: to register .*\[depth\].* times 0\.5$"
    ):
        open_source(folder, plain)[0]
    other = Calibration(COLOR, replace(COARSE, width=162), COLOR_T_DEPTH)
    with pytest.raises(GavoError, match=r"0\.png: is 160x120 pixels, but the depth camera's images are 162x120"):
        open_pair([(folder / "color/0.png", folder / "depth/0.png")], other)[0]


def test_scannet_with_cameras_of_two_sizes(folder):
    for camera, name in ((COLOR, "color"), (COARSE, "depth")):
        four = np.eye(4)
        four[:3, :3] = camera.matrix
        (folder / "intrinsic").mkdir(exist_ok=True)
        np.savetxt(folder / "intrinsic" / f"intrinsic_{name}.txt", four)
    sequence = open_source(folder)
    assert isinstance(sequence, ScanNet) and sequence[0].depth.shape == (240, 320)


def test_the_truth_of_seven_scenes_is_the_depth_cameras(tmp_path):
    poses = [np.eye(4), COLOR_T_DEPTH]
    for i, pose in enumerate(poses):
        image(tmp_path / f"frame-{i:06}.color.png", np.zeros((240, 320), np.uint8))
        image(tmp_path / f"frame-{i:06}.depth.png", np.full((120, 160), 1500, np.uint16))
        np.savetxt(tmp_path / f"frame-{i:06}.pose.txt", pose)
    truth = open_source(tmp_path, Reading(camera=Calibration(COLOR, COARSE, COLOR_T_DEPTH))).ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth.world_T_camera, [pose @ inverse(COLOR_T_DEPTH) for pose in poses], atol=1e-9)
