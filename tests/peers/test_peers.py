"""The adapters answer with target_T_reference, in metres, whatever their libraries do inside."""

import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.errors import GavoError
from gavo_jax.odometry.tracking import Clock
from gavo_jax.peers import clouds
from gavo_jax.peers.base import failure
from gavo_jax.peers.clouds import SmallGicpPeer
from gavo_jax.peers.comparison import PeerAligner
from gavo_jax.peers.registry import PEERS, Peer, make_peer
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import inverse

CAMERA = Camera(fx=260.0, fy=258.0, cx=159.5, cy=119.5, width=320, height=240)
OPENCV = [name for name in PEERS if name.startswith("opencv")]
MOTIONS = {
    "sideways": ((0.025, 0.0, 0.0), (0.0, 0.0, 0.0)),
    "forward": ((0.0, 0.0, -0.02), (0.0, 0.0, 0.0)),
    "turn": ((0.0, 0.0, 0.0), (0.0, 0.01, 0.0)),
    "roll": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.015)),
    "mixed": ((-0.008, 0.006, 0.01), (0.006, -0.004, 0.008)),
}


REAL_ONLY = ("orb-pnp", "kiss-icp")
"""The rendered scene is smooth: it has no corners for ORB, and points slide along its surface."""


@pytest.fixture(params=[name for name in PEERS if name not in REAL_ONLY])
def peer(request: pytest.FixtureRequest) -> Peer:
    """Return each peer in turn; skip where its library cannot be imported."""
    try:
        return make_peer(request.param, CAMERA)
    except GavoError as error:
        pytest.skip(str(error))


def motion(translation: tuple[float, ...], rotation: tuple[float, ...]) -> np.ndarray:
    """Return a_T_b from metres and a rotation vector in radians."""
    a_T_b = np.eye(4)
    a_T_b[:3, :3] = cv2.Rodrigues(np.array(rotation))[0]
    a_T_b[:3, 3] = translation
    return a_T_b


def render(camera_T_world: np.ndarray, far_corner: float | None = None) -> Frame:
    """Render a textured ellipsoid around (0, 0, 1.2) from within, curved in every direction so that no motion slides.

    Depth t along the ray o + t d in closed form from |A (o + t d - c)| = 1, A = diag(1, 0.8, 1.3).
    far_corner: depth in metres of a few pixels in a corner, like what is seen through a door.
    """
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u, float)], axis=-1)
    world_T_camera = inverse(camera_T_world)
    squeeze = np.array([1.0, 0.8, 1.3])
    direction = rays @ world_T_camera[:3, :3].T * squeeze
    origin = (world_T_camera[:3, 3] - [0.0, 0.0, 1.2]) * squeeze
    a = np.sum(direction**2, axis=-1)
    b = direction @ origin
    depth = (-b + np.sqrt(b**2 - a * (origin @ origin - 1.0))) / a
    x, y, z = np.moveaxis(rays @ world_T_camera[:3, :3].T * depth[..., None] + world_T_camera[:3, 3], -1, 0)
    texture = np.sin(23 * x + 3 * y) + np.sin(19 * y - 5 * z) + np.sin(11 * z + 7 * x) + np.sin(31 * (x + y) + 2)
    grey = np.round(127.5 + 30 * texture).astype(np.uint8)
    if far_corner is not None:
        depth[:3, :3] = far_corner
    return Frame(grey=grey, depth=np.round(depth * CAMERA.depth_scale).astype(np.uint16), timestamp=0.0)


def image_error(frame: Frame, estimate: np.ndarray, truth: np.ndarray) -> float:
    """Return how far apart two motions carry the frame's points on the target image, RMS in pixels."""
    u, v = np.meshgrid(np.arange(0.0, CAMERA.width, 8), np.arange(0.0, CAMERA.height, 8))
    points = CAMERA.back_project(np.stack([u, v], axis=-1), frame.depth[::8, ::8] / CAMERA.depth_scale)
    a, b = (np.asarray(CAMERA.project(points @ T[:3, :3].T + T[:3, 3])) for T in (estimate, truth))
    return float(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=-1))))


