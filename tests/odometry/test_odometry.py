"""The driver: poses chained, lost frames survived, the same bits for the same seed, nothing kept that is not needed."""

import gc
import threading
import tracemalloc
import weakref
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small
from small import Rendered, StandIn

from gavo_jax.alignment.pairs import align
from gavo_jax.alignment.result import Alignment, no_alignment, with_finding
from gavo_jax.alignment.visits import levels_of
from gavo_jax.bodies.aligner import BodyAware
from gavo_jax.bodies.rival import WithRival
from gavo_jax.datasets.base import Frame, FrameError
from gavo_jax.datasets.sensor_noise import NONE
from gavo_jax.datasets.synthetic import DEFAULT_CAMERA, SyntheticSequence
from gavo_jax.datasets.tum import TumSequence
from gavo_jax.errors import GavoError
from gavo_jax.image.pyramid import build_pyramid
from gavo_jax.image.warp import Points
from gavo_jax.objective.points import make_references, move_reference
from gavo_jax.odometry.aligners import BEGINNING, Attempt, Search
from gavo_jax.odometry.composition import blank_of, wide_search
from gavo_jax.odometry.driver import Odometry, Step, rectified
from gavo_jax.odometry.metrics import compute_metrics
from gavo_jax.odometry.run import OdometryRun, run_odometry, trajectory_of
from gavo_jax.odometry.second_thoughts import DoubtingDepth, Polished, Recovering
from gavo_jax.odometry.stream import track
from gavo_jax.odometry.tracking import Clock, blank_state, first_state, renew_keyframe
from gavo_jax.se3 import exp
from gavo_jax.settings import AlignmentOptions, OdometryOptions, Settings
from gavo_jax.solvers.base import Solver
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.solvers.genetic import GeneticAlgorithm
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import Trajectory

CAMERA = DEFAULT_CAMERA.level(1)
FRAMES = 12
PLAIN = OdometryOptions(recover=False, bodies="off")
"""No wide search where a pair looks wrong: what happens to lost pairs is the subject here."""
FRAME_TO_FRAME = replace(PLAIN, reference="previous", prior=False)


SOLVER = GaussNewton(iterations=(0, 15, 0, 0, 20))
"""Two levels: soon compiled."""
SEARCH_ALONE = Settings(SOLVER, odometry=PLAIN)


class Altered:
    """A sequence whose frames pass through a function (index, frame) -> frame, which may also raise FrameError."""

    def __init__(self, inner: Any, alter: Callable[[int, Frame], Frame], ground_truth: bool = True):
        self.inner, self.alter, self.has_truth = inner, alter, ground_truth
        self.read: list[int] = []
        self.checked = 0
        self.name, self.camera, self.timestamps = inner.name, inner.camera, inner.timestamps

    @property
    def ground_truth(self) -> Trajectory | None:
        return self.inner.ground_truth if self.has_truth else None

    def __len__(self) -> int:
        return len(self.inner)

    def __getitem__(self, index: Any) -> Any:
        self.read.append(index)
        return self.alter(index, self.inner[index])

    def __iter__(self) -> Any:
        return (self[i] for i in range(len(self)))

    def check(self) -> None:
        self.checked += 1


@pytest.fixture(scope="module")
def sequence() -> SyntheticSequence:
    """Twelve frames with a Kinect's noise."""
    return Rendered(frames=FRAMES, camera=CAMERA)


def run(sequence: Any, options: OdometryOptions = PLAIN, **arguments: Any) -> OdometryRun:
    return run_odometry(sequence, Settings(SOLVER, odometry=options), **arguments)


@pytest.fixture(scope="module")
def plain_run(sequence: SyntheticSequence) -> OdometryRun:
    return run(sequence)


def errors(result: OdometryRun, sequence: Any) -> np.ndarray:
    """Distance of each recorded position from the truth, metres, both relative to the first camera."""
    world_T_camera, _ = sequence.ground_truth.interpolate(result.trajectory.timestamps)
    truth = np.linalg.inv(world_T_camera[0]) @ world_T_camera
    return np.linalg.norm(result.trajectory.world_T_camera[:, :3, 3] - truth[:, :3, 3], axis=1)


def test_what_is_no_sequence_is_refused_by_name():
    frames = list(SyntheticSequence(frames=2, camera=small.CAMERA))
    for wrong in (frames, "fr1_xyz"):
        with pytest.raises(GavoError, match="a Sequence is needed, not (list|str)"):
            run_odometry(wrong)  # pyright: ignore[reportArgumentType]
    with pytest.raises(GavoError, match="Camera is needed"):
        Odometry("fr1")  # pyright: ignore[reportArgumentType]
    odometry = Odometry(small.CAMERA, small.NEWTON)
    dark = frames[0].grey / np.float32(255.0)
    with pytest.raises(GavoError, match="multiply by 255"):
        odometry.register(replace(frames[0], grey=dark), 0.0)
    odometry.register(frames[0], 0.0)
    step = odometry.register(replace(frames[1], grey=dark), 1 / 30)  # a covered lens is no reason to end a run
    assert step is not None and step.alignment.status is not AlignmentStatus.OK


