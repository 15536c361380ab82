"""Bodies beside the search: found where they are, left out of it, and no obstacle to what stands still."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from carded import CAMERA, FRAMES, TRACKED, Carded, beliefs, view

from gavo_jax.alignment.result import Alignment, no_alignment
from gavo_jax.bodies.aligner import SUSPECTED, BodyAware, MotionCandidate, _judged
from gavo_jax.bodies.belief import Belief
from gavo_jax.bodies.identity import BodyTracks, associate, body_components
from gavo_jax.bodies.pixel_evidence import gather_evidence
from gavo_jax.bodies.records import Seen, in_world
from gavo_jax.bodies.scene import MotionSegmenter
from gavo_jax.compilation import programs
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.odometry.aligners import Attempt, Search
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.stream import track
from gavo_jax.odometry.tracking import Clock, blank_state
from gavo_jax.presets import preset
from gavo_jax.settings import Settings
from gavo_jax.status import AlignmentStatus

IGNORED = replace(TRACKED, odometry=replace(TRACKED.odometry, bodies="off"))


def run(sequence: Any, settings: Settings) -> list[Step]:
    return list(track(sequence, odometry=Odometry(CAMERA, settings)))


def test_a_body_is_found_where_it_is() -> None:
    sequence = Carded()
    tracks = BodyTracks.empty(MotionSegmenter(CAMERA, TRACKED).size)
    for index, belief in enumerate(beliefs(sequence)[1:], start=2):
        moving = np.asarray(belief.moving)
        labels = body_components(moving, np.asarray(belief.known), tracks.labels > 0)
        tracks = associate(labels, tracks)
        field = np.where(labels == 1, moving, -1.0).astype(np.float32)
        mask = in_world(Seen(1, field, 0.0, np.zeros(3)), np.eye(4), np.eye(4), (CAMERA.height, CAMERA.width)).mask
        true = sequence.mask(index)
        assert np.sum(mask & true) / np.sum(mask | true) > 0.75
        assert set(tracks.numbers) == {0, 1}


def test_a_large_body_leaves_the_brightness_of_the_rest_alone() -> None:
    """A regression on what it covers took contrast out, so that a dark screen seemed to change, and became a body."""
    segmenter = MotionSegmenter(CAMERA, TRACKED)
    frame = SyntheticSequence(frames=1, camera=CAMERA)[0]
    here = np.array(frame.grey)
    here[:60] = 6  # a screen without texture
    before, depth = here.copy(), np.array(frame.depth)
    noise = np.random.default_rng(0).integers(0, 255, (15, 18)).astype(np.uint8)
    before[60:, 60:] = cv2.resize(noise, (CAMERA.width - 60, CAMERA.height - 60), interpolation=cv2.INTER_CUBIC)
    nearer = depth.copy()
    nearer[60:, 60:] = 0.5 * CAMERA.depth_scale
    now, others = view(here, depth, segmenter.levels), view(before, nearer, segmenter.levels)
    others = jax.tree.map(lambda leaf: leaf[None], others)
    seen = gather_evidence(now, others, jnp.eye(4)[None], segmenter.camera)
    screen = np.asarray(seen.grey[0, 4:24, 4:-4])
    assert np.median(screen) < 0.5


def test_bodies_take_rows_as_exposed_as_the_search_does() -> None:
    """With the rolling shutter left out of the search only, what is at rest would seem to move."""
    camera = replace(CAMERA, readout=0.02)
    for reckons in (True, False):
        settings = replace(TRACKED, odometry=replace(TRACKED.odometry, rolling_shutter=reckons))
        search = Search(camera, settings, jax.random.key(0))
        assert (BodyAware(search, search).segmenter.full.readout > 0) == reckons


def test_what_is_at_rest_supports_the_motion() -> None:
    moving, still = beliefs(Carded())[-1], beliefs(Carded(moves=False))[-1]
    assert float(still.contradicted) == 0 and float(still.support) > 0.9
    assert not np.any(np.asarray(still.moving) > 0)
    assert float(moving.support) < 0.98


def test_what_stands_still_is_part_of_the_scene() -> None:
    sequence = Carded(moves=False)
    aware, ignoring = run(sequence, TRACKED), run(sequence, IGNORED)
    assert not any(step.bodies for step in aware)
    np.testing.assert_array_equal([step.world_T_camera for step in aware], [step.world_T_camera for step in ignoring])


def test_a_body_that_stops_stays_out_of_the_search() -> None:
    sequence, odometry = Carded(stops=3), Odometry(CAMERA, TRACKED)
    for index in range(FRAMES):
        odometry.register(sequence[index], index / 30)
    state = odometry.progress.tracker.first
    factor = CAMERA.height // MotionSegmenter(CAMERA, TRACKED).size[0]
    on_card = sequence.mask(FRAMES - 1)[::factor, ::factor]
    suspected = np.asarray(state.scene.suspected) > SUSPECTED
    assert suspected[on_card].mean() > 0.9 and suspected[~on_card].mean() < 0.1
    points = jax.tree.map(np.asarray, state.tracker.previous.points)
    u, v = CAMERA.fx * points.x + CAMERA.cx, CAMERA.fy * points.y + CAMERA.cy
    inside = sequence.mask(FRAMES - 1)[np.clip(v, 0, 239).astype(int), np.clip(u, 0, 319).astype(int)]
    assert inside.mean() > 0.05 and inside[points.q > 0].mean() < 0.02


def test_a_strong_body_before_a_plain_room_does_not_take_the_camera_along_from_the_first_frame_on() -> None:
    steps = run(Carded(), TRACKED)
    assert max(np.linalg.norm(step.world_T_camera[:3, 3]) for step in steps) < 1e-3
    assert np.linalg.norm(run(Carded(), IGNORED)[0].world_T_camera[:3, 3]) > 0.03


def test_no_frame_after_the_warm_up_waits_for_a_program(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kept programs are compiled once for each kind of input, wherever that lies."""
    sequence, odometry = Carded(), Odometry(CAMERA, TRACKED)
    monkeypatch.setattr(programs, "_loaded", {})
    odometry.warm_up()
    before = set(programs._loaded)
    assert {"_look", "track_frame"} <= {function.__name__ for function, *_ in before}
    for index in range(3):
        odometry.register(sequence[index], index / 30)
    assert set(programs._loaded) == before


