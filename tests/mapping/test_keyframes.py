"""Keyframes: of one moment, bounded in number, found again; the driver that asks for them."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small import CAMERA

from gavo_jax.alignment.judgement import UNDETERMINED
from gavo_jax.alignment.result import no_alignment, with_finding
from gavo_jax.bodies.records import Body, Seen
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.sensor_noise import NONE
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.image.motion_compensation import compensate_motion
from gavo_jax.mapping.background import mapper_of
from gavo_jax.mapping.candidates import APART, MAX_CANDIDATES, MIN_SECONDS, LoopCandidate, find_candidates
from gavo_jax.mapping.correction import correct, loop_figures
from gavo_jax.mapping.keyframes import NOTHING_SEEN, SPACING, Keyframe, Keyframes, correlation, shift, shifts
from gavo_jax.mapping.mapper import Mapper, _own_velocity, _Uncertainty, in_order, tied_segments
from gavo_jax.mapping.relocalisation import Place
from gavo_jax.mapping.verification import Edge
from gavo_jax.odometry.aligners import Attempt
from gavo_jax.odometry.driver import Found, Odometry, Step
from gavo_jax.odometry.metrics import compute_metrics
from gavo_jax.odometry.progress import Progress
from gavo_jax.odometry.run import doubts_of, trajectory_of
from gavo_jax.output.frames import FRAME_COLUMNS, frame_row
from gavo_jax.rigid_motions import exp, length_and_angle, log, transport_covariance
from gavo_jax.settings import OdometryOptions, Settings
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import Trajectory, inverse


def test_what_is_found_in_a_segment_that_is_adrift_itself_is_looked_for_further():
    """The search for the world where the run began was over once another stretch had been recognised."""
    steps = covered_twice(26, {16: 1, 17: 1, 18: 0})
    assert [step.segment for step in steps[15:19]] == [1, 1, 0, 0]
    assert [step.origin for step in steps[15:19]] == ["relocalised"] * 3 + ["tracked"]


@pytest.mark.parametrize(("width", "height"), [(160, 120), (80, 60), (40, 32), (16, 16)])
def test_keyframes_of_images_of_any_size_can_be_compared(width: int, height: int):
    """Of images below 112 x 80 the small image had too few pixels: no loop was ever found, without a word."""
    camera = Camera(0.8 * width, 0.8 * width, width / 2 - 0.5, height / 2 - 0.5, width, height)
    frame = SyntheticSequence(1, camera=camera)[0]
    keyframes = Keyframes(camera)
    one, other = (keyframes.make(frame, index, 0, np.eye(4), np.zeros(6)) for index in range(2))
    share, correlation = one.thumbnail.agreement(other.thumbnail, np.eye(4), keyframes.camera)
    assert share > 0.6 and correlation > 0.99


@pytest.mark.parametrize(
    ("sees", "tied"),
    [
        ([{0, 2}, {1, 2}], []),  # the second is seen from the third alone
        ([{0, 2}], [Edge(3, 6, np.eye(4), np.eye(6))]),  # and was tied to it before
        ([{0, 1}, {0, 2}], []),
    ],
)
def test_segments_are_joined_until_no_more_can_be(sees: list[set[int]], tied: list[Edge]) -> None:
    """Each was looked for once, and not by what had been tied to it: it stayed apart."""
    mapper: Any = Mapper(CAMERA)
    numbers = enumerate([0, 0, 0, 1, 1, 1, 2, 2, 2])
    images: Any = object()
    mapper.keyframes.all = [
        Keyframe(i, i, float(i), s, np.eye(4), np.eye(4), None, images, NOTHING_SEEN) for i, s in numbers
    ]
    mapper.edges = list(tied)

    def find(frame: Keyframe, others: list[Keyframe]) -> Place | None:
        seen = [other for other in others if {frame.segment, other.segment} in sees]
        motion = exp(np.array([0.1, 0, 0, 0, 0.2, 0]))
        return Place(seen[-1], Edge(seen[-1].number, frame.number, motion, np.eye(6))) if seen else None

    mapper.recogniser = SimpleNamespace(find=find)
    assert mapper._join() and not mapper._join()
    assert tied_segments(mapper.keyframes.all, mapper.edges) == {0: 0, 1: 0, 2: 0}
    assert all(edge.earlier < edge.later for edge in mapper.edges)


def test_the_ends_of_an_edge_are_exchanged_with_its_motion_and_covariance() -> None:
    motion, half = exp(np.array([0.3, -0.2, 0.5, 0.1, 0.4, -0.2])), np.random.default_rng(0).normal(size=(6, 6))
    edge = in_order(Edge(5, 2, motion, half @ half.T))
    assert (edge.earlier, edge.later) == (2, 5)
    np.testing.assert_allclose(edge.earlier_T_later @ motion, np.eye(4), atol=1e-12)
    step = 1e-6 * np.array([1.0, 2.0, -1.0, 0.5, -2.0, 1.0])
    here = log(inverse(edge.earlier_T_later) @ inverse(motion @ exp(step)))
    np.testing.assert_allclose(
        np.outer(here, here), transport_covariance(motion, np.outer(step, step)), rtol=1e-3, atol=1e-17
    )
    same = in_order(Edge(5, 2, motion, np.outer(step, step))).covariance
    np.testing.assert_allclose(np.outer(here, here), same, rtol=1e-3, atol=1e-17)


def test_only_earlier_segments_are_searched_for_a_frame() -> None:
    """A segment found in another one was then found again in what had come of it, back and forth every ten frames."""
    mapper: Any = Mapper(CAMERA)
    images, asked = SimpleNamespace(), []
    mapper.keyframes.all = [
        Keyframe(i, i, float(i), i, np.eye(4), np.eye(4), None, images, NOTHING_SEEN)  # pyright: ignore
        for i in range(4)
    ]
    mapper._find = lambda frame, keyframes: asked.append([keyframe.segment for keyframe in keyframes])
    for segment in (2, 1, 0):
        assert mapper.find(WALK[0], segment) is None
    assert asked == [[0, 1], [0]], "nothing to search, nothing made of the frame"


def test_a_motion_that_took_another_time_is_not_the_frame_s_own() -> None:
    """Of a leap over missing frames the keyframe was freed of ten times its velocity."""
    motion = exp(np.array([0.1, 0, 0, 0, 0.05, 0]))
    for status, is_known in ((AlignmentStatus.OK, True), (AlignmentStatus.IMPLAUSIBLE_MOTION, False)):
        result = with_finding(no_alignment(AlignmentStatus.OK), status)
        result = result._replace(target_T_reference=motion, covariance=1e-6 * np.eye(6))
        step = Step(1, 0.0, 0.1, result, np.eye(4), 1.0, False)
        assert _own_velocity(step).any() == is_known
    unknown = result._replace(status=AlignmentStatus.OK, findings=0, covariance=UNDETERMINED**2 * np.eye(6))
    assert not _own_velocity(replace(step, alignment=unknown)).any()
    fine = result._replace(status=AlignmentStatus.OK, findings=0)
    assert [_own_velocity(replace(step, alignment=fine, timestamp=t)).any() for t in (0.1, 0.005)] == [True, False]


def test_depth_that_turns_out_to_be_wrong_closes_no_loop() -> None:
    """Loops to frames that a later one found to have wrong depth stayed in the map."""
    mapper = mapper_of_three()
    mapper._distrust({1, 7})
    assert [(edge.earlier, edge.later) for edge in mapper.edges] == [(0, 2)]
    assert [keyframe.number for keyframe in mapper.keyframes.searchable()] == [0, 2]


@pytest.mark.parametrize(
    ("status", "left"), [(AlignmentStatus.MOVING_BODY, [0, 1]), (AlignmentStatus.IMPLAUSIBLE_MOTION, [0, 1, 2])]
)
def test_a_frame_that_turns_out_to_have_followed_a_body_is_no_place_in_the_map(
    status: AlignmentStatus, left: list[int]
) -> None:
    """A frame was recognised by a card that filled it. That was told by the next, which was recognised by it."""
    mapper = mapper_of_three()
    result = with_finding(no_alignment(AlignmentStatus.OK), status)._replace(covariance=1e-6 * np.eye(6))
    step = Step(3, WALK[2].timestamp, WALK[3].timestamp, result, np.eye(4), 1.0, False, origin="guessed", revises=1)
    mapper.watch(None, step)
    assert [keyframe.number for keyframe in mapper.keyframes.searchable()] == left
    assert [edge.later for edge in mapper.edges] == left[1:]


def mapper_of_three() -> Any:
    """A map of three keyframes, with loops from the first to the others."""
    mapper: Any = Mapper(CAMERA)
    for index in range(3):
        mapper.keyframes.all.append(mapper.keyframes.make(WALK[index], index, 0, np.eye(4), np.zeros(6)))
        mapper.keyframes.all[-1].number = index
    mapper.edges = [Edge(0, 1, np.eye(4), np.eye(6)), Edge(0, 2, np.eye(4), np.eye(6))]
    return mapper


def test_a_reference_that_is_held_for_long_is_still_known() -> None:
    """After 64 frames with one reference, the motion to the next keyframe counted as unknown."""
    mapper: Any = Mapper(CAMERA)
    mapper._known["0.000000"] = _Uncertainty(np.zeros((6, 6)), False)
    result = no_alignment(AlignmentStatus.OK)._replace(covariance=1e-6 * np.eye(6))
    for index in range(1, 100):
        mapper._follow(Step(index, 0.0, index / 30, result, np.eye(4), 1.0, False))
    assert "0.000000" in mapper._known


def test_segments_are_tied_over_others():
    """Two that were tied to each other alone counted as tied to the first one, and were never looked for there."""
    frames = [Keyframe(i, i, float(i), i, np.eye(4), np.eye(4), None, None, NOTHING_SEEN) for i in range(4)]
    edges = [Edge(1, 2, np.eye(4), np.eye(6))]
    assert tied_segments(frames, edges) == {0: 0, 1: 1, 2: 1, 3: 3}
    assert tied_segments(frames, [*edges, Edge(0, 2, np.eye(4), np.eye(6))]) == {0: 0, 1: 0, 2: 0, 3: 3}


def test_a_resumed_run_weighs_motions_by_the_same_digits():
    """A computed covariance is symmetric but for its last digits, and motions.csv keeps its upper triangle."""
    computed = np.diag([1e-4] * 6) + np.tril(np.full((6, 6), 1e-12), -1)
    kept = np.triu(computed) + np.triu(computed, 1).T
    steps = [replace(step, alignment=step.alignment._replace(covariance=computed)) for step in drifting(WALK, STEP)]
    resumed = [replace(step, alignment=step.alignment._replace(covariance=kept)) for step in steps]
    maps = []
    for run in (steps, resumed):
        mapper = Mapper(CAMERA)
        mapper.watch(WALK[0], None)
        for step in run[:8]:
            mapper.watch(WALK[step.index], step)
        maps.append([keyframe.step for keyframe in mapper.keyframes.all])
    assert len(maps[0]) > 1
    for one, other in zip(*maps, strict=True):
        np.testing.assert_array_equal(one, other)


RATE = 10.0
STEP = np.array([2e-3, -1e-3, 1e-3, 0.0, 1e-3, 5e-4])


def there_and_back(frames: int) -> Trajectory:
    """To the side and back again, with a turn."""
    way = 0.5 * (1.0 - np.cos(2 * np.pi * np.arange(frames) / (frames - 1)))
    body = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.3], [0.0, 0.0, 0.0, 1.0]])
    poses = np.stack([body @ exp(np.array([0.35, 0.02, 0.0, 0.02, 0.3, 0.03]) * w) for w in way])
    return Trajectory(np.arange(frames) / RATE, poses)


WALK = SyntheticSequence(trajectory=there_and_back(25), noise=NONE, camera=CAMERA)


def test_a_keyframe_is_freed_of_its_own_motion():
    """The mean velocity since the last frame was taken for it: loops of a camera that trembles were off by more."""
    rolling, sway = replace(CAMERA, readout=0.03), np.array([0.0, 0.01, 0.0, 0.0, 0.02, 0.0])
    steps = [replace(step, alignment=step.alignment._replace(sway=sway)) for step in drifting(WALK, STEP)]
    mapper = Mapper(rolling)
    mapper.watch(WALK[0], None)
    for step in steps[:8]:
        mapper.watch(WALK[step.index], step)
    last, step = mapper.keyframes.all[-1], steps[mapper.keyframes.all[-1].index - 1]
    own = (log(np.asarray(step.alignment.target_T_reference)) + sway) * RATE
    grey, depth = WALK[step.index].grey, WALK[step.index].depth
    assert last.images is not None and step.index > 0
    np.testing.assert_array_equal(last.images.grey, compensate_motion(grey, depth, rolling, own).grey)
    assert not np.array_equal(last.images.grey, compensate_motion(grey, depth, rolling, own - sway * RATE).grey)


def test_a_frame_without_its_own_motion_is_that_of_a_global_shutter():
    rolling = replace(CAMERA, readout=0.06)
    path = there_and_back(25)
    skewed = SyntheticSequence(trajectory=path, noise=NONE, camera=rolling)[6]
    straight = WALK[6]
    truth = WALK.ground_truth.world_T_camera
    back = inverse(truth[7]) @ truth[5]
    twist = log(back) * RATE / 2
    plain, compensated, wanted = (
        compensate_motion(frame.grey, frame.depth, rolling, motion)
        for frame, motion in ((skewed, np.zeros(6)), (skewed, twist), (straight, np.zeros(6)))
    )

    def off(images) -> float:
        inner = (slice(4, -4), slice(6, -6))
        return float(np.abs(images.grey[inner].astype(float) - wanted.grey[inner]).mean())

    assert off(compensated) < 0.5 * off(plain)
    known = (compensated.depth > 0) & (wanted.depth > 0)
    assert np.median(np.abs(compensated.depth[known].astype(float) - wanted.depth[known])) < 25  # 5 mm


def test_images_are_bounded_and_the_likest_are_candidates():
    truth = WALK.ground_truth.world_T_camera
    keyframes = Keyframes(CAMERA, most=10)
    for i in range(25):
        keyframes.add(keyframes.make(WALK[i], i, 0, inverse(truth[0]) @ truth[i], np.zeros(6)))
    kept = keyframes.searchable()
    assert len(keyframes.all) == 25 and len(kept) == 10
    assert max(k.index for k in kept) == 24
    found = find_candidates(keyframes.all[24], kept[:-1], keyframes.camera)
    assert found and all(c.likeness > 0.88 and c.overlap >= 0.5 for c in found)
    assert all(c.later.timestamp - c.earlier.timestamp >= MIN_SECONDS for c in found)
    keyframes.all[24].timestamp -= 100.0
    assert len(find_candidates(keyframes.all[24], kept[:-1], keyframes.camera)) >= len(found), "its clock was set back"
    numbers = sorted(c.earlier.number for c in found)
    assert all(b - a >= APART for a, b in zip(numbers, numbers[1:], strict=False))


def test_shifts_of_many_are_those_of_any_two():
    poses = np.stack([exp(0.4 * xi) for xi in np.random.default_rng(0).normal(size=(8, 6))])
    wanted = [[shift(inverse(a) @ b, 2.0) for b in poses] for a in poses]
    np.testing.assert_allclose(shifts(poses, 2.0), wanted, atol=1e-7)


def test_thumbnails_agree_where_they_show_the_same():
    """Of the walk's first frame and others, by their true poses: the share that is seen, and how alike it is."""
    truth, keyframes = WALK.ground_truth.world_T_camera, Keyframes(CAMERA)
    first, near, far = (
        keyframes.make(WALK[i], i, 0, inverse(truth[0]) @ truth[i], np.zeros(6)).thumbnail for i in (0, 4, 12)
    )
    seen, alike = first.agreement(first, np.eye(4), keyframes.camera)
    assert seen > 0.97 and alike > 0.999
    shares = []
    for other, i in ((near, 4), (far, 12)):
        seen, alike = first.agreement(other, inverse(truth[i]) @ truth[0], keyframes.camera)
        wrong = first.agreement(other, inverse(truth[0]) @ truth[i], keyframes.camera)[1]
        assert alike > 0.9 and alike > wrong
        shares.append(seen)
    assert 1.0 > shares[0] > shares[1] > 0.3
    away = exp(np.array([0.0, 0.0, 0.0, 0.0, 3.0, 0.0]))
    assert first.agreement(first, away, keyframes.camera) == (0.0, 0.0), "behind the camera"
    a, b = np.array([1.0, 2.0, 4.0]), np.array([2.0, 1.0, -3.0])
    assert correlation(a, b) == pytest.approx(np.corrcoef(a, b)[0, 1])
    assert correlation(np.ones(3), np.arange(3.0)) == 0.0