@pytest.mark.parametrize("stamp", ["0.1", None, np.datetime64("2026-01-01"), [0.1], np.array([0.1]), 1j])
def test_what_is_no_time_is_refused_by_name(stamp: Any) -> None:
    frame = Rendered(1, camera=small.CAMERA)[0]
    with pytest.raises(GavoError, match="timestamp: seconds are needed, a number, not"):
        Odometry(small.CAMERA, small.NEWTON).register(frame, stamp)
    with pytest.raises(GavoError, match="timestamp: seconds are needed"):
        replace(frame, timestamp=stamp)
    with pytest.raises(GavoError, match="depth_timestamp: seconds are needed"):
        replace(frame, depth_timestamp=stamp or "")


def big_endian(image: np.ndarray) -> np.ndarray:
    return image.astype(image.dtype.newbyteorder(">"))


def masked(image: np.ndarray) -> np.ndarray:
    """What is 0 holds numbers that do not count."""
    return np.ma.masked_array(np.where(image == 0, 77, image), image == 0)


@pytest.mark.parametrize("form", [np.ndarray.tolist, np.asfortranarray, big_endian, masked, jnp.asarray])
def test_images_are_arrays_of_any_kind(form: Callable[[np.ndarray], Any]) -> None:
    frames = list(Rendered(3, camera=small.CAMERA))
    assert any((frame.depth == 0).any() for frame in frames)

    def poses(form: Callable[[np.ndarray], Any]) -> list[np.ndarray]:
        odometry = Odometry(small.CAMERA, small.NEWTON)
        shaped = [replace(frame, grey=form(frame.grey), depth=form(frame.depth)) for frame in frames]
        steps = [odometry.register(frame, frame.timestamp) for frame in shaped]
        return [step.world_T_camera for step in steps if step is not None]

    np.testing.assert_array_equal(poses(form), poses(np.asarray))
    kinds = [[(kind(frame.grey), kind(frame.depth)) for frame in frames] for kind in (form, np.asarray)]
    pairs = [align(first, second, small.CAMERA, small.NEWTON) for first, second, _ in kinds]
    np.testing.assert_array_equal(pairs[0].target_T_reference, pairs[1].target_T_reference)


@pytest.mark.parametrize("kind", [np.int32, np.int64, np.float16, np.float64, ">u2"])
def test_numbers_of_any_kind_are_free_of_the_lens(kind: Any) -> None:
    """OpenCV ended the program where a distorted camera's depth was of other whole numbers."""
    camera = replace(small.CAMERA, distortion=(0.1, -0.2, 0.001, 0.0, 0.0))
    frame = Rendered(1, camera=small.CAMERA)[0]
    depth = np.minimum(frame.depth, 2000)  # which all of them hold exactly
    other = replace(frame, grey=frame.grey.astype(kind), depth=depth.astype(kind))
    plain, same = (rectified(each, camera) for each in (replace(frame, depth=depth), other))
    np.testing.assert_array_equal(same.depth, plain.depth)
    np.testing.assert_allclose(same.grey, plain.grey, atol=1.0)


def test_follows_the_camera(sequence: SyntheticSequence, plain_run: OdometryRun) -> None:
    trajectory = plain_run.trajectory
    np.testing.assert_array_equal(trajectory.timestamps, sequence.timestamps)
    np.testing.assert_array_equal(trajectory.world_T_camera[0], np.eye(4))
    truth = sequence.ground_truth.world_T_camera[:, :3, 3]
    travelled = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    assert errors(plain_run, sequence)[-1] < 0.1 * travelled
    assert not any(step.lost for step in plain_run.steps)


def test_a_step_for_every_frame_after_the_first(sequence: SyntheticSequence, plain_run: OdometryRun) -> None:
    steps = plain_run.steps
    assert [step.index for step in steps] == list(range(1, FRAMES))
    assert [step.timestamp for step in steps] == list(sequence.timestamps[1:])
    assert [step.reference_timestamp for step in steps] == list(sequence.timestamps[:-1])
    assert plain_run.alignments == [step.alignment for step in steps]
    for step in steps:
        assert isinstance(step.alignment.status, AlignmentStatus)
        assert isinstance(step.alignment.xi, np.ndarray)
        assert step.milliseconds > 0


def test_poses_are_chained_inverses(plain_run: OdometryRun) -> None:
    world_T_camera = np.eye(4)
    for step in plain_run.steps:
        world_T_camera = world_T_camera @ np.linalg.inv(step.alignment.target_T_reference.astype(np.float64))
        np.testing.assert_allclose(step.world_T_camera, world_T_camera, atol=1e-5)


def test_poses_stay_rigid(plain_run: OdometryRun) -> None:
    rotation = plain_run.trajectory.world_T_camera[:, :3, :3]
    identity = np.broadcast_to(np.eye(3), rotation.shape)
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), identity, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-12)


METRICS = {
    "device",
    "frames",
    "pairs",
    "lost_pairs",
    "guessed_pairs",
    "rpe_translation_rmse_m_per_s",
    "rpe_rotation_rmse_deg_per_s",
    "rpe_translation_rmse_m_per_frame",
    "ate_translation_rmse_m",
    "distance_error_final_m",
    "compile_seconds",
    "milliseconds_per_pair_median",
    "frames_per_second",
}


