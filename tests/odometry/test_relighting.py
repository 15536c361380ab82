"""Where light changed from place to place, a frame is searched for once more, with references in its own light."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from carded import Carded
from driving import CAMERA, PLAIN, SEARCH_ALONE, SOLVER, Altered, Told, errors, run
from flicker import flickering, followed

from gavo_jax.alignment.result import no_alignment
from gavo_jax.compilation import programs
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.odometry.aligners import BEGINNING, Attempt, FrameSearch
from gavo_jax.odometry.composition import make_aligner
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.relighting import Relighting
from gavo_jax.odometry.tracking import Clock
from gavo_jax.presets import preset
from gavo_jax.settings import Settings
from gavo_jax.status import AlignmentStatus

RELIT = replace(PLAIN, relight=True)
FAST = preset("gauss-newton", "fast")


@dataclass(frozen=True)
class Counting:
    """A search that counts how often it was asked."""

    search: FrameSearch
    states: list[Any]

    def __getattr__(self, name: str) -> Any:
        return getattr(self.search, name)

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        self.states.append(state)
        return self.search.align(state, frame, clock)


def counted(sequence: Any) -> tuple[list[AlignmentStatus], list[Any]]:
    """What a run says of its pairs, and the states of its second searches."""
    relighting = make_aligner(CAMERA, Settings(SOLVER, odometry=RELIT), jax.random.key(0))
    assert isinstance(relighting, Relighting)
    again: list[Any] = []
    search: Any = Counting(relighting.search, again)
    odometry = Odometry(CAMERA, SEARCH_ALONE, aligner=replace(relighting, search=search))
    steps = [odometry.register(frame, frame.timestamp) for frame in map(sequence.__getitem__, range(len(sequence)))]
    return [step.alignment.status for step in steps if step], again


@pytest.fixture(scope="module")
def room() -> SyntheticSequence:
    return SyntheticSequence(frames=6, camera=CAMERA)


def test_a_flickering_lamp_does_not_move_the_camera(room: SyntheticSequence) -> None:
    lit = Altered(room, flickering)
    before, after = (run(lit, options) for options in (PLAIN, RELIT))
    assert np.max(errors(after, lit)) < 0.7 * np.max(errors(before, lit))
    assert min(float(step.alignment.explained.grey) for step in after.steps) > 0.9


def test_light_that_is_even_asks_for_nothing(room: SyntheticSequence) -> None:
    statuses, again = counted(Altered(room, lambda index, frame: replace(frame, grey=frame.grey // (1 + index % 2))))
    assert statuses == [AlignmentStatus.OK] * 5 and not again


def test_a_body_is_not_taken_for_light() -> None:
    """References in the light of a body that moved would show it where it went, and the camera would follow it."""
    statuses, again = counted(Carded())
    assert AlignmentStatus.HIGH_ERROR in statuses and not again


def test_references_are_as_bright_as_the_new_frame_shows_them(room: SyntheticSequence) -> None:
    still = [flickering(index, replace(room[0], timestamp=index / 30), amplitude=0.1) for index in range(2)]
    _, again = counted(still)
    (state,) = again
    plain = Odometry(CAMERA, SEARCH_ALONE)
    plain.register(still[0], still[0].timestamp)
    tracker: Any = plain.progress.tracker
    finest = CAMERA.level(1)
    before, after = (jax.tree.map(lambda leaf: np.asarray(leaf)[-1], one.previous) for one in (tracker, state))
    rows = (np.asarray(before.points.y) * finest.fy + finest.cy + 0.5) / finest.height
    wanted = np.divide(*(1.0 + 0.1 * np.sin(4.0 * np.pi * rows + 2.1 * index) for index in (1, 0)))
    gain, has = after.grey / before.grey, before.points.q > 0
    overall = np.median((gain / wanted)[has])  # the search estimates one gain for all by itself
    assert np.std(wanted[has]) > 0.08
    assert np.median(np.abs(gain / wanted / overall - 1.0)[has]) < 0.02
    np.testing.assert_allclose(after.grey_u[has], (gain * before.grey_u)[has], rtol=1e-4)


def test_a_motion_that_can_be_used_does_not_give_way_to_one_that_cannot(room: SyntheticSequence) -> None:
    """By the light that goes with a motion nearly everything can be explained."""
    lit = [flickering(index, room[index]) for index in range(2)]
    search: Any = make_aligner(CAMERA, SEARCH_ALONE, jax.random.key(0))
    first = search.align(search.start(lit[0]), lit[1], clock_of(lit))
    assert first.usable and float(first.result.explained.grey) < 0.7
    explained = first.result.explained._replace(grey=np.float32(1.0))
    for usable in (False, True):
        told: Any = Answering(search, first._replace(result=first.result._replace(explained=explained), usable=usable))
        attempt = Relighting(search, told).align(search.start(lit[0]), lit[1], clock_of(lit))
        assert (float(attempt.result.explained.grey) == 1.0) == usable


@dataclass(frozen=True)
class Answering:
    """A search that has one answer."""

    search: Any
    answer: Attempt

    def __getattr__(self, name: str) -> Any:
        return getattr(self.search, name)

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        return self.answer


def clock_of(pair: list[Frame]) -> Clock:
    """When the second of two frames was taken."""
    return Clock(np.float32(pair[1].timestamp - pair[0].timestamp), np.float32(0.0), np.uint32(1))


def test_a_camera_does_not_wait_for_the_light(monkeypatch: pytest.MonkeyPatch, room: SyntheticSequence) -> None:
    """The program that looks at it took two seconds in the middle of a run."""
    odometry = Odometry(CAMERA, Settings(SOLVER, odometry=RELIT))
    monkeypatch.setattr(programs, "_loaded", {})
    odometry.warm_up(wholly=True)
    before = set(programs._loaded)
    for index in range(4):
        odometry.register(flickering(index, room[index]), room[index].timestamp)
    assert {"_with_light", "track_frame"} <= {function.__name__ for function, *_ in before}
    assert set(programs._loaded) == before


def test_where_nothing_is_seen_twice_nothing_is_known_of_the_light(room: SyntheticSequence) -> None:
    told: Any = Told(no_alignment(AlignmentStatus.HIGH_ERROR))
    nothing: Any = None
    attempt = Relighting(told, nothing).align(nothing, room[0], BEGINNING)
    assert attempt.result is told.result and np.isnan(attempt.result.explained.grey)


def test_a_clip_under_a_flickering_lamp(data_dir: Path) -> None:
    """Bands of 8 % made every third pair `high_error`."""
    clip = TumSequence(data_dir / "fr1_desk")
    steps = followed(clip, clip.camera, FAST, frames=12)
    assert {step.alignment.status for step in steps} == {AlignmentStatus.OK}