def test_a_keyframe_is_due_after_some_motion_and_in_each_segment():
    keyframes = Keyframes(CAMERA)
    assert keyframes.is_due(np.eye(4), 0)
    keyframes.add(keyframes.make(WALK[0], 0, 0, exp(np.array([1.0, 0, 0, 0, 0.5, 0])), np.zeros(6)))
    last = keyframes.all[0]
    for share, due in ((0.9, False), (1.1, True)):
        aside = np.array([share * SPACING * last.thumbnail.distance, 0, 0, 0, 0, 0])
        assert keyframes.is_due(last.world_T_odometry @ exp(aside), 0) is due
        turned = np.array([0, 0, 0, 0, share * SPACING, 0])
        assert keyframes.is_due(last.world_T_odometry @ exp(turned), 0) is due
    assert keyframes.is_due(last.world_T_odometry, 1)


def drifting(sequence: SyntheticSequence, drift: np.ndarray) -> list[Step]:
    """Steps of an odometry that is off by a little more in each, and says so."""
    truth, world, steps = sequence.ground_truth.world_T_camera, np.eye(4), []
    for i in range(1, len(sequence)):
        motion = inverse(inverse(truth[i - 1]) @ truth[i] @ exp(drift))
        world = world @ inverse(motion)
        alignment = no_alignment(AlignmentStatus.OK)._replace(
            target_T_reference=motion, covariance=np.diag(drift**2 + 1e-6)
        )
        steps.append(Step(i, (i - 1) / RATE, i / RATE, alignment, world, 0.0, False))
    return steps


