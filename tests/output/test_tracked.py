"""A sequence is tracked under the eyes of a user."""

import time
from typing import Any

import jax
import numpy as np
import pytest

from gavo_jax.alignment.result import no_alignment
from gavo_jax.bodies.records import Seen
from gavo_jax.compilation import programs
from gavo_jax.compilation.programs import CachedProgram
from gavo_jax.datasets.base import Frame
from gavo_jax.odometry.aligners import Attempt
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.metrics import COMPILE_SECONDS
from gavo_jax.odometry.run import run_odometry
from gavo_jax.odometry.second_thoughts import Recovering
from gavo_jax.odometry.tracking import Clock
from gavo_jax.output import screen
from gavo_jax.output.tracked import track_visibly
from gavo_jax.status import AlignmentStatus
from tests.small import CAMERA, Rendered, StandIn

SECONDS = 0.5
"""That the program below takes to be made."""


class CompilesLate(StandIn):
    """An aligner whose third frame is the first to need some program."""

    def __init__(self) -> None:
        def slowly_traced(numbers: jax.Array) -> jax.Array:
            time.sleep(SECONDS)
            return numbers + 1.0

        self.program: Any = CachedProgram(slowly_traced)

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        if clock.index == 2:
            self.program(np.zeros(3, np.float32))
        return Attempt(frame.timestamp, no_alignment(AlignmentStatus.OK)._replace(target_T_reference=np.eye(4)), True)


def rendered() -> Rendered:
    """Frames that take no time any more."""
    sequence = Rendered(4, camera=CAMERA)
    assert all(sequence[index] is sequence[index] for index in range(4))
    return sequence


@pytest.fixture(autouse=True)
def _anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """No program is kept from an earlier test."""
    monkeypatch.setattr(programs, "_folder", None)


def test_what_is_compiled_on_the_way_is_said_and_does_not_slow_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """The wide search, which the first doubtful pair needs, made 13 frames a second 0.9."""
    said = []
    monkeypatch.setattr(screen.PairProgress, "compiling", lambda bar: said.append(len(steps)))
    sequence, steps = rendered(), []
    start = time.perf_counter()
    tracked = track_visibly("clip", sequence, Odometry(CAMERA, aligner=CompilesLate()), steps.append)
    assert said == [1]
    assert tracked.compile_seconds >= SECONDS
    assert tracked.outcome(sequence).figures[COMPILE_SECONDS] == tracked.compile_seconds
    others = time.perf_counter() - start - SECONDS
    assert tracked.seconds < others
    assert sum(step.milliseconds for step in steps) < 1e3 * others


def test_no_masks_are_kept_of_what_was_tracked() -> None:
    """Every frame with a body held 77 kB for each until the run ended, though they are read from its folder then."""

    class Sees(StandIn):
        def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
            result = no_alignment(AlignmentStatus.OK)._replace(target_T_reference=np.eye(4))
            body = Seen(1, np.ones((60, 80), np.float32), 1.0, np.zeros(3))
            return Attempt(frame.timestamp, result, usable=True, bodies=(body,))

    seen: list[Step] = []
    tracked = track_visibly("clip", rendered(), Odometry(CAMERA, aligner=Sees()), seen.append)
    assert [len(step.bodies) for step in seen] == [1, 1, 1]
    assert [len(step.bodies) for step in tracked.steps] == [0, 0, 0]


def test_a_library_call_leaves_it_out_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gavo_jax.odometry.driver.make_aligner", lambda *_: CompilesLate())
    sequence, start = rendered(), time.perf_counter()
    metrics: Any = run_odometry(sequence).metrics
    assert metrics[COMPILE_SECONDS] >= SECONDS
    assert 4 / metrics["frames_per_second"] < time.perf_counter() - start - SECONDS


def test_before_a_camera_the_search_behind_the_first_one_is_made_as_well() -> None:
    made: list[str] = []

    class Made(StandIn):
        def __init__(self, name: str) -> None:
            self.name = name

        def warm_up(self) -> float:
            made.append(self.name)
            return 0.0

    first, wide = Made("first"), Made("wide")
    behind: Any = wide
    odometry = Odometry(CAMERA, aligner=Recovering(first, wide, behind))  # pyright: ignore[reportArgumentType]
    odometry.warm_up()
    assert made == ["first"]
    odometry.warm_up(wholly=True)
    assert sorted(made) == ["first", "first", "wide"]
