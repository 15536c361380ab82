"""A motion that only seems to be the camera's loses against what stands behind: from the first frame on, and told."""

from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import cv2
import jax
import numpy as np
import pytest

from gavo_jax.alignment.result import Alignment, no_alignment, with_finding
from gavo_jax.bodies.aligner import BodyAware
from gavo_jax.bodies.duel import OVER, Span
from gavo_jax.bodies.rival import RivalledState, WithRival
from gavo_jax.bodies.scene import MotionSegmenter
from gavo_jax.bodies.votes import vote
from gavo_jax.datasets.base import Frame, Sequence
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.rendered.synthetic import DEFAULT_CAMERA, SyntheticSequence
from gavo_jax.evaluation import relative_pose_error
from gavo_jax.odometry.aligners import Attempt, Search
from gavo_jax.odometry.composition import warm_up_wholly
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.hindsight import revised
from gavo_jax.odometry.run import run_odometry
from gavo_jax.odometry.stream import track
from gavo_jax.odometry.tracking import Clock
from gavo_jax.presets import preset
from gavo_jax.rigid_motions import exp, log
from gavo_jax.settings import OdometryOptions, Settings
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.status import AlignmentStatus, bit
from gavo_jax.trajectory import inverse

CAMERA = DEFAULT_CAMERA.level(1)
SETTINGS = Settings(GaussNewton(iterations=(0, 15, 0, 0, 20)), odometry=OdometryOptions(recover=False, bodies="mask"))
"""Of a program that other tests use, too."""
FAST = preset("gauss-newton", "fast")


def test_blocks_vote_for_the_true_motion() -> None:
    sequence, search = SyntheticSequence(frames=2, camera=CAMERA), Search(CAMERA, SETTINGS, jax.random.key(0))
    segmenter = MotionSegmenter(CAMERA, SETTINGS)
    views = [segmenter.view(search.start(frame)) for frame in sequence]
    poses, _ = sequence.ground_truth.interpolate(sequence.timestamps)
    true = inverse(poses[1]) @ poses[0]
    wrong = exp(np.array([0.03, 0.0, 0.0, 0.0, 0.0, 0.0])) @ true
    nothing = np.zeros(segmenter.size, bool)
    for motions, sign in (((wrong, true), 1.0), ((true, wrong), -1.0)):
        margin = vote(*views, np.stack(motions).astype(np.float32), nothing, segmenter.camera)
        assert sign * float(margin.whole) > 0.3 and margin.far == pytest.approx(float(margin.whole), abs=1e-5)
    assert float(vote(*views, np.stack([true, true]).astype(np.float32), nothing, segmenter.camera).whole) == 0.0


def test_blocks_that_are_out_of_view_do_not_vote() -> None:
    """Where the camera has turned away from the anchor a few blocks at the edge had the say of all."""
    search, segmenter = Search(CAMERA, SETTINGS, jax.random.key(0)), MotionSegmenter(CAMERA, SETTINGS)
    view = segmenter.view(search.start(SyntheticSequence(frames=1, camera=CAMERA)[0]))
    nothing = np.zeros(segmenter.size, bool)
    half_view = np.arctan(CAMERA.width / 2 / float(CAMERA.fx))
    margins = []
    for turned in (0.0, 1.8 * half_view):
        away = exp(np.array([0.0, 0.0, 0.0, 0.0, turned, 0.0]))
        aside = exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])) @ away
        margins.append(vote(view, view, np.stack([aside, away]).astype(np.float32), nothing, segmenter.camera))
    assert float(margins[0].whole) > 0.5
    assert abs(float(margins[1].whole)) < 0.3 and abs(float(margins[1].far)) < 0.3


def error_mm(sequence: Any, steps: list[Step]) -> float:
    """Of the last pose against the first, millimetres."""
    truth = sequence.camera_at(np.array([sequence.timestamps[0], steps[-1].timestamp]))
    between = inverse(inverse(truth[0]) @ truth[1]) @ steps[-1].world_T_camera
    return 1e3 * float(np.linalg.norm(between[:3, 3]))


def registered(sequence: Any, indices: range) -> list[Step]:
    odometry = Odometry(sequence.camera, FAST)
    steps = [odometry.register(sequence[index], float(sequence.timestamps[index])) for index in indices]
    return [step for step in steps if step is not None]