@pytest.mark.parametrize("poor", [None, 5, 6, 10])
def test_a_keyframe_that_is_no_reference_ties_what_refers_to_the_one_before(poor: int | None) -> None:
    """Depth that is partly missing makes a keyframe and no reference: the next way was one that nobody knows."""
    mapper, truth, reference = Mapper(CAMERA), WALK.ground_truth.world_T_camera, 0
    mapper.watch(WALK[0], None)
    for i in range(1, len(WALK)):
        alignment = no_alignment(AlignmentStatus.OK)._replace(
            target_T_reference=inverse(truth[i]) @ truth[reference], covariance=1e-6 * np.eye(6)
        )
        pose = inverse(truth[0]) @ truth[i]
        mapper.watch(WALK[i], Step(i, reference / RATE, i / RATE, alignment, pose, 0.0, False))
        reference = reference if i == poor else i
    edges = mapper.odometry_edges()
    assert len(edges) > 1 and max(edge.covariance.max() for edge in edges) < 0.01


def test_a_guessed_frame_becomes_no_keyframe():
    """Others were found against it, and a way that nobody knows counted as one that is known."""
    mapper, steps = Mapper(CAMERA), drifting(WALK, np.zeros(6))
    mapper.watch(WALK[0], None)
    for step in steps:
        mapper.watch(WALK[step.index], replace(step, origin="guessed"))
    assert [keyframe.index for keyframe in mapper.finish().keyframes] == [0]


