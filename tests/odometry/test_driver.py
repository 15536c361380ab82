"""The driver: poses chained, images of any kind taken, lost frames survived, references that are fit."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import small
from driving import CAMERA, FRAMES, PLAIN, SEARCH_ALONE, SOLVER, Altered, Told, errors, found, run, unreadable
from small import Rendered, StandIn

from gavo_jax.alignment.judgement import UNKNOWN
from gavo_jax.alignment.pairs import align
from gavo_jax.alignment.result import Alignment, with_finding
from gavo_jax.bodies.records import Seen
from gavo_jax.datasets.base import Frame, FrameError
from gavo_jax.datasets.rendered.sensor_noise import NONE
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError, GavoWarning
from gavo_jax.odometry.aligners import Attempt
from gavo_jax.odometry.driver import Odometry, rectified
from gavo_jax.odometry.hindsight import taken_back
from gavo_jax.odometry.metrics import compute_metrics
from gavo_jax.odometry.run import OdometryRun, trajectory_of
from gavo_jax.odometry.tracking import Clock
from gavo_jax.status import AlignmentStatus


@pytest.mark.parametrize("stamp", ["0.1", None, np.datetime64("2026-01-01"), [0.1], np.array([0.1]), 1j])
def test_what_is_no_time_is_refused_by_name(stamp: Any) -> None:
    frame = Rendered(1, camera=small.CAMERA)[0]
    with pytest.raises(GavoError, match="timestamp: expected seconds as a number, "):
        Odometry(small.CAMERA, small.NEWTON).register(frame, stamp)
    with pytest.raises(GavoError, match="timestamp: expected seconds"):
        replace(frame, timestamp=stamp)
    with pytest.raises(GavoError, match="depth_timestamp: expected seconds"):
        replace(frame, depth_timestamp=stamp or "")


def test_a_frame_keeps_its_stamp_and_not_the_array_that_held_it() -> None:
    """An array that was filled again made all frames one: no time passed between them."""
    stamp = np.zeros(())
    frame = replace(Rendered(1, camera=small.CAMERA)[0], timestamp=stamp, depth_timestamp=stamp)
    stamp[...] = 1.0
    assert (frame.timestamp, frame.depth_timestamp) == (0.0, 0.0) and type(frame.timestamp) is float


@pytest.mark.parametrize("unit", [1e3, 1e6, 1e9, -1e9])
def test_a_stream_in_other_units_of_time_is_refused(unit: float) -> None:
    """Nanoseconds were taken for seconds without a word: no motion was implausible, and every guess wrong."""
    first, second = Rendered(2, camera=small.CAMERA)
    odometry = Odometry(small.CAMERA, small.NEWTON)
    with pytest.raises(GavoError, match="timestamp: expected seconds, but -?1.* years"):
        odometry.register(first, int(1.3e9 * unit))
    assert odometry.register(first, 1.3e9) is None
    step = odometry.register(second, 1.3e18)
    assert step is not None and not step.lost, "a single bad stamp ends no run"


@pytest.mark.parametrize("unit", [1e3, 1e9])
def test_stamps_that_count_something_else_from_0_are_doubted_once(unit: float) -> None:
    """Nanoseconds that begin at 0 passed for seconds: every motion was plausible, and every pair `ok`."""
    interval = int(unit / 30)
    frames = list(Rendered(9, camera=small.CAMERA))
    odometry = Odometry(small.CAMERA, aligner=Told(found(AlignmentStatus.OK, 0.01)))
    with pytest.warns(
        GavoWarning, match=f"^timestamps: expected seconds, but the first frames are {interval} s"
    ) as said:
        for index, frame in enumerate(frames):
            odometry.register(frame, interval * index)
    assert len(said) == 1
    slow = Odometry(small.CAMERA, aligner=Told(found(AlignmentStatus.OK, 0.01)))
    for index, frame in enumerate(frames):
        slow.register(frame, 11.0 * index if index < 3 else 25.0 + index)


def test_a_stamp_is_a_number_of_the_step_s_own() -> None:
    """An array that the caller changes for the next frame changed the last one's stamp, and every frame was late."""
    odometry, stamp = Odometry(small.CAMERA, small.NEWTON), np.zeros(())
    steps = []
    for frame in Rendered(3, camera=small.CAMERA):
        stamp[...] = frame.timestamp
        steps.append(odometry.register(frame, stamp))  # pyright: ignore[reportArgumentType]
    assert [(type(step.timestamp), step.lost) for step in steps[1:] if step] == 2 * [(float, False)]


def test_a_frame_s_own_stamp_gives_way_to_the_last_digit() -> None:
    """Hindsight tells by equal stamps which pair follows which: none did, and one that was wrong took back all."""
    odometry = Odometry(small.CAMERA, small.NEWTON)
    frames = list(Rendered(4, camera=small.CAMERA))
    steps = [odometry.register(replace(frame, timestamp=frame.timestamp + 1e-9), frame.timestamp) for frame in frames]
    known = [step for step in steps if step is not None]
    assert [step.reference_timestamp for step in known] == [frame.timestamp for frame in frames[:-1]]
    assert sorted(taken_back([*known[:-1], replace(known[-1], revises=1)])) == [1]