@pytest.mark.parametrize(("share", "seed"), [(0.25, 2), (0.33, 5)])
def test_a_card_does_not_take_the_camera_along(data_dir: Path, share: float, seed: int, clips: ModuleType) -> None:
    """A step to the side and a turn explained card and room to the eye; from then on the pose was 5 to 8 cm off."""
    sequence = clips.CardClip(TumSequence(data_dir / "fr1_xyz")[:60], share, seed, clips.LOOKS[0])
    steps = registered(sequence, range(9))
    assert error_mm(sequence, steps) < 15.0
    jumps = [step.alignment for step in steps if step.alignment.covariance[0, 0] > 0.1]
    assert len(jumps) == 1 and AlignmentStatus.MOVING_BODY in jumps[0].statuses  # the pose is mended, and that is told


@pytest.mark.parametrize("seed", [20, 32])
def test_what_a_card_led_that_filled_the_image_is_told_once_it_leaves(
    data_dir: Path, seed: int, clips: ModuleType
) -> None:
    """Eleven pairs were off by more than 2 cm, and all were ok; the track went on from the card to the room."""
    sequence = clips.CardClip(TumSequence(data_dir / "fr1_rpy")[:60], 0.4, seed, clips.LOOKS[0])
    steps = revised(registered(sequence, range(28)))
    covered = [np.mean(sequence.part_labels(step.index)) > 0.8 for step in steps]
    assert sum(covered) > 8
    told = [AlignmentStatus.MOVING_BODY in step.alignment.statuses for step in steps]
    assert all(flagged for flagged, by_card in zip(told, covered, strict=True) if by_card)
    assert steps[-1].segment > 0


def test_a_plain_body_that_comes_in_is_not_taken_for_wrong_depth(data_dir: Path, clips: ModuleType) -> None:
    """It was, and as no such frame became the reference, the body was never found."""
    sequence = clips.CardClip(TumSequence(data_dir / "fr1_rpy")[:60], 0.1, 2, clips.LOOKS[2])
    steps = registered(sequence, range(36, 60))
    assert {step.alignment.status for step in steps} == {AlignmentStatus.OK}
    last = steps[-1]
    assert len(last.bodies) == 1
    covered = sequence.part_labels(59) > 0
    assert np.sum(last.bodies[0].mask & covered) > 0.8 * np.sum(last.bodies[0].mask | covered)


@pytest.mark.parametrize("clip", ["fr1_xyz", "fr1_rpy"])
def test_where_nothing_moves_a_rival_changes_nothing(data_dir: Path, clip: str) -> None:
    sequence = TumSequence(data_dir / clip)[:8]
    aligner = Odometry(sequence.camera, FAST).aligner
    while not isinstance(aligner, WithRival):
        aligner = aligner.first  # pyright: ignore[reportAttributeAccessIssue]
    with_rival, without = (steps_of(sequence, one) for one in (aligner, aligner.first))
    for step, other in zip(with_rival, without, strict=True):
        assert (step.world_T_camera == other.world_T_camera).all()
        assert step.alignment.findings == other.alignment.findings == 0


def test_a_rival_that_sees_little_of_a_blurred_image_is_not_the_camera(data_dir: Path) -> None:
    """Its first errors stayed, its covariance was one frame's, and so it seemed to contradict the first motion."""
    clip = TumSequence(data_dir / "fr1_rpy")
    odometry = Odometry(clip.camera, preset("ga", "fast"))
    for frame in (clip[index] for index in range(20)):
        blurred = replace(frame, grey=cv2.GaussianBlur(frame.grey, (0, 0), 4.0))
        step = odometry.register(blurred, frame.timestamp)
        assert step is None or AlignmentStatus.MOVING_BODY not in step.alignment.statuses


def steps_of(sequence: Sequence, aligner: Any) -> list[Step]:
    return list(track(sequence, odometry=Odometry(sequence.camera, FAST, aligner=aligner)))


def test_a_rival_is_given_up_where_it_is_the_same_motion() -> None:
    sequence = SyntheticSequence(frames=8, camera=CAMERA)
    odometry = Odometry(CAMERA, SETTINGS)
    there = []
    for index, frame in enumerate(sequence):
        odometry.register(frame, float(sequence.timestamps[index]))
        state = odometry.progress.tracker
        assert isinstance(state, RivalledState)
        there.append(state.rival.is_there)
    assert there[0] and not there[-1]


