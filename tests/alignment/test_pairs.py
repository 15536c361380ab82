"""`align` and `align_batch`: accuracy, direction, batches, what is given is what is searched."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from aligning import difference, run, target_T_reference
from small import CAMERA, NEWTON

from gavo_jax import presets
from gavo_jax.alignment import pairs
from gavo_jax.alignment.pairs import align, align_batch
from gavo_jax.alignment.result import Alignment
from gavo_jax.alignment.visits import levels_of
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.se3 import exp
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.status import AlignmentStatus

PAIRS = ((0, 1), (1, 0), (8, 9), (14, 15), (22, 23))


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


def test_what_does_not_belong_to_the_frames_is_refused_by_name(small_frames: dict[int, Frame]) -> None:
    """These ended in the middle of the search, with words of arrays that nobody had given."""
    frame = small_frames[0]
    bright = frame.grey / np.float32(255.0)
    two, key = [frame, frame], jax.random.key(0)
    words: Any = "x"
    ragged: Any = [np.eye(4), np.eye(3)]
    calls: list[tuple[str, Callable[[], Any]]] = [
        ("expected a Camera, got str", lambda: align(frame, frame, "fr1", NEWTON)),  # pyright: ignore
        ("multiply by 255", lambda: align((bright, frame.depth), frame, CAMERA, NEWTON)),
        ("multiply by 255", lambda: align_batch((bright[None], frame.depth[None]), [frame], CAMERA, NEWTON)),
        ("expected a key", lambda: align(frame, frame, CAMERA, NEWTON, key=5)),  # pyright: ignore
        ("a matrix of numbers, got 'x'", lambda: align(frame, frame, CAMERA, NEWTON, guess=words)),
        ("a matrix of numbers", lambda: align_batch(two, two, CAMERA, NEWTON, guesses=ragged)),
        ("guesses have shape", lambda: align(frame, frame, CAMERA, NEWTON, guess=np.zeros(6))),
        ("guesses have shape", lambda: align_batch(two, two, CAMERA, NEWTON, guesses=np.eye(4))),
        ("guesses have shape", lambda: align_batch(two, two, CAMERA, NEWTON, guesses=np.tile(np.eye(4), (3, 1, 1)))),
        ("not a rigid motion", lambda: align(frame, frame, CAMERA, NEWTON, guess=np.diag([2.0, 2.0, 2.0, 1.0]))),
        ("not a rigid motion", lambda: align(frame, frame, CAMERA, NEWTON, guess=np.diag([-1.0, 1.0, 1.0, 1.0]))),
        ("not a rigid motion", lambda: align(frame, frame, CAMERA, NEWTON, guess=np.full((4, 4), np.nan))),
        ("guess 1 is not", lambda: align_batch(two, two, CAMERA, NEWTON, guesses=np.stack([np.eye(4), 0 * np.eye(4)]))),
        ("one per pair", lambda: align_batch(two, two, CAMERA, NEWTON, keys=key)),
        ("one per pair", lambda: align_batch(two, two, CAMERA, NEWTON, keys=jax.random.split(key, 3))),
    ]
    for words, call in calls:
        with pytest.raises(GavoError, match=words):
            call()


def test_a_guess_of_rounded_numbers_is_a_motion(small_frames: dict[int, Frame]) -> None:
    """The result was `not_rigid`, which says that the machine computes wrong numbers."""
    guess = np.array(exp(jnp.array([0.01, 0.0, 0.02, 0.03, 0.02, -0.01])), np.float64)
    found = align(small_frames[0], small_frames[1], CAMERA, NEWTON, guess=guess.round(3))
    assert AlignmentStatus.NOT_RIGID not in found.statuses
