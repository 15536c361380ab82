"""Bodies: a card that moves in a rendered room is told from it, and nothing is where nothing moves."""

from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gavo_jax import program_cache
from gavo_jax.alignment.result import Alignment, no_alignment
from gavo_jax.alignment.visits import prepare_target
from gavo_jax.bodies import motions
from gavo_jax.bodies.aligner import SUSPECTED, BodyAware, MotionCandidate, _judged
from gavo_jax.bodies.belief import Belief, follow, form_belief, suspect
from gavo_jax.bodies.evidence import PixelEvidence, View, gather_evidence, view_of
from gavo_jax.bodies.identity import BodyTracks, associate, body_components
from gavo_jax.bodies.records import Seen, in_world
from gavo_jax.bodies.scene import MotionSegmenter
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.synthetic import DEFAULT_CAMERA, SyntheticSequence
from gavo_jax.datasets.tum import TumSequence
from gavo_jax.image.levels import Levels
from gavo_jax.image.pyramid import build_pyramid
from gavo_jax.odometry.aligners import Attempt, Search
from gavo_jax.odometry.composition import blank_of
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.stream import track
from gavo_jax.odometry.tracking import Clock, blank_state
from gavo_jax.output.bodies import BODY_COLUMNS, body_rows
from gavo_jax.presets import preset
from gavo_jax.settings import OdometryOptions, Settings
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.status import AlignmentStatus

CAMERA = DEFAULT_CAMERA.level(1)
FRAMES = 5
DISTANCE, STEP = 1.5, 0.03
"""Of the card from the camera, and its way from frame to frame, to the right, metres."""
TRACKED = Settings(GaussNewton(iterations=(0, 15, 0, 0, 20)), odometry=OdometryOptions(recover=False, bodies="track"))
"""Of a program that other tests use, too."""
IGNORED = replace(TRACKED, odometry=replace(TRACKED.odometry, bodies="off"))


class Carded:
    """A still camera before a room; a textured card that covers a sixth of the image moves to the right, and stops."""

    name, camera, ground_truth = "card", CAMERA, None

    def __init__(self, moves: bool = True, stops: int = FRAMES) -> None:
        self.scene = SyntheticSequence(frames=1, camera=CAMERA)[0]
        self.timestamps = np.arange(FRAMES) / 30
        rng = np.random.default_rng(0)
        blotches = [
            cv2.resize(rng.normal(0, 60, (n, 2 * n)), (144, 108), interpolation=cv2.INTER_CUBIC) for n in (6, 15)
        ]
        self.texture = np.clip(blotches[0] + 0.5 * blotches[1] + 120, 10, 240)
        self.steps = np.minimum(np.arange(FRAMES), stops) * moves

    def __len__(self) -> int:
        return FRAMES

    def mask(self, index: int) -> np.ndarray:
        """Pixels of the card."""
        left = 60 + CAMERA.fx * STEP / DISTANCE * self.steps[index]
        mask = np.zeros((CAMERA.height, CAMERA.width), bool)
        mask[40:148, round(left) : round(left) + 144] = True
        return mask

    def __getitem__(self, index: int) -> Frame:
        left = 60 + CAMERA.fx * STEP / DISTANCE * self.steps[index]
        grey, depth = self.scene.grey.astype(float), np.array(self.scene.depth)
        on = self.mask(index)
        v, u = np.nonzero(on)
        column = np.clip(u - left, 0, 142)
        low = np.floor(column).astype(int)
        part, rows = column - low, self.texture[v - 40]
        places = np.arange(len(u))
        grey[on] = (1 - part) * rows[places, low] + part * rows[places, low + 1]
        depth[on] = round(DISTANCE * CAMERA.depth_scale)
        return Frame(grey.round().astype(np.uint8), depth, timestamp=float(self.timestamps[index]))


def field(*boxes: tuple[slice, slice]) -> np.ndarray:
    image = np.full((60, 80), -1.0, np.float32)
    for box in boxes:
        image[box] = 1.0
    return image


BOX, OTHER, THIN = np.s_[10:30, 10:30], np.s_[35:55, 50:75], np.s_[0:60, 40:43]


def run(sequence: Any, settings: Settings) -> list[Step]:
    return list(track(sequence, odometry=Odometry(CAMERA, settings)))


@partial(jax.jit, static_argnames="levels")
def view(grey: jax.Array, depth: jax.Array, levels: Levels) -> View:
    """Of one image."""
    return view_of(prepare_target(build_pyramid(grey, depth, CAMERA.depth_scale), levels), levels, jnp.zeros(6))


