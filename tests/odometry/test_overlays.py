"""What is drawn into every image is told by its levels, and left out of the search."""

from collections.abc import Iterable
from dataclasses import replace

import cv2
import numpy as np
import pytest
import small
from driving import SEARCH_ALONE, Altered, Told, found
from small import Rendered

from gavo_jax.datasets.base import Frame, FrameError
from gavo_jax.datasets.rendered.sensor_noise import KINECT, NONE, SensorNoise
from gavo_jax.mapping.mapper import Mapper
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.overlays import FRAMES, AsTracked, Overlays
from gavo_jax.odometry.run import run_odometry
from gavo_jax.odometry.stream import track
from gavo_jax.output.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from gavo_jax.status import AlignmentStatus

ROOM = Rendered(FRAMES + 12, camera=small.CAMERA)


def marked(_: int, frame: Frame) -> Frame:
    """A bar with a text along the lower edge."""
    grey = np.array(frame.grey)
    grey[100:] = 40
    cv2.putText(grey, "12:30:05 #7", (2, 115), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 240, 1)
    return replace(frame, grey=grey)


def seen(frames: Iterable[Frame]) -> Overlays:
    overlays = Overlays()
    for frame in frames:
        overlays = overlays.after(frame.grey, np.eye(4))
    return overlays


def test_what_is_drawn_loses_its_edges_and_its_depth_and_nothing_else_does() -> None:
    frames = [marked(i, frame) for i, frame in enumerate(ROOM)]
    for count in (1, FRAMES):
        assert seen(frames[:count]).without(frames[count - 1]) is frames[count - 1], "it is not known yet"
    last = frames[FRAMES + 2]
    freed = seen(frames[: FRAMES + 3]).without(last)
    steepest = [np.abs(np.diff(frame.grey[105:115, 5:95].astype(int))).max() for frame in (freed, last)]
    assert steepest[0] < 15 and steepest[1] > 100
    assert not np.any(freed.depth[104:115, 5:95])
    np.testing.assert_array_equal(freed.grey[:86], last.grey[:86])
    np.testing.assert_array_equal(freed.depth[:86], last.depth[:86])


@pytest.mark.parametrize("noise", [KINECT, NONE])
@pytest.mark.parametrize("speed", [0.2, 1.0])
def test_a_scene_is_not_taken_for_a_drawing(noise: SensorNoise, speed: float) -> None:
    overlays = Overlays()
    for frame in Rendered(30, camera=small.CAMERA, noise=noise, speed=speed):
        overlays = overlays.after(frame.grey, np.eye(4))
        assert overlays.without(frame) is frame


def test_a_camera_that_stands_still_draws_nothing() -> None:
    """An exact sensor returns the same image over and over then."""
    still = [marked(0, ROOM[0])] * 30
    assert seen(still).without(still[0]) is still[0]


def test_another_size_begins_anew() -> None:
    overlays = seen(marked(i, frame) for i, frame in enumerate(ROOM))
    small_image = Rendered(1, camera=small.CAMERA.level(1))[0]
    assert overlays.after(small_image.grey, np.eye(4)).without(small_image) is small_image


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int32])
def test_levels_of_any_kind(kind: type) -> None:
    frames = [replace(frame, grey=marked(i, frame).grey.astype(kind)) for i, frame in enumerate(ROOM)]
    freed = seen(frames).without(frames[-1])
    assert freed.grey.dtype == kind and not np.any(freed.depth[104:115, 5:95])


@pytest.mark.filterwarnings("error")
def test_an_image_without_levels_is_looked_at_without_a_word() -> None:
    images = [np.full((40, 60), value) for value in (np.inf, -np.inf, np.nan, 3e38, -1.0, 7)]
    overlays = Overlays()
    for image in (*images, *images[::-1], *(image.astype(np.uint8) for image in images[-1:])):
        overlays = overlays.after(image, np.eye(4))
    assert not np.any(overlays.counts)


def test_a_run_is_not_held_by_what_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    sequence = Altered(ROOM, marked)
    truth = ROOM.ground_truth
    assert truth is not None

    def error() -> float:
        run = run_odometry(sequence, SEARCH_ALONE)
        moved = [np.linalg.inv(poses[FRAMES + 1]) @ poses[-1] for poses in (run.trajectory.world_T_camera, true)]
        return float(np.linalg.norm((moved[0] - moved[1])[:3, 3]))

    true = truth.interpolate(ROOM.timestamps)[0]
    freed = error()
    monkeypatch.setattr(Overlays, "without", lambda self, frame: frame)
    assert freed < 0.3 * error()


