"""A sequence streams through the driver: nothing is kept that is not needed."""

import gc
import threading
import tracemalloc
import weakref
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest
from driving import CAMERA, FRAMES, PLAIN, SEARCH_ALONE, Altered, run, unreadable

from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.stream import decoded, track


def test_on_lost_stop_ends_the_run(sequence: SyntheticSequence) -> None:
    result = run(Altered(sequence, unreadable(5)), replace(PLAIN, on_lost="stop"))
    assert [step.index for step in result.steps] == [1, 2, 3, 4, 5]
    assert result.steps[-1].lost
    assert result.metrics["frames"] == 6 and not result.metrics["complete"]


def test_what_is_no_driver_is_refused(sequence: SyntheticSequence) -> None:
    driver: Any = PLAIN
    with pytest.raises(GavoError, match=r"expected an Odometry, got OdometryOptions: gavo\.Odometry\(camera"):
        next(track(sequence, odometry=driver))


def test_a_driver_of_another_camera_or_sequence_is_refused(sequence: SyntheticSequence) -> None:
    """A wrong camera gave wrong poses, and frames of another part of a recording were left out."""
    with pytest.raises(GavoError, match="the driver's camera is not that of"):
        next(track(sequence, odometry=Odometry(replace(CAMERA, fx=2 * CAMERA.fx), SEARCH_ALONE)))
    driver = Odometry(CAMERA, SEARCH_ALONE)
    assert [step.index for step in track(sequence[:4], odometry=driver)] == [1, 2, 3]
    with pytest.raises(GavoError, match="has seen 4 frames and goes on with the next one, but there are 3"):
        next(track(sequence[4:7], odometry=driver))


def test_streams(sequence: SyntheticSequence) -> None:
    """Each frame is decoded once, in order, in another thread, and let go soon after."""
    alive: list[weakref.ref[Frame]] = []
    most, threads = [0], set()

    def alter(_: int, frame: Frame) -> Frame:
        copy = replace(frame, grey=frame.grey.copy(), depth=frame.depth.copy())
        alive.append(weakref.ref(copy))
        most[0] = max(most[0], sum(reference() is not None for reference in alive))
        threads.add(threading.get_ident())
        return copy

    streamed = Altered(sequence, alter)
    told: list[Step] = []
    result = run(streamed, on_step=told.append)
    assert streamed.read == list(range(FRAMES))
    assert threading.get_ident() not in threads
    assert most[0] <= 4
    assert all(step.alignment is own.alignment for step, own in zip(told, result.steps, strict=True))


def test_a_sequence_may_decode_into_the_same_arrays(sequence: SyntheticSequence) -> None:
    """The next frame is decoded while one is aligned; poses were wrong, each time others, and the pairs `ok`."""
    grey, depth = np.empty_like(sequence[0].grey), np.empty_like(sequence[0].depth)
    is_read = [threading.Event() for _ in range(FRAMES)]

    def alter(index: int, frame: Frame) -> Frame:
        np.copyto(grey, frame.grey)
        np.copyto(depth, frame.depth)
        is_read[index].set()
        return replace(frame, grey=grey, depth=depth)

    for index, frame in enumerate(decoded(Altered(sequence, alter))):
        assert is_read[min(index + 1, FRAMES - 1)].wait(10.0)
        assert isinstance(frame, Frame)
        np.testing.assert_array_equal(frame.grey, sequence[index].grey)
        np.testing.assert_array_equal(frame.depth, sequence[index].depth)


def test_who_watches_sees_the_stamps_of_the_sequence(sequence: SyntheticSequence) -> None:
    """A map was kept by the frames' own stamps: where those are others, loops counted and corrected nothing."""
    stamped, seen = Altered(sequence, lambda index, frame: replace(frame, timestamp=float(index))), []
    for _ in track(stamped, SEARCH_ALONE, watch=lambda frame, _: seen.append(frame)):
        if len(seen) == 3:
            break
    assert [frame.timestamp for frame in seen] == sequence.timestamps[:3].tolist()


def test_memory_does_not_grow_with_the_frames(sequence: SyntheticSequence) -> None:
    """From frame to frame the device holds as much as before, and the host less than a hundredth of a frame more."""
    device: list[int] = []
    host: list[int] = []

    def weigh(_: Step) -> None:
        gc.collect()
        device.append(sum(array.nbytes for array in jax.live_arrays()))
        host.append(tracemalloc.get_traced_memory()[0])

    run(sequence)
    tracemalloc.start()
    try:
        run(Altered(sequence, lambda _, frame: replace(frame, grey=frame.grey.copy())), on_step=weigh)
    finally:
        tracemalloc.stop()
    assert len(set(device[3:])) == 1
    assert (host[-1] - host[3]) / len(host[4:]) < 0.01 * CAMERA.width * CAMERA.height * 3


def test_track_yields_steps_as_they_are_done(sequence: SyntheticSequence) -> None:
    altered = Altered(sequence, lambda _, frame: frame)
    steps = track(altered, SEARCH_ALONE)
    assert altered.read == []
    first = next(steps)
    assert first.index == 1 and max(altered.read) <= 3
    steps.close()  # pyright: ignore[reportAttributeAccessIssue]
