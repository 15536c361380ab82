"""The synthetic sequence: exact where it claims to be, disturbed as documented, the same every time."""

import time
from dataclasses import replace

import cv2
import numpy as np
import pytest

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.layouts.tum_writing import write_tum
from gavo_jax.datasets.rendered.rendering import render
from gavo_jax.datasets.rendered.room import build_room, free_space
from gavo_jax.datasets.rendered.sensor_noise import KINECT, NONE, SensorNoise
from gavo_jax.datasets.rendered.synthetic import DEFAULT_CAMERA, SyntheticSequence, builtin_path
from gavo_jax.errors import GavoError
from gavo_jax.trajectory import Trajectory, quaternion_from_rotation

SMALL = DEFAULT_CAMERA.level(2)


def same(a: Frame, b: Frame) -> bool:
    return np.array_equal(a.grey, b.grey) and np.array_equal(a.depth, b.depth) and a.timestamp == b.timestamp


def warp(sequence: SyntheticSequence, i: int, j: int, nudge: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
    """Grey differences, predicted and measured depth of frame i's pixels in frame j at the exact motion: (1) to (8)."""
    camera, reference, target = sequence.camera, sequence[i], sequence[j]
    world_T_reference, world_T_target = sequence.ground_truth.world_T_camera[[i, j]]
    target_T_reference = np.linalg.inv(world_T_target) @ world_T_reference
    if nudge is not None:
        target_T_reference = nudge @ target_T_reference
    rows, columns = np.nonzero(reference.depth)
    pixels = np.stack([columns, rows], axis=-1).astype(float)
    points = camera.back_project(pixels, reference.depth[rows, columns] / camera.depth_scale)
    points = points @ target_T_reference[:3, :3].T + target_T_reference[:3, 3]
    x, y = np.asarray(camera.project(points)).T
    inside = (x >= 0) & (y >= 0) & (x <= camera.width - 1) & (y <= camera.height - 1) & (points[:, 2] > 0)
    x, y, z = x[inside], y[inside], points[inside, 2]
    x0, y0 = np.minimum(x.astype(int), camera.width - 2), np.minimum(y.astype(int), camera.height - 2)
    a, b, grey = x - x0, y - y0, target.grey.astype(float)
    above = grey[y0, x0] * (1 - a) + grey[y0, x0 + 1] * a
    below = grey[y0 + 1, x0] * (1 - a) + grey[y0 + 1, x0 + 1] * a
    difference = above * (1 - b) + below * b - reference.grey[rows, columns][inside]
    nearest = target.depth[np.rint(y).astype(int), np.rint(x).astype(int)] / camera.depth_scale
    return difference, z, nearest


def still(rotation: np.ndarray, height: float = 1.35) -> Trajectory:
    """One view from the room's middle."""
    world_T_camera = np.eye(4)[None].copy()
    world_T_camera[0, :3, :3], world_T_camera[0, 2, 3] = rotation, height
    return Trajectory(np.zeros(1), world_T_camera)


# Determinism


def test_frames_depend_on_seed_and_index_alone():
    first, second = (SyntheticSequence(frames=4, seed=7, camera=SMALL) for _ in range(2))
    forwards = [first[i] for i in range(4)]
    backwards = [second[i] for i in (3, 2, 1, 0)][::-1]
    assert all(same(a, b) for a, b in zip(forwards, backwards, strict=True))
    assert not same(forwards[0], SyntheticSequence(frames=4, seed=8, camera=SMALL)[0])
    assert not np.array_equal(forwards[0].grey, forwards[1].grey)


def test_slices_keep_frames_and_knowledge():
    sequence = SyntheticSequence(frames=6, camera=SMALL)
    part = sequence[1:6:2]
    assert len(part) == 3 and part.name == "synthetic" and part.camera == sequence.camera
    assert part.ground_truth is sequence.ground_truth
    np.testing.assert_array_equal(part.timestamps, sequence.timestamps[1::2])
    assert all(same(a, sequence[i]) for a, i in zip(part, (1, 3, 5), strict=True))
    assert same(part[1:][-1], sequence[5])
    with pytest.raises(IndexError):
        part[3]


def test_frames_cannot_be_changed_by_their_users():
    frame = SyntheticSequence(frames=1, camera=SMALL)[0]
    with pytest.raises(ValueError):
        frame.grey[0, 0] = 1


# Exactness


def test_shapes_types_and_full_depth():
    frame = SyntheticSequence(frames=1, noise=NONE, color=True)[0]
    assert frame.grey.shape == frame.depth.shape == (480, 640)
    assert (frame.grey.dtype, frame.depth.dtype) == (np.uint8, np.uint16)
    assert frame.color is not None and frame.color.shape == (480, 640, 3)
    np.testing.assert_array_equal(frame.grey, cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY))
    assert (frame.depth > 0).all()
    assert frame.grey.std() > 15