def covering(left: int, right: int) -> Body:
    """A body that covers some columns of the image."""
    field = -np.ones((CAMERA.height, CAMERA.width), np.float32)
    field[:, left:right] = 1.0
    nan = np.full(3, np.nan)
    return Body(1, (right - left) / CAMERA.width, np.zeros(3), nan, nan, None, field, field.shape)


def test_what_moves_on_its_own_is_no_part_of_a_keyframe():
    """Frames that show the same card were tied by it: with loops the drift was three times that without."""
    plain = drifting(WALK, np.zeros(6))[:5]
    moving = {step.timestamp: covering(40, 80) for step in plain}
    seen = [replace(step, bodies=(moving[step.timestamp],)) for step in plain]
    live, resumed = Mapper(CAMERA), Mapper(CAMERA)
    live.watch(WALK[0], None)
    for step in seen:
        live.watch(WALK[step.index], step)
    resumed.replay(WALK, plain, lambda step: moving[step.timestamp].mask)
    maps = [mapper.finish().keyframes for mapper in (live, resumed)]
    assert len(maps[0]) > 1 and [k.index for k in maps[0]] == [k.index for k in maps[1]]
    for keyframe, again in zip(*maps, strict=True):
        images, others = keyframe.images, again.images
        assert images is not None and others is not None
        np.testing.assert_array_equal(images.depth, others.depth)
        in_front = images.depth[:, 22:38]
        assert (in_front == 0).all() == (keyframe.index > 0) and (images.depth[:, :10] > 0).any()