class Scripted:
    """Stands for a `BodyAware` search: its attempts are told beforehand."""

    def __init__(self, aware: BodyAware, *attempts: tuple[bool, float, float]) -> None:
        self.aware, self.attempts = aware, list(attempts)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.aware, name)

    def align(self, state: Any, frame: Any, clock: Any) -> Attempt:
        usable, x, deviation = self.attempts.pop(0)
        covariance = np.diag(np.full(6, deviation**2, np.float32))
        result = no_alignment(AlignmentStatus.OK)._replace(
            target_T_reference=exp(np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0])), covariance=covariance, findings=0
        )
        return Attempt(state, result, usable)


class Flagged:
    """Stands for a search whose every result has a finding."""

    def __init__(self, first: Any, finding: AlignmentStatus) -> None:
        self.first, self.finding = first, finding

    def __getattr__(self, name: str) -> Any:
        return getattr(self.first, name)

    def align(self, state: Any, frame: Any, clock: Any) -> Attempt:
        attempt = self.first.align(state, frame, clock)
        return attempt._replace(result=with_finding(attempt.result, self.finding))


def rivalled(
    first: list[tuple[bool, float, float]], second: list[tuple[bool, float, float]]
) -> tuple[WithRival, Frame]:
    """An aligner whose two searches' attempts are told beforehand, and a frame in which boxes stand before a wall."""
    search = Search(CAMERA, SETTINGS, jax.random.key(0))
    aware = BodyAware(search, search)
    aligner = WithRival(Scripted(aware, *first))  # pyright: ignore[reportArgumentType]
    object.__setattr__(aligner, "second", Scripted(aware, *second))
    return aligner, SyntheticSequence(frames=1, camera=CAMERA)[0]


def flag_first(aligner: WithRival, finding: AlignmentStatus) -> None:
    """Give every result of an aligner's first search a finding."""
    object.__setattr__(aligner, "first", Flagged(aligner.first, finding))


def covered_by_a_wall(frame: Frame) -> Frame:
    """A frame in which nothing stands before anything else."""
    return replace(frame, depth=np.full_like(frame.depth, 5000))


CLOCK = Clock(np.float32(1 / 30), np.float32(0), np.uint32(1))


def test_what_a_body_that_fills_the_image_led_is_unknown_once_it_is_seen() -> None:
    """Nothing stands before anything else in the first frames, so that there is no rival to tell."""
    aligner, frame = rivalled([(True, 0.05, 1e-3)] * 7, [(True, 0.0, 1e-3)])
    covered = covered_by_a_wall(frame)
    state, seen = aligner.start(covered), aligner.start(frame)
    assert not state.rival.is_there and seen.rival.is_there
    for _ in range(6):
        attempt = aligner.align(state, covered, CLOCK)
        state = attempt.state
        assert attempt.unknown == 0 and not state.rival.is_there
    taken = aligner.align(state._replace(rival=seen.rival), frame, CLOCK)
    assert taken.unknown == taken.revises == 6 and not taken.state.open_for.lasts


def test_motions_that_part_slowly_are_told_apart_by_how_far_they_are_apart_since_the_anchor() -> None:
    """A centimetre a frame at a deviation of 1 mm each: no pair tells, two do."""
    aligner, frame = rivalled([(True, 0.01, 9e-4)] * 3, [(True, 0.0, 9e-4)] * 3)
    first = aligner.align(aligner.start(frame), frame, CLOCK)
    assert first.state.rival.is_there and AlignmentStatus.MOVING_BODY not in first.result.statuses
    second = aligner.align(first.state, frame, CLOCK)
    assert not second.state.rival.is_there and AlignmentStatus.MOVING_BODY in second.result.statuses
    assert first.revises == 0 and second.revises == 1, "the first pair followed the body, too"
    assert np.asarray(second.result.target_T_reference)[0, 3] == pytest.approx(-0.01, abs=1e-6)  # the way back and on


def test_as_long_as_it_is_open_whose_motion_is_found_a_rival_is_asked_for_once_something_stands_before_the_rest() -> (
    None
):
    aligner, frame = rivalled([(True, 0.0, 1e-3)] * 2, [(True, 0.0, 1e-3)] * 2)
    state = aligner.start(frame)
    alone = state._replace(rival=aligner._nobody)
    assert aligner.align(alone, frame, CLOCK).state.rival.is_there
    assert not aligner.align(alone._replace(open_for=OVER), frame, CLOCK).state.rival.is_there


