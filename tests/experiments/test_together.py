"""Many runs together are the single runs, and compile once."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from small import CAMERA, GENETIC

from gavo_jax import presets
from gavo_jax.alignment.result import no_alignment
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame, FrameError
from gavo_jax.datasets.rendered.sensor_noise import KINECT
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.experiments import together
from gavo_jax.experiments.executors import LocalExecutor
from gavo_jax.experiments.plan import Plan, programs
from gavo_jax.experiments.plan_file import read_plan
from gavo_jax.experiments.runner import run_experiment
from gavo_jax.experiments.table import Table
from gavo_jax.experiments.together import track_stacked, track_together
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.run import run_odometry
from gavo_jax.odometry.second_thoughts import without_depth
from gavo_jax.odometry.stream import track
from gavo_jax.odometry.tracking import Clock
from gavo_jax.settings import Settings
from gavo_jax.settings_file import override
from gavo_jax.status import AlignmentStatus

FRAMES = 5


def frames(count: int = FRAMES) -> SyntheticSequence:
    return SyntheticSequence(count, noise=KINECT, camera=CAMERA)


class Damaged(SyntheticSequence):
    """Frame 2 cannot be read, frame 4 is black."""

    def __getitem__(self, index: Any) -> Any:
        frame = super().__getitem__(index)
        if index == 2:
            raise FrameError("frame 2: torn")
        if index == 4 and isinstance(frame, Frame):
            return replace(frame, grey=np.zeros_like(frame.grey), depth=np.zeros_like(frame.depth))
        return frame


def drivers(settings: list[Settings]) -> list[Odometry]:
    return [Odometry(CAMERA, own, seed=seed) for seed, own in enumerate(settings)]


def poses(steps: list[Step]) -> np.ndarray:
    return np.stack([step.world_T_camera for step in steps])


@contextmanager
def compilations() -> Iterator[list[str]]:
    """Programs that XLA compiles (or loads from the cache) meanwhile."""
    events: list[str] = []
    counting = True

    def listen(event: str, duration_secs: float, **kwargs: str | int) -> None:
        if counting and event == "/jax/core/compile/backend_compile_duration":
            events.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield events
    finally:
        counting = False


SMALL = {"solver.iterations": [0, 0, 6, 6, 8]}
"""The three coarsest levels: 40 x 30 pixels are the finest."""


def rates(count: int) -> list[Settings]:
    """Gauss-Newton with a damping and a depth weight of its own for every run."""
    preset = override(presets.preset("gauss-newton"), SMALL)
    return [
        replace(
            preset,
            solver=replace(preset.solver, damping=1e-4 * (1 + i)),
            alignment=replace(preset.alignment, depth_weight=(1.0 + 0.01 * i,) * 5),
        )
        for i in range(count)
    ]


def test_together_is_one_by_one_bit_for_bit():
    others = (replace(GENETIC.solver, mutation_decay=decay) for decay in (0.6, 0.9))
    settings = [GENETIC] * 2 + [replace(GENETIC, solver=solver) for solver in others]
    found = track_together(frames(), drivers(settings))
    for i, (own, steps) in enumerate(zip(settings, found, strict=True)):
        alone = list(track(frames(), own, seed=i))
        assert np.array_equal(poses(steps), poses(alone))
    assert len({steps[-1].alignment.error.tobytes() for steps in found}) == 4


def test_lost_frames_together():
    settings = rates(2)
    stopping = [replace(p, odometry=replace(p.odometry, on_lost="stop", recover=False)) for p in settings[:1]]
    staying = [replace(p, odometry=replace(p.odometry, recover=False)) for p in settings[1:]]
    sequence = Damaged(7, camera=CAMERA)
    found = track_together(sequence, drivers(stopping + staying))
    assert [len(steps) for steps in found] == [2, 6]
    assert [step.lost for step in found[1]] == [False, True, False, True, False, False]


def test_stacked_runs_agree_with_single_ones():
    settings = rates(4)
    found = track_stacked(frames(), settings, range(4))
    for i, (own, steps) in enumerate(zip(settings, found, strict=True)):
        alone = list(track(frames(), own, seed=i))
        np.testing.assert_allclose(poses(steps), poses(alone), atol=2e-5)
        assert [step.index for step in steps] == [1, 2, 3, 4]
    assert not np.array_equal(poses(found[0]), poses(found[3]))


def test_stacked_runs_lose_and_find_themselves():
    settings = [replace(p, odometry=replace(p.odometry, recover=False)) for p in rates(4)]
    sequence = Damaged(7, camera=CAMERA)
    found = track_stacked(sequence, settings, range(4))
    for i, (own, steps) in enumerate(zip(settings, found, strict=True)):
        alone = list(track(sequence, own, seed=i))
        assert [step.lost for step in steps] == [step.lost for step in alone]
        np.testing.assert_allclose(poses(steps), poses(alone), atol=2e-5)


class FrozenDepth(SyntheticSequence):
    """The depth of frame 3 is that of frame 2 once more."""

    def __getitem__(self, index: Any) -> Any:
        frame = super().__getitem__(index)
        return replace(frame, depth=super().__getitem__(2).depth) if index == 3 else frame


class Distorted(SyntheticSequence):
    """Its camera says that its lens distorts."""

    @property
    def camera(self) -> Camera:
        return replace(super().camera, distortion=(0.2, -0.1, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("kind", [FrozenDepth, Distorted])
def test_stacked_runs_see_the_frames_that_single_ones_see(kind: type[SyntheticSequence]):
    settings = [replace(p, odometry=replace(p.odometry, recover=False)) for p in rates(4)]
    sequence = kind(FRAMES, camera=CAMERA)
    for i, (own, steps) in enumerate(zip(settings, track_stacked(sequence, settings, range(4)), strict=True)):
        alone = list(track(sequence, own, seed=i))
        assert [step.alignment.statuses for step in steps] == [step.alignment.statuses for step in alone]
        np.testing.assert_allclose(poses(steps), poses(alone), atol=2e-5)


def test_an_attempt_of_the_stack_answers_only_what_was_asked_of_it():
    class Fake:
        def align(self, *asked: Any) -> str:
            return "its own"

        def judged(self, *asked: Any) -> str:
            return "the stack's"

    state, frame = object(), frames(1)[0]
    clock = Clock(np.float32(0.03), np.float32(0.0), np.uint32(2))
    made = together._Made(state, frame, clock, no_alignment(AlignmentStatus.OK), lambda: state)  # pyright: ignore
    stacked: Any = together._Stacked(Fake(), made)  # pyright: ignore
    assert stacked.align(state, replace(frame), clock) == "the stack's"
    others = [
        (object(), frame, clock),
        (state, without_depth(frame), clock),
        (state, frame, clock._replace(elapsed=np.float32(0.06))),
    ]
    assert [stacked.align(*other) for other in others] == ["its own"] * 3


def test_the_time_of_a_step_holds_that_of_the_stack(monkeypatch: pytest.MonkeyPatch):
    tracked = together._track_stack

    def slowly(*inputs: Any) -> Any:
        time.sleep(0.3)
        return tracked(*inputs)

    monkeypatch.setattr(together, "_track_stack", slowly)
    found = track_stacked(frames(3), rates(4), range(4))
    assert all(step.milliseconds > 300 for steps in found for step in steps)


def test_other_rates_compile_nothing_more_stacked():
    with compilations() as events:
        track_stacked(frames(2), rates(4), range(4))
        first = len(events)
        track_stacked(frames(4), rates(4)[::-1], range(10, 14))
        assert len(events) == first


SWEPT = {
    "gauss-newton": ("solver.iterations = [0, 0, 6, 6, 8]", "solver.damping", [1e-4 * (1 + i) for i in range(8)]),
    "ga": (
        "solver.iterations = [0, 0, 0, 6, 8]\nsolver.population = [0, 0, 0, 8, 16]\n"
        "alignment.last_step = false\nodometry.recover = false",
        "solver.mutation_decay",
        [0.6 + 0.05 * i for i in range(8)],
    ),
}
"""By method: a few coarse levels alone, and a rate with eight values."""


def clocks() -> np.ndarray:
    """Seconds on the wall, and of the processor: what else runs beside takes a core from either way, and more of the
    first from the one that uses both."""
    return np.array([time.perf_counter(), time.process_time()])


EVERY = 5
"""Of the runs one in so many is run alone too: no divisor of eight, so that each rate and each seed has its turn."""
TRIES = 3
"""Another process beside this one may spoil a measurement."""


def ratio_of_together(plan: Plan, *, seeds_differ: bool) -> list[float]:
    """Time of a plan's runs together over what as many take one by one, on the wall and of the processor; nothing is
    compiled, and the figures are those of runs alone.
    """
    settings = plan.runs[0].settings
    assert settings is not None
    run_odometry(frames(), settings)

    with compilations() as events:
        start = clocks()
        assert run_experiment(plan, Table(plan.folder), LocalExecutor()) == (64, [])
        joint = clocks() - start
        assert events == []
    rows = {row["run"]: row for row in Table(plan.folder).read()}
    start = clocks()
    some = plan.runs[::EVERY]
    for run in some:
        assert run.settings is not None and run.seed is not None
        alone = run_odometry(frames(), run.settings, seed=run.seed).metrics
        for name in ("rpe_translation_rmse_m_per_frame", "ate_translation_rmse_m", "distance_error_final_m"):
            assert rows[run.id][name] == alone[name]
    single = (clocks() - start) * len(plan.runs) / len(some)
    if seeds_differ:
        assert len({row["ate_translation_rmse_m"] for row in rows.values()}) > 32, "seeds and rates change nothing"
    return list(joint / single)


MOST_TIME = 0.7
"""Of that of single runs. On two quiet cores it is 0.47 to 0.51, beside other work 0.55 at the best of three tries."""


@pytest.mark.parametrize("method", SWEPT)
def test_64_runs_compile_once_and_are_the_single_runs_in_less_time(
    write_experiment: Callable[..., Path], tmp_path: Path, method: str
):
    sizes, rate, values = SWEPT[method]
    methods = f'[[methods]]\nname = "{method}"\n{sizes}\nsweep.{rate} = {values!r}\n'
    experiment = write_experiment("seeds = 8\nbatch = 64\n", methods, FRAMES)
    ratios = []
    for attempt in range(TRIES):
        plan = read_plan(experiment, tmp_path / f"out{attempt}")
        assert len(plan.runs) == 64 and programs(plan.runs) == 1
        ratios.append(ratio_of_together(plan, seeds_differ=method == "ga"))
        if np.min(ratios) < MOST_TIME:
            return
    pytest.fail(f"together, over one by one, on the wall and of the processor: {ratios}")