def beliefs(sequence: Carded) -> list[Belief]:
    """What the true motion, none, makes of each frame after the first."""
    segmenter = MotionSegmenter(CAMERA, TRACKED)
    views = [view(frame.grey, frame.depth, segmenter.levels) for frame in map(sequence.__getitem__, range(FRAMES))]
    known, found = jnp.zeros(segmenter.size), []
    for before, here in pairwise(views):
        others = jax.tree.map(lambda leaf: leaf[None], before)
        found.append(form_belief(here, others, jnp.eye(4)[None], segmenter.camera, known, carried=True))
        known = found[-1].known
    return found


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


def test_what_is_at_rest_supports_the_motion() -> None:
    moving, still = beliefs(Carded())[-1], beliefs(Carded(moves=False))[-1]
    assert float(still.contradicted) == 0 and float(still.support) > 0.9
    assert not np.any(np.asarray(still.moving) > 0)
    assert float(moving.support) < 0.98


def test_a_motion_in_the_camera_is_one_in_the_world() -> None:
    step = np.eye(4)
    step[0, 3] = 0.05
    in_camera = no_alignment(AlignmentStatus.OK)._replace(target_T_reference=step)
    turned = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    seen = Seen(4, field(BOX), 0.1, np.array([0.0, 0, 2]), in_camera)
    body = in_world(seen, turned, turned, (120, 160))
    assert body.displacement == pytest.approx([0, 0.05, 0]) and body.rotation == pytest.approx(np.zeros(3))
    assert body.centroid == pytest.approx([1, 2, 5])
    assert body.mask.shape == (120, 160) and body.mask[40, 40] and not body.mask[100, 100]
    still = in_world(seen._replace(alignment=None), turned, turned, (120, 160))
    of_lost = in_world(seen, turned, None, (120, 160))
    assert np.isnan([of_lost.displacement, of_lost.rotation]).all(), "the camera's own part is not known"
    pose, status = np.eye(4), no_alignment(AlignmentStatus.OK)
    rows = body_rows(Step(1, 0.0, 0.1, status, pose, 1.0, False, bodies=(body, still)))
    assert all(len(row) == len(BODY_COLUMNS) for row in rows)
    assert rows[0][0] == "0.100000" and rows[0][-1] == "ok" and rows[1][-1] == "seen"
    assert float(rows[0][BODY_COLUMNS.index("dy")]) == 0.05 and np.isnan(float(rows[1][BODY_COLUMNS.index("dx")]))


def test_a_bodys_motion_is_its_own_under_a_rolling_shutter() -> None:
    """Rows see a body go its own way: moved to the frame's moment along the camera's, it was off by 8 mm and 1.3°."""
    sequence = SyntheticSequence(14, camera=replace(CAMERA, readout=0.03), bodies=1)
    world_T_first, truth = sequence.ground_truth.world_T_camera[0], sequence.bodies_truth[0].world_T_part[0]
    apart, turned = [], []
    for step in track(sequence, TRACKED):
        for body in step.bodies[:1]:
            if not np.isfinite(body.displacement).all():
                continue
            moved = truth[step.index] @ np.linalg.inv(truth[step.index - 1])
            moved = np.linalg.inv(world_T_first) @ moved @ world_T_first
            before = np.linalg.inv(moved) @ np.append(body.centroid, 1.0)
            apart.append(np.linalg.norm(body.displacement - body.centroid + before[:3]))
            turned.append(np.linalg.norm(cv2.Rodrigues(moved[:3, :3].T @ cv2.Rodrigues(body.rotation)[0])[0]))
    assert len(apart) > 3
    assert np.median(apart) < 0.002 and np.median(turned) < np.radians(0.3)


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


def test_a_suspicion_spreads_to_what_comes_into_view_of_its_surface_and_no_further() -> None:
    shape = 1, 20, 30
    columns = np.arange(30)
    near = np.broadcast_to(np.where(columns < 15, 1.0, 0.4), shape[1:]).astype(np.float32)
    place = np.stack(np.meshgrid(columns.astype(np.float32), np.arange(20, dtype=np.float32)))[None]
    seen = np.broadcast_to((columns >= 6).astype(np.float32), shape)
    nothing, one = np.zeros(shape, np.float32), np.ones(shape, np.float32)
    evidence = PixelEvidence(nothing, nothing, nothing, seen, one, near, place)  # pyright: ignore[reportArgumentType]
    before = np.broadcast_to(((columns >= 6) & (columns < 15)).astype(np.float32), shape[1:])
    after = np.asarray(follow(jnp.asarray(before), evidence, jnp.zeros(shape[1:])))
    np.testing.assert_array_equal(after, np.broadcast_to(columns < 15, shape[1:]))
    nobody = np.asarray(follow(jnp.zeros(shape[1:]), evidence, jnp.zeros(shape[1:])))
    assert not nobody.any()