@pytest.mark.parametrize(
    ("open_for", "usable", "unknown"), [(Span(3, 0.1), True, 4), (Span(3, 0.1), False, 0), (OVER, True, 0)]
)
def test_as_long_as_that_is_open_a_motion_that_may_be_a_bodys_puts_all_before_in_doubt(
    open_for: Span, usable: bool, unknown: int
) -> None:
    """A card that fills the image leaves it: the search hands itself over to the room, over some frames."""
    aligner, frame = rivalled([(usable, 0.0, 1e-3)], [])
    covered = covered_by_a_wall(frame)
    flag_first(aligner, AlignmentStatus.MOVING_BODY)
    state = aligner.start(covered)._replace(open_for=open_for)
    attempt = aligner.align(state, covered, CLOCK)
    assert attempt.unknown == unknown and attempt.revises == max(unknown - 1, 0)
    assert (int(attempt.state.open_for.frames) == 0) == (unknown > 0), "the question is open anew"


@pytest.mark.parametrize("suspected", [0.0, 1.0])
def test_what_was_learnt_before_such_a_motion_is_kept_where_it_tells_bodies(suspected: float) -> None:
    """A card that filled the image was known to be at rest; the room that it uncovered was then taken for a body."""
    aligner, frame = rivalled([(True, 0.0, 1e-3)], [])
    covered = covered_by_a_wall(frame)
    flag_first(aligner, AlignmentStatus.MOVING_BODY)
    state = aligner.start(covered)
    everywhere = np.ones_like(np.asarray(state.first.scene.known))
    scene = state.first.scene._replace(known=-everywhere, suspected=suspected * everywhere)
    state = state._replace(first=state.first._replace(scene=scene))
    after = aligner.align(state, covered, CLOCK).state
    assert np.all(np.asarray(after.first.scene.known) == (-1.0 if suspected else 0.0))


def test_a_rival_that_tells_what_stands_before_the_rest_is_kept_at_such_a_motion() -> None:
    aligner, frame = rivalled([(True, 0.0, 1e-3)], [(True, 0.01, 1e-3)])
    flag_first(aligner, AlignmentStatus.MOVING_BODY)
    state = aligner.start(frame)
    attempt = aligner.align(state, frame, CLOCK)
    assert attempt.unknown == 1 and attempt.state.rival.is_there
    assert attempt.state.rival.age.seconds > 0, "of the same anchor"


@pytest.mark.parametrize(("open_for", "revises"), [(Span(9, 0.3), 10), (OVER, 0)])
def test_motions_that_agreed_for_a_moment_say_nothing_of_those_before(open_for: Span, revises: int) -> None:
    """A card moves hardly at all as its edge comes into view, and then as fast as before."""
    aligner, frame = rivalled([(True, 0.0, 1e-3), (True, 0.05, 1e-3)], [(True, 0.0, 1e-3)] * 2)
    state = aligner.start(frame)._replace(open_for=open_for)
    both = aligner.align(state, frame, CLOCK)
    assert both.state.rival.is_there and both.revises == 0
    taken = aligner.align(both.state, frame, CLOCK)
    assert not taken.state.rival.is_there and taken.revises == revises


@pytest.mark.parametrize(("missed", "unknown"), [(0, 0), (4, 4)])
def test_what_was_followed_before_the_anchor_is_unknown_once_the_rival_is_taken(missed: int, unknown: int) -> None:
    """A rival that could not be followed at first is asked for again; its anchor is then the later frame."""
    second = [(False, 0.0, 1.0)] * missed + [(True, 0.0, 1e-3)]
    aligner, frame = rivalled([(True, 0.05, 1e-3)] * (missed + 1), second)
    state = aligner.start(frame)
    assert state.rival.is_there and int(state.open_for.frames) == 0
    for _ in range(missed):
        attempt = aligner.align(state, frame, CLOCK)
        state = attempt.state
        assert state.rival.is_there and attempt.unknown == 0
    taken = aligner.align(state, frame, CLOCK)
    assert not taken.state.rival.is_there and not taken.state.open_for.lasts
    assert taken.unknown == taken.revises == unknown and AlignmentStatus.MOVING_BODY in taken.result.statuses
    assert taken.result.target_T_reference[0, 3] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(("deviation", "usable"), [(1e-3, True), (0.02, False)])
def test_where_the_first_motion_ends_the_rival_goes_on_if_it_is_known(deviation: float, usable: bool) -> None:
    first, second = [(True, 0.0, 1e-3), (False, 0.0, 1.0)], [(True, 0.01, 1e-3), (True, 0.02, deviation)]
    aligner, frame = rivalled(first, second)
    both = aligner.align(aligner.start(frame), frame, CLOCK)
    assert both.usable and both.state.rival.is_there and both.result.status == AlignmentStatus.OK
    ended = aligner.align(both.state, frame, CLOCK)
    assert ended.revises == usable, "both had parted"
    assert ended.usable == usable and not ended.state.rival.is_there, "it would have missed a frame"
    assert int(ended.state.open_for.frames) == 2, "nobody has said whose motion either is"
    if usable:  # as far as the rival has come since the anchor, from where the first one was believed to be
        assert ended.result.target_T_reference[0, 3] == pytest.approx(0.03, abs=1e-6)
        assert AlignmentStatus.MOVING_BODY in ended.result.statuses


