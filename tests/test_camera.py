"""Intrinsics, levels, projection, undistortion and camera files."""

from dataclasses import replace
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gavo_jax.camera import PRESETS, RIM, Camera, in_image, inverse_depth, preset_for_sequence, vignetting_gain
from gavo_jax.camera_check import require_camera
from gavo_jax.camera_files.calibration import load_camera
from gavo_jax.errors import GavoError

SMALL = Camera(50.0, 52.0, 31.2, 23.9, 64, 48)
TOML = "fx = 50.0\nfy = 52\ncx = 31.2\ncy = 23.9\nwidth = 64\nheight = 48\n"
YAML = "---\n# a comment\nfx: 50.0\nfy: 52  # pixels\ncx: 31.2\ncy: 23.9\nwidth: 64\nheight: 48\n"

coordinate = st.floats(-5, 5)
cameras = st.builds(
    Camera,
    fx=st.floats(20, 2000),
    fy=st.floats(20, 2000),
    cx=st.floats(0, 640),
    cy=st.floats(0, 480),
    width=st.just(640),
    height=st.just(480),
)


def distorted_source(camera: Camera, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where an undistorted pixel comes from in the recorded image: Brown-Conrady, from its formula in float64."""
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return camera.fx * xd + camera.cx, camera.fy * yd + camera.cy


@given(camera=cameras, x=coordinate, y=coordinate, z=st.floats(0.1, 10))
def test_projection_then_back_projection_is_identity(camera, x, y, z):
    points = np.array([[x, y, z]])
    pixels = camera.project(points)
    assert pixels.dtype == np.float64
    np.testing.assert_allclose(camera.back_project(pixels, points[:, 2]), points, rtol=1e-9, atol=1e-9)


def test_projection_follows_the_pinhole_formula_in_numpy_and_jax():
    points = np.array([[[0.2, -0.1, 2.0], [0.0, 0.0, 1.0]]])
    expected = np.array([[[50 * 0.1 + 31.2, 52 * -0.05 + 23.9], [31.2, 23.9]]])
    np.testing.assert_allclose(SMALL.project(points), expected)
    traced = jax.jit(lambda camera, p: camera.project(p))(SMALL, jnp.asarray(points, jnp.float32))
    np.testing.assert_allclose(traced, expected, rtol=1e-6)
    lifted = jax.jit(lambda camera, uv, z: camera.back_project(uv, z))(SMALL, expected, points[..., 2])
    np.testing.assert_allclose(lifted, points, atol=1e-6)


def test_camera_is_a_pytree_with_static_sizes():
    leaves, structure = jax.tree.flatten(Camera.preset("fr1"))
    assert leaves == [517.3, 516.5, 318.6, 255.3, 5000.0, 0.02]
    assert jax.tree.unflatten(structure, leaves) == Camera.preset("fr1")


@pytest.mark.parametrize("k", [0, 1, 2, 4])
def test_a_level_sees_its_pixels_where_their_averages_lie(k):
    """Catches a half-pixel shift: the mean of 2^k × 2^k pixels' rays is the ray of the level's pixel."""
    camera = Camera.preset("fr3")
    level = camera.level(k)
    assert (level.width, level.height) == (640 >> k, 480 >> k)
    side = 2**k
    fine = np.stack(np.meshgrid(np.arange(3 * side, 4 * side), np.arange(5 * side, 6 * side)), -1).astype(float)
    rays = camera.back_project(fine, np.ones(fine.shape[:2]))
    coarse = level.back_project(np.array([3.0, 5.0]), np.array(1.0))
    np.testing.assert_allclose(coarse, rays.mean(axis=(0, 1)), atol=1e-12)


def test_levels_compose():
    camera = Camera.preset("fr1")
    np.testing.assert_allclose(jax.tree.leaves(camera.level(1).level(2)), jax.tree.leaves(camera.level(3)))


@pytest.mark.parametrize("name", ["fr1", "fr2"])
def test_undistortion_samples_where_the_lens_put_the_light(name):
    """A smooth image, sampled at the analytic source position; catches the inverse mapping and swapped axes."""
    camera = Camera.preset(name)
    v, u = np.mgrid[:480, :640].astype(float)

    def image(u, v):
        return 127 + 60 * np.sin(u / 40) + 60 * np.cos(v / 50)

    source_u, source_v = distorted_source(camera, u, v)
    inside = (source_u >= 0) & (source_u <= 639) & (source_v >= 0) & (source_v <= 479)
    undistorted = camera.undistort_image(np.round(image(u, v)).astype(np.uint8))
    assert np.abs(undistorted[inside] - image(source_u, source_v)[inside]).max() < 1.5
    color = camera.undistort_image(np.repeat(np.round(image(u, v)).astype(np.uint8)[..., None], 3, axis=-1))
    np.testing.assert_array_equal(color, np.repeat(undistorted[..., None], 3, axis=-1))


def test_a_camera_of_jax_numbers_undistorts_like_one_of_pythons():
    camera = replace(Camera.preset("fr1"), fx=517.25, fy=516.5, cx=318.5, cy=255.25)
    traced = jax.tree.map(jnp.float32, camera)
    image = np.random.default_rng(0).integers(0, 255, (480, 640)).astype(np.uint8)
    np.testing.assert_array_equal(traced.undistort_image(image), camera.undistort_image(image))
    depth = image.astype(np.uint16)
    np.testing.assert_array_equal(traced.undistort_depth(depth), camera.undistort_depth(depth))


@pytest.mark.parametrize("k2", [-0.05, -0.2])
def test_a_fisheye_reaches_to_where_its_polynomial_turns_back(k2):
    """Catches powers of the angle that are those of another model: θ + k2 θ⁵ turns back at θ⁴ = -1 / (5 k2)."""
    fisheye = replace(SMALL, distortion=(0.0, k2, 0.0, 0.0), model="fisheye")
    assert fisheye.reach == pytest.approx(np.tan((-5 * k2) ** -0.25), rel=5e-3)


def test_an_image_ends_at_the_centres_of_its_outermost_pixels():
    """Catches one column or row too many, which would be read from beyond the image."""
    u, v = [0.0, 63.0, 63.01, -0.01, 5.0, 5.0], [47.0, 0.0, 5.0, 5.0, 47.01, -0.01]
    assert in_image(SMALL, np.array(u), np.array(v)).tolist() == [True, True, False, False, False, False]


def test_inverse_depth_is_per_metre_and_0_without_a_reading():
    """Catches raw depth that is multiplied by its scale, and readings that are none."""
    readings = np.array([5000.0, 10000.0, 0.0, np.nan, np.inf, -5000.0])
    np.testing.assert_array_equal(inverse_depth(readings, SMALL), [1.0, 0.5, 0.0, 0.0, 0.0, 0.0])


def test_a_lens_reaches_to_where_its_polynomial_turns_back():
    barrel = replace(Camera.preset("fr1"), distortion=(-0.6, 0.0, 0.0, 0.0, 0.0))
    assert barrel.reach == pytest.approx(1.8**-0.5, abs=2e-3)
    assert all(Camera.preset(name).reach > 1.2 for name in PRESETS)
    assert replace(barrel, distortion=(0.0, 0.0, 0.0, 0.0), model="fisheye").reach == np.inf
    depth = barrel.undistort_depth(np.full((480, 640), 5000, np.uint16))
    v, u = np.mgrid[:480, :640]
    off = np.hypot((u - barrel.cx) / barrel.fx, (v - barrel.cy) / barrel.fy)
    assert (off > barrel.reach).any() and not depth[off > barrel.reach].any() and depth[off < 0.9 * barrel.reach].all()


def test_undistortion_leaves_no_black_rim():
    camera = Camera.preset("fr1")
    grey = np.full((480, 640), 200, np.uint8)
    assert np.all(camera.undistort_image(grey) == 200)


@pytest.mark.parametrize("name", ["fr1", "fr2"])
def test_undistorted_depth_is_nearest_and_empty_near_the_rim(name):
    camera = Camera.preset(name)
    v, u = np.mgrid[:480, :640].astype(float)
    source_u, source_v = distorted_source(camera, u, v)
    rows = np.broadcast_to(np.arange(1, 481, dtype=np.uint16)[:, None], (480, 640)).copy()
    columns = np.broadcast_to(np.arange(1, 641, dtype=np.uint16), (480, 640)).copy()
    row, column = (camera.undistort_depth(depth).astype(int) for depth in (rows, columns))
    margin = np.minimum.reduce([source_u, 639 - source_u, source_v, 479 - source_v])
    assert np.all(row[margin < RIM - 0.01] == 0)
    kept = margin > RIM + 0.01
    assert np.all(row[kept] > 0)
    assert np.abs(row - 1 - source_v)[kept].max() < 0.55
    assert np.abs(column - 1 - source_u)[kept].max() < 0.55
    assert 0.5 < kept.mean() < 0.99


def test_without_distortion_the_same_objects_come_back():
    grey, depth = np.zeros((48, 64), np.uint8), np.zeros((48, 64), np.uint16)
    same_grey, same_depth = SMALL.undistort(grey, depth)
    assert same_grey is grey and same_depth is depth
    assert not Camera.preset("fr1").rectified().is_distorted
    assert Camera.preset("fr1").rectified().fx == 517.3


def test_vignetting_is_undone_in_all_kinds_of_images():
    """Dark corners stand still while the scene moves: they drew the motion of corridors with them."""
    camera = replace(SMALL, vignetting=(2.0, 1.0))
    x, y = (np.arange(64) - SMALL.cx) / SMALL.fx, (np.arange(48)[:, None] - SMALL.cy) / SMALL.fy
    fourth_power = np.cos(np.arctan(np.hypot(x, y))) ** 4
    assert fourth_power.min() < 0.8, "a wide view"
    flat = (100.0 * fourth_power).astype(np.float32)
    depth = np.ones((48, 64), np.uint16)
    grey, same_depth = camera.undistort(flat, depth)
    assert same_depth is depth and grey.dtype == np.float32
    np.testing.assert_allclose(grey, 100.0, rtol=1e-5)
    bytes_of_it = np.round(np.dstack([flat] * 3)).astype(np.uint8)
    color = camera.undistort_image(bytes_of_it)
    assert color.dtype == np.uint8 and np.abs(color.astype(int) - 100).max() <= 1
    white = np.full((48, 64), 250, np.uint8)
    assert camera.undistort_image(white).min() >= 250 and camera.undistort_image(white.astype(float)).max() == 255
    assert not camera.is_rectified and not camera.is_distorted and camera.rectified() == SMALL.rectified()


def test_vignetting_is_undone_after_distortion():
    camera = replace(Camera.preset("fr1"), vignetting=(0.5,))
    flat = np.full((480, 640), 100, np.uint8)
    gain = vignetting_gain(camera)
    assert gain[0, 0] == pytest.approx(1 + 0.5 * ((camera.cx / camera.fx) ** 2 + (camera.cy / camera.fy) ** 2))
    assert np.abs(camera.undistort_image(flat) - 100 * gain).max() <= 0.51


@pytest.mark.parametrize("vignetting", [(np.nan,), ("dark",), [0.1], 0.1])
def test_vignetting_is_a_tuple_of_numbers(vignetting):
    with pytest.raises(GavoError, match="vignetting: expected a tuple of numbers"):
        require_camera(replace(SMALL, vignetting=vignetting))


def test_undistortion_refuses_another_size():
    with pytest.raises(ValueError, match="480 rows"):
        Camera.preset("fr1").undistort_image(np.zeros((240, 320), np.uint8))


def test_images_of_the_other_byte_order_are_undistorted_alike():
    """Depth of 5000 became 34835."""
    camera = replace(Camera.preset("fr1"), vignetting=(0.3,))
    raw = np.random.default_rng(0).integers(3000, 6000, (480, 640)).astype(np.uint16)
    for undistort in (camera.undistort_depth, camera.undistort_image):
        np.testing.assert_array_equal(undistort(raw.astype(">u2")), undistort(raw.astype("<u2")))


def test_images_of_any_numbers_are_undistorted():
    """What a frame may hold, OpenCV refused with a message of its own."""
    camera = replace(Camera.preset("fr1"), vignetting=(0.3,))
    raw = np.random.default_rng(0).integers(0, 256, (480, 640))
    for undistort in (camera.undistort_depth, camera.undistort_image):
        right = undistort(raw.astype(np.float32))
        for kind in (np.int64, np.float16, np.int8):
            np.testing.assert_array_equal(undistort(raw.astype(kind)), undistort(raw.astype(kind).astype(np.float32)))
        np.testing.assert_array_equal(undistort(jnp.asarray(raw)), right)  # pyright: ignore[reportArgumentType]


def test_a_lens_without_distortion_reaches_everywhere():
    assert Camera(500.0, 500.0, 319.5, 239.5, 640, 480, distortion=()).reach == np.inf


def test_undistortion_agrees_with_opencv():
    camera = Camera.preset("fr1")
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    grey = np.random.default_rng(0).integers(0, 256, (480, 640), dtype=np.uint8)
    theirs = cv2.undistort(grey, matrix, np.array(camera.distortion))
    ours = camera.undistort_image(grey)
    middle = np.s_[60:-60, 60:-60]
    assert np.abs(ours[middle].astype(int) - theirs[middle]).mean() < 1


@pytest.mark.parametrize(
    ("name", "preset"),
    [
        ("rgbd_dataset_freiburg1_xyz", "fr1"),
        ("fr1_desk", "fr1"),
        ("FR2_desk", "fr2"),
        ("rgbd_dataset_freiburg3_long_office_household", "fr3"),
        ("clip-fr3", "fr3"),
        ("rgbd_bonn_balloon", "bonn"),
        ("living_room_traj2_frei_png", "icl"),
        ("icl-office", "icl"),
    ],
)
def test_sequence_names_pick_the_preset(name, preset):
    assert preset_for_sequence(name) == preset


@pytest.mark.parametrize("name", ["office", "fr4_x", "fr12", "afr1_x", "bonn", "icloud", "vehicle", ""])
def test_other_sequence_names_ask_for_a_camera(name):
    with pytest.raises(GavoError, match="--camera"):
        preset_for_sequence(name)


def test_camera_files(tmp_path):
    (tmp_path / "a.toml").write_text(TOML)
    (tmp_path / "b.yaml").write_text(YAML + "distortion: [0.1, -0.2, 0, 0.001]\ndepth_scale: 1000\n")
    (tmp_path / "c.toml").write_text(TOML + "distortion = [0.1, -0.2, 0, 0.001, 0.3]\n")
    assert load_camera(tmp_path / "a.toml") == SMALL
    expected = replace(SMALL, distortion=(0.1, -0.2, 0.0, 0.001, 0.0), depth_scale=1000.0)
    assert load_camera(str(tmp_path / "b.yaml")) == expected
    assert load_camera(tmp_path / "c.toml").distortion == (0.1, -0.2, 0.0, 0.001, 0.3)
    (tmp_path / "d.toml").write_text(TOML + "vignetting = [0.9, 0.2]\n")
    assert load_camera(tmp_path / "d.toml") == replace(SMALL, vignetting=(0.9, 0.2))
    (tmp_path / "d.toml").write_text(TOML + "readout = 0.02\n")
    assert load_camera(tmp_path / "d.toml") == replace(SMALL, readout=0.02)
    assert load_camera("fr2") == Camera.preset("fr2")


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (TOML.replace("fx = 50.0", "fx = nan"), "fx"),
        (TOML.replace("fx = 50.0", "fx = -50.0"), "fx"),
        (TOML.replace("fx = 50.0", "fx = '50'"), "fx"),
        (TOML.replace("fx = 50.0", "fx = true"), "fx"),
        (TOML.replace("fx = 50.0", "fx = 1e9"), "fx"),
        (TOML.replace("fx = 50.0", "fx = 1281"), "fx: must be a number from 6.4 to 1280, not 1281"),
        (TOML.replace("fy = 52", "fy = 52000"), "fy"),
        (TOML.replace("fx = 50.0", "fx = 1" + "0" * 400), "fx"),
        (TOML.replace("fx = 50.0", "fx = 0x" + "f" * 5000), "fx"),
        (TOML.replace("fx = 50.0", "fx = 1" + "0" * 5000), "TOML"),
        (TOML.replace("fx = 50.0\n", ""), "fx"),
        (TOML.replace("width = 64", "width = 64.5"), "width"),
        (TOML.replace("width = 64", "width = 100000"), "width"),
        (TOML.replace("width = 64", "width = 0"), "width"),
        (TOML + "fz = 1\n", "fz"),
        (TOML + "depth_scale = 0\n", "depth_scale"),
        (TOML + "depth_scale = inf\n", "depth_scale"),
        (TOML + "readout = -0.01\n", "readout"),
        (TOML + "readout = 20\n", "readout"),
        (TOML + "distortion = 3\n", "distortion"),
        (TOML + "distortion = [1, 2]\n", "distortion"),
        (TOML + "distortion = [1, 2, 3, nan]\n", "distortion"),
        (TOML + "distortion = [1, 2, 3, 4, [5]]\n", "distortion"),
        (TOML + '"a\\nb" = 1\n', "unknown key"),
        (TOML + "not toml at all", "TOML"),
        ("[" * 3000, "TOML"),
        ("", "missing"),
    ],
)
def test_bad_camera_files_are_refused_in_one_line(tmp_path, text, fault):
    path = tmp_path / "camera.toml"
    path.write_text(text)
    with pytest.raises(GavoError) as caught:
        load_camera(path)
    message = str(caught.value)
    assert message.startswith(str(path)) and fault in message and len(message.splitlines()) == 1


@pytest.mark.parametrize("text", [YAML + "fx: 3\n", YAML + "distortion:\n  - 1\n", YAML.replace("50.0", ".nan"), "x"])
def test_bad_yaml_is_refused(tmp_path, text):
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(GavoError, match=r"camera\.yaml"):
        load_camera(tmp_path / "camera.yaml")


@pytest.mark.parametrize("name", ["nonsense", "fr4", "", "missing.toml", "missing.yaml", "a\0b.toml"])
def test_unknown_cameras_are_refused(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(GavoError):
        load_camera(name)
    with pytest.raises(GavoError, match="unknown camera"):
        Camera.preset(name)


@given(
    content=st.one_of(st.binary(max_size=200), st.text(max_size=200).map(str.encode)),
    suffix=st.sampled_from([".toml", ".yaml"]),
)
def test_no_camera_file_raises_anything_else(tmp_path_factory, content, suffix):
    path = tmp_path_factory.mktemp("camera") / f"camera{suffix}"
    path.write_bytes(content)
    with pytest.raises(GavoError):
        load_camera(path)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"fx": -131.0}, "fx: expected a positive number"),
        ({"fy": float("nan")}, "fy: expected a positive number"),
        ({"cx": "80"}, "cx: expected a number"),
        ({"width": 160.0}, "width: expected a whole number"),
        ({"width": 8}, "too small"),
        ({"vignetting": (-10.0,)}, "vignetting: multiplies parts of the image by -"),
        ({"vignetting": (1e300,)}, "vignetting: multiplies parts"),
        ({"depth_scale": 0.0}, "depth_scale: expected a positive number"),
        ({"readout": -0.02}, "readout: expected seconds"),
        ({"readout": None}, "readout: expected seconds from 0 to 1, got None"),
        ({"readout": 20.0}, "readout: expected seconds from 0 to 1, got 20.0"),
        ({"distortion": [0.1, 0.0, 0.0, 0.0]}, "distortion: expected a tuple of 4, 5, 8, 12, 14 numbers"),
        ({"distortion": (0.1, 0.2, 0.3)}, "distortion: expected a tuple"),
        ({"distortion": (0.1,) * 5, "model": "fisheye"}, "distortion: expected a tuple of 4 numbers"),
        ({"model": "panorama"}, "model: expected one of pinhole, fisheye"),
        ({"distortion": (0.26, -0.95, 1.16, -0.005, 0.003)}, "distortion: p1 or p2 is 1.16, .*in this order"),
        ({"distortion": (100.0, 0.0, 0.0, 0.0)}, "distortion: 9.% of the undistorted image would lie outside"),
        ({"distortion": (-9.0, 0.0, 0.0, 0.0)}, "distortion: 90% of the undistorted image would lie outside"),
    ],
)
def test_a_camera_that_cannot_be_is_refused_before_anything_is_searched(values: dict[str, Any], words: str) -> None:
    """A negative focal length was `ok`; others ended with a traceback, or said that there is no depth."""
    camera = Camera(131.0, 131.0, 79.5, 59.5, 160, 120)
    require_camera(camera)
    require_camera(replace(camera, fx=np.float32(131.0), cx=jnp.float32(79.5), width=np.int64(160), distortion=()))  # pyright: ignore
    with pytest.raises(GavoError, match=words):
        require_camera(replace(camera, **values))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"fx": -5}, "fx: expected a positive number"),
        ({"fy": np.float32(-5)}, "fy: expected a positive number"),
        ({"depth_scale": -1000.0}, "depth_scale: expected a positive number"),
        ({"readout": -0.02}, "readout: expected seconds"),
        ({"height": 480.5}, "height: expected a whole number"),
        ({"width": -640}, "width: expected a whole number"),
    ],
)
def test_a_camera_that_cannot_be_is_refused_as_it_is_made(values: dict[str, Any], words: str) -> None:
    with pytest.raises(GavoError, match=f"^camera: {words}"):
        Camera(**{"fx": 525, "fy": 525, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480, **values})


def test_a_camera_holds_whatever_stands_for_its_numbers() -> None:
    """As a pytree: traced, batched, shapes alone, names and axes."""
    camera = Camera(np.float32(131), 131, 79.5, 59.5, np.int64(160), 120)  # pyright: ignore[reportArgumentType]

    def half(one: Camera) -> Camera:
        return replace(one.level(1), fx=-one.fx)

    assert jax.jit(half)(camera).fx == -131 and jax.eval_shape(half, camera).width == 80
    batch = jax.tree.map(lambda value: jnp.stack([-value, value]), jax.tree.map(jnp.float32, camera))
    axes = jax.tree.map(lambda _: 0, camera)
    np.testing.assert_array_equal(jax.vmap(half, in_axes=(axes,))(batch).fx, [131, -131])
    for leaf in (None, "fx", object(), True):
        assert jax.tree.map(lambda _, leaf=leaf: leaf, camera).fx is leaf
    assert jax.grad(lambda one: one.fx * one.cx)(jax.tree.map(float, camera)).fx == 79.5


@pytest.mark.parametrize("wrong", [0, -2, 1.5, True, "2", None])
def test_images_have_whole_numbers_of_pixels(wrong: Any) -> None:
    camera = Camera(131.0, 131.0, 79.5, 59.5, 160, 120)
    for call in (lambda: camera.binned(wrong), lambda: camera.resized(wrong, 60), lambda: camera.resized(80, wrong)):
        with pytest.raises(GavoError, match="expected a whole number of at least 1"):
            call()
    with pytest.raises(GavoError, match="an image of 160x120 cannot be 128 times smaller"):
        camera.level(7)
    assert camera.binned(np.int64(2)) == camera.resized(80, 60)  # pyright: ignore[reportArgumentType]
    assert camera.resized(80, 30) == Camera(65.5, 32.75, 39.5, 14.5, 80, 30), "each side by its own factor"
