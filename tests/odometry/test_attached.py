"""Parts of what carries the camera stay put in its images, and are left out of the search."""

from collections.abc import Iterable
from dataclasses import replace

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
import small
from driving import SEARCH_ALONE, SOLVER, Altered
from small import Rendered

from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.odometry.attached import MOVES, Attached
from gavo_jax.odometry.overlays import AsTracked, Overlays
from gavo_jax.odometry.run import run_odometry
from gavo_jax.odometry.stream import track
from gavo_jax.se3 import exp
from gavo_jax.settings import Settings
from gavo_jax.trajectory import Trajectory

FRAMES = 60
ROOM = Rendered(FRAMES, camera=small.CAMERA, speed=3.0)
POSES = ROOM.ground_truth.world_T_camera  # pyright: ignore[reportOptionalMemberAccess]
FINGERS = np.array([[[30, 119], [30, 96], [44, 92], [50, 119]], [[110, 119], [116, 92], [130, 96], [130, 119]]])
BAR = np.array([[[0, 119], [0, 110], [159, 110], [159, 119]]])


def held(index: int, frame: Frame) -> Frame:
    """A gripper along the lower edge, without depth, in changing light and as noisy as a sensor."""
    rng, grey = np.random.default_rng(index), np.array(frame.grey)
    light = 1.0 + 0.2 * np.sin(index / 5)
    part = cv2.fillPoly(np.zeros_like(grey), [*FINGERS, *BAR], 1) > 0
    level = np.where(cv2.fillPoly(np.zeros_like(grey), [*BAR], 1) > 0, 60.0, 160.0) * light
    grey = np.where(part, np.clip(level + rng.normal(0, 2, grey.shape), 0, 255), grey).astype(np.uint8)
    return replace(frame, grey=grey, depth=np.where(part, 0, frame.depth).astype(frame.depth.dtype))


def seen(frames: Iterable[Frame], poses: Iterable[np.ndarray] = POSES) -> Attached:
    attached = Attached()
    for frame, pose in zip(frames, poses, strict=False):
        attached = attached.after(frame.grey, pose)
    return attached


def test_edges_that_stay_put_are_those_of_the_part_in_view() -> None:
    attached = seen(held(i, frame) for i, frame in enumerate(ROOM))
    assert attached.moves >= MOVES
    rows, _ = np.nonzero(attached.edges)
    assert len(rows) > 100 and rows.min() >= 88


def test_nothing_is_known_before_the_camera_has_moved() -> None:
    frames = [held(i, frame) for i, frame in enumerate(ROOM)]
    assert not seen(frames[: MOVES - 1]).edges.any()
    assert seen([frames[0]] * FRAMES).moves == 0
    assert seen(frames, [np.eye(4)] * FRAMES).moves == 0, "what moves before a camera at rest proves nothing"


@pytest.mark.parametrize("speed", [0.5, 3.0])
def test_a_scene_is_not_attached(speed: float) -> None:
    room = Rendered(FRAMES, camera=small.CAMERA, speed=speed, seed=1)
    assert not seen(room, room.ground_truth.world_T_camera).edges.any()  # pyright: ignore[reportOptionalMemberAccess]


@pytest.mark.parametrize(("amplitude", "period"), [(0.01, 6), (0.01, 15), (0.014, 6)])
def test_the_scene_before_a_camera_that_trembles_is_not_attached(amplitude: float, period: int) -> None:
    """All of the image was left out, and the run was blank to its end."""
    start, poses = POSES[0], []
    for i in range(130):
        turn = amplitude * np.array([np.cos(2 * np.pi * i / period), np.sin(2 * np.pi * i / period), 0.0])
        poses.append(start @ np.asarray(exp(jnp.array([0.0, 0.0, 0.0, *turn])), np.float64))
    path = Trajectory(np.arange(130) / 30, np.stack(poses))
    shaken = SyntheticSequence(130, camera=small.CAMERA, trajectory=path)
    attached = seen(shaken, poses)
    assert attached.moves >= MOVES and not attached.edges.any()


def test_edges_along_the_motion_are_not_attached() -> None:
    """Boards of a wall that the camera slides along; across them only their grain."""
    rng = np.random.default_rng(0)
    wall = np.repeat(rng.uniform(40, 200, (12, 1)), 10, axis=0) + rng.normal(0, 40, (120, 400))
    images = [np.clip(wall[:, 3 * i : 3 * i + 160], 0, 255).astype(np.uint8) for i in range(FRAMES)]
    attached = Attached()
    for i, image in enumerate(images):
        pose = np.eye(4)
        pose[0, 3] = 0.01 * i
        attached = attached.after(image, pose)
    assert attached.moves >= MOVES and not attached.edges.any()


def test_another_size_begins_anew() -> None:
    attached = seen(held(i, frame) for i, frame in enumerate(ROOM))
    small_image = Rendered(1, camera=small.CAMERA.level(1))[0]
    assert attached.after(small_image.grey, np.eye(4)).moves == 0


PLATES = cv2.resize(np.random.default_rng(0).uniform(60, 180, (3, 12)), (160, 24), interpolation=cv2.INTER_NEAREST)


def plated(index: int, frame: Frame) -> Frame:
    """A bonnet of bright and dark plates close to the camera, a fifth of the image."""
    rng, grey, depth = np.random.default_rng(index), np.array(frame.grey), np.array(frame.depth)
    grey[96:] = np.clip(PLATES + rng.normal(0, 2, PLATES.shape), 0, 255)
    depth[96:] = 0.4 * small.CAMERA.depth_scale
    return replace(frame, grey=grey, depth=depth)


def test_a_run_is_not_held_by_a_part_in_view(monkeypatch: pytest.MonkeyPatch) -> None:
    def error() -> float:
        poses = run_odometry(Altered(ROOM, plated), Settings(SOLVER)).trajectory.world_T_camera
        moved = [np.linalg.inv(where[2 * MOVES]) @ where[-1] for where in (poses, POSES)]
        return float(np.linalg.norm((moved[0] - moved[1])[:3, 3]))

    freed = error()
    assert freed < 0.012
    monkeypatch.setattr(Attached, "after", lambda self, *_: self)
    assert freed < 0.6 * error()  # what moves with the camera is a body in the scene, which helps for a while


def test_frames_are_read_again_as_they_were_tracked() -> None:
    sequence, shown = Altered(ROOM, held), []
    steps = [*track(sequence, SEARCH_ALONE, watch=lambda frame, _: shown.append(frame))]
    again = AsTracked(sequence, steps)
    assert not np.array_equal(shown[-1].grey, sequence[FRAMES - 1].grey)
    for index in (0, MOVES, FRAMES - 1):
        np.testing.assert_array_equal(again[index].grey, shown[index].grey)


def test_overlays_know_of_it() -> None:
    overlays = Overlays()
    for index, pose in enumerate(POSES):
        overlays = overlays.after(held(index, ROOM[index]).grey, pose)
    assert overlays.is_any and not overlays.is_drawn