def test_colour_leaves_grey_as_it_is_up_to_rounding():
    grey, color = (SyntheticSequence(frames=1, noise=NONE, camera=SMALL, color=c)[0].grey for c in (False, True))
    assert np.percentile(np.abs(grey.astype(int) - color), 99) <= 1


@pytest.mark.parametrize(
    ("rotation", "distance"), [(np.eye(3), 3.0 - 1.35), (np.diag([1.0, -1.0, -1.0]), 1.35 - 0.012)]
)
def test_looking_straight_up_and_down_gives_the_plane_distance(rotation: np.ndarray, distance: float):
    """Depth is along the optical axis: constant over a plane that faces the camera (the ceiling; the rug)."""
    frame = SyntheticSequence(trajectory=still(rotation), noise=NONE, camera=SMALL)[0]
    middle = frame.depth[30:90, 50:110]
    assert np.abs(middle.astype(float) - 5000 * distance).max() <= 1


def test_depth_agrees_between_views():
    sequence = SyntheticSequence(frames=11, noise=NONE, camera=DEFAULT_CAMERA.level(1))
    _, predicted, measured = warp(sequence, 0, 10)
    apart = np.abs(predicted - measured) / predicted
    assert np.median(apart) < 1e-3
    assert (apart < 0.02).mean() > 0.9


def test_points_lie_in_the_room():
    sequence = SyntheticSequence(frames=1, noise=NONE, camera=SMALL)
    rows, columns = np.mgrid[: SMALL.height, : SMALL.width]
    points = SMALL.back_project(np.stack([columns, rows], -1).astype(float), sequence[0].depth / SMALL.depth_scale)
    world_T_camera = sequence.ground_truth.world_T_camera[0]
    points = points @ world_T_camera[:3, :3].T + world_T_camera[:3, 3]
    assert (np.abs(points[..., 0]) < 3.001).all() and (np.abs(points[..., 1]) < 2.501).all()
    assert (points[..., 2] > -0.001).all() and (points[..., 2] < 3.001).all()


@pytest.mark.parametrize("seed", [0, 1])
def test_grey_agrees_between_views(seed: int):
    difference, predicted, measured = warp(SyntheticSequence(frames=2, seed=seed, noise=NONE), 0, 1)
    visible = np.abs(predicted - measured) < 0.03 * predicted
    assert visible.mean() > 0.97
    assert np.abs(difference[visible]).mean() < 1.0
    assert np.abs(difference).mean() < 1.2


def test_grey_agrees_between_small_views():
    difference, predicted, measured = warp(SyntheticSequence(frames=2, noise=NONE, camera=SMALL), 0, 1)
    assert np.abs(difference[np.abs(predicted - measured) < 0.03 * predicted]).mean() < 1.5


@pytest.mark.parametrize("axis", range(6))
def test_the_true_motion_is_the_best(axis: int):
    """The clipped error has its minimum at the truth: 2 mm or 0.1 degrees off in any direction is worse."""
    sequence = SyntheticSequence(frames=2, noise=NONE, camera=DEFAULT_CAMERA.level(1))
    at_truth = np.minimum(np.abs(warp(sequence, 0, 1)[0]), 10).mean()
    for sign in (-1, 1):
        nudge = np.eye(4)
        if axis < 3:
            nudge[axis, 3] = sign * 2e-3
        else:
            nudge[:3, :3] = cv2.Rodrigues(np.radians(0.1) * sign * np.eye(3)[axis - 3])[0]
        assert np.minimum(np.abs(warp(sequence, 0, 1, nudge)[0]), 10).mean() > at_truth