def test_a_doubted_motion_ties_little():
    """A keyframe that was reached by following a body pulled the map with it, as sure as any other."""
    steps = drifting(WALK, np.zeros(6))
    steps[3] = replace(steps[3], alignment=with_finding(steps[3].alignment, AlignmentStatus.MOVING_BODY))
    mapper = Mapper(CAMERA)
    mapper.watch(WALK[0], None)
    for step in steps:
        mapper.watch(WALK[step.index], step)
    later = replace(steps[5], alignment=with_finding(steps[5].alignment, AlignmentStatus.MOVING_BODY))
    aside = replace(steps[14], lost=True, alignment=no_alignment(AlignmentStatus.HIGH_ERROR))
    keyframes = mapper.finish([*steps[:5], later, *steps[6:14], aside, *steps[15:]]).keyframes
    spans = [(a.index, b.index) for a, b in zip(keyframes, keyframes[1:], strict=False)]
    doubted = [any(first < step.index <= last for step in (steps[3], later)) for first, last in spans]
    assert any(doubted) and not all(doubted)
    for edge, is_doubted in zip(mapper.odometry_edges(), doubted, strict=True):
        assert (np.diag(edge.covariance) >= 0.1**2).all() == is_doubted


def test_ways_end_where_a_clock_that_was_set_back_repeats_its_stamps():
    """The run hung at its end: a step's reference seemed to be a later one, and its reference the step."""
    mapper, stamps = Mapper(CAMERA), [10.0, 10.1, 10.2, 10.1, 10.2, 12.0]
    keyframes: Any = [SimpleNamespace(timestamp=stamp, in_doubt=False) for stamp in (10.0, 12.0)]
    mapper.keyframes.all = keyframes
    found = no_alignment(AlignmentStatus.OK)
    mapper._doubt([Step(i, stamps[i - 1], stamps[i], found, np.eye(4), 0.0, False) for i in range(1, 6)])
    assert not any(keyframe.in_doubt for keyframe in keyframes)


def test_what_is_not_synchronised_is_not_in_the_map_either():
    """Loops reckoned with a shutter and a depth delay that a run's settings leave out."""
    late = replace(WALK[6], depth_timestamp=WALK[6].timestamp + 0.02)
    twist = np.array([0.3, 0.0, 0.0, 0.0, 0.5, 0.0])
    rolling = replace(CAMERA, readout=0.03)
    options = OdometryOptions(loops=True, rolling_shutter=False, synchronise=False)
    mapper = mapper_of(rolling, options)
    assert mapper is not None and mapper_of(rolling, replace(options, loops=False)) is None
    made = mapper.mapper.keyframes.make(late, 6, 0, np.eye(4), twist)
    plain = Keyframes(CAMERA).make(WALK[6], 6, 0, np.eye(4), twist)
    assert made.images is not None and plain.images is not None
    np.testing.assert_array_equal(made.images.grey, plain.images.grey)
    np.testing.assert_array_equal(made.images.depth, plain.images.depth)


def test_what_may_be_the_last_keyframe_is_read_again_where_a_run_goes_on():
    """The last frame that was not lost is of doubtful depth: the one before it becomes the keyframe."""
    steps = drifting(WALK, np.zeros(6))[:5]
    steps[2] = replace(steps[2], alignment=with_finding(steps[2].alignment, AlignmentStatus.DEPTH_MISMATCH))
    steps[3:] = [replace(step, lost=True, origin="guessed") for step in steps[3:]]
    in_one_go, resumed = Mapper(CAMERA), Mapper(CAMERA)
    in_one_go.watch(WALK[0], None)
    for step in steps:
        in_one_go.watch(WALK[step.index], step)
    resumed.replay(WALK, steps[:3])
    for step in steps[3:]:
        resumed.watch(WALK[step.index], step)
    kept = [[keyframe.index for keyframe in mapper.finish().keyframes] for mapper in (in_one_go, resumed)]
    assert kept == [[0, 2], [0, 2]]


