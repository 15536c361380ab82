"""A frame's own velocity under a rolling shutter, told apart from the motion since the last frame."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from small import Rendered

from gavo_jax.camera import Camera
from gavo_jax.datasets.rendered.sensor_noise import NONE
from gavo_jax.datasets.rendered.synthetic import DEFAULT_CAMERA, SyntheticSequence
from gavo_jax.image.shutter import Shutter, delay, row_time, twist_flow
from gavo_jax.image.warp import Points, warp
from gavo_jax.odometry.run import OdometryRun, run_odometry
from gavo_jax.se3 import exp
from gavo_jax.settings import OdometryOptions, Settings
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.trajectory import Trajectory

CAMERA = replace(DEFAULT_CAMERA.level(1), readout=0.02)
HERTZ, RATE, PHASE = 10.0, 0.5, 0.7
"""Of a hand's tremor: times a second, and rad/s."""
SEARCH = Settings(
    GaussNewton(iterations=(0, 15, 0, 0, 20)), odometry=OdometryOptions(relight=False, recover=False, bodies="off")
)


def trembling(axis: int) -> Trajectory:
    """The room's path with a tremor about an axis of the camera."""
    seconds = np.arange(400) / 600
    path = SyntheticSequence(len(seconds), rate=600.0, noise=NONE).ground_truth
    twists = np.zeros((len(seconds), 6), np.float32)
    twists[:, 3 + axis] = RATE / (2 * np.pi * HERTZ) * np.sin(2 * np.pi * HERTZ * seconds + PHASE)
    return Trajectory(path.timestamps, path.world_T_camera @ np.asarray(exp(jnp.asarray(twists)), np.float64))


def pair_errors(run: OdometryRun, truth: Trajectory) -> np.ndarray:
    """Metres, pair by pair; the first two know nothing of the frame before."""
    found, true = (
        np.linalg.inv(path[:-1]) @ path[1:] for path in (run.trajectory.world_T_camera, truth.world_T_camera)
    )
    return np.linalg.norm((np.linalg.inv(true) @ found)[2:, :3, 3], axis=1)


@pytest.mark.parametrize(("axis", "symmetric"), [(0, False), (1, False), (0, True)])
def test_a_tremor_is_told_from_a_step_to_the_side(axis: int, symmetric: bool) -> None:
    """With the symmetric error no sway was estimated: runs of `wide` saw bodies in a static room."""
    search = replace(SEARCH, alignment=replace(SEARCH.alignment, symmetric=symmetric))
    sequence = Rendered(18, trajectory=trembling(axis), rate=30.0, camera=CAMERA, noise=NONE)
    with_sway, without = (
        run_odometry(sequence, replace(search, odometry=replace(search.odometry, sway=sway))) for sway in (True, False)
    )
    errors, mean_velocity = (pair_errors(run, sequence.ground_truth) for run in (with_sway, without))
    assert np.sqrt(np.mean(errors**2)) < 0.6 * np.sqrt(np.mean(mean_velocity**2))
    sways = np.array([step.alignment.sway for step in with_sway.steps])[2:, 3 + axis] * 30.0
    seconds = np.asarray(sequence.timestamps)[1:]
    angle = RATE / (2 * np.pi * HERTZ) * np.sin(2 * np.pi * HERTZ * np.stack([seconds - 1 / 30, seconds]) + PHASE)
    own, mean = RATE * np.cos(2 * np.pi * HERTZ * seconds + PHASE), 30.0 * (angle[1] - angle[0])
    assert np.corrcoef(sways, (mean - own)[2:])[0, 1] > 0.7  # points turn the other way round
    assert not any(np.any(step.alignment.sway) for step in without.steps)


def test_without_a_readout_nothing_changes() -> None:
    """Not a bit: the last step is the one that there is without sway."""
    sequence = Rendered(4, camera=replace(CAMERA, readout=0.0), noise=NONE)
    with_sway, without = (
        run_odometry(sequence, replace(SEARCH, odometry=replace(SEARCH.odometry, sway=sway))) for sway in (True, False)
    )
    assert np.array_equal(with_sway.trajectory.world_T_camera, without.trajectory.world_T_camera)
    assert not any(np.any(step.alignment.sway) for step in with_sway.steps)


def test_a_sway_moves_each_row_by_its_time() -> None:
    """As far as the points move when they go on by the twist for that time."""
    camera, rng = Camera(131.0, 131.0, 79.5, 59.5, 160, 120), np.random.default_rng(0)
    points = Points(
        *(jnp.asarray(rng.uniform(low, high, 200), jnp.float32) for low, high in [(-0.4, 0.4)] * 2 + [(0.4, 2.0)])
    )
    motion = exp(jnp.array([0.02, -0.01, 0.03, 0.02, -0.03, 0.01]))
    sway = jnp.array([0.004, 0.002, -0.003, 0.005, -0.004, 0.006])
    still = warp(points, motion, camera)
    shutter = Shutter(jnp.float32(0.0), jnp.zeros(200), sway)
    assert np.allclose(delay(points, still, shutter, camera)[:3], still[:3])
    swayed = delay(points, still, shutter._replace(readout=jnp.float32(1e-6)), camera)
    share = 1e-6 * row_time(still.v, camera)
    flow = twist_flow(sway, still, camera)
    later = warp(points, exp(sway) @ motion, camera)
    for value, start, end in zip(flow, still[:3], later[:3], strict=True):
        assert np.allclose(value, end - start, atol=0.02 * float(jnp.max(jnp.abs(end - start))))
    assert np.isfinite(np.asarray(swayed.u)).all() and np.all(np.abs(share) < 1e-6)