# Noise


def test_depth_noise_grows_with_the_square_of_depth():
    rng = np.random.default_rng(0)
    for z in (0.7, 1.3, 2.9, 5.1):
        ramp = np.linspace(0.99 * z, 1.01 * z, 200 * 300, dtype=np.float32).reshape(200, 300)
        noise = replace(KINECT, baseline=0.0, edge_dropout=0.0)
        error = noise.disturb_depth(ramp, 525.0, rng) - ramp
        expected = np.hypot(KINECT.depth_sigma, KINECT.depth_step / np.sqrt(12)) * z**2
        assert error.std() == pytest.approx(expected, rel=0.05)
        assert abs(error.mean()) < 0.1 * expected


def test_depth_takes_few_values_far_away():
    depth = np.linspace(4.0, 4.5, 10_000, dtype=np.float32).reshape(100, 100)
    measured = SensorNoise(depth_step=KINECT.depth_step).disturb_depth(depth, 525.0, np.random.default_rng(0))
    values = np.unique(measured)
    assert np.diff(values) == pytest.approx(KINECT.depth_step * values[1:] * values[:-1], rel=1e-3)


def test_no_reading_too_near_or_too_far():
    depth = np.tile(np.array([0.2, 0.39, 0.41, 7.9, 8.1, 0.0], np.float32), (4, 1))
    noise = SensorNoise(depth_nearest=0.4, depth_furthest=8.0)
    measured = noise.disturb_depth(depth, 525.0, np.random.default_rng(0))
    np.testing.assert_array_equal(measured > 0, np.tile([False, False, True, True, False, False], (4, 1)))


def test_an_object_throws_a_shadow_to_its_left():
    depth = np.full((10, 200), 3.0, np.float32)
    depth[:, 100:140] = 1.5
    measured = SensorNoise(baseline=0.075).disturb_depth(depth, 525.0, np.random.default_rng(0))
    width = 525 * 0.075 * (1 / 1.5 - 1 / 3.0)
    missing = np.flatnonzero(measured[0] == 0)
    assert abs(len(missing) - width) <= 1
    assert missing[0] == 100 - len(missing) and missing[-1] == 99


def test_depth_goes_missing_at_edges():
    exact, noisy = (SyntheticSequence(frames=1, noise=noise)[0].depth for noise in (NONE, KINECT))
    z = exact.astype(np.float32)
    jump = cv2.dilate(z, np.ones((3, 3))) > 1.1 * cv2.erode(z, np.ones((3, 3)))
    missing = noisy == 0
    assert missing[jump].mean() > 0.25
    assert missing[~jump].mean() < 0.1


def test_grey_noise_and_exposure_drift():
    rng, phases = np.random.default_rng(0), np.array([0.3, 1.2])
    flat = np.full((200, 200), 120, np.float32)
    assert KINECT.disturb_grey(flat, 0.0, phases, rng).std() == pytest.approx(KINECT.grey_sigma, rel=0.03)
    drift = replace(KINECT, grey_sigma=0.0)
    levels = np.array([drift.disturb_grey(flat, t, phases, rng).mean() for t in np.arange(0, 6, 1 / 30)])
    assert 1.0 < np.ptp(levels) <= 2 * (0.03 * 120 + 3)
    assert np.abs(np.diff(levels)).max() < 0.5


def test_the_sequence_as_a_whole_is_noisy_by_default():
    exact, noisy = (SyntheticSequence(frames=1, noise=noise)[0] for noise in (NONE, KINECT))
    both = noisy.depth > 0
    error = (noisy.depth.astype(float) - exact.depth)[both] / 5000 / (exact.depth[both] / 5000) ** 2
    assert np.std(error) == pytest.approx(np.hypot(1.4e-3, 2.85e-3 / np.sqrt(12)), rel=0.05)
    assert 1.9 < np.std(noisy.grey.astype(float) - exact.grey) < 3.5
    assert same(SyntheticSequence(frames=1)[0], noisy)