def test_loops_bring_the_end_back_to_where_it_was():
    pytest.importorskip("gtsam")
    mapper, steps = Mapper(CAMERA), drifting(WALK, np.array([2e-3, -1e-3, 1e-3, 0.0, 1e-3, 5e-4]))
    mapper.watch(WALK[0], None)
    for step in steps:
        mapper.watch(WALK[step.index], step)
    loops, causal = mapper.finish(), trajectory_of(0.0, steps)
    trajectory = correct(causal, loops)
    truth = WALK.ground_truth.world_T_camera
    end = inverse(truth[0]) @ truth[-1]
    before, after = (length_and_angle(inverse(end) @ of.world_T_camera[-1]) for of in (causal, trajectory))
    assert loop_figures(loops)["loops"] > 0 == loop_figures(loops)["loops_refused"]
    assert before[0] > 0.03 and after[0] < 0.15 * before[0] and after[1] < 0.2 * before[1]
    again = Mapper(CAMERA)
    again.replay(WALK, steps)
    np.testing.assert_allclose(
        [keyframe.world_T_odometry for keyframe in again.keyframes.all],
        [keyframe.world_T_odometry for keyframe in loops.keyframes[: len(again.keyframes.all)]],
    )
    assert [(e.earlier, e.later) for e in again.edges] == [
        (e.earlier, e.later) for e in loops.edges[: len(again.edges)]
    ]


class Sure:
    """An aligner that finds no motion of dark frames or of what comes right after them, and the same bodies always."""

    def __init__(self, bodies: tuple[Seen, ...] = ()):
        self.bodies = bodies

    def warm_up(self) -> float:
        return 0.0

    def start(self, frame: Frame) -> Any:
        return 0

    def predict(self, state: Any, elapsed: float) -> np.ndarray:
        return np.eye(4)

    def align(self, state: Any, frame: Frame, clock: Any) -> Attempt:
        status = AlignmentStatus.HIGH_ERROR if clock.elapsed > 1.5 / RATE else AlignmentStatus.OK
        result = no_alignment(status)._replace(overlap=np.float32(1.0), error=np.float32(1.0))
        return Attempt(0, result, status is AlignmentStatus.OK, bodies=self.bodies)


class Knows:
    """A map that knows where a frame is."""

    asked = 0

    def __init__(self, segment: int | None = 0):
        self.segment = segment

    def find(self, frame: Frame, segment: int) -> Found | None:
        self.asked += 1
        if self.segment is None:
            return None
        pose = exp(np.array([0.5, 0, 0, 0, 0, 0]))
        return Found(no_alignment(AlignmentStatus.OK), 0.1, pose, self.segment)


def covered_twice(frames: int, known: dict[int, int]) -> list[Step]:
    """Steps of a camera that is covered twice, by a map that knows the segments of some frames."""
    relocaliser, steps = Knows(None), []
    driver = Odometry(CAMERA, Settings(), aligner=Sure(), relocaliser=relocaliser)
    for i in range(frames):
        frame = replace(WALK[i % len(WALK)], timestamp=i / RATE)
        if 4 <= i < 8 or 12 <= i < 16:
            frame = replace(frame, grey=np.zeros_like(frame.grey), depth=np.zeros_like(frame.depth))
        relocaliser.segment = known.get(i)
        if (step := driver.register(frame, frame.timestamp)) is not None:
            steps.append(step)
    return steps


def test_a_segment_s_number_is_given_once():
    """Lost, found in the first segment, and lost again: the new stretch had the number of the second."""
    steps = covered_twice(24, {10: 0})
    trajectory = trajectory_of(0.0, steps)
    assert list(dict.fromkeys(trajectory.segments.tolist())) == [0, 1, 2]
    assert trajectory.segments[10] == 0 and trajectory.segments[-1] == 2
    metrics = compute_metrics(trajectory, None, steps, 1.0, 0.0)
    assert metrics["segments"] == 3 and metrics["unknown_motions"] == 3


@pytest.mark.parametrize("found_at", [8, 9])
def test_a_frame_that_is_found_shows_no_body_of_a_search_that_failed(found_at: int):
    """Nearly all of the first frame after a loss was masked: to the wrong motion the scene is what moves."""
    relocaliser = Knows(None)
    aligner = Sure((Seen(1, np.ones((3, 4), np.float32), 0.9, np.zeros(3)),))
    driver, step = Odometry(CAMERA, Settings(), aligner=aligner, relocaliser=relocaliser), None
    for i in range(found_at + 1):
        frame = replace(WALK[i], timestamp=i / RATE)
        if 4 <= i < 8:
            frame = replace(frame, grey=np.zeros_like(frame.grey), depth=np.zeros_like(frame.depth))
        relocaliser.segment = 0 if i == found_at else None
        step = driver.register(frame, frame.timestamp)
    assert step is not None and step.origin == "relocalised"
    assert len(step.bodies) == (0 if found_at == 8 else 1), "the next one's is seen by a motion that holds"


def test_a_lost_pair_shows_no_body():
    """To a wrong motion a third of a static room was a body, in bodies.csv and in the masks."""
    aligner = Sure((Seen(1, np.ones((3, 4), np.float32), 0.9, np.zeros(3)),))
    driver, steps = Odometry(CAMERA, Settings(), aligner=aligner), []
    for i in range(10):
        frame = replace(WALK[i], timestamp=i / RATE)
        if 4 <= i < 8:
            frame = replace(frame, grey=np.zeros_like(frame.grey), depth=np.zeros_like(frame.depth))
        steps.append(driver.register(frame, frame.timestamp))
    assert [len(step.bodies) for step in steps[1:]] == [0 if step.lost else 1 for step in steps[1:]]
    assert steps[8].lost and not steps[9].lost