def test_frames_may_share_a_depth_image_whose_stamp_does_not_change() -> None:
    """Depth at half the rate: a stamp that was computed anew, off by rounding, made the depth `frozen`."""
    blank, depth_stamp = np.zeros((2, 2), np.uint8), 1305031102.16
    for index in range(12):
        stamp = 1305031102.175304 + index / 300
        frame = Frame(blank, blank.astype(np.uint16), stamp, depth_timestamp=depth_stamp)
        assert frame.at(stamp + 3e-7).depth_timestamp == depth_stamp
        assert frame.at(stamp + 0.5).depth_timestamp == pytest.approx(depth_stamp + 0.5, abs=1e-6)


@pytest.mark.parametrize("kind", [np.uint16, np.float32])
def test_grey_of_more_than_eight_bits_is_refused(kind: Any) -> None:
    """Every frame of 16 bits was lost as blank, and one twice as bright said that bodies moved."""
    first, second = (replace(f, grey=f.grey.astype(kind) * kind(257)) for f in Rendered(2, camera=small.CAMERA))
    with pytest.raises(GavoError, match="grey levels must range from 0 to 255, not to "):
        Odometry(small.CAMERA, small.NEWTON).register(first, 0.0)
    with pytest.raises(GavoError, match="grey levels must range from 0 to 255, not to "):
        align(first, second, small.CAMERA, small.NEWTON)


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
    assert result.steps[4].alignment.sentence == "The image repeats the last one."
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


class GuessingAside(Guessing):
    """The same, whose guesses become no reference: a near body takes the depth with it."""

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        attempt = super().align(state, frame, clock)
        return attempt._replace(fit=not attempt.unknown)


def test_guesses_that_lead_nowhere_do_not_break_the_trajectory() -> None:
    """The next frame was aligned with the reference before them, and began a segment though its motion was known."""
    unknown = (0, 1, 1, 1, 1, 0, 0)
    sequence = Rendered(frames=len(unknown) + 1, camera=CAMERA, noise=NONE)
    odometry = Odometry(CAMERA, aligner=GuessingAside(*unknown))
    steps = [odometry.register(frame, index / 30) for index, frame in enumerate(sequence)][1:]
    assert [step.segment for step in steps if step is not None] == [0] * len(unknown)
    assert [step.origin for step in steps if step is not None] == ["guessed" if n else "tracked" for n in unknown]


@pytest.mark.parametrize("use", [AlignmentStatus.NO_DEPTH, AlignmentStatus.FROZEN, AlignmentStatus.PARTIAL_DEPTH])
def test_a_frame_without_depth_is_no_reference_however_long_the_old_one_is_held(use: AlignmentStatus) -> None:
    """Where a high error was confirmed for three frames, one whose depth was missing became it."""
    poor = with_finding(found(AlignmentStatus.HIGH_ERROR, 0.01), use)
    aligner = Told(poor, confirmed=True)
    odometry = Odometry(CAMERA, aligner=aligner)
    for index, frame in enumerate(Rendered(frames=6, camera=CAMERA, noise=NONE)):
        odometry.register(frame, index / 30)
    assert (odometry.progress.held < 5) == (use is AlignmentStatus.PARTIAL_DEPTH)


@pytest.mark.parametrize(
    ("status", "tells"),
    [(AlignmentStatus.PARTIAL_DEPTH, True), (AlignmentStatus.AMBIGUOUS, False), (AlignmentStatus.HIGH_ERROR, False)],
)
def test_the_next_motion_is_not_expected_by_one_that_may_be_off(status: AlignmentStatus, tells: bool) -> None:
    """Before tiles a motion that may be off by one of them was the prediction of the next, which then was `ok`."""
    odometry = Odometry(CAMERA, aligner=Told(found(status, 0.01), confirmed=True))
    for index, frame in enumerate(Rendered(frames=2, camera=CAMERA, noise=NONE)):
        odometry.register(frame, index / 30)
    assert bool(odometry.progress.way.fixes) == tells


@dataclass
class Showing(StandIn):
    """An aligner that always finds one motion, and a body that moves in the image."""

    result: Alignment

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        body = Seen(1, np.ones((6, 8), np.float32), 0.1, np.array([0.0, 0.0, 2.0]), found(AlignmentStatus.OK, 0.05))
        return Attempt(frame.timestamp, self.result, True, bodies=(body,))


@pytest.mark.parametrize("is_known", [True, False])
def test_how_far_a_body_moved_is_unknown_where_the_camera_s_motion_is(is_known: bool) -> None:
    """Bodies leapt by what the camera's pose was corrected by, and were `ok`."""
    covariance = 1e-6 * np.eye(6, dtype=np.float32) if is_known else UNKNOWN
    odometry = Odometry(CAMERA, aligner=Showing(found(AlignmentStatus.OK, 0.01)._replace(covariance=covariance)))
    first, second = Rendered(frames=2, camera=CAMERA, noise=NONE)
    odometry.register(first, 0.0)
    step = odometry.register(second, 1 / 30)
    assert step is not None and np.isfinite(step.bodies[0].displacement).all() == is_known


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


def test_a_driver_alone_says_that_it_closes_no_loops() -> None:
    """It took `loops` without a word, and made no map."""
    settings = replace(SEARCH_ALONE, odometry=replace(PLAIN, loops=True))
    with pytest.warns(GavoWarning, match="closes no loops: run_odometry does"):
        Odometry(CAMERA, settings)