@pytest.mark.parametrize(
    "bad",
    [{"depth_sigma": -1.0}, {"grey_sigma": float("nan")}, {"drift_period": 0.0}, {"baseline": "1"}, {"gain_drift": []}],
)
def test_impossible_noise_is_refused(bad: dict):
    with pytest.raises(GavoError, match=next(iter(bad))):
        SensorNoise(**bad)


# Motion


@pytest.mark.parametrize("seed", range(5))
def test_builtin_path_is_handheld_and_stays_in_the_free_space(seed: int):
    path = builtin_path(3000, seed=seed)
    low, high = free_space((3.0, 2.5), 3.0)
    positions, rotations = path.world_T_camera[:, :3, 3], path.world_T_camera[:, :3, :3]
    assert (positions > low).all() and (positions < high).all()
    np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (3000, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1)
    assert 0.2 < 30 * np.linalg.norm(np.diff(positions, axis=0), axis=1).mean() < 0.4
    quaternions = quaternion_from_rotation(rotations[:-1].swapaxes(1, 2) @ rotations[1:])
    assert 15 < 30 * np.degrees(2 * np.arcsin(np.linalg.norm(quaternions[:, :3], axis=1))).mean() < 25


def test_speed_plays_the_same_motion_faster():
    slow, fast = builtin_path(21), builtin_path(11, speed=2.0)
    np.testing.assert_allclose(fast.world_T_camera, slow.world_T_camera[::2], atol=1e-5)


def test_a_trajectory_is_followed_at_its_own_stamps_shifted_only(tmp_path):
    path = builtin_path(12, seed=3)
    away = path.world_T_camera.copy()
    away[:, :3, 3] += [40.0, -7.0, 90.0]
    source = Trajectory(path.timestamps + 1.3e9, away)
    source.write_tum(tmp_path / "path.txt")
    for given in (source, tmp_path / "path.txt", str(tmp_path / "path.txt")):
        sequence = SyntheticSequence(trajectory=given, camera=SMALL)
        assert len(sequence) == 12
        np.testing.assert_array_equal(sequence.timestamps, source.timestamps)
        shift = sequence.ground_truth.world_T_camera - away
        np.testing.assert_allclose(shift - shift[:1], 0, atol=1e-9)
    assert len(SyntheticSequence(frames=5, trajectory=source)) == 5
    assert same(sequence[3], SyntheticSequence(trajectory=source, camera=SMALL)[3])


def test_a_trajectory_can_be_resampled_and_sped_up():
    source = builtin_path(101, rate=100.0)
    sequence = SyntheticSequence(trajectory=source, rate=25.0, speed=0.5)
    assert len(sequence) == 51
    np.testing.assert_allclose(np.diff(sequence.timestamps), 0.04, atol=2e-6)
    expected, valid = source.interpolate(sequence.timestamps / 2)
    assert valid.all()
    actual = sequence.ground_truth.world_T_camera
    np.testing.assert_allclose(actual[:, :3, :3], expected[:, :3, :3], atol=1e-9)
    np.testing.assert_allclose(actual[:, :3, 3] - actual[0, :3, 3], expected[:, :3, 3] - expected[0, :3, 3], atol=1e-9)


def test_a_wide_trajectory_gets_a_larger_room():
    world_T_camera = np.tile(np.eye(4), (2, 1, 1))
    world_T_camera[:, :3, :3] = builtin_path(1).world_T_camera[0, :3, :3]
    world_T_camera[1, :3, 3] = [6.0, 4.0, 2.5]
    sequence = SyntheticSequence(trajectory=Trajectory(np.array([0.0, 9.0]), world_T_camera), noise=NONE, camera=SMALL)
    assert all((frame.depth > 0).mean() > 0.9 and frame.depth[frame.depth > 0].min() > 500 for frame in sequence)


# Arguments, files, time