def test_a_run_whose_first_frames_are_dark_is_not_adrift():
    """Every tenth frame of the whole run was looked for in a map that held nothing else."""
    driver = Odometry(CAMERA, Settings(), aligner=Sure(), relocaliser=(relocaliser := Knows(None)))
    for i in range(6):
        frame = replace(WALK[i], timestamp=i / RATE)
        if i < 2:
            frame = replace(frame, grey=np.zeros_like(frame.grey))
        driver.register(frame, frame.timestamp)
    assert driver.progress.adrift == 0 and relocaliser.asked == 0


@pytest.mark.parametrize("parity", [0, 1])
def test_a_segment_adrift_is_looked_for_whichever_frames_become_references(parity: int):
    """With depth in every other frame, a tenth frame was never a reference, and the search was over after ten."""
    driver = Odometry(CAMERA, Settings(), aligner=Sure(), relocaliser=(relocaliser := Knows(None)))
    counts = []
    for adrift in range(11, 61):
        held = (adrift + parity) % 2
        driver._seek(Progress(adrift=adrift, held=held), WALK[0], held=1 - held)
        counts.append(relocaliser.asked)
    assert counts[-1] == 5


def test_what_is_found_again_after_a_gap_says_so():
    """The finding of the frame's stamp was gone: the frame was plainly `ok`."""
    relocaliser = Knows(None)
    driver, steps = Odometry(CAMERA, Settings(), aligner=Sure(), relocaliser=relocaliser), []
    for i in range(12):
        stamp = i / RATE + (2.0 if i == 11 else 0.0)
        frame = replace(WALK[i], timestamp=stamp)
        if 4 <= i < 11:
            frame = replace(frame, grey=np.zeros_like(frame.grey), depth=np.zeros_like(frame.depth))
        relocaliser.segment = 0 if i == 11 else None
        steps.append(driver.register(frame, stamp))
    assert steps[-1] is not None and steps[-1].origin == "relocalised"
    assert steps[-1].alignment.statuses == (AlignmentStatus.GAP,)


@pytest.mark.parametrize("known", [True, False])
def test_a_covered_lens_is_followed_by_the_map(known):
    relocaliser = Knows(0 if known else None)
    driver = Odometry(CAMERA, Settings(), aligner=Sure(), relocaliser=relocaliser)
    steps = []
    for i in range(16):
        frame = replace(WALK[i], timestamp=i / RATE)
        if 4 <= i < 9:
            frame = replace(frame, grey=np.zeros_like(frame.grey), depth=np.zeros_like(frame.depth))
        step = driver.register(frame, frame.timestamp)
        if step is not None:
            steps.append(step)
    origins = [step.origin for step in steps]
    assert origins[:3] == ["tracked"] * 3 and origins[3:8] == ["guessed"] * 5
    assert origins[8] == ("relocalised" if known else "guessed")
    assert [step.segment for step in steps[8:]] == [0 if known else 1] * 7
    assert relocaliser.asked == (1 if known else 7)
    assert not steps[8].lost == known
    row = dict(zip(FRAME_COLUMNS, frame_row(steps[8]), strict=True))
    assert row["origin"] == origins[8]
    if known:
        np.testing.assert_allclose(steps[-1].world_T_camera[0, 3], 0.5)
    trajectory = trajectory_of(0.0, steps)
    doubts = doubts_of(steps)
    assert doubts.guessed.sum() == (5 if known else 6)
    assert doubts.lost.sum() == 5, "the first frame of a new segment is known by those that were aligned with it"
    assert len(doubts.guessed) == len(doubts.lost) == len(trajectory)


def test_keyframes_are_frames_whose_depth_can_be_trusted():
    """Frozen depth, depth that did not agree and a first frame that was refused made keyframes of their own."""
    pytest.importorskip("gtsam")
    mapper, poses = Mapper(CAMERA), WALK.ground_truth.world_T_camera
    black = replace(WALK[0], grey=np.zeros_like(WALK[0].grey))
    mapper.watch(black, None)
    status = {1: AlignmentStatus.NO_REFERENCE, 6: AlignmentStatus.FROZEN, 12: AlignmentStatus.DEPTH_MISMATCH}
    for i in range(1, 25):
        result = no_alignment(status.get(i - i % 6, AlignmentStatus.OK) if i > 1 else status[1])
        motion = inverse(poses[i]) @ poses[i - 1]
        pose = inverse(poses[1]) @ poses[i]
        result = result._replace(target_T_reference=motion)
        mapper.watch(WALK[i], Step(i, (i - 1) / RATE, i / RATE, result, pose, 1.0, i == 1, segment=1))
    made = [keyframe.index for keyframe in mapper.keyframes.all]
    assert made and min(made) > 1 and not any(6 <= index < 18 for index in made) and max(made) >= 18