def test_a_run_that_goes_on_knows_what_is_drawn(tmp_path) -> None:
    sequence = Altered(ROOM, marked)
    whole = [*track(sequence, SEARCH_ALONE)]
    first = Odometry(small.CAMERA, SEARCH_ALONE)
    for index in range(8):
        first.register(sequence[index], float(sequence.timestamps[index]))
    save_checkpoint(tmp_path / "checkpoint.npz", Checkpoint(first.progress, {}, ""))
    again = Odometry(small.CAMERA, SEARCH_ALONE)
    again.progress = load_checkpoint(tmp_path / "checkpoint.npz", first.progress.tracker).progress
    assert again.progress.overlays.counts.dtype == np.uint8
    rest = [*track(sequence, odometry=again)]
    np.testing.assert_array_equal(rest[-1].world_T_camera, whole[-1].world_T_camera)


def test_maps_are_shown_what_was_tracked() -> None:
    shown: list[Frame | None] = []
    for _ in track(Altered(ROOM, marked), SEARCH_ALONE, watch=lambda frame, _: shown.append(frame)):
        pass
    first, last = shown[0], shown[-1]
    assert first is not None and np.any(first.depth[104:115, 5:95])
    assert last is not None and not np.any(last.depth[104:115, 5:95])


def torn_once(index: int, frame: Frame) -> Frame:
    """The same, of which one cannot be read."""
    if index == 4:
        raise FrameError("torn")
    return marked(index, frame)


def test_frames_are_read_again_as_they_were_tracked() -> None:
    sequence, shown = Altered(ROOM, torn_once), {}

    def watch(frame: Frame | None, step: Step | None) -> None:
        shown[0 if step is None else step.index] = frame

    steps = [*track(sequence, SEARCH_ALONE, watch=watch)]
    again, plain = AsTracked(sequence, steps), AsTracked(sequence, steps, is_drawn_on=False)
    for index in (0, 3, FRAMES + 2, len(ROOM) - 1):
        np.testing.assert_array_equal(again[index].grey, shown[index].grey)
        np.testing.assert_array_equal(again[index].depth, shown[index].depth)
        np.testing.assert_array_equal(plain[index].grey, sequence[index].grey)
    with pytest.raises(FrameError, match="torn"):
        AsTracked(sequence, steps)[4]


BLIND = FRAMES + 5


@pytest.mark.parametrize("seen_then", [np.zeros((120, 160)), np.random.default_rng(0).integers(0, 256, (120, 160))])
def test_what_is_drawn_is_still_known_after_a_frame_that_is_refused(seen_then: np.ndarray) -> None:
    """A black or noisy frame wiped it: the next eight frames, and keyframes made again, had the clock."""
    grey = seen_then.astype(np.uint8)
    sequence = Altered(ROOM, lambda i, frame: replace(frame, grey=grey) if i == BLIND else marked(i, frame))
    odometry, shown, steps = Odometry(small.CAMERA, aligner=Told(found(AlignmentStatus.OK, 0.01))), [], []
    for step in track(sequence, odometry=odometry, watch=lambda frame, _: shown.append(frame)):
        steps.append(step)
        assert odometry.progress.overlays.is_any == (step.index >= FRAMES), step.index
    assert [step.index for step in steps if step.lost] == [BLIND]
    again = AsTracked(sequence, steps)
    for index in (FRAMES - 1, FRAMES, BLIND - 1, BLIND, BLIND + 1, len(ROOM) - 1):
        np.testing.assert_array_equal(again[index].grey, shown[index].grey)
        np.testing.assert_array_equal(again[index].depth, shown[index].depth)


def test_a_resumed_run_makes_its_map_of_what_was_tracked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keyframes from before the interruption had the clock that later ones were freed of."""
    sequence, replayed = Altered(ROOM, marked), []
    steps = [*track(sequence, SEARCH_ALONE)]
    monkeypatch.setattr(Mapper, "is_due", lambda self, step: step.index % 5 == 0)
    monkeypatch.setattr(Mapper, "watch", lambda self, frame, *_: replayed.append(frame))
    Mapper(small.CAMERA).replay(sequence, steps, is_drawn_on=True)
    kept = [np.any(frame.depth[104:115, 5:95]) for frame in replayed if frame is not None]
    assert kept[0] and not kept[-1]