def test_a_rolling_shutter_sees_each_row_at_its_moment():
    at_once, rolling = (
        SyntheticSequence(frames=3, noise=NONE, camera=replace(SMALL, readout=readout)) for readout in (0.0, 1 / 30)
    )
    path, last = rolling.ground_truth, SMALL.height - 1
    for row in (0, SMALL.height // 2, last):
        moment = path.timestamps[1] + ((row + 0.5) / SMALL.height - 0.5) / 30
        [pose], _ = path.interpolate(np.array([moment]))
        _, depth, _ = render(build_room(0), SMALL, pose)
        off, seen_at_once = (
            np.median(np.abs(s[1].depth[row] / SMALL.depth_scale - depth[row])) for s in (rolling, at_once)
        )
        assert off < 5e-4
        assert row not in (0, last) or seen_at_once > 4 * off


def test_any_camera():
    camera = Camera(100.0, 110.0, 40.0, 33.0, 90, 70, (0.2, -0.1, 0.0, 0.0, 0.0), 1000.0)
    sequence = SyntheticSequence(frames=1, noise=NONE, camera=camera)
    plain = SyntheticSequence(frames=1, noise=NONE, camera=replace(camera, distortion=(0.0,) * 5, depth_scale=5000.0))
    assert sequence.camera == camera.rectified()
    assert sequence[0].depth.shape == (70, 90)
    np.testing.assert_array_equal(sequence[0].grey, plain[0].grey)
    np.testing.assert_allclose(sequence[0].depth, plain[0].depth / 5, atol=0.7)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ({"frames": 0}, "frames"),
        ({"frames": 2.5}, "frames: expected a whole number, got 2.5"),
        ({"frames": "3"}, "frames: expected a whole number, got '3'"),
        ({"frames": 10**9}, "frames: must be at most 1000000"),
        ({"seed": -1}, "seed"),
        ({"seed": 1.5}, "seed: expected a whole number"),
        ({"seed": None}, "seed: expected a whole number"),
        ({"rate": 0.0}, "rate"),
        ({"rate": "30"}, "rate: expected a number, got '30'"),
        ({"speed": float("inf")}, "speed"),
        ({"speed": None}, "speed: expected a number"),
        ({"noise": None}, "noise: expected a SensorNoise, got None"),
        ({"camera": "fr1"}, "expected a Camera, got str"),
        ({"trajectory": 1}, "trajectory: expected a Trajectory or a TUM file, got 1"),
        ({"trajectory": "nowhere/groundtruth.txt"}, "nowhere"),
        ({"trajectory": Trajectory(np.zeros(0), np.zeros((0, 4, 4)))}, "empty"),
        ({"trajectory": Trajectory(np.zeros(1), np.full((1, 4, 4), np.nan))}, "finite"),
        ({"trajectory": Trajectory(np.arange(2.0), np.stack([np.eye(4), 1e3 * np.ones((4, 4))]))}, "room"),
    ],
)
def test_bad_arguments_are_refused_in_one_line(arguments: dict, word: str):
    with pytest.raises(GavoError, match=word) as caught:
        SyntheticSequence(**arguments)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("color", [False, True])
def test_a_written_folder_reads_back_identically(tmp_path, color: bool):
    sequence = SyntheticSequence(frames=3, camera=SMALL, color=color)[:2]
    write_tum(sequence, tmp_path / "room")
    back = TumSequence(tmp_path / "room", camera=str(tmp_path / "room" / "camera.toml"), color=color)
    assert back.camera == sequence.camera and len(back) == 2
    for a, b in zip(sequence, back, strict=True):
        assert same(a, b)
        assert color is False or (b.color is not None and a.color is not None and np.array_equal(a.color, b.color))
    assert back.ground_truth is not None
    np.testing.assert_array_equal(back.ground_truth.timestamps, sequence.ground_truth.timestamps)
    np.testing.assert_allclose(
        back.ground_truth.world_T_camera, sequence.ground_truth.world_T_camera, rtol=0, atol=1e-12
    )