@pytest.mark.parametrize("name", MOTIONS)
def test_peer_recovers_a_known_motion(peer: Peer, name: str) -> None:
    """A small motion comes back in our direction: its inverse would be twice as far off as the identity."""
    target_T_reference = motion(*MOTIONS[name])
    reference, target = render(np.eye(4)), render(target_T_reference)
    result = peer.align(peer.prepare(reference), peer.prepare(target))
    assert result.success
    assert result.target_T_reference.dtype == np.float64
    np.testing.assert_allclose(result.target_T_reference[3], [0, 0, 0, 1])
    error = image_error(reference, result.target_T_reference, target_T_reference)
    assert error < 0.3 * image_error(reference, np.eye(4), target_T_reference)


def test_prepared_frames_can_be_used_again(peer: Peer) -> None:
    """A frame prepared once serves as target and then as reference, with the same answers as a fresh one."""
    first, second = render(np.eye(4)), render(motion(*MOTIONS["mixed"]))
    a, b = peer.prepare(first), peer.prepare(second)
    there, back = peer.align(a, b), peer.align(b, a)
    fresh = peer.align(peer.prepare(second), peer.prepare(first))
    np.testing.assert_allclose(back.target_T_reference, fresh.target_T_reference, atol=1e-4)
    assert image_error(first, back.target_T_reference @ there.target_T_reference, np.eye(4)) < 1.0


