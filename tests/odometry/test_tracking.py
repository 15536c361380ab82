"""The program for a frame: one for all of them; shutter and depth's moment, and a keyframe renewed share by share."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from driving import CAMERA, FRAME_TO_FRAME, FRAMES, PLAIN, SEARCH_ALONE, SOLVER, Altered, errors, known, run
from small import Rendered

from gavo_jax.alignment.visits import levels_of
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.sensor_noise import NONE
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.image.pyramid import build_pyramid
from gavo_jax.image.warp import Points
from gavo_jax.objective.points import make_references, move_reference
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.tracking import blank_state, first_state, renew_keyframe
from gavo_jax.se3 import exp
from gavo_jax.settings import AlignmentOptions


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


def test_shares_that_bodies_have_emptied_are_renewed() -> None:
    """Of a share that had lost all points but some, these were all in view, so that it was never renewed."""
    blank = blank_state(CAMERA, SOLVER, AlignmentOptions()).keyframe
    q = np.ones_like(blank.points.q)
    newest = blank._replace(points=blank.points._replace(q=q), grey=np.ones_like(blank.grey))
    for left, is_renewed in ((0.1, True), (0.7, False)):
        kept = np.where(np.arange(q.shape[1]) % 10 < 10 * left, q, 0.0)
        keyframe = blank._replace(points=blank.points._replace(q=kept))
        renewed = jax.jit(renew_keyframe)(keyframe, newest, CAMERA.level(1), 0.5)
        assert np.all(renewed.grey == is_renewed)


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
