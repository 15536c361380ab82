"""Bodies in the synthetic room: their truth fits what is seen, and nothing else changes."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from gavo_jax.camera import Camera
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.layouts.tum_writing import write_tum
from gavo_jax.datasets.rendered.actors import MOST_BODIES, Sway, Walk, box, figure
from gavo_jax.datasets.rendered.bodies_truth import MASKS, TRUTH
from gavo_jax.datasets.rendered.moving import BodyTruth, MovingBody, MovingPart
from gavo_jax.datasets.rendered.room import Box
from gavo_jax.datasets.rendered.sensor_noise import KINECT, NONE
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.trajectory import Trajectory, inverse

TINY = Camera(65.5, 65.5, 39.5, 29.5, 80, 60)


@pytest.fixture(scope="module")
def moving() -> SyntheticSequence:
    """A box and a walking figure before an exact sensor."""
    return SyntheticSequence(frames=12, noise=NONE, camera=TINY, rate=15.0, bodies=2)


def world_points(sequence: SyntheticSequence, index: int) -> np.ndarray:
    """Of every pixel, [H, W, 3]."""
    rows, columns = np.mgrid[: TINY.height, : TINY.width].astype(float)
    depth = sequence[index].depth / TINY.depth_scale
    points = TINY.back_project(np.stack([columns, rows], axis=-1), depth)
    world_T_camera = sequence.ground_truth.world_T_camera[index]
    return points @ world_T_camera[:3, :3].T + world_T_camera[:3, 3]


def seen(sequence: SyntheticSequence, index: int, world: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns and rows (rounded) and depth in a frame of points of the world, [n, 3]."""
    camera_T_world = inverse(sequence.ground_truth.world_T_camera[index])
    points = world @ camera_T_world[:3, :3].T + camera_T_world[:3, 3]
    x, y = np.rint(np.asarray(TINY.project(points))).astype(int).T
    return x, y, points[:, 2]


@pytest.mark.parametrize("later", [5, 9])
def test_a_parts_points_move_as_its_truth_says(moving: SyntheticSequence, later: int) -> None:
    """They land on the same part, or behind what is nearer; edges are off by a pixel's rounding."""
    labels, after, world = moving.part_labels(4), moving.part_labels(later), world_points(moving, 4)
    depth = moving[later].depth / TINY.depth_scale
    nearest, furthest = cv2.erode(depth, np.ones((3, 3))) - 1e-3, cv2.dilate(depth, np.ones((3, 3))) + 1e-3
    looked_at = 0
    for body in moving.bodies_truth:
        for label, poses in zip(body.part_labels, body.world_T_part, strict=True):
            motion = poses[later] @ inverse(poses[4])
            x, y, z = seen(moving, later, world[labels == label] @ motion[:3, :3].T + motion[:3, 3])
            inside = (x >= 0) & (y >= 0) & (x < TINY.width) & (y < TINY.height)
            x, y, z = x[inside], y[inside], z[inside]
            near = cv2.dilate((after == label).astype(np.uint8), np.ones((3, 3), np.uint8))[y, x] > 0
            assert np.all(near | (depth[y, x] < z - 0.01))
            on = after[y, x] == label
            if on.sum() > 20:
                looked_at += 1
                assert ((nearest[y, x] <= z) & (z <= furthest[y, x]))[on].mean() > 0.9
                assert on.mean() > 0.6
    assert looked_at >= 3