def test_a_camera_that_moves_fast_finds_no_bodies_where_nothing_moves(data_dir: Path) -> None:
    clip = TumSequence(data_dir / "fr1_desk_loop")
    odometry = Odometry(clip.camera, preset("ga", "fast"))
    steps = [odometry.register(frame, frame.timestamp) for frame in (clip[index] for index in range(55, 90))]
    assert sum(bool(step.bodies) for step in steps if step is not None) <= 3


@pytest.mark.parametrize(("name", "first"), [("fr1_xyz", 68), ("fr1_rpy", 6), ("fr1_rpy", 52), ("fr1_desk", 42)])
def test_a_first_frame_moved_while_it_was_exposed(data_dir: Path, name: str, first: int) -> None:
    """Its rows were taken for those of one moment, and by the second frame half of the scene seemed to move."""
    clip = TumSequence(data_dir / name)
    odometry = Odometry(clip.camera, preset("ga", "fast"))
    odometry.register(clip[first], clip[first].timestamp)
    step = odometry.register(clip[first + 1], clip[first + 1].timestamp)
    assert step is not None and step.alignment.status is AlignmentStatus.OK


def test_depth_upside_down_is_no_body(data_dir: Path) -> None:
    """Where depth is wrong, half of the image seems to stand before what was seen; the image itself agrees."""
    clip = TumSequence(data_dir / "fr1_rpy")
    odometry = Odometry(clip.camera, preset("ga", "fast"))
    steps = []
    for index in range(20, 29):
        frame = clip[index]
        frame = replace(frame, depth=np.flipud(frame.depth)) if index in (26, 27) else frame
        steps += [step] if (step := odometry.register(frame, frame.timestamp)) is not None else []
    assert [AlignmentStatus.DEPTH_MISMATCH in step.alignment.statuses for step in steps] == [
        *[False] * 5,
        *[True] * 2,
        False,
    ]
    assert not any(step.bodies for step in steps)


