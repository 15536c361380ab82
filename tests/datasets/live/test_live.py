"""Live frames: the newest of a stand-in device, checked and rectified, and the SDK's lens models."""

import threading
import time
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest
from small import CAMERA

from gavo_jax.camera import Camera
from gavo_jax.datasets.live.frames import LiveImages, Newest, frame_of
from gavo_jax.datasets.live.realsense import RealSense, camera_of
from gavo_jax.errors import GavoError

SIZE = (CAMERA.height, CAMERA.width)
LENS = replace(CAMERA, distortion=(0.2, -0.4, 0.001, 0.002, 0.1))


def images(number: int = 0) -> LiveImages:
    grey = np.random.default_rng(number).integers(0, 255, (*SIZE, 3), np.uint8)
    return LiveImages(grey, np.full(SIZE, 5000, np.uint16), number / 30)


@dataclass
class StandIn:
    """A device that gives a few images, and then the end or a fault."""

    count: int
    camera: Camera = CAMERA
    fault: Exception | None = None
    name: str = "stand-in"
    allowed: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))
    given: int = 0
    closed: bool = False

    def read(self) -> LiveImages | None:
        if self.given == self.count:
            if self.fault is not None:
                raise self.fault
            return None
        self.allowed.acquire()
        self.given += 1
        return images(self.given - 1)

    def close(self) -> None:
        self.closed = True


def test_what_is_not_taken_in_time_makes_room_and_is_counted():
    device = StandIn(5)
    with Newest(device) as newest:
        stream = iter(newest)
        device.allowed.release()
        assert next(stream).timestamp == 0.0
        device.allowed.release(4)
        while newest.received < 5:
            time.sleep(0.001)
        assert next(stream).timestamp == 4 / 30
        assert list(stream) == []
    assert (newest.received, newest.dropped, device.closed) == (5, 3, True)


def test_a_device_may_read_into_the_same_arrays():
    """What was being tracked was overwritten by what came next."""
    same = images(0)

    class Reusing(StandIn):
        def read(self):
            taken = super().read()
            if taken is not None:
                np.copyto(same.color, taken.color)
                taken = taken._replace(color=same.color, depth=same.depth)
            return taken

    device = Reusing(2)
    device.allowed.release(1)
    with Newest(device) as newest:
        first = next(iter(newest))
        device.allowed.release(1)
        while newest.received < 2:
            time.sleep(0.001)
        np.testing.assert_array_equal(first.color, images(0).color)


def test_without_its_thread_nothing_is_waited_for():
    with pytest.raises(GavoError, match="inside a with block"):
        next(iter(Newest(StandIn(1))))


@pytest.mark.parametrize("fault", [GavoError("unplugged"), RuntimeError("unplugged")])
def test_a_devices_fault_is_one_line_after_the_last_frame(fault):
    device = StandIn(1, fault=fault)
    device.allowed.release()
    with Newest(device) as newest, pytest.raises(GavoError, match="unplugged"):
        for _ in newest:
            pass


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"color": np.zeros((10, 10, 3), np.uint8)}, r"colour image is uint8 of shape \(10, 10, 3\)"),
        ({"color": np.zeros((*SIZE, 3), np.float32)}, "colour image is float32"),
        ({"color": np.zeros((*SIZE, 3), np.int64)}, "colour image is int64"),
        ({"color": np.zeros((*SIZE, 4), np.uint8)}, "colour image"),
        ({"depth": np.zeros((10, 10), np.uint16)}, r"depth image is uint16 of shape \(10, 10\)"),
        ({"depth": np.zeros(SIZE, np.int32)}, "depth image is int32"),
    ],
)
def test_images_of_another_size_or_type_are_refused(changes, words):
    with pytest.raises(GavoError, match=words):
        frame_of(images()._replace(**changes), CAMERA)


def test_what_a_device_must_deliver_is_told():
    """A plain tuple ended a run in a traceback."""
    for images in (None, (np.zeros((4, 4), np.uint8), np.zeros((4, 4), np.uint16), 0.0)):
        with pytest.raises(GavoError, match=r"expected gavo.LiveImages\(color, depth, timestamp\), got"):
            frame_of(images, CAMERA)  # pyright: ignore[reportArgumentType]


def test_frames_are_rectified():
    raw = images(3)
    frame, plain = frame_of(raw, LENS, color=True), frame_of(raw, CAMERA, color=True)
    assert plain.color is not None
    np.testing.assert_array_equal(frame.color, LENS.undistort_image(plain.color))
    np.testing.assert_array_equal(frame.depth, LENS.undistort_depth(plain.depth))
    assert not np.array_equal(frame.grey, plain.grey)