def known(figure: float | None) -> float:
    assert figure is not None
    return figure


def test_metrics(plain_run: OdometryRun, sequence: SyntheticSequence) -> None:
    metrics = plain_run.metrics
    assert METRICS <= set(metrics)
    assert (metrics["frames"], metrics["pairs"], metrics["lost_pairs"]) == (FRAMES, FRAMES - 1, 0)
    assert metrics["sequence"] == "synthetic" and metrics["seed"] == 0
    assert metrics["method"] == "gauss-newton" and metrics["preset"] is None and metrics["complete"]
    assert metrics["distance_error_final_m"] == pytest.approx(errors(plain_run, sequence)[-1], abs=1e-6)
    assert 0 < known(metrics["rpe_translation_rmse_m_per_frame"]) < 0.01
    assert metrics["rpe_translation_rmse_m_per_s"] is None, "the sequence is shorter than a second"
    for key in ("compile_seconds", "milliseconds_per_pair_median", "frames_per_second"):
        assert known(metrics[key]) > 0


def test_without_ground_truth_there_are_no_errors(sequence: SyntheticSequence) -> None:
    blind = Altered(sequence[:4], lambda _, frame: frame, ground_truth=False)
    metrics = run(blind).metrics
    about_truth = {key for key in METRICS if key.startswith(("rpe", "ate", "distance"))}
    assert {key for key in METRICS if metrics[key] is None} == about_truth


def test_same_seed_same_bits() -> None:
    part = Rendered(frames=4)
    poses = [run_odometry(part, seed=seed).trajectory.world_T_camera for seed in (0, 0, 1)]
    np.testing.assert_array_equal(poses[0], poses[1])
    assert np.any(poses[0] != poses[2])
    np.testing.assert_allclose(poses[0], poses[2], atol=0.01)


def unreadable(*indices: int) -> Callable[[int, Frame], Frame]:
    def alter(index: int, frame: Frame) -> Frame:
        if index in indices:
            raise FrameError(f"{index}.png: cannot be read")
        return frame

    return alter


@pytest.mark.parametrize("missing", [(5,), (5, 6), (1,), (FRAMES - 1,), (3, 7)])
def test_unreadable_frames_are_lost_and_the_run_goes_on(
    missing: tuple[int, ...], sequence: SyntheticSequence, plain_run: OdometryRun
) -> None:
    result = run(Altered(sequence, unreadable(*missing)))
    assert [step.index for step in result.steps if step.lost] == list(missing)
    assert result.metrics["lost_pairs"] == len(missing)
    assert len(result.trajectory) == FRAMES
    for step in result.steps:
        if step.lost:
            assert step.alignment.status is AlignmentStatus.UNREADABLE
            before = result.trajectory.world_T_camera[step.index - 1]
            np.testing.assert_array_equal(step.world_T_camera, before)
        elif step.index - 1 in missing:
            assert step.reference_timestamp < sequence.timestamps[step.index - 1]
    seen = [i for i in range(FRAMES) if i not in missing]
    assert errors(result, sequence)[seen].max() < errors(plain_run, sequence).max() + 0.004


def test_on_lost_predict_goes_on_as_before(sequence: SyntheticSequence) -> None:
    lossy = Altered(sequence, unreadable(5))
    held = run(lossy)
    predicted = run(lossy, replace(PLAIN, on_lost="predict"))
    assert predicted.steps[4].lost
    assert errors(predicted, sequence)[5] < 0.7 * errors(held, sequence)[5]
    others = [i for i in range(FRAMES) if i != 5]
    np.testing.assert_array_equal(predicted.trajectory.world_T_camera[others], held.trajectory.world_T_camera[others])


def test_on_lost_stop_ends_the_run(sequence: SyntheticSequence) -> None:
    result = run(Altered(sequence, unreadable(5)), replace(PLAIN, on_lost="stop"))
    assert [step.index for step in result.steps] == [1, 2, 3, 4, 5]
    assert result.steps[-1].lost
    assert result.metrics["frames"] == 6 and not result.metrics["complete"]


def test_a_covered_lens_is_survived(sequence: SyntheticSequence) -> None:
    """Black images without depth for a while: they are lost, and tracking comes back."""

    def alter(index: int, frame: Frame) -> Frame:
        if 3 <= index < 6:
            return replace(frame, grey=np.zeros_like(frame.grey), depth=np.zeros_like(frame.depth))
        return frame

    result = run(Altered(sequence, alter))
    assert all(step.lost for step in result.steps if 3 <= step.index < 6)
    assert not any(step.lost for step in result.steps[-2:])
    assert np.isfinite(result.trajectory.world_T_camera).all()


def grey(value: int) -> Callable[[Frame], Frame]:
    return lambda frame: replace(frame, grey=np.full_like(frame.grey, value))


def without_depth(share: float) -> Callable[[Frame], Frame]:
    def damage(frame: Frame) -> Frame:
        rows = np.arange(frame.depth.shape[0])[:, None]
        return replace(frame, depth=np.where(rows < share * len(rows), 0, frame.depth))

    return damage