def judged(finding: AlignmentStatus, *, grey: float, depth: float, support: float, contradicted: float) -> Alignment:
    """A finding's result as the whole image judges it, beside a body over two fifths of that."""
    image, covered = jnp.zeros((8, 10)), jnp.zeros((8, 10)).at[:, :4].set(1.0)
    shares = jnp.float32(support), jnp.float32(contradicted), covered > 0
    belief = Belief(2 * covered - 1, 2 * covered - 1, *shares, image, image, jnp.ones(2))
    result = no_alignment(finding)
    result = result._replace(explained=result.explained._replace(grey=np.float32(grey), depth=np.float32(depth)))
    best = MotionCandidate(Attempt(None, result, usable=False), belief)
    return _judged(best, [best], known=True).result


@pytest.mark.parametrize(("explained", "status"), [(0.6, AlignmentStatus.OK), (0.1, AlignmentStatus.DEPTH_MISMATCH)])
def test_depth_that_disagrees_where_no_body_is_has_no_excuse(explained: float, status: AlignmentStatus) -> None:
    result = judged(AlignmentStatus.DEPTH_MISMATCH, grey=0.8, depth=explained, support=0.8, contradicted=0.2)
    assert result.status is status


@pytest.mark.parametrize(("explained", "status"), [(0.7, AlignmentStatus.OK), (0.3, AlignmentStatus.HIGH_ERROR)])
def test_an_image_that_disagrees_where_its_points_still_see_has_no_excuse(
    explained: float, status: AlignmentStatus
) -> None:
    """An image that a fault had shifted was `ok` beside a body, as depth went on agreeing."""
    result = judged(AlignmentStatus.HIGH_ERROR, grey=explained, depth=0.95, support=0.8, contradicted=0.1)
    assert result.status is status


@pytest.mark.parametrize(
    ("support", "contradicted", "status"),
    [(0.3, 0.6, AlignmentStatus.MOVING_BODY), (0.6, 0.3, AlignmentStatus.OK)],
)
def test_a_motion_that_more_of_the_image_contradicts_may_be_a_bodys(
    support: float, contradicted: float, status: AlignmentStatus
) -> None:
    """Dirt on the lens over a third of the image was followed, and `ok`."""
    result = judged(AlignmentStatus.OK, grey=0.8, depth=0.9, support=support, contradicted=contradicted)
    assert result.status is status


@pytest.mark.parametrize("repeats", [False, True])
def test_an_excused_motion_may_still_be_off_by_a_period(monkeypatch: pytest.MonkeyPatch, repeats: bool) -> None:
    """Only what a search takes itself is checked for that: beside a body in front of tiles the next tile was `ok`."""
    monkeypatch.setattr("gavo_jax.odometry.aligners.another_period_fits_expected", lambda *_: repeats)
    result = no_alignment(AlignmentStatus.HIGH_ERROR)
    result = result._replace(explained=result.explained._replace(grey=np.float32(0.8), depth=np.float32(0.9)))
    refused = Attempt(None, result, usable=False)
    image, covered = jnp.zeros((8, 10)), jnp.zeros((8, 10)).at[:, :4].set(1)
    shares = jnp.float32(0.8), jnp.float32(0.05), covered > 0
    belief = Belief(2 * covered - 1, image, *shares, image, image, jnp.ones(2))
    search: Any = SimpleNamespace(align=lambda *_: refused, predict=lambda *_: np.eye(4), camera=CAMERA)
    aware, frame = BodyAware(search, search), Frame(np.zeros((8, 10), np.uint8), np.zeros((8, 10), np.uint16), 0.0)
    stand_in = SimpleNamespace(look_back=lambda *_: belief, without=lambda tracker, _: tracker)
    vars(aware)["segmenter"] = stand_in
    tracker: Any = SimpleNamespace(motion=np.ones(6), seconds=1 / 30)
    scene = SimpleNamespace(tracks=SimpleNamespace(labels=np.ones((8, 10))))
    state: Any = SimpleNamespace(scene=scene, tracker=tracker)
    clock: Any = SimpleNamespace(elapsed=1 / 30)
    attempt = aware._share_out(state, frame, clock, refused)
    assert attempt.usable is not repeats
    assert attempt.result.status is (AlignmentStatus.AMBIGUOUS if repeats else AlignmentStatus.OK)


