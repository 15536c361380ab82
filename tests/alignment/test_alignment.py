"""Motions between two frames: accuracy, direction, batches, what is said of pairs that cannot be aligned."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small import CAMERA, NEWTON

from gavo_jax import presets
from gavo_jax.alignment import pairs
from gavo_jax.alignment.information import Information
from gavo_jax.alignment.judgement import Examination, find_against
from gavo_jax.alignment.pairs import align, align_batch
from gavo_jax.alignment.result import Alignment
from gavo_jax.alignment.stacking import stacked_images
from gavo_jax.alignment.visits import levels_of, prepare_pair, stack_levels, visited_levels
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.sensor_noise import NONE
from gavo_jax.datasets.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.image.levels import Levels
from gavo_jax.image.pyramid import LEVELS, build_pyramid
from gavo_jax.objective.derivatives import Linearization
from gavo_jax.objective.error import Scales
from gavo_jax.objective.estimates import ExplainedShare
from gavo_jax.odometry.driver import Odometry
from gavo_jax.presets import METHODS, PRESETS
from gavo_jax.se3 import exp
from gavo_jax.settings import AlignmentOptions, Settings
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.solvers.genetic import GeneticAlgorithm
from gavo_jax.status import AlignmentStatus, as_findings, bit, gravest

FRAMES = (0, 1, 8, 9, 14, 15, 22, 23)
Images = tuple[np.ndarray, np.ndarray]
"""Grey and depth."""
PAIRS = ((0, 1), (1, 0), (8, 9), (14, 15), (22, 23))


@pytest.fixture(scope="module")
def sequence() -> SyntheticSequence:
    """Noise-free, 640 x 480."""
    return SyntheticSequence(frames=30, noise=NONE)


@pytest.fixture(scope="module")
def frames(sequence: SyntheticSequence) -> dict[int, Frame]:
    return {i: sequence[i] for i in FRAMES}


@pytest.fixture(scope="module")
def small_frames() -> dict[int, Frame]:
    """Of the same room, 160 x 120: for what any search shows."""
    small = SyntheticSequence(frames=30, noise=NONE, camera=CAMERA)
    return {i: small[i] for i in (0, 1, 8, 9)}


def target_T_reference(sequence: SyntheticSequence, reference: int, target: int) -> np.ndarray:
    world_T_camera = sequence.ground_truth.world_T_camera
    return np.linalg.inv(world_T_camera[target]) @ world_T_camera[reference]


def difference(estimate: Any, truth: np.ndarray) -> tuple[float, float]:
    """Metres and degrees between two motions."""
    delta = np.linalg.inv(truth) @ np.asarray(estimate, np.float64)
    sine = np.linalg.norm(delta[:3, :3] - delta[:3, :3].T) / np.sqrt(8)
    return float(np.linalg.norm(delta[:3, 3])), float(np.degrees(np.arctan2(sine, (np.trace(delta[:3, :3]) - 1) / 2)))


def run(method: str, reference: Frame | Images, target: Frame | Images, camera: Camera, seed: int = 0) -> Alignment:
    """Align by a method's default preset."""
    return align(reference, target, camera, presets.preset(method), key=jax.random.key(seed))


@pytest.mark.parametrize("reference, target", PAIRS)
@pytest.mark.parametrize("method", ["ga", "gauss-newton"])
def test_recovers_an_exact_motion(
    method: str, reference: int, target: int, sequence: SyntheticSequence, frames: dict[int, Frame]
) -> None:
    result = run(method, frames[reference], frames[target], sequence.camera)
    metres, degrees = difference(result.target_T_reference, target_T_reference(sequence, reference, target))
    assert metres < 0.0005 and degrees < 0.02
    assert result.status is AlignmentStatus.OK
    assert 0.9 < result.overlap <= 1