class Kinect:
    """Frames whose depth is read out later, of a camera with another lens."""

    name, ground_truth = "kinect", None
    camera = replace(SMALL, distortion=(0.05, -0.01, 0.002, 0.0), model="fisheye")

    def __init__(self, depth: type = np.uint16) -> None:
        self.depth = depth

    def __iter__(self):
        for frame in SyntheticSequence(frames=2, camera=SMALL):
            late = frame.timestamp + 0.015
            yield replace(frame, depth=frame.depth.astype(self.depth), depth_timestamp=late)


def test_stamps_of_depth_and_the_lens_come_back(tmp_path):
    write_tum(Kinect(), tmp_path / "k")  # pyright: ignore[reportArgumentType]
    back = TumSequence(tmp_path / "k", camera=str(tmp_path / "k" / "camera.toml"), undistort=False)
    assert back.camera == Kinect.camera
    assert [frame.depth_delay for frame in back] == pytest.approx([0.015] * 2)
    with pytest.raises(GavoError, match="depth of float32 cannot be stored exactly in PNG"):
        write_tum(Kinect(np.float32), tmp_path / "f")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("stamps", "depth_stamps"),
    [
        ([0.0, 0.03, 0.06], [0.01, 0.01, 0.06]),
        ([0.0, 0.03, 0.06], [0.02, 0.05, 0.08]),
        ([0.0, 0.0, 0.06], [0.0, 0.0, 0.06]),
        ([0.0, np.nan, 0.06], [0.0, 0.03, 0.06]),
    ],
)
def test_frames_that_would_be_paired_otherwise_are_not_written(tmp_path, stamps: list, depth_stamps: list):
    """Half of the frames were lost, or had each other's depth."""

    class Stamped(Kinect):
        def __iter__(self):
            for frame, *own in zip(SyntheticSequence(frames=3, camera=SMALL), stamps, depth_stamps, strict=True):
                yield replace(frame, timestamp=own[0], depth_timestamp=own[1])

    with pytest.raises(GavoError, match="frame [01], stamps .*would lose this pair"):
        write_tum(Stamped(), tmp_path / "k")  # pyright: ignore[reportArgumentType]
    assert not (tmp_path / "k" / "rgb.txt").exists()


@pytest.mark.parametrize("other", [None, "fr1_xyz", [], SyntheticSequence])
def test_what_is_no_sequence_is_not_written(tmp_path, other):
    with pytest.raises(GavoError, match="expected a Sequence, got"):
        write_tum(other, tmp_path / "k")
    assert not list(tmp_path.iterdir())


def test_stamps_of_a_frame_a_second_are_seconds(tmp_path):
    """Their decimals are zeros: they were taken for numbers of frames."""
    write_tum(SyntheticSequence(frames=3, rate=1.0, camera=SMALL), tmp_path / "slow")
    back = TumSequence(tmp_path / "slow", camera=str(tmp_path / "slow" / "camera.toml"))
    assert back.timestamps.tolist() == [0.0, 1.0, 2.0]


def test_writing_over_a_sequence_or_a_file_is_refused(tmp_path):
    sequence = SyntheticSequence(frames=1, camera=SMALL)
    write_tum(sequence, tmp_path / "room")
    with pytest.raises(GavoError, match="room"):
        write_tum(sequence, tmp_path / "room")
    (tmp_path / "file").write_text("")
    with pytest.raises(GavoError, match="file"):
        write_tum(sequence, tmp_path / "file")


def test_rendering_keeps_up():
    """About 0.07 s a frame on an idle machine; processor time, and room for a busy one."""
    sequence = SyntheticSequence(frames=5)
    build_room(0)
    started = time.process_time()
    for _ in sequence:
        pass
    assert time.process_time() - started < 2.5


@pytest.mark.parametrize("scale", [1.0, 1e5, float("nan")])
def test_a_unit_in_which_16_bits_hold_no_room_is_refused(scale: float) -> None:
    """Depth came in whole metres, or not at all."""
    with pytest.raises(GavoError, match="depth_scale: (must be from 100 to 20000|expected a positive number)"):
        SyntheticSequence(2, camera=replace(DEFAULT_CAMERA, depth_scale=scale))