DAMAGES = {
    "black": (grey(0), AlignmentStatus.BLANK, True),
    "millimetres": (lambda frame: replace(frame, depth=frame.depth // 5), AlignmentStatus.DEPTH_UNITS, True),
    "no depth": (without_depth(1.0), AlignmentStatus.NO_DEPTH, False),
    "half the depth": (without_depth(0.5), AlignmentStatus.PARTIAL_DEPTH, False),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_frame_is_flagged_and_never_a_reference(
    name: str, sequence: SyntheticSequence, plain_run: OdometryRun
) -> None:
    damage, status, lost = DAMAGES[name]
    damaged = (4, 8)
    result = run(Altered(sequence, lambda index, frame: damage(frame) if index in damaged else frame))
    for step in result.steps:
        expected = (status, lost) if step.index in damaged else (AlignmentStatus.OK, False)
        assert (step.alignment.status, step.lost) == expected, step.index
        assert step.policy == ("hold" if step.lost else "")
        if step.index - 1 in damaged:
            assert step.reference_timestamp == sequence.timestamps[step.index - 2]
    others = [i for i in range(FRAMES) if i not in damaged or not lost]
    assert errors(result, sequence)[others].max() < errors(plain_run, sequence).max() + 0.004


def test_a_frozen_image_stands_still(sequence: SyntheticSequence, plain_run: OdometryRun) -> None:
    frozen = Altered(sequence, lambda i, f: replace(sequence[4], timestamp=f.timestamp) if i == 5 else f)
    result = run(frozen)
    assert result.steps[4].alignment.status is AlignmentStatus.FROZEN
    assert result.steps[4].alignment.sentence == "The image is the last one once more."
    np.testing.assert_array_equal(result.steps[4].world_T_camera, result.steps[3].world_T_camera)
    assert [step.index for step in result.steps if step.lost] == [5]
    assert errors(result, sequence)[6:].max() < errors(plain_run, sequence).max() + 0.004


@pytest.mark.parametrize("shift", [0.0, -0.02])
def test_a_bad_stamp_has_no_pose(sequence: SyntheticSequence, plain_run: OdometryRun, shift: float) -> None:
    altered = Altered(sequence, lambda index, frame: replace(frame, timestamp=float(altered.timestamps[index])))
    altered.timestamps = sequence.timestamps.copy()
    altered.timestamps[6] = altered.timestamps[5] + shift
    result = run(altered)
    assert [step.index for step in result.steps if step.lost] == [6]
    assert result.steps[5].alignment.status is AlignmentStatus.BAD_TIMESTAMP
    assert result.metrics["statuses"] == {"ok": FRAMES - 2, "bad_timestamp": 1}
    np.testing.assert_array_equal(result.trajectory.timestamps, np.delete(sequence.timestamps, 6))
    assert errors(result, sequence).max() < errors(plain_run, sequence).max() + 0.004


def test_dropped_frames_are_told_and_bridged(sequence: SyntheticSequence) -> None:
    kept = [0, 1, 2, 3, 4, 5, 9, 10, 11]
    gapped = Altered(sequence, lambda index, frame: frame)
    gapped.timestamps = sequence.timestamps[kept]
    odometry = Odometry(CAMERA, SEARCH_ALONE)
    steps = [odometry.register(sequence[i], float(sequence.timestamps[i])) for i in kept]
    told = {kept[i]: step.alignment.status for i, step in enumerate(steps) if step and step.alignment.status}
    assert told == {9: AlignmentStatus.GAP} and not any(step.lost for step in steps if step)


@pytest.mark.parametrize("count", [2, 5])
def test_only_a_good_frame_becomes_the_first_reference(sequence: SyntheticSequence, count: int) -> None:
    """A lens cap on at the start, for shorter and longer than a reference is held."""
    result = run(Altered(sequence, lambda index, frame: grey(0)(frame) if index < count else frame))
    statuses = [step.alignment.status for step in result.steps]
    assert statuses[: count - 1] == [AlignmentStatus.BLANK] * (count - 1)
    assert statuses[count - 1] is AlignmentStatus.NO_REFERENCE
    assert statuses[count:] == [AlignmentStatus.OK] * (FRAMES - 1 - count)
    np.testing.assert_array_equal(result.steps[count - 1].world_T_camera, np.eye(4))


def test_a_lost_run_never_starts_again_from_a_bad_frame(sequence: SyntheticSequence) -> None:
    """Five black frames, more than a reference is held: the frame after them is aligned with the one before."""
    result = run(Altered(sequence[:10], lambda index, frame: grey(0)(frame) if 3 <= index < 8 else frame))
    after = result.steps[7]
    assert after.reference_timestamp == sequence.timestamps[2]


def test_the_first_frame_is_needed(sequence: SyntheticSequence) -> None:
    with pytest.raises(FrameError, match="0.png"):
        run(Altered(sequence, unreadable(0)))
    with pytest.raises(FrameError):
        Odometry(CAMERA, SOLVER).register(None, 0.0)


def test_an_odometry_needs_two_frames(sequence: SyntheticSequence) -> None:
    for count in (0, 1):
        with pytest.raises(GavoError, match="two frames"):
            run(sequence[:count])


def test_a_sequence_is_checked_before_the_run(sequence: SyntheticSequence) -> None:
    class Refused(Altered):
        def check(self) -> None:
            raise GavoError("rgb.txt: nonsense")

    refused = Refused(sequence, lambda _, frame: frame)
    with pytest.raises(GavoError, match="nonsense"):
        run(refused)
    assert refused.read == []


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
    assert told == result.steps


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


def test_a_rolling_shutter_is_reckoned_with() -> None:
    """Where the camera tells its readout."""
    camera = replace(CAMERA, readout=0.03)
    sequence = Rendered(frames=FRAMES, camera=camera, noise=NONE, speed=2.0)
    untold = Altered(sequence, lambda _, frame: frame)
    untold.camera = CAMERA
    truth = sequence.ground_truth.world_T_camera

    def off(estimate: np.ndarray) -> np.ndarray:
        apart = np.linalg.inv(np.linalg.inv(truth[0]) @ truth) @ estimate
        # over six frames, from the third on: before, nothing is known of the camera's speed
        drift = np.linalg.inv(apart[2:-6]) @ apart[8:]
        turned, moved = drift[:, :3, :3] - np.eye(3), drift[:, :3, 3]
        return np.array([np.sqrt(np.mean(part**2)) for part in (moved, turned)])

    for options in (PLAIN, FRAME_TO_FRAME):
        told, ignorant = (run(source, options).trajectory.world_T_camera for source in (sequence, untold))
        assert np.all(off(told) < 0.7 * off(ignorant))


def test_the_first_frame_is_put_back_once_a_motion_is_known(sequence: SyntheticSequence) -> None:
    odometry = Odometry(replace(CAMERA, readout=0.03), SEARCH_ALONE)
    pending = []
    for index in range(2):
        odometry.register(sequence[index], float(sequence.timestamps[index]))
        state = odometry.progress.tracker
        assert state is not None
        pending.append([bool(np.any(frame.row_time)) for frame in (state.previous, state.keyframe)])
    assert pending == [[True, True], [False, False]]


def test_the_program_for_every_frame_makes_the_first_state_too(sequence: SyntheticSequence) -> None:
    frame, camera = sequence[0], replace(CAMERA, readout=0.03)
    odometry = Odometry(camera, SEARCH_ALONE)
    odometry.register(frame, 0.0)
    expected = first_state(frame.grey, frame.depth, camera, SOLVER, odometry.settings.alignment)
    state = odometry.progress.tracker
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6), state, expected)


def test_one_program_serves_every_frame(sequence: SyntheticSequence) -> None:
    odometry = Odometry(replace(CAMERA, readout=0.03), SEARCH_ALONE)
    blank = blank_state(odometry.camera, SOLVER, odometry.settings.alignment)
    odometry.register(sequence[0], 0.0)
    states = blank, odometry.progress.tracker
    types = [[jax.typeof(leaf) for leaf in jax.tree.leaves(state)] for state in states]
    assert types[0] == types[1]


@pytest.mark.parametrize("collects", [False, True])
def test_warming_up_leaves_the_garbage_collector_as_it_was(collects: bool) -> None:
    before = gc.isenabled()
    try:
        (gc.enable if collects else gc.disable)()
        Odometry(CAMERA, SEARCH_ALONE).warm_up()
        assert gc.isenabled() == collects
    finally:
        (gc.enable if before else gc.disable)()


@jax.jit
def keyframe_after_a_turn(grey: jax.Array, depth: jax.Array, turn: jax.Array) -> tuple[Points, jax.Array]:
    """Points of a frame after a turn to the side by so many radians, and which of them are renewed, [L, N]."""
    pyramid = build_pyramid(grey, depth, CAMERA.depth_scale)
    first = make_references(pyramid, CAMERA, levels_of(CAMERA, SOLVER, AlignmentOptions()))
    keyframe = move_reference(first, exp(jnp.zeros(6).at[4].set(turn)))
    newest = first._replace(grey=first.grey + 1000.0)
    return keyframe.points, renew_keyframe(keyframe, newest, CAMERA.level(1), 0.7).grey > 500.0


@pytest.mark.parametrize("turn", [0.0, 0.2, 0.25, 0.3, 0.6])
def test_a_keyframe_is_renewed_share_by_share(turn: float, sequence: SyntheticSequence) -> None:
    frame, camera = sequence[0], CAMERA.level(1)
    points, is_renewed = keyframe_after_a_turn(frame.grey, frame.depth, jnp.float32(turn))

    x, y, q = (np.asarray(leaf[-1], float) for leaf in points)
    seen = q > 0
    u, v = x * camera.fx + camera.cx, y * camera.fy + camera.cy
    inside = seen & (u >= 0) & (u < camera.width - 1) & (v >= 0) & (v < camera.height - 1)
    overlap = np.sum(inside) / np.sum(seen)
    expected = np.clip((0.8 - overlap) / 0.2, 0.0, 1.0)
    renewed = np.asarray(is_renewed)
    share = np.mean(renewed[-1])
    assert share == pytest.approx(expected, abs=0.13) and (share in (0.0, 1.0)) == (expected in (0.0, 1.0))
    places = np.arange(renewed.shape[1]) % 80 < 40  # each share is spread over the whole image
    left, right = (np.mean(renewed[-1][side]) for side in (places, ~places))
    assert left == pytest.approx(right, abs=0.03)
    np.testing.assert_array_equal(renewed[0], renewed[-1])


@pytest.mark.parametrize("overlap", [0.0, 0.7])
def test_a_keyframe_without_readings_takes_all_of_the_newest(overlap: float) -> None:
    blank = blank_state(CAMERA, SOLVER, AlignmentOptions()).keyframe
    newest = blank._replace(points=blank.points._replace(q=np.ones_like(blank.points.q)))
    renewed = jax.jit(renew_keyframe)(blank, newest, CAMERA.level(1), overlap)
    assert np.all(renewed.points.q == 1)


def test_there_is_no_distance_at_the_end_where_the_way_there_is_unknown() -> None:
    stamps = np.arange(4) / 30
    poses = np.stack([np.eye(4)] * 4)
    poses[:, 0, 3] = np.arange(4)
    truth = Trajectory(stamps, poses)
    shrunk = np.array(poses)
    shrunk[:, 0, 3] *= 0.5
    ends = [
        compute_metrics(Trajectory(stamps, shrunk, np.array(segments)), truth, [], 1.0, 0.0)["distance_error_final_m"]
        for segments in ([0, 0, 0, 0], [0, 0, 0, 1], [0, 1, 1, 0])
    ]
    assert ends == [pytest.approx(1.5), None, pytest.approx(1.5)]


def test_frame_to_frame(sequence: SyntheticSequence) -> None:
    result = run(sequence[:6], FRAME_TO_FRAME)
    assert result.metrics["lost_pairs"] == 0
    assert errors(result, sequence).max() < 0.01


def late_depth(source: SyntheticSequence) -> Altered:
    """Every other frame of a sequence, with the depth of the frame that follows it: half a frame's time late."""

    def alter(index: int, frame: Frame) -> Frame:
        later = source[2 * index + 1]
        return replace(frame, depth=later.depth, depth_timestamp=later.timestamp)

    return Altered(source[::2], alter)


def without_stamps(source: Altered) -> Altered:
    """A sequence that does not tell when its depth was taken."""
    return Altered(source, lambda _, frame: replace(frame, depth_timestamp=None))


def test_synchronised_depth_drifts_less() -> None:
    late = late_depth(Rendered(frames=40, camera=CAMERA, noise=NONE, rate=60.0, speed=4.0))
    figures = []
    for source in (late, without_stamps(late)):
        metrics = run(source).metrics
        assert metrics["lost_pairs"] == 0
        figures.append(known(metrics["rpe_translation_rmse_m_per_frame"]))
    assert figures[0] < 0.92 * figures[1]


def test_what_is_switched_off_is_not_reckoned_with() -> None:
    """A readout and a delay of depth, each of which changes the poses where it is told."""
    late = late_depth(Rendered(frames=12, camera=CAMERA, noise=NONE, rate=60.0, speed=4.0))
    rolling = without_stamps(late)
    rolling.camera = replace(CAMERA, readout=0.03)
    both = Altered(late, lambda _, frame: frame)
    both.camera = rolling.camera
    off = replace(FRAME_TO_FRAME, rolling_shutter=False, synchronise=False)
    expected = run(without_stamps(late), FRAME_TO_FRAME).trajectory.world_T_camera
    for told in (late, rolling):
        assert np.abs(run(told, FRAME_TO_FRAME).trajectory.world_T_camera - expected).max() > 1e-3
    np.testing.assert_allclose(run(both, off).trajectory.world_T_camera, expected, atol=1e-4)


def test_synchronising_without_delay_changes_nothing(sequence: SyntheticSequence) -> None:
    """Stamps that agree, and stamps that are not known, leave depth as it is."""
    same = Altered(sequence[:5], lambda _, frame: replace(frame, depth_timestamp=frame.timestamp))
    known, unknown = run(same), run(sequence[:5])
    np.testing.assert_array_equal(known.trajectory.world_T_camera, unknown.trajectory.world_T_camera)


def test_warm_up_leaves_no_trace(sequence: SyntheticSequence) -> None:
    steps = []
    for warm in (True, False):
        odometry = Odometry(CAMERA, SEARCH_ALONE)
        if warm:
            assert odometry.warm_up() > 0
        assert odometry.register(sequence[0], 0.0) is None
        step = odometry.register(sequence[1], float(sequence.timestamps[1]))
        assert step is not None
        steps.append(step)
    np.testing.assert_array_equal(steps[0].world_T_camera, steps[1].world_T_camera)


def test_real_frames(data_dir: Path) -> None:
    result = run_odometry(TumSequence(data_dir / "fr1_xyz")[:40])
    assert result.metrics["lost_pairs"] == 0
    assert known(result.metrics["rpe_translation_rmse_m_per_s"]) < 0.03
    assert known(result.metrics["rpe_rotation_rmse_deg_per_s"]) < 2.0
    assert known(result.metrics["ate_translation_rmse_m"]) < 0.02


@pytest.mark.slow
def test_the_wide_search_recovers_what_the_default_loses() -> None:
    jump = SyntheticSequence(frames=60, camera=CAMERA)[::25]
    lost = run_odometry(jump, Settings(GaussNewton(), odometry=PLAIN)).metrics["lost_pairs"]
    assert lost > 0
    assert run_odometry(jump, GaussNewton()).metrics["lost_pairs"] < lost


class Told(StandIn):
    """An aligner that finds what it is told."""

    def __init__(self, result: Alignment, confirmed: bool = False) -> None:
        self.result = result
        self.confirmed = confirmed
        self.clocks: list[Clock] = []

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        self.clocks.append(clock)
        is_ok = self.result.status is AlignmentStatus.OK
        return Attempt(frame.timestamp, self.result, is_ok or self.confirmed, is_ok)


def found(status: AlignmentStatus, x: float) -> Alignment:
    """A motion of so many metres to the right, and what is said of it."""
    motion = np.eye(4)
    motion[0, 3] = x
    return no_alignment(status)._replace(target_T_reference=motion)


@pytest.mark.parametrize(
    "first, second, x",
    [
        (found(AlignmentStatus.OK, 0.02), found(AlignmentStatus.OK, 0.1), 0.02),
        (found(AlignmentStatus.AMBIGUOUS, 0.02), found(AlignmentStatus.OK, 0.1), 0.1),
        (found(AlignmentStatus.HIGH_ERROR, 0.02), found(AlignmentStatus.HIGH_ERROR, 0.03), 0.02),
        (found(AlignmentStatus.HIGH_ERROR, 0.02), found(AlignmentStatus.HIGH_ERROR, 0.1), None),
        (found(AlignmentStatus.LOW_OVERLAP, 0.02), found(AlignmentStatus.LOW_OVERLAP, 0.02), None),
    ],
)
def test_a_second_aligner_is_asked_where_the_first_is_not_sure(
    first: Alignment, second: Alignment, x: float | None
) -> None:
    sequence = Rendered(frames=2, camera=CAMERA, noise=NONE)
    odometry = Odometry(CAMERA, aligner=Recovering(Told(first), Told(second)))
    odometry.register(sequence[0], 0.0)
    step = odometry.register(sequence[1], 1 / 30)
    assert step is not None and step.lost is (x is None)
    assert step.world_T_camera[0, 3] == pytest.approx(-(x or 0.0))
    is_explained = AlignmentStatus.OK in (first.status, second.status)
    assert odometry.progress.tracker == sequence[int(is_explained)].timestamp


def test_a_frame_that_is_not_explained_is_no_reference_while_the_old_one_is_in_reach() -> None:
    """The next frame would be compared with what was wrong in it: pairs behind one were off by three times as much."""
    poor = Told(found(AlignmentStatus.HIGH_ERROR, 0.02))
    odometry = Odometry(CAMERA, aligner=Recovering(poor, poor))
    sequence = Rendered(frames=6, camera=CAMERA, noise=NONE)
    steps = [odometry.register(frame, frame.timestamp) for frame in sequence]
    of = [int(np.argmin(np.abs(sequence.timestamps - step.reference_timestamp))) for step in steps if step is not None]
    assert of == [0, 0, 0, 3, 3]
    assert not any(step.lost for step in steps if step is not None)


@pytest.mark.parametrize(
    ("first", "fine", "x"),
    [
        (found(AlignmentStatus.OK, 0.10), found(AlignmentStatus.HIGH_ERROR, 0.12), 0.12),
        (found(AlignmentStatus.OK, 0.10), found(AlignmentStatus.OK, 0.12), 0.12),
        (found(AlignmentStatus.OK, 0.10), found(AlignmentStatus.OK, 0.16), 0.10),
        (found(AlignmentStatus.OK, 0.10), found(AlignmentStatus.LOW_TEXTURE, 0.12), 0.10),
        (found(AlignmentStatus.AMBIGUOUS, 0.10), found(AlignmentStatus.OK, 0.12), 0.10),
    ],
)
def test_what_the_wide_search_finds_is_polished(first: Alignment, fine: Alignment, x: float) -> None:
    """By the search that has the keyframe, if it ends in the same minimum; the wide one says what it is worth."""
    state = blank_of(Odometry(CAMERA, SEARCH_ALONE).aligner)
    polished = Polished(Told(first), Told(fine))  # pyright: ignore[reportArgumentType]
    attempt = polished.align(state, Rendered(frames=1, camera=CAMERA, noise=NONE)[0], BEGINNING)
    assert attempt.result.target_T_reference[0, 3] == x
    assert attempt.result.status is first.status and attempt.usable is (first.status is AlignmentStatus.OK)


@pytest.mark.parametrize(("explained", "status"), [(0.5, AlignmentStatus.OK), (0.4, AlignmentStatus.HIGH_ERROR)])
def test_an_image_that_the_finer_motion_does_not_explain_is_told(explained: float, status: AlignmentStatus) -> None:
    """An image whose rows a fault had shifted was 4 degrees off and `ok`, as the wide search found it good enough."""
    fine = found(AlignmentStatus.HIGH_ERROR, 0.12)
    fine = fine._replace(explained=fine.explained._replace(grey=np.float32(explained)))
    state = blank_of(Odometry(CAMERA, SEARCH_ALONE).aligner)
    polished = Polished(Told(found(AlignmentStatus.OK, 0.10)), Told(fine))  # pyright: ignore[reportArgumentType]
    attempt = polished.align(state, Rendered(frames=1, camera=CAMERA, noise=NONE)[0], BEGINNING)
    assert attempt.result.status is status and attempt.usable


class Guessing(Told):
    """An aligner that guesses its motions, or says of how many it has guessed, where it is told so."""

    def __init__(self, *unknown: int) -> None:
        super().__init__(found(AlignmentStatus.OK, 0.01))
        self.unknown = list(unknown)

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        return super().align(state, frame, clock)._replace(unknown=self.unknown.pop(0))


@pytest.mark.parametrize(
    ("unknown", "segments"),
    [
        ((0, 1, 1, 0, 0), [0, 0, 0, 0, 0]),
        ((0, 1, 1, 1, 0, 0), [0, 0, 0, 0, 1, 1]),
        ((0, 0, 5, 0), [0, 0, 0, 1]),
        ((1, 1, 0, 1, 0), [0, 0, 0, 0, 0]),
    ],
)
def test_behind_a_stretch_of_guesses_a_new_segment_starts(unknown: tuple[int, ...], segments: list[int]) -> None:
    """Through a guessed motion or two the world is the same; a longer way that nobody saw breaks the trajectory."""
    sequence = Rendered(frames=len(unknown) + 1, camera=CAMERA, noise=NONE)
    odometry = Odometry(CAMERA, aligner=Guessing(*unknown))
    steps = [odometry.register(frame, index / 30) for index, frame in enumerate(sequence)][1:]
    assert [step.segment for step in steps if step is not None] == segments
    assert [step.origin for step in steps if step is not None] == ["guessed" if n else "tracked" for n in unknown]
    assert not any(step.lost for step in steps if step is not None)
    assert odometry.progress.world_T_camera[0, 3] == pytest.approx(-0.01 * len(unknown))
    kept = [step for step in steps if step is not None]
    metrics = compute_metrics(trajectory_of(0.0, kept), None, kept, 1.0, 0.0)
    assert metrics["guessed_pairs"] == sum(n > 0 for n in unknown) and metrics["lost_pairs"] == 0


@pytest.mark.parametrize(
    "solver",
    [GaussNewton(iterations=(10, 0, 0, 0, 0)), GeneticAlgorithm(iterations=(10, 8, 8, 10, 12)), SOLVER],
)
def test_the_wide_search_searches_every_level_that_the_references_have(solver: Solver) -> None:
    """Of a solver that searches the full image it left that level out, and the first hard pair ended in a traceback."""
    search = Search(CAMERA, replace(SEARCH_ALONE, solver=solver), jax.random.key(0))
    wide = wide_search(search)
    assert wide.settings.solver.levels == solver.levels
    shapes = jax.eval_shape(lambda: wide.blank_state()), jax.eval_shape(lambda: search.blank_state())
    assert shapes[0] == shapes[1]


@pytest.mark.parametrize("use", [AlignmentStatus.NO_DEPTH, AlignmentStatus.FROZEN, AlignmentStatus.PARTIAL_DEPTH])
def test_a_frame_without_depth_is_no_reference_however_long_the_old_one_is_held(use: AlignmentStatus) -> None:
    """Where a high error was confirmed for three frames, one whose depth was missing became it."""
    poor = with_finding(found(AlignmentStatus.HIGH_ERROR, 0.01), use)
    aligner = Told(poor, confirmed=True)
    odometry = Odometry(CAMERA, aligner=aligner)
    for index, frame in enumerate(Rendered(frames=6, camera=CAMERA, noise=NONE)):
        odometry.register(frame, index / 30)
    assert (odometry.progress.held < 5) == (use is AlignmentStatus.PARTIAL_DEPTH)


def test_the_stamp_that_is_registered_is_the_frame_s() -> None:
    """A frame with a stamp of its own, 0 in each, was taken a millisecond after the last."""
    aligner = Told(found(AlignmentStatus.OK, 0.01))
    odometry = Odometry(CAMERA, aligner=aligner)
    for index, frame in enumerate(Rendered(frames=3, camera=CAMERA, noise=NONE)):
        late = replace(frame, timestamp=0.0, depth_timestamp=0.005)
        odometry.register(late, 5 + index / 30)
    assert odometry.progress.reference_timestamp == 5 + 2 / 30
    last = aligner.clocks[-1]
    assert last.elapsed == pytest.approx(1 / 30) and last.depth_delay == pytest.approx(0.005)


def test_the_wide_search_stands_behind_the_default_one() -> None:
    aligner = Odometry(CAMERA, SOLVER, seed=3).aligner
    assert isinstance(aligner, Recovering) and isinstance(aligner.first, DoubtingDepth)
    rivalled = aligner.first.first, aligner.first.alone, aligner.second
    first, alone, second = (one.first for one in rivalled if isinstance(one, WithRival))
    assert isinstance(first, BodyAware) and isinstance(alone, BodyAware) and isinstance(second, BodyAware)
    search, wide = first.search, second.search
    assert first.first is search and alone.search is search and wide.key == search.key
    assert second.first == Polished(wide, search)
    assert wide.settings.alignment.scouts > 0 and wide.settings.odometry.reference == "previous"
    assert wide.settings.solver.levels == SOLVER.levels
    assert wide.settings.alignment.points == search.settings.alignment.points
    assert isinstance(Odometry(CAMERA, SEARCH_ALONE).aligner, Search)