@pytest.mark.parametrize(("apart", "deviation", "unknown"), [(0.002, 1e-3, 0), (0.01, 1e-3, 4), (0.01, 0.008, 0)])
def test_where_both_moved_alike_a_rival_that_goes_on_makes_no_guesses_of_the_motions_before(
    apart: float, deviation: float, unknown: int
) -> None:
    """A run of a still scene broke in two: at few frames a second, or under a light that flickered."""
    first, second = [(True, 0.0, 1e-3), (False, 0.0, 1.0)], [(True, apart, deviation), (True, 0.02, 1e-3)]
    aligner, frame = rivalled(first, second)
    both = aligner.align(aligner.start(frame)._replace(open_for=Span(4, 0.1)), frame, CLOCK)
    ended = aligner.align(both.state, frame, CLOCK)
    assert ended.usable and ended.unknown == unknown and (ended.revises > 0) == (unknown > 0)


def test_where_depth_is_in_doubt_the_rival_does_not_take_over() -> None:
    """Wrong depth ends the first motion, and looks like a body to the rival; it is looked at without depth first."""
    aligner, frame = rivalled([(True, 0.0, 1e-3), (False, 0.0, 1.0)], [(True, 0.01, 1e-3)] * 2)
    flag_first(aligner, AlignmentStatus.DEPTH_MISMATCH)
    both = aligner.align(aligner.start(frame), frame, CLOCK)
    assert not aligner.align(both.state, frame, CLOCK).usable


def test_what_a_rival_lost_in_a_vague_frame_is_not_certain_in_the_next_one() -> None:
    """Both have moved alike since; that the last frame was exact says nothing of the way from the anchor."""
    aligner, frame = rivalled([(True, 0.0, 1e-3)] * 4, [(True, 0.02, 0.01), *[(True, 0.0, 1e-3)] * 3])
    state = aligner.start(frame)
    for _ in range(4):
        attempt = aligner.align(state, frame, CLOCK)
        state = attempt.state
        assert AlignmentStatus.MOVING_BODY not in attempt.result.statuses


def test_where_nothing_moves_and_frames_lie_far_apart_no_body_costs_drift(data_dir: Path) -> None:
    """It cost 1.6 times the drift: what was seen so many frames ago was out of reach, and drift became a body."""
    ratios = []
    for clip, stride, seed in (("fr1_rpy", 3, 1), ("fr1_rpy", 4, 0), ("fr1_desk", 3, 0)):
        sequence = TumSequence(data_dir / clip)[::stride]
        without = drift(sequence, "off", seed)
        with_bodies = drift(sequence, "mask", seed) if without else None
        ratios += [with_bodies / without] if with_bodies and without else []
    assert len(ratios) >= 2 and np.median(ratios) < 1.15 and max(ratios) < 3.0


def drift(sequence: Sequence, bodies: Literal["off", "mask"], seed: int) -> float | None:
    """Of a run, m/s; None where it broke: by blur, with bodies or without, on one machine and not on another."""
    settings, truth = preset("ga", "fast"), sequence.ground_truth
    settings = replace(settings, odometry=replace(settings.odometry, bodies=bodies))
    trajectory = run_odometry(sequence, settings, seed=seed).trajectory
    assert truth is not None
    return None if trajectory.segments.any() else relative_pose_error(trajectory, truth).translation.rmse


def result_of(covariance: np.ndarray) -> Alignment:
    found = exp(np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0]))
    result = no_alignment(AlignmentStatus.LOW_TEXTURE)._replace(findings=bit(AlignmentStatus.LOW_TEXTURE))
    return result._replace(target_T_reference=found, covariance=covariance.astype(np.float32))