def test_the_symmetric_error_does_not_care_which_frame_is_the_reference(
    sequence: SyntheticSequence, small_frames: dict[int, Frame]
) -> None:
    start, far = small_frames[0], SyntheticSequence(frames=30, camera=CAMERA)[9]
    truth = target_T_reference(sequence, 0, 9)

    def there_and_back(symmetric: bool) -> tuple[float, float]:
        settings = replace(NEWTON, alignment=replace(NEWTON.alignment, symmetric=symmetric))
        there = align(start, far, CAMERA, settings, guess=truth)
        back = align(far, start, CAMERA, settings, guess=np.linalg.inv(truth))
        return difference(back.target_T_reference, np.linalg.inv(np.asarray(there.target_T_reference, float)))

    one_way, both_ways = there_and_back(False), there_and_back(True)
    assert both_ways[0] < one_way[0] / 5 and both_ways[1] < one_way[1] / 5
    assert one_way[0] > 1e-4


def test_coarse_levels_see_the_first_view_alone(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    camera, options = sequence.camera, AlignmentOptions(views=(2, 2, 1, 1, 1))

    @jax.jit
    def stacked(grey: jax.Array, depth: jax.Array) -> tuple[jax.Array, jax.Array]:
        pyramid = build_pyramid(grey, depth, camera.depth_scale)
        searched = Levels.of(camera, (2, 1), options.points)
        view, *_ = prepare_pair(pyramid, pyramid, camera, searched, options)
        levels = stack_levels((view, view), camera, searched, options)
        return levels.views, levels.reference.points.q

    views, q = stacked(jnp.asarray(frames[0].grey), jnp.asarray(frames[0].depth))
    assert views.tolist() == [1, 2]
    has_reading = np.asarray(q > 0).any(axis=-1)
    assert has_reading.tolist() == [[True, False], [True, True]]


def test_a_last_step_centres_what_a_short_search_leaves(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    solver = GeneticAlgorithm(population=16, iterations=(0, 2, 3, 8, 10))
    truth = target_T_reference(sequence, 0, 1)

    def off(last_step: bool) -> tuple[list[float], list[float]]:
        settings = Settings(solver, AlignmentOptions(last_step=last_step, depth=False))
        found = [align(frames[0], frames[1], sequence.camera, settings, key=jax.random.key(k)) for k in range(5)]
        return [difference(a.target_T_reference, truth)[0] for a in found], [float(a.error) for a in found]

    (with_step, error), (without, error_before) = off(True), off(False)
    assert np.median(with_step) < 0.7 * np.median(without)
    assert np.all(np.array(error) <= 1.003 * np.array(error_before))


def test_what_won_is_refined_on_all_levels(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    options = AlignmentOptions(islands=(1, 1, 1, 1, 3), scouts=32, refine=True)
    assert visited_levels((4, 3), options) == (4,)
    assert visited_levels((4, 3), replace(options, refine=False)) == (4, 3)
    wide = presets.preset("ga", "wide")
    searched = visited_levels(wide.solver.levels, wide.alignment)
    assert searched == (4, 3) and wide.solver.levels[-1] == 1
    result = wide_search(frames[0], frames[1], sequence.camera)
    assert result.history.shape == (sum(wide.solver.iterations[level] for level in searched),)
    assert difference(result.target_T_reference, target_T_reference(sequence, 0, 1))[0] < 0.01


def test_the_result_tells_all(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    result = run("ga", frames[0], frames[1], sequence.camera)
    solver = presets.preset("ga").solver
    assert result.target_T_reference.shape == (4, 4) and result.covariance.shape == (6, 6)
    assert result.target_T_reference.dtype == np.float64
    numbers = result._replace(status=np.float32(0), findings=np.float32(0))
    assert all(np.asarray(field).dtype == np.float32 for field in numbers[1:])
    np.testing.assert_allclose(exp(result.xi), result.target_T_reference, atol=1e-6)
    np.testing.assert_array_equal(result.target_T_reference[3], [0, 0, 0, 1])
    assert result.error > 0
    assert result.history.shape == (sum(solver.iterations),)
    ends = np.cumsum([solver.iterations[level] for level in solver.levels])
    for part in np.split(result.history, ends[:-1]):
        part = part[np.isfinite(part)]
        assert len(part) and np.all(np.diff(part) <= 0)
    assert result.status.sentence.endswith(".")


def test_the_inverse_is_the_cameras_motion(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    world_T_camera = sequence.ground_truth.world_T_camera
    result = run("gauss-newton", frames[8], frames[9], sequence.camera)
    moved = world_T_camera[8] @ np.linalg.inv(result.target_T_reference)
    assert np.abs(moved - world_T_camera[9]).max() < 1e-3
    step = world_T_camera[9, :3, 3] - world_T_camera[8, :3, 3]
    assert (moved[:3, 3] - world_T_camera[8, :3, 3]) @ step > 0.9 * step @ step


@pytest.mark.parametrize(
    ("scale", "asked", "status"),
    [
        (1.0, 100, AlignmentStatus.OK),
        (1.001, 100, AlignmentStatus.NOT_RIGID),
        (1.0, 1900, AlignmentStatus.OK),
        (1.0, 2100, AlignmentStatus.NO_DEPTH),
    ],
)
def test_what_speaks_against_a_motion_whatever_the_images(scale: float, asked: int, status: AlignmentStatus) -> None:
    """It is not rigid; or of the points that were asked for too few have a reading."""
    motion = np.diag([scale, scale, scale, 1.0]).astype(np.float32)
    model = Linearization(jnp.float32(20.0), jnp.float32(0.9), jnp.zeros(6), 1e4 * jnp.eye(6))
    points = SimpleNamespace(q=jnp.ones(100))
    information = Information(jnp.eye(6), 1e4 * jnp.ones(6), jnp.ones(6, bool))
    explained = ExplainedShare(jnp.float32(1.0), jnp.float32(1.0))
    reference = SimpleNamespace(points=points, grey=jnp.arange(100.0))
    objective: Any = SimpleNamespace(scales=Scales.unit(), reference=reference)

    @jax.jit
    def judge(motion: jax.Array) -> jax.Array:
        examination = Examination(motion, jnp.float32(100.0), model, jnp.eye(6), information, explained)
        return gravest(
            as_findings(
                find_against(examination, 1e-6 * jnp.eye(6), objective, jnp.float32(np.inf), jnp.float32(asked))
            )
        )

    assert AlignmentStatus(int(judge(motion))) is status


def test_covariance_is_one(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    for method in ("ga", "gauss-newton"):
        covariance = np.asarray(run(method, frames[0], frames[1], sequence.camera).covariance, float)
        np.testing.assert_array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > 0
        deviation = np.sqrt(np.diag(covariance))
        assert np.all(deviation < 0.02) and np.all(deviation > 1e-7)


def test_covariance_covers_the_error_under_noise(sequence: SyntheticSequence) -> None:
    noisy = SyntheticSequence(frames=30)
    distances = []
    for i in range(0, 12, 2):
        result = run("gauss-newton", noisy[i], noisy[i + 1], noisy.camera)
        delta = np.linalg.inv(np.asarray(result.target_T_reference, float)) @ target_T_reference(noisy, i, i + 1)
        small = np.array([*delta[:3, 3], delta[2, 1], delta[0, 2], delta[1, 0]])
        distances.append(small @ np.linalg.solve(np.asarray(result.covariance, float), small))
    # chi-square with six degrees of freedom has a median of 5.3
    assert 1 < np.median(distances) < 20


def test_same_key_same_bits(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    first, second, other = (run("ga", frames[0], frames[1], sequence.camera, seed) for seed in (3, 3, 4))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.any(first.xi != other.xi)


@pytest.fixture(scope="module")
def batch(sequence: SyntheticSequence, frames: dict[int, Frame]) -> Alignment:
    """Two pairs by the default genetic algorithm."""
    references, targets = ([frames[i] for i in side] for side in ((0, 8), (1, 9)))
    return align_batch(references, targets, sequence.camera, keys=jax.random.split(jax.random.key(5), 2))


def test_a_batch_is_on_the_host_and_rigid(batch: Alignment) -> None:
    rotation = batch.target_T_reference[:, :3, :3]
    assert isinstance(rotation, np.ndarray) and rotation.dtype == np.float64
    np.testing.assert_allclose(rotation.swapaxes(1, 2) @ rotation, np.broadcast_to(np.eye(3), (2, 3, 3)), atol=1e-14)


def test_a_batch_is_its_pairs(batch: Alignment, sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    keys = jax.random.split(jax.random.key(5), 2)
    for i, (reference, target) in enumerate(((0, 1), (8, 9))):
        single = align(frames[reference], frames[target], sequence.camera, key=keys[i])
        assert AlignmentStatus(int(batch.status[i])) is single.status
        for name in ("target_T_reference", "xi", "error", "overlap", "covariance", "history"):
            np.testing.assert_array_equal(getattr(batch, name)[i], getattr(single, name))


def test_a_batch_of_arrays_is_a_batch_of_frames(
    batch: Alignment, sequence: SyntheticSequence, frames: dict[int, Frame]
) -> None:
    def stacked(indices: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        chosen = [frames[i] for i in indices]
        return np.stack([f.grey for f in chosen]), np.stack([f.depth for f in chosen])

    keys = jax.random.split(jax.random.key(5), 2)
    again = align_batch(stacked((0, 8)), stacked((1, 9)), sequence.camera, keys=keys)
    for a, b in zip(batch, again, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("put", [np.asarray, jnp.asarray])
def test_depth_that_is_no_number_is_no_reading_however_it_comes(put: Any) -> None:
    grey, depth = np.zeros((2, 120, 160), np.float32), np.ones((2, 120, 160), np.float32)
    depth[0, 0], depth[0, 1] = np.inf, np.nan
    camera = Camera(131.0, 131.0, 79.5, 59.5, 160, 120)
    for side in ((put(grey), put(depth)), [(put(grey[i]), put(depth[i])) for i in range(2)]):
        cleaned = np.asarray(stacked_images(side, camera).depth)
        assert not cleaned[0, :2].any() and (cleaned[0, 2:] == 1).all() and (cleaned[1] == 1).all()


def test_a_batch_of_two_pairs_of_images_is_no_stack_of_them(
    batch: Alignment, sequence: SyntheticSequence, frames: dict[int, Frame]
) -> None:
    references, targets = (tuple((frames[i].grey, frames[i].depth) for i in side) for side in ((0, 8), (1, 9)))
    again = align_batch(references, targets, sequence.camera, keys=jax.random.split(jax.random.key(5), 2))
    for a, b in zip(batch, again, strict=True):
        np.testing.assert_array_equal(a, b)


def test_an_accelerator_aligns_a_batch_in_chunks(
    small_frames: dict[int, Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = ((0, 1), (8, 9), (1, 0))
    expected = [align(small_frames[i], small_frames[j], CAMERA, NEWTON) for i, j in shown]
    as_on_a_cpu = pairs._align_pairs._function
    monkeypatch.setattr(pairs, "_align_pairs", jax.jit(lambda *given: as_on_a_cpu(*given)))  # to be traced anew
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(
        pairs, "POINTS_SIDE_BY_SIDE", 2 * levels_of(CAMERA, NEWTON.solver, NEWTON.alignment).most_points + 1
    )
    sizes, plain = [], jax.lax.map

    def noted(function: Callable[..., Any], rows: Any, batch_size: int) -> Any:
        sizes.append(batch_size)
        return plain(function, rows, batch_size=batch_size)

    monkeypatch.setattr(jax.lax, "map", noted)
    references, targets = ([small_frames[pair[side]] for pair in shown] for side in (0, 1))
    found = align_batch(references, targets, CAMERA, NEWTON)
    assert sizes == [2]
    assert found.xi.shape == (3, 6)
    np.testing.assert_allclose(found.target_T_reference, [one.target_T_reference for one in expected], atol=1e-5)
    np.testing.assert_array_equal(found.status, [one.status for one in expected])


def test_arrays_of_metres_are_frames_of_raw_depth(small_frames: dict[int, Frame]) -> None:
    metres = replace(CAMERA, depth_scale=1.0)
    images = [(small_frames[i].grey, small_frames[i].depth.astype(np.float32) / np.float32(5000)) for i in (0, 1)]
    metric = align(images[0], images[1], metres, NEWTON)
    raw = align(small_frames[0], small_frames[1], CAMERA, NEWTON)
    np.testing.assert_allclose(metric.target_T_reference, raw.target_T_reference, atol=1e-5)
    on_device = [(jnp.asarray(grey), jnp.asarray(depth)) for grey, depth in images]
    again = align(on_device[0], on_device[1], metres, NEWTON)
    np.testing.assert_array_equal(again.target_T_reference, metric.target_T_reference)


def test_a_guess_is_where_the_search_starts(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    truth = target_T_reference(sequence, 0, 23)
    blind = align(frames[0], frames[23], sequence.camera, solver=GaussNewton())
    guided = align(frames[0], frames[23], sequence.camera, solver=GaussNewton(), guess=jnp.asarray(truth, jnp.float32))
    metres, degrees = difference(guided.target_T_reference, truth)
    assert metres < 0.005 and degrees < 0.1
    assert difference(blind.target_T_reference, truth) > (metres, degrees)


def test_lens_distortion_is_taken_out(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    camera = replace(sequence.camera, distortion=(0.2, -0.7, -0.004, 0.002, 0.9))
    plain = [camera.undistort(frames[i].grey, frames[i].depth) for i in (0, 1)]
    expected = align(plain[0], plain[1], sequence.camera, solver=GaussNewton())
    found = align(frames[0], frames[1], camera, solver=GaussNewton())
    np.testing.assert_array_equal(found.target_T_reference, expected.target_T_reference)


def black(frame: Frame) -> Frame:
    return replace(frame, grey=np.zeros_like(frame.grey))


def blind(frame: Frame) -> Frame:
    return replace(frame, depth=np.zeros_like(frame.depth))


def upside_down(frame: Frame) -> Frame:
    return replace(frame, grey=frame.grey[::-1, ::-1].copy(), depth=frame.depth[::-1, ::-1].copy())


def blank(frame: Frame) -> Frame:
    return replace(frame, grey=np.full_like(frame.grey, 128))


SPOILT = [(spoil, side) for spoil in (black, blank, upside_down, blind) for side in ("reference", "target", "both")]
# enough is known of these two: grey alone finds the motion, and so it does when the world stands on its head
SPOILT = [case for case in SPOILT if case not in ((blind, "target"), (upside_down, "both"))]


@pytest.mark.parametrize("spoil, side", SPOILT)
@pytest.mark.parametrize("method", ["ga", "gauss-newton"])
def test_what_cannot_be_aligned_is_not_ok(
    spoil: Callable[[Frame], Frame],
    side: str,
    method: str,
    sequence: SyntheticSequence,
    frames: dict[int, Frame],
) -> None:
    reference = spoil(frames[0]) if side in ("reference", "both") else frames[0]
    target = spoil(frames[1]) if side in ("target", "both") else frames[1]
    result = run(method, reference, target, sequence.camera)
    assert result.status is not AlignmentStatus.OK or is_right(result, sequence)
    if spoil is blind:
        assert result.status is AlignmentStatus.NO_DEPTH


def is_right(result: Alignment, sequence: SyntheticSequence) -> bool:
    """Whether the motion was found in spite of all, say from depth alone."""
    metres, degrees = difference(result.target_T_reference, target_T_reference(sequence, 0, 1))
    return metres < 0.005 and degrees < 0.3


def test_frames_of_two_rooms_are_not_ok(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    elsewhere = SyntheticSequence(frames=30, noise=NONE, seed=11)[15]
    for method in ("ga", "gauss-newton"):
        assert run(method, frames[0], elsewhere, sequence.camera).status is not AlignmentStatus.OK


def test_a_target_without_depth_is_aligned_by_its_grey(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    result = run("gauss-newton", frames[0], blind(frames[1]), sequence.camera)
    metres, degrees = difference(result.target_T_reference, target_T_reference(sequence, 0, 1))
    assert metres < 0.002 and degrees < 0.05


def test_nothing_but_numbers_comes_out_of_nothing(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    result = run("gauss-newton", blind(black(frames[0])), blind(black(frames[1])), sequence.camera)
    assert np.isfinite(result.target_T_reference).all()
    assert result.status is not AlignmentStatus.OK


def grey_of(value: int) -> Callable[[Images], Images]:
    return lambda images: (np.full_like(images[0], value), images[1])


def in_metres(images: Images) -> Images:
    return images[0], (images[1] / CAMERA.depth_scale).astype(np.float32)


@pytest.mark.parametrize(
    ("spoil", "finding"),
    [
        (grey_of(0), AlignmentStatus.BLANK),
        (grey_of(255), AlignmentStatus.BLANK),
        (in_metres, AlignmentStatus.DEPTH_UNITS),
        (lambda images: (np.where(images[0] > 200, np.nan, images[0]), images[1]), AlignmentStatus.NOT_FINITE),
    ],
)
def test_what_an_image_says_by_itself_is_told(
    spoil: Callable[[Images], Images], finding: AlignmentStatus, small_frames: dict[int, Frame]
) -> None:
    """A white target and depth in metres where raw numbers belong were `ok`."""
    before, after = ((small_frames[i].grey, small_frames[i].depth) for i in (0, 1))
    for pair in ((before, spoil(after)), (spoil(before), spoil(after))):
        result = align(*pair, CAMERA, NEWTON)
        assert result.status is not AlignmentStatus.OK and finding in result.statuses
    batch = align_batch([before, before], [after, spoil(after)], CAMERA, NEWTON)
    assert batch.status[0] == AlignmentStatus.OK and int(batch.findings[1]) & bit(finding)


def test_what_is_no_frame_is_refused_by_name(small_frames: dict[int, Frame]) -> None:
    frame = small_frames[0]
    with pytest.raises(GavoError, match="pair \\(grey, depth\\), not ndarray"):
        align(frame.grey, frame.depth, CAMERA, NEWTON)  # pyright: ignore[reportArgumentType]
    with pytest.raises(GavoError, match="frame_of"):
        align((np.repeat(frame.grey[..., None], 3, axis=2), frame.depth), frame, CAMERA, NEWTON)
    with pytest.raises(GavoError, match="alignment.loss: must be a function, not 'huber'"):
        align(frame, frame, CAMERA, Settings(NEWTON.solver, AlignmentOptions(loss="huber")))  # pyright: ignore


def test_what_does_not_belong_to_the_frames_is_refused_by_name(small_frames: dict[int, Frame]) -> None:
    """These ended in the middle of the search, with words of arrays that nobody had given."""
    frame = small_frames[0]
    bright = frame.grey / np.float32(255.0)
    two, key = [frame, frame], jax.random.key(0)
    calls: list[tuple[str, Callable[[], Any]]] = [
        ("Camera is needed, not str", lambda: align(frame, frame, "fr1", NEWTON)),  # pyright: ignore
        ("multiply by 255", lambda: align((bright, frame.depth), frame, CAMERA, NEWTON)),
        ("multiply by 255", lambda: align_batch((bright[None], frame.depth[None]), [frame], CAMERA, NEWTON)),
        ("key is needed", lambda: align(frame, frame, CAMERA, NEWTON, key=5)),  # pyright: ignore
        ("guesses are of shape", lambda: align(frame, frame, CAMERA, NEWTON, guess=np.zeros(6))),
        ("guesses are of shape", lambda: align_batch(two, two, CAMERA, NEWTON, guesses=np.eye(4))),
        ("guesses are of shape", lambda: align_batch(two, two, CAMERA, NEWTON, guesses=np.tile(np.eye(4), (3, 1, 1)))),
        ("one per pair", lambda: align_batch(two, two, CAMERA, NEWTON, keys=key)),
        ("one per pair", lambda: align_batch(two, two, CAMERA, NEWTON, keys=jax.random.split(key, 3))),
    ]
    for words, call in calls:
        with pytest.raises(GavoError, match=words):
            call()


@pytest.mark.parametrize(("width", "height"), [(1, 640), (640, 1), (15, 20)])
def test_images_too_small_for_a_pyramid_are_refused(width: int, height: int) -> None:
    camera = Camera(100.0, 100.0, width / 2, height / 2, width, height)
    frame = np.zeros((height, width), np.uint8), np.zeros((height, width), np.uint16)
    for name in ("default", "wide"):
        with pytest.raises(GavoError, match="16 pixels"):
            align(frame, frame, camera, presets.preset("ga", name))
    with pytest.raises(GavoError, match="16 pixels"):
        Odometry(camera)


def test_wrong_sizes_are_refused(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    camera, frame = sequence.camera, frames[0]
    cut = replace(frame, depth=frame.depth[:-1])
    coloured = (np.zeros((480, 640, 3), np.uint8), frame.depth)
    for reference, target in ((cut, frame), (frame, cut), (coloured, frame), (frame, (frame.grey, frame.grey[:5]))):
        with pytest.raises(GavoError, match="shape"):
            align(reference, target, camera)
    with pytest.raises(GavoError):
        align(frame, frame, camera.level(1))
    with pytest.raises(GavoError):
        align_batch([frame, frame], [frame], camera)
    stack = np.zeros((2, 480, 640), np.uint8)
    with pytest.raises(GavoError):
        align_batch((stack, stack[:, :-1]), (stack, stack), camera)
    for nothing in ([], (stack[:0], stack[:0])):
        with pytest.raises(GavoError, match="a batch of no frames"):
            align_batch(nothing, nothing, camera)


def test_an_undetermined_direction_is_named(sequence: SyntheticSequence) -> None:
    height, width = sequence.camera.height, sequence.camera.width
    stripes = 128 + 100 * np.sin(np.arange(width) / 7.0 + 3 * np.sin(np.arange(width) / 40.0))
    depth = np.full((height, width), 2 * sequence.camera.depth_scale).astype(np.uint16)
    upright = np.tile(stripes.astype(np.uint8), (height, 1))
    result = run("gauss-newton", (upright, depth), (upright, depth), sequence.camera)
    assert result.status is AlignmentStatus.LOW_TEXTURE
    assert result.undetermined.startswith("translation along y") and result.undetermined in result.sentence
    textured = run("gauss-newton", sequence[0], sequence[1], sequence.camera)
    assert textured.undetermined == "" and textured.sentence == textured.status.sentence


def wide_search(reference: Frame | Images, target: Frame | Images, camera: Camera, **changes: Any) -> Alignment:
    wide = presets.preset("ga", "wide")
    return align(reference, target, camera, replace(wide, alignment=replace(wide.alignment, **changes)))


def wallpaper(sequence: SyntheticSequence, shift: float, repeats: bool) -> Images:
    """A wall 1 m ahead, moved by some pixels to the side; its pattern may repeat every 160 pixels."""
    height, width = sequence.camera.height, sequence.camera.width
    u, v = np.arange(width) - shift, np.arange(height)[:, None]
    phase = 2 * np.pi * u / 160 + 2 * np.sin(v / 60)
    grey = 110 + 50 * np.sin(phase) + (0.0 if repeats else 60 * np.sin(u / 200 + v / 90))
    clouds = np.random.default_rng(int(shift)).normal(0, 5, (24, 32))
    grey = grey + cv2.resize(clouds, (width, height), interpolation=cv2.INTER_CUBIC)
    depth = np.full((height, width), sequence.camera.depth_scale)
    return np.clip(grey, 0, 255).astype(np.uint8), depth.astype(np.uint16)


def test_a_pattern_that_repeats_is_ambiguous(sequence: SyntheticSequence) -> None:
    near = {"scout_spread": (0.15, 0.02)}
    results = [
        wide_search(wallpaper(sequence, 0, repeats), wallpaper(sequence, shift, repeats), sequence.camera, **near)
        for repeats, shift in ((True, 80), (False, 40))
    ]
    assert results[0].status is AlignmentStatus.AMBIGUOUS
    assert results[1].status is AlignmentStatus.OK
    assert abs(results[1].xi[0] - 40 / sequence.camera.fx) < 0.005


def test_exposure_does_not_hide_a_large_motion(sequence: SyntheticSequence) -> None:
    bright = frame_with(sequence[0], 40.0)
    result = wide_search(bright, sequence[14], sequence.camera)
    metres, degrees = difference(result.target_T_reference, target_T_reference(sequence, 0, 14))
    assert metres < 0.01 and degrees < 0.3


def frame_with(frame: Frame, brighter: float) -> Frame:
    return replace(frame, grey=np.clip(frame.grey + brighter, 0, 255).astype(np.uint8))


def test_statuses_say_a_sentence() -> None:
    sentences = {status.sentence for status in AlignmentStatus}
    assert len(sentences) == len(AlignmentStatus)
    assert all(sentence[0].isupper() and sentence.endswith(".") for sentence in sentences)


def test_every_preset_has_a_solver_for_all_levels() -> None:
    for method in METHODS:
        for name in PRESETS:
            settings = presets.preset(method, name)
            assert len(settings.solver.iterations) == len(settings.alignment.islands) == LEVELS
            assert settings.solver.levels[0] == 4
    assert presets.preset("ga", "paper").solver.levels[-1] == 0
    for bad in (("simplex", "default"), ("ga", "best")):
        with pytest.raises(GavoError, match="unknown"):
            presets.preset(*bad)


def test_bounds_are_inputs_of_the_program(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    """Half-widths that shut the true motion out show in the result, without a second compilation."""
    options = AlignmentOptions(bounds=(0.001, 0.001))
    result = align(frames[0], frames[1], sequence.camera, Settings(GaussNewton(), options))
    metres, degrees = difference(result.target_T_reference, np.eye(4))
    true_metres, true_degrees = difference(target_T_reference(sequence, 0, 1), np.eye(4))
    assert true_degrees > 0.3 and true_metres > 0.005
    assert degrees < 0.9 * true_degrees or metres < 0.9 * true_metres
    assert AlignmentStatus.HIGH_ERROR in result.statuses, "the search ended where it was held"


def test_a_box_that_shrinks_is_about_what_was_found(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    """Held about the first guess, a search by the last half-widths would have no candidate left."""
    options = AlignmentOptions(bounds_factor=0.1)
    result = align(frames[0], frames[1], sequence.camera, Settings(GaussNewton(), options))
    metres, degrees = difference(result.target_T_reference, target_T_reference(sequence, 0, 1))
    assert not np.isinf(result.history).any() and result.status is AlignmentStatus.OK
    assert metres < 0.003 and degrees < 0.1