def test_a_suspicion_of_what_was_not_measured_says_nothing_of_the_surface_that_shows_there_next() -> None:
    """In the sensor's shadow beside a body: the wall that came into view there lost its points for half a second."""
    shape = 1, 20, 30
    columns = np.arange(30)
    near = np.broadcast_to(np.where(columns < 15, 1.0, 0.4), shape[1:]).astype(np.float32)
    place = np.stack(np.meshgrid(columns.astype(np.float32), np.arange(20, dtype=np.float32)))[None]
    nothing, one = np.zeros(shape, np.float32), np.ones(shape, np.float32)
    measured = np.broadcast_to((columns < 15).astype(np.float32), shape)
    evidence = PixelEvidence(nothing, nothing, nothing, one, measured, near, place)  # pyright: ignore[reportArgumentType]
    before = np.broadcast_to((columns < 20).astype(np.float32), shape[1:])
    after = np.asarray(follow(jnp.asarray(before), evidence, jnp.zeros(shape[1:])))
    np.testing.assert_array_equal(after, np.broadcast_to(columns < 15, shape[1:]))


def test_a_suspicion_fades_ends_where_all_is_at_rest_and_is_not_learnt_from_a_wrong_motion() -> None:
    body = field(BOX) > 0
    belief = beliefs(Carded(moves=False))[0]._replace(
        known=np.where(field(OTHER) > 0, -0.9, 0.5), suspected=np.ones((60, 80))
    )  # pyright: ignore
    after = suspect(belief, body, 1 / 30, trusted=True)
    assert np.all(after[body] == 1) and not np.any(after[field(OTHER) > 0]) and 0.9 < after[0, 0] < 1
    assert suspect(belief, body, 0.2, trusted=True)[0, 0] == pytest.approx(after[0, 0] ** 6, rel=1e-5), "by the clock"
    nobody = belief._replace(suspected=np.zeros((60, 80)))  # pyright: ignore
    assert not np.any(suspect(nobody, body, 1 / 30, trusted=False))


@pytest.mark.parametrize(("rate", "frames"), [(30, 7), (10, 3), (5, 2)])
def test_the_oldest_view_is_of_about_a_quarter_of_a_second_ago_at_any_frame_rate(rate: int, frames: int) -> None:
    """Counted in frames it lay two seconds back where there are five a second, and all the drift since was a body."""
    segmenter = MotionSegmenter(CAMERA, TRACKED)
    tracker = Search(CAMERA, TRACKED, jax.random.key(0)).start(SyntheticSequence(frames=1, camera=CAMERA)[0])
    tracker = tracker._replace(seconds=np.float32(1 / rate))
    scene, kept = segmenter.first(tracker), []
    for _ in range(frames):
        before = scene.age
        look = segmenter.look(scene, tracker, np.eye(4))
        scene = segmenter.renewed(scene, look, 1 / rate)
        kept.append(float(scene.age) > float(before))
    assert kept == [True] * (frames - 1) + [False]


def test_a_strong_body_before_a_plain_room_does_not_take_the_camera_along_from_the_first_frame_on() -> None:
    steps = run(Carded(), TRACKED)
    assert max(np.linalg.norm(step.world_T_camera[:3, 3]) for step in steps) < 1e-3
    assert np.linalg.norm(run(Carded(), IGNORED)[0].world_T_camera[:3, 3]) > 0.03