def test_what_the_images_do_not_tell_goes_on_as_before() -> None:
    """Sideways the found motion is exact, upwards it tells nothing; the last motion was upwards."""
    search = Search(CAMERA, SETTINGS, jax.random.key(0))
    aware = BodyAware(search, search)
    blank = aware.blank_state()
    upwards = np.array([0.0, 0.03, 0.0, 0.0, 0.0, 0.0], np.float32)
    state = blank._replace(tracker=blank.tracker._replace(motion=upwards, seconds=np.float32(1 / 30)))
    sharp = np.diag([1e-8, 0.25, 1e-8, 1e-8, 1e-8, 1e-8])
    attempt = Attempt(blank.tracker, result_of(sharp), usable=False)
    clock = Clock(np.float32(1 / 30), np.float32(0), np.uint32(1))
    completed = aware._helped_by_prediction(state, clock, attempt, covered=0.1)
    assert completed.usable and completed.unknown == 0
    assert completed.result.target_T_reference[:3, 3] == pytest.approx([0.02, 0.03, 0.0], abs=1e-3)
    assert completed.result.status is AlignmentStatus.LOW_TEXTURE
    variances = np.diag(completed.result.covariance)
    assert variances[0] == pytest.approx(1e-8, rel=0.1) and variances[1] == pytest.approx(1e-4, rel=0.1)
    blind = attempt._replace(result=result_of(np.full((6, 6), np.nan)))
    assert aware._helped_by_prediction(state, clock, blind, covered=0.1) is blind
    guessed = aware._helped_by_prediction(state, clock, blind, covered=0.9)
    assert guessed.usable and guessed.unknown == 1


def test_nothing_goes_on_where_what_is_known_says_otherwise() -> None:
    """The camera turned back: a motion that was 4 cm off became 16 cm off, with a deviation of 9 mm."""
    search = Search(CAMERA, SETTINGS, jax.random.key(0))
    aware = BodyAware(search, search)
    blank = aware.blank_state()
    away = np.array([-0.2, 0.0, 0.0, 0.0, 0.0, 0.0], np.float32)
    state = blank._replace(tracker=blank.tracker._replace(motion=away, seconds=np.float32(1 / 30)))
    clock = Clock(np.float32(1 / 30), np.float32(0), np.uint32(1))
    attempt = Attempt(blank.tracker, result_of(np.diag([0.015**2, 0.25] + [0.01**2] * 4)), usable=False)
    assert aware._helped_by_prediction(state, clock, attempt, covered=0.1) is attempt
    jerky = state.tracker.velocity_change._replace(changes=np.full(2, 9.0, np.float32))  # what is usual is no surprise
    state = state._replace(tracker=state.tracker._replace(velocity_change=jerky))
    assert aware._helped_by_prediction(state, clock, attempt, covered=0.1).usable


@pytest.mark.parametrize("degrees", [0.0, 2.0, 10.0])
def test_what_goes_on_beside_what_is_known_leaves_that_alone_while_the_camera_turns(degrees: float) -> None:
    """Along the reference's axis the found motion is 5 cm off, and knows it; along the others it is exact."""
    search = Search(CAMERA, SETTINGS, jax.random.key(0))
    aware = BodyAware(search, search)
    blank = aware.blank_state()
    truth = np.array([0.02, 0.0, 0.0, 0.0, np.radians(degrees), 0.0])
    elapsed = np.float32(1 / 30)
    state = blank._replace(tracker=blank.tracker._replace(motion=np.float32(truth), seconds=elapsed))
    vague = result_of(np.diag([0.3**2] + [1e-3**2] * 5))
    found = exp(truth) @ exp(np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0]))
    attempt = Attempt(blank.tracker, vague._replace(target_T_reference=found), usable=False)
    clock = Clock(elapsed, np.float32(0), np.uint32(1))
    result = aware._helped_by_prediction(state, clock, attempt, covered=0.1).result
    off = log(inverse(exp(truth)) @ result.target_T_reference)
    assert np.all(np.abs(off) < 1e-4 + np.sqrt(np.diag(result.covariance)))


def test_before_a_camera_what_is_asked_in_doubt_is_compiled_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """The votes and the look back were compiled while the camera waited."""
    asked: list[str] = []
    monkeypatch.setattr("gavo_jax.bodies.rival.vote", lambda *_: asked.append("vote"))
    monkeypatch.setattr("gavo_jax.bodies.scene._look_back", lambda *_, **__: asked.append("look back"))
    monkeypatch.setattr(Search, "warm_up", lambda _: 0.0)
    monkeypatch.setattr("gavo_jax.bodies.scene._look", lambda *_, **__: ())
    search = Search(CAMERA, SETTINGS, jax.random.key(0))
    aligner = WithRival(BodyAware(search, search))
    warm_up_wholly(aligner)
    assert sorted(asked) == ["look back", "vote"]