def test_depth_may_be_floats_in_metres():
    metres = np.full(SIZE, 1.5, np.float32)
    metres[0, :3] = (np.nan, np.inf, -1)
    depth = frame_of(images()._replace(depth=metres), CAMERA).depth
    assert depth[0, :4].tolist() == [0, 0, 0, 7500]
    metric = frame_of(images()._replace(depth=metres), replace(CAMERA, depth_scale=1.0)).depth
    assert metric[0, :4].tolist() == [0, 0, 0, 1.5], "it was rounded to whole metres"
    hidden = np.ma.masked_array(np.full(SIZE, 5000, np.uint16), metres != 1.5)
    assert frame_of(images()._replace(depth=hidden), CAMERA).depth[0, :4].tolist() == [0, 0, 0, 5000]


def intrinsics(model: str, coefficients: tuple[float, ...]) -> SimpleNamespace:
    return SimpleNamespace(
        fx=131.0, fy=131.0, ppx=79.5, ppy=59.5, width=160, height=120, model=f"distortion.{model}", coeffs=coefficients
    )


def test_the_sdks_lens_models_become_opencvs():
    coefficients = (0.05, -0.06, 0.001, -0.0005, 0.01)
    assert camera_of(intrinsics("inverse_brown_conrady", (0.0,) * 5), 1000.0).distortion == (0.0,) * 5
    np.testing.assert_allclose(camera_of(intrinsics("brown_conrady", coefficients), 1000.0).distortion, coefficients)
    import cv2

    for model in ("modified_brown_conrady", "inverse_brown_conrady"):
        camera = camera_of(intrinsics(model, coefficients), 1000.0)
        ideal = np.array([[[0.4, 0.3]]])
        seen = cv2.projectPoints(
            np.append(ideal, 1.0), np.zeros(3), np.zeros(3), np.eye(3), np.array(camera.distortion)
        )[0]
        k1, k2, p1, p2, k3 = coefficients
        x, y = (seen if model.startswith("inverse") else ideal).ravel()
        square = x * x + y * y
        radial = 1 + k1 * square + k2 * square**2 + k3 * square**3
        u, v = (x, y) if model.startswith("inverse") else (x * radial, y * radial)
        mapped = (
            x * radial + 2 * p1 * u * v + p2 * (square + 2 * u * u),
            y * radial + 2 * p2 * u * v + p1 * (square + 2 * v * v),
        )
        np.testing.assert_allclose(mapped, (ideal if model.startswith("inverse") else seen).ravel(), atol=2e-4)
    with pytest.raises(GavoError, match="lens model is ftheta"):
        camera_of(intrinsics("ftheta", coefficients), 1000.0)


class Sdk:
    """What of pyrealsense2 is used, with one pair of images."""

    stream = SimpleNamespace(color="color", depth="depth")
    format = SimpleNamespace(rgb8="rgb8", z16="z16")

    def __init__(self, cameras: int = 1) -> None:
        self.cameras, self.left = cameras, 1

    def config(self):
        return SimpleNamespace(enable_stream=lambda *_: None)

    def pipeline(self):
        video = SimpleNamespace(get_intrinsics=lambda: intrinsics("brown_conrady", (0.1, 0.0, 0.0, 0.0, 0.0)))
        profile = SimpleNamespace(
            get_stream=lambda _: SimpleNamespace(as_video_stream_profile=lambda: video),
            get_device=lambda: SimpleNamespace(
                first_depth_sensor=lambda: SimpleNamespace(get_depth_scale=lambda: 0.00025)
            ),
        )

        def start(_):
            if not self.cameras:
                raise RuntimeError("No device connected")
            return profile

        def wait(_):
            if not self.left:
                raise RuntimeError("Frame didn't arrive within 5000")
            self.left -= 1
            shot = images(7)

            def part(data, stamp):
                return SimpleNamespace(get_data=lambda: data, get_timestamp=lambda: stamp)

            return SimpleNamespace(
                get_color_frame=lambda: part(shot.color, 1000.0), get_depth_frame=lambda: part(shot.depth, 1010.0)
            )

        return SimpleNamespace(start=start, wait_for_frames=wait, stop=lambda: None)

    def align(self, _):
        return SimpleNamespace(process=lambda frames: frames)


def test_a_realsense_camera_through_its_sdk():
    device = RealSense(sdk=Sdk())
    assert device.camera.depth_scale == pytest.approx(4000.0)
    assert device.camera.is_distorted
    shot = device.read()
    assert shot is not None and (shot.timestamp, shot.depth_timestamp) == (1.0, 1.01)
    assert frame_of(shot, device.camera).grey.shape == SIZE
    with pytest.raises(GavoError, match="delivers no more frames"):
        device.read()
    device.close()
    assert device.read() is None
    with pytest.raises(GavoError, match="No device connected"):
        RealSense(sdk=Sdk(cameras=0))