def test_a_frame_is_found_in_the_map_and_another_room_is_not():
    pytest.importorskip("gtsam")
    mapper = Mapper(CAMERA)
    truth = WALK.ground_truth.world_T_camera
    for i in range(0, 12, 2):
        keyframe = mapper.keyframes.make(WALK[i], i, 0, inverse(truth[0]) @ truth[i], np.zeros(6))
        mapper.keyframes.add(keyframe)
    found = mapper.find(WALK[5], segment=1)
    assert found is not None and found.segment == 0
    metres, radians = length_and_angle(inverse(inverse(truth[0]) @ truth[5]) @ found.world_T_camera)
    assert metres < 0.03 and radians < 0.03
    assert mapper.find(SyntheticSequence(1, seed=7, camera=CAMERA)[0], segment=1) is None
    assert mapper.find(WALK[5], segment=0) is None  # to its own segment nothing has to tie it


def weight(thing: Any, seen: set[int]) -> int:
    """Bytes of all arrays that a thing holds and that were not seen before."""
    if isinstance(thing, np.ndarray):
        whole = thing if thing.base is None else thing.base
        is_new = id(whole) not in seen
        seen.add(id(whole))
        return whole.nbytes if is_new else 0
    if isinstance(thing, dict):
        return weight(list(thing.values()), seen)
    if isinstance(thing, list | tuple | set):
        return sum(weight(part, seen) for part in thing)
    return weight(vars(thing), seen) if hasattr(thing, "__dict__") else 0


def test_what_is_heavy_is_held_for_a_stated_number_of_keyframes():
    pytest.importorskip("gtsam")
    path = Trajectory(np.arange(73) / RATE, there_and_back(25).world_T_camera[np.arange(73) % 24])
    rounds = SyntheticSequence(trajectory=path, noise=NONE, camera=CAMERA)
    mapper = Mapper(CAMERA, most=6)
    mapper.watch(rounds[0], None)
    for step in drifting(rounds, np.full(6, 1e-4)):
        mapper.watch(rounds[step.index], step)
        if step.index % 5 == 0:
            mapper.find(rounds[step.index], segment=1)
    mapper.finish()
    kept, seen = mapper.keyframes.searchable(), set()
    heavy = weight(kept, seen)
    others = [keyframe for keyframe in mapper.keyframes.all if keyframe.images is None]
    assert len(kept) == 6 and len(others) > 4 and mapper.edges
    assert weight(others, seen) < 2000 * len(others)
    assert weight(mapper.edges, seen) < 1000 * len(mapper.edges)
    assert weight(vars(mapper), seen) < 4000  # the place that was found last
    pixels = CAMERA.width * CAMERA.height
    assert heavy < len(kept) * 16 * pixels


PATTERN_CAMERA = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)


def tiled(shift: float) -> Frame:
    """A wall of tiles of 60 pixels, 1.5 m ahead, from a camera that went so many pixels to the right."""
    v, u = np.mgrid[:480, :640] * (2 * np.pi / 60)
    u = u + 2 * np.pi / 60 * shift
    grey = 128 + 25 * np.sin(u) + 25 * np.sin(v) + 15 * np.sin(2 * u + v) + 15 * np.sin(u - 3 * v)
    return Frame(np.round(grey).astype(np.uint8), np.full((480, 640), 7500, np.uint16), timestamp=shift)


def test_before_tiles_that_repeat_nothing_ties_two_keyframes():
    """A frame was found in the map, and keyframes were tied, off by a tile."""
    pytest.importorskip("gtsam")
    mapper = Mapper(PATTERN_CAMERA)
    earlier, later = (mapper.keyframes.make(tiled(s), 0, 0, np.eye(4), np.zeros(6)) for s in (0.0, 96.0))
    mapper.keyframes.add(earlier)
    near_the_last_tile = exp(np.array([-24.0 * 1.5 / 525, 0, 0, 0, 0, 0]))
    assert mapper.verifier.verify([LoopCandidate(earlier, later, near_the_last_tile, 1.0, 1.0)]) == [None]
    assert mapper.find(tiled(96.0), segment=1) is None


def test_many_candidates_are_verified_side_by_side_to_the_same_edges():
    sequence = SyntheticSequence(9, camera=CAMERA, rate=10.0, noise=NONE)
    mapper = Mapper(CAMERA)
    frames = [mapper.keyframes.make(frame, k, 0, np.eye(4), np.zeros(6)) for k, frame in enumerate(sequence)]
    for keyframe in frames:
        mapper.keyframes.add(keyframe)
    poses = sequence.ground_truth.world_T_camera
    guesses = [inverse(pose) @ poses[0] for pose in poses[1:]]
    many = [LoopCandidate(frames[0], later, guess, 1.0, 1.0) for later, guess in zip(frames[1:], guesses, strict=True)]
    alone = [edge for candidate in many for edge in mapper.verifier.verify([candidate])]
    together = mapper.verifier.verify(many)
    assert len(many) > MAX_CANDIDATES and [edge is None for edge in together] == [edge is None for edge in alone]
    assert sum(edge is not None for edge in together) > MAX_CANDIDATES
    for one, other in zip(together, alone, strict=True):
        if one is not None and other is not None:
            assert (one.earlier, one.later) == (other.earlier, other.later)
            np.testing.assert_array_equal(one.earlier_T_later, other.earlier_T_later)