@pytest.mark.parametrize(("lost", "is_guessed"), [(0, True), (10, False)])
def test_the_last_motion_does_not_stand_in_for_frames_that_were_lost(
    monkeypatch: pytest.MonkeyPatch, lost: int, is_guessed: bool
) -> None:
    """A camera that was covered and carried elsewhere went on in the same world, by the last motion before that."""
    missing = Attempt(None, no_alignment(AlignmentStatus.HIGH_ERROR), usable=False)
    guess = missing._replace(usable=True)
    monkeypatch.setattr(BodyAware, "_share_out", lambda *_: missing)
    monkeypatch.setattr(BodyAware, "_helped_by_prediction", lambda *_: guess)
    scene = SimpleNamespace(seconds_extrapolated=0.0, tracks=SimpleNamespace(labels=np.ones((6, 8))))
    state: Any = SimpleNamespace(tracker=SimpleNamespace(seconds=1 / 30, motion=np.ones(6)), scene=scene)
    nothing: Any = None
    clock: Any = SimpleNamespace(elapsed=(lost + 1) / 30)
    attempt, _ = BodyAware(nothing, nothing)._asked(state, nothing, clock, missing)
    assert attempt is (guess if is_guessed else missing)


@pytest.mark.parametrize(
    ("metres", "dissent", "status"),
    [
        (0.02, 14.0, AlignmentStatus.MOVING_BODY),
        (0.02, 10.0, AlignmentStatus.OK),
        (0.0, 14.0, AlignmentStatus.OK),
        (0.0, 20.0, AlignmentStatus.MOVING_BODY),
    ],
)
def test_an_abrupt_motion_that_much_of_the_area_dissents_from_may_be_a_bodys(
    monkeypatch: pytest.MonkeyPatch, metres: float, dissent: float, status: AlignmentStatus
) -> None:
    """A card left the view, and the search the card for the room: 2 cm from one frame to the next, all `ok`."""
    look = MotionSegmenter.look

    def with_dissent(self: MotionSegmenter, *arguments: Any) -> Any:
        seen: Any = look(self, *arguments)
        return seen._replace(opinion=seen.opinion._replace(dissent=jnp.float32(dissent), least=jnp.float32(dissent)))

    monkeypatch.setattr(MotionSegmenter, "look", with_dissent)
    search, frames = Search(CAMERA, TRACKED, jax.random.key(0)), SyntheticSequence(3, camera=CAMERA)
    aware = BodyAware(search, search)
    clocks = [Clock(np.float32(1 / 30), np.float32(0), np.uint32(index)) for index in range(3)]
    state = aware.align(aware.start(frames[0]), frames[1], clocks[1]).state
    onward = aware.predict(state, 1 / 30)
    onward[0, 3] += metres
    monkeypatch.setattr(BodyAware, "predict", lambda *_: onward)
    result = aware.align(state, frames[2], clocks[2]).result
    assert result.status is status


def test_points_that_are_left_out_are_not_asked_for() -> None:
    """A body's own search has few points, each with a reading: there is depth enough."""
    segmenter = MotionSegmenter(CAMERA, TRACKED)
    mask = np.ones(segmenter.size, bool)
    mask[: segmenter.size[0] // 4] = False
    state = blank_state(CAMERA, TRACKED.solver, TRACKED.alignment)
    assert float(state.part.share) == 1 and float(segmenter.without(state, mask).part.share) == pytest.approx(0.25)