def test_labels_and_truth_fit_together(moving: SyntheticSequence) -> None:
    first, second = moving.bodies_truth
    assert isinstance(first, BodyTruth)
    assert (first.rigid, second.rigid) == (True, False) and (first.label, second.label) == (1, 2)
    assert first.part_labels == (1,) and second.part_labels == tuple(range(2, 8))
    assert second.world_T_part.shape == (6, 12, 4, 4)
    body, part = moving.body_labels(0), moving.part_labels(0)
    assert body.dtype == np.uint8 and body.shape == (TINY.height, TINY.width)
    np.testing.assert_array_equal(body, np.where(part > 1, 2, part))
    assert (body == 1).mean() > 0.05 and (body == 2).mean() > 0.01 and (body == 0).mean() > 0.5
    assert np.all(moving[4:8:2].body_labels(1) == moving.body_labels(6))
    steps = np.linalg.norm(np.diff(first.world_T_part[0, :, :3, 3], axis=0), axis=1)
    assert 0.05 < steps.mean() * 15 < 1.0


def test_the_camera_and_the_rest_of_the_room_stay(moving: SyntheticSequence) -> None:
    alone = SyntheticSequence(frames=12, noise=NONE, camera=TINY, rate=15.0)
    assert alone.bodies_truth == () and not alone.body_labels(3).any()
    np.testing.assert_array_equal(moving.ground_truth.world_T_camera, alone.ground_truth.world_T_camera)
    bodies = moving.body_labels(3) > 0
    np.testing.assert_array_equal(moving[3].depth[~bodies], alone[3].depth[~bodies])
    inner = cv2.erode((~bodies).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    np.testing.assert_array_equal(moving[3].grey[inner], alone[3].grey[inner])
    assert np.all(moving[3].depth[bodies] < alone[3].depth[bodies])


def test_the_sensor_disturbs_bodies_as_well(moving: SyntheticSequence) -> None:
    noisy = SyntheticSequence(frames=12, noise=KINECT, camera=TINY, rate=15.0, bodies=2)
    np.testing.assert_array_equal(noisy.part_labels(0), moving.part_labels(0))
    on = (moving.body_labels(0) == 1) & (noisy[0].depth > 0)
    assert 2 < (noisy[0].depth[on].astype(int) - moving[0].depth[on]).std() < 100
    lost = (moving.body_labels(0) == 0) & (noisy[0].depth == 0)
    alone = SyntheticSequence(frames=12, noise=KINECT, camera=TINY, rate=15.0)[0].depth == 0
    assert lost.sum() > (alone & (moving.body_labels(0) == 0)).sum()  # the shadow of the projector


def test_a_rolling_shutter_sees_each_row_at_its_moment() -> None:
    """A box that moves down while it is read is seen longer than one that stands still."""
    rolling = replace(TINY, readout=1 / 30)
    still = Trajectory(np.arange(3) / 30, np.tile(np.eye(4), (3, 1, 1)))
    still.world_T_camera[:, :3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    middle = np.eye(4)
    middle[:3, 3] = 1.0, 0.0, 1.35

    def falling(seconds: np.ndarray) -> np.ndarray:
        poses = np.tile(middle, (len(seconds), 1, 1))
        poses[:, 2, 3] -= 6.0 * (seconds - 1 / 30)
        return poses

    body = box("falls", (0.2, 0.3, 0.4), falling)
    tall = [
        SyntheticSequence(trajectory=still, noise=NONE, camera=camera, bodies=[body]).body_labels(1).any(axis=1).sum()
        for camera in (TINY, rolling)
    ]
    assert tall[1] > tall[0] + 3


def test_paths_may_be_trajectories(moving: SyntheticSequence) -> None:
    """Between their poses they are followed; before and after them the body stands still."""
    ends = np.tile(np.eye(4), (2, 1, 1))
    ends[:, :3, 3] = [1.2, -0.2, 1.3], [1.2, 0.2, 1.3]
    path = Trajectory(np.array([0.2, 0.6]), ends)
    body = MovingBody("drawer", (MovingPart((Box((0.0, 0.0, -0.1), (0.2, 0.2, 0.2), "carton"),), path),))
    sequence = SyntheticSequence(frames=12, camera=TINY, rate=10.0, bodies=[body])
    along = sequence.bodies_truth[0].world_T_part[0, :, 1, 3]
    np.testing.assert_allclose(along, np.interp(np.arange(12) / 10, [0.2, 0.6], [-0.2, 0.2]), atol=1e-12)


def test_a_written_folder_tells_the_truth(moving: SyntheticSequence, tmp_path) -> None:
    write_tum(moving[1:3], tmp_path / "room")
    back = TumSequence(tmp_path / "room", camera=str(tmp_path / "room" / "camera.toml"))
    assert len(back) == 2
    header, *rows = [row.split(",") for row in (tmp_path / "room" / TRUTH).read_text().splitlines()]
    assert header[:3] == ["timestamp", "body", "part"] and len(rows) == 2 * 7
    masks = sorted((tmp_path / "room" / MASKS).iterdir())
    assert [float(mask.stem) for mask in masks] == list(back.timestamps)
    np.testing.assert_array_equal(cv2.imread(str(masks[1]), cv2.IMREAD_UNCHANGED), moving.body_labels(2))
    values = np.array(rows[7], float)
    np.testing.assert_allclose(values[3:6], moving.bodies_truth[0].world_T_part[0, 2, :3, 3], atol=1e-9)
    assert values[-1] == pytest.approx((moving.part_labels(2) == 1).mean(), abs=1e-6)
    write_tum(SyntheticSequence(frames=1, camera=TINY), tmp_path / "empty")
    assert not (tmp_path / "empty" / TRUTH).exists() and not (tmp_path / "empty" / MASKS).exists()


@pytest.mark.parametrize(
    ("bodies", "word"),
    [
        (-1, "bodies"),
        (1.5, "bodies: expected a whole number, got 1.5"),
        ("2", "bodies: expected a MovingBody, got str"),
        ([1], "bodies: expected a MovingBody, got int"),
        ([MovingBody("whole", 1)], "bodies: 'int' object is not iterable"),  # pyright: ignore[reportArgumentType]
        ([box("held", (1.0, 1.0, 1.0), None)], "bodies: 'NoneType' object"),  # pyright: ignore[reportArgumentType]
        (MOST_BODIES + 1, f"to {MOST_BODIES}"),
        ([MovingBody("nothing", ())], "needs a part"),
        ([MovingBody("hollow", (MovingPart((), Sway(np.eye(4))),))], "a box"),
        ([box("bent", (1.0, 1.0, 1.0), lambda seconds: np.zeros((len(seconds), 4, 4)))], "rigid motions"),
        (
            [box("mirrored", (1.0, 1.0, 1.0), lambda seconds: np.tile(np.diag([1.0, 1, -1, 1]), (len(seconds), 1, 1)))],
            "rigid",
        ),
        ([box("lost", (1.0, 1.0, 1.0), lambda seconds: np.eye(4))], "path"),
        ([box("odd", (1.0, 1.0, 1.0), Sway(np.eye(4)), texture="granite")], "granite"),
        ([box("flat", (1.0, 0.0, 1.0), Sway(np.eye(4)))], "size"),
    ],
)
def test_bodies_that_cannot_be_are_refused(bodies: int | list[MovingBody], word: str) -> None:
    with pytest.raises(GavoError, match=word) as caught:
        SyntheticSequence(frames=2, camera=TINY, bodies=bodies)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("size", [None, 3, (1.0, 1.0), "big"])
def test_what_is_no_box_or_figure_is_refused_at_once(size: Any) -> None:
    """It was a fault of Python's, about a subscript or an attribute."""
    with pytest.raises(GavoError, match="box 'a': size: expected three edge lengths"):
        box("a", size, Sway(np.eye(4)))
    with pytest.raises(GavoError, match="box 'a': colour: not one of yaw, tint"):
        box("a", (1.0, 1.0, 1.0), Sway(np.eye(4)), colour=size)
    with pytest.raises(GavoError, match="figure 'a': expected a Walk"):
        figure("a", size)
    with pytest.raises(GavoError, match="figure 'a': tall"):
        figure("a", Walk((0.0, 0.0, 0.0), 0.0), 0.0)