def test_depth_scale_is_the_cameras(peer: Peer) -> None:
    """Raw depth in millimetres with a camera that says so gives the same metres."""
    first, second = render(np.eye(4)), render(motion(*MOTIONS["forward"]))
    expected = peer.align(peer.prepare(first), peer.prepare(second)).target_T_reference
    millimetres = make_peer(peer.name, replace(CAMERA, depth_scale=1000.0))
    a, b = (millimetres.prepare(replace(frame, depth=frame.depth // 5)) for frame in (first, second))
    assert np.linalg.norm(millimetres.align(a, b).target_T_reference - expected) < 0.005


def test_images_may_be_of_any_numbers(peer: Peer) -> None:
    """OpenCV ended the program where grey was not bytes."""
    first, second = render(np.eye(4)), render(motion(*MOTIONS["forward"]))
    expected = peer.align(peer.prepare(first), peer.prepare(second)).target_T_reference
    metric = make_peer(peer.name, replace(CAMERA, depth_scale=1.0))
    metres = [frame.depth / np.float32(CAMERA.depth_scale) for frame in (first, second)]
    floats = [frame.grey.astype(np.float32) for frame in (first, second)]
    a, b = (metric.prepare(Frame(*images, 0.0)) for images in zip(floats, metres, strict=True))  # pyright: ignore
    np.testing.assert_allclose(metric.align(a, b).target_T_reference, expected, atol=1e-3)


@pytest.mark.parametrize("name", [*OPENCV, "open3d-tensor-hybrid"])
def test_failure_is_the_identity(name: str) -> None:
    """Without any depth there is nothing to align: success is false and the motion the identity."""
    try:
        peer = make_peer(name, CAMERA)
    except GavoError as error:
        pytest.skip(str(error))
    frame = render(np.eye(4))
    empty = peer.prepare(replace(frame, depth=np.zeros_like(frame.depth)))
    result = peer.align(empty, empty)
    assert not result.success
    np.testing.assert_array_equal(result.target_T_reference, np.eye(4))


@pytest.mark.parametrize("name", OPENCV)
def test_opencv_survives_a_reading_beyond_ten_metres(name: str) -> None:
    """One far reading must not make OpenCV take metres for 1/5000 m: the scene would shrink and the motion with it."""
    peer = make_peer(name, CAMERA)
    target_T_reference = motion(*MOTIONS["forward"])
    first, second = render(np.eye(4), far_corner=12.0), render(target_T_reference, far_corner=12.0)
    result = peer.align(peer.prepare(first), peer.prepare(second))
    assert np.linalg.norm(result.target_T_reference[:3, 3] - target_T_reference[:3, 3]) < 0.01


@pytest.mark.parametrize("name", ["small-gicp", "kiss-icp"])
def test_missing_cloud_library_names_the_extra(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """As for Open3D."""
    for module in ("small_gicp", "kiss_icp.kiss_icp"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(GavoError, match=r"gavo-jax\[peers\]"):
        make_peer(name, CAMERA)


def test_a_cloud_of_a_few_voxels_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Points were counted before downsampling: a patch of depth that left five of them was aligned, and called ok."""
    kept = {"points": SmallGicpPeer.NEIGHBOURS - 1}
    library: Any = ModuleType("small_gicp")
    library.preprocess_points = lambda *_: (SimpleNamespace(size=lambda: kept["points"]), None)
    library.align = lambda *_, **__: SimpleNamespace(T_target_source=np.eye(4), converged=True)
    monkeypatch.setitem(sys.modules, "small_gicp", library)
    monkeypatch.setattr(clouds, "_version", lambda _: "1.0")
    peer = make_peer("small-gicp", CAMERA)
    frame = render(np.eye(4))
    few = peer.prepare(frame)
    kept["points"] += 1
    enough = peer.prepare(frame)
    assert not peer.align(few, enough).success and not peer.align(enough, few).success
    assert peer.align(enough, enough).success


def test_a_peer_that_fails_says_nothing_about_numbers() -> None:
    """The pair was `not_finite`, which docs/frames.md says of an image with NaN."""
    peer: Any = SimpleNamespace(prepare=lambda frame: frame, align=lambda *_: failure())
    frame = render(np.eye(4))
    attempt = PeerAligner(peer).align(frame, frame, Clock(np.float32(1 / 30), np.float32(0), np.uint32(1)))
    assert not attempt.usable and attempt.result.status is AlignmentStatus.HIGH_ERROR


def test_wrong_size_is_refused(peer: Peer) -> None:
    """A frame of another size than the camera's is refused in our own words."""
    frame = render(np.eye(4))
    with pytest.raises(GavoError, match="for a camera of"):
        peer.prepare(replace(frame, grey=frame.grey[::2], depth=frame.depth[::2]))


def test_unknown_peer_is_refused() -> None:
    """The message lists the names that exist."""
    with pytest.raises(GavoError, match="opencv-rgbd"):
        make_peer("opencv", CAMERA)


def test_missing_open3d_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where Open3D cannot be imported, the message says what to install."""
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(GavoError, match=r"gavo-jax\[peers\]"):
        make_peer("open3d-color", CAMERA)


@pytest.mark.parametrize("name", PEERS)
def test_motion_of_a_real_clip(name: str, data_dir: Path) -> None:
    """Five pairs of fr1_xyz chained explain most of the true motion over them; a wrong direction would double it."""
    sequence = TumSequence(data_dir / "fr1_xyz")[20:26]
    try:
        peer = make_peer(name, sequence.camera)
    except GavoError as error:
        pytest.skip(str(error))
    prepared = [peer.prepare(frame) for frame in sequence]
    last_T_first = np.eye(4)
    for reference, target in zip(prepared, prepared[1:], strict=False):
        last_T_first = peer.align(reference, target).target_T_reference @ last_T_first
    assert sequence.ground_truth is not None
    world_T_camera, _ = sequence.ground_truth.interpolate(sequence.timestamps)
    truth = inverse(world_T_camera[-1]) @ world_T_camera[0]
    distance = np.linalg.norm(truth[:3, 3])
    assert distance > 0.04
    assert np.linalg.norm(last_T_first[:3, 3] - truth[:3, 3]) < 0.5 * distance


def test_open3d_that_lacks_a_library_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Its own parts may be missing: then it raises OSError."""
    (tmp_path / "open3d.py").write_text("raise OSError('libGL.so.1: cannot open shared object file')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    with pytest.raises(GavoError, match="libGL"):
        make_peer("open3d-color", CAMERA)