def test_no_frame_after_the_warm_up_waits_for_a_program(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kept programs are compiled once for each kind of input, wherever that lies."""
    sequence, odometry = Carded(), Odometry(CAMERA, TRACKED)
    monkeypatch.setattr(program_cache, "_loaded", {})
    odometry.warm_up()
    before = set(program_cache._loaded)
    assert {"_look", "track_frame"} <= {function.__name__ for function, *_ in before}
    for index in range(3):
        odometry.register(sequence[index], index / 30)
    assert set(program_cache._loaded) == before


@pytest.mark.parametrize(("in_view", "goes"), [(0.5, True), (0.95, False)])
def test_an_older_view_that_sees_little_of_the_image_goes_at_once(in_view: float, goes: bool) -> None:
    odometry = Odometry(CAMERA, TRACKED)
    odometry.register(Carded()[0], 0.0)
    state, segmenter = odometry.progress.tracker.first, MotionSegmenter(CAMERA, TRACKED)
    state = state._replace(tracker=state.tracker._replace(seconds=np.float32(1 / 30)))
    look = segmenter.look(state.scene, state.tracker, np.eye(4))
    belief = look.belief._replace(in_view=jnp.array([1.0, in_view]))
    scene = segmenter.renewed(state.scene, look._replace(belief=belief), 1 / 30)
    older, between = scene.views_T_last[1], jnp.eye(4).at[0, 3].set(0.1)
    scene = scene._replace(views_T_last=scene.views_T_last.at[2].set(between))
    after = segmenter.renewed(scene, segmenter.look(scene, state.tracker, np.eye(4)), 1 / 30)
    np.testing.assert_allclose(after.views_T_last[1], between if goes else older, atol=1e-6)


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


def test_a_state_keeps_its_shape() -> None:
    odometry = Odometry(CAMERA, TRACKED)
    odometry.register(Carded()[0], 0.0)
    shapes = [
        [(np.shape(leaf), np.asarray(leaf).dtype) for leaf in jax.tree.leaves(state)]
        for state in (blank_of(odometry.aligner), odometry.progress.tracker)
    ]
    assert shapes[0] == shapes[1]


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


def test_what_is_thin_is_no_body() -> None:
    nowhere = np.zeros((60, 80), bool)
    assert set(np.unique(body_components(field(BOX, THIN), field(BOX, THIN), nowhere))) == {0, 1}
    assert not np.any(body_components(field(THIN), field(THIN), nowhere))


def test_a_body_that_was_known_needs_less() -> None:
    nowhere, there = np.zeros((60, 80), bool), field(BOX) > 0
    little = 0.2 * field(BOX)
    assert not np.any(body_components(field(BOX), little, nowhere))
    assert np.any(body_components(field(BOX), little, there))


def test_the_largest_part_needs_less_where_depth_disagrees() -> None:
    nowhere, both = np.zeros((60, 80), bool), field(BOX, OTHER)
    little = 0.25 * both
    assert not np.any(body_components(both, little, nowhere))
    assert set(np.unique(body_components(both, little, nowhere, depth_disagrees=True))) == {0, 1}
    assert not np.any(body_components(both, 0.05 * both, nowhere, depth_disagrees=True))


def test_points_that_are_left_out_are_not_asked_for() -> None:
    """A body's own search has few points, each with a reading: there is depth enough."""
    segmenter = MotionSegmenter(CAMERA, TRACKED)
    mask = np.ones(segmenter.size, bool)
    mask[: segmenter.size[0] // 4] = False
    state = blank_state(CAMERA, TRACKED.solver, TRACKED.alignment)
    assert float(state.share) == 1 and float(segmenter.without(state, mask).share) == pytest.approx(0.25)


@pytest.mark.parametrize("status", [AlignmentStatus.OK, AlignmentStatus.LOW_TEXTURE])
def test_what_a_bodys_images_do_not_tell_is_not_its_last_motion(
    status: AlignmentStatus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next motion is judged by it, and its search begins there."""
    xi = np.full(6, 0.01, np.float32)
    found = no_alignment(status)._replace(xi=xi)
    monkeypatch.setattr(motions, "_align", lambda *_: found)
    search = Search(CAMERA, TRACKED, jax.random.key(0))
    aware = BodyAware(search, search)
    blank = aware.blank_state()
    part = np.zeros(aware.segmenter.size, bool)
    part[10:30, 10:30] = True
    before = associate(part.astype(np.int32), BodyTracks.empty(part.shape))
    state = blank._replace(scene=blank.scene._replace(tracks=before))
    belief: Any = SimpleNamespace(moving=part.astype(np.float32))
    frame: Any = None
    clock = Clock(np.float32(1 / 30), np.float32(0), np.uint32(1))
    nearness = np.ones(part.shape)
    tracks, seen = motions.find_motions(aware, state, frame, clock, part.astype(np.int32), belief, nearness)
    assert seen[0].alignment is found
    kept = tracks.motions[list(tracks.numbers).index(seen[0].number)]
    np.testing.assert_array_equal(kept, xi if status is AlignmentStatus.OK else np.zeros(6))


def test_bodies_keep_their_numbers() -> None:
    nowhere = np.zeros((60, 80), bool)
    both = body_components(field(BOX, OTHER), field(BOX, OTHER), nowhere)
    tracks = associate(both, BodyTracks.empty((60, 80)))
    number = tracks.labels[20, 20]
    moved = np.s_[12:32, 14:34]
    alone = associate(body_components(field(moved), field(moved), nowhere), tracks)
    assert alone.labels[20, 20] == number
    again = associate(both, alone)
    assert set(again.numbers[again.numbers > 0]) == {1, 2} and again.labels[20, 20] == number
