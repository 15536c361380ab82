"""A scene of little contrast outvotes a body of much."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small import NEWTON

from gavo_jax.alignment.visits import prepare_target
from gavo_jax.bodies.consensus import Blocks, _whitened, ask_area, gain_of_its_own, weighted_median
from gavo_jax.bodies.pixel_evidence import View, view_of
from gavo_jax.bodies.scene import MotionSegmenter
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.rendered.synthetic import DEFAULT_CAMERA, SyntheticSequence
from gavo_jax.image.levels import Levels
from gavo_jax.image.pyramid import build_pyramid
from gavo_jax.image.sampling import Target
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.stream import track
from gavo_jax.presets import preset
from gavo_jax.settings import OdometryOptions, Settings
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import inverse

CAMERA = DEFAULT_CAMERA.level(1)
MASKED = Settings(GaussNewton(iterations=(0, 15, 0, 0, 20)), odometry=OdometryOptions(recover=False, bodies="mask"))
BETWEEN = np.array([0.0, 0.0, 0.0, 0.0, np.radians(0.5), 0.0])


@pytest.fixture(scope="module")
def room() -> SyntheticSequence:
    """A camera that moves, a box and a walker before it."""
    return SyntheticSequence(frames=6, camera=CAMERA, bodies=2)


@partial(jax.jit, static_argnames="levels")
def seen(grey: jax.Array, depth: jax.Array, levels: Levels) -> View:
    """Of one image."""
    return view_of(prepare_target(build_pyramid(grey, depth, CAMERA.depth_scale), levels), levels, jnp.zeros(6))


def views(room: SyntheticSequence, segmenter: MotionSegmenter) -> tuple[list[View], np.ndarray]:
    """Of the first two frames, and the true motion between them."""
    poses = room.ground_truth.interpolate(room.timestamps)[0]
    true = (inverse(poses[1]) @ poses[0]).astype(np.float32)
    return [seen(frame.grey, frame.depth, segmenter.levels) for frame in room[:2]], true


def test_the_area_asks_for_the_scene_and_names_what_dissents(room: SyntheticSequence) -> None:
    segmenter = MotionSegmenter(CAMERA, MASKED)
    (last, new), true = views(room, segmenter)
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(BETWEEN[3:])[0]
    turn[0, 3] = -2.5 * np.sin(BETWEEN[4])  # what is 2.5 m away stays where it is in the image
    wrong = (turn @ true).astype(np.float32)
    everywhere = np.ones(segmenter.size, np.float32)
    ask = jax.jit(partial(ask_area, camera=segmenter.camera))
    right, misled = (ask(last, new, motion, everywhere) for motion in (true, wrong))
    assert float(right.dissent) < 1.3 * float(right.least)
    assert float(misled.dissent) > 2.0 * float(misled.least)
    asked = np.asarray(misled.target_T_reference)
    assert np.linalg.norm((asked - true)[:3, 3]) < 0.4 * np.linalg.norm((wrong - true)[:3, 3])
    assert float(right.dissent) < 0.5 * float(misled.dissent)
    factor = CAMERA.height // segmenter.size[0]
    body = room.body_labels(0)[::factor, ::factor] > 0
    dissenting = np.asarray(right.dissenting)
    assert dissenting[body].mean() > 3 * dissenting[~body].mean()


def test_the_median_by_weight_is_that_of_sorted_values() -> None:
    generator = np.random.default_rng(0)
    for values in (generator.exponential(size=301), generator.integers(0, 4, 300), 1e30 * generator.uniform(size=7)):
        weights = np.where(generator.uniform(size=len(values)) < 0.2, 0.0, generator.uniform(size=len(values)))
        order = np.argsort(values)
        half = np.searchsorted(np.cumsum(weights[order]), 0.5 * weights.sum())
        found = weighted_median(jnp.asarray(values, jnp.float32), jnp.asarray(weights, jnp.float32))
        assert float(found) == np.float32(values[order][half])


def test_what_a_block_would_gain_is_its_pull_in_units_of_its_hessian() -> None:
    generator = np.random.default_rng(0)
    roots, gradient = generator.normal(size=(9, 6, 6)), generator.normal(size=(9, 6))
    hessian, delta = roots @ roots.transpose(0, 2, 1) + np.eye(6), generator.normal(size=6)
    pull = hessian @ delta + gradient
    right = jnp.asarray(np.concatenate([hessian, gradient[..., None]], axis=-1), jnp.float32)
    whitened = _whitened(jnp.asarray(hessian, jnp.float32), right)
    blocks = Blocks(hessian=right[..., :6], gradient=right[..., 6], whitened=whitened, credit=jnp.ones(9))
    gains = gain_of_its_own(blocks, jnp.asarray(delta, jnp.float32))
    np.testing.assert_allclose(gains, np.einsum("bi,bij,bj->b", pull, np.linalg.inv(hessian), pull), rtol=1e-4)


def test_the_camera_is_not_taken_along(room: SyntheticSequence) -> None:
    poses = room.ground_truth.interpolate(room.timestamps)[0]
    true = inverse(poses[0]) @ poses[-1]

    def error(bodies: str) -> float:
        settings = replace(MASKED, odometry=replace(MASKED.odometry, bodies=bodies))  # pyright: ignore
        *_, step = track(room, settings)
        return float(np.linalg.norm((inverse(true) @ step.world_T_camera)[:3, 3]))

    assert error("mask") < min(0.01, 0.3 * error("off"))


def test_an_image_without_room_for_a_block_is_not_asked() -> None:
    tiny = DEFAULT_CAMERA.level(4)
    sequence = SyntheticSequence(3, camera=tiny)
    coarse = replace(NEWTON, odometry=MASKED.odometry)
    assert [step.index for step in track(sequence, coarse)] == [1, 2]


@pytest.mark.parametrize("size", [(15, 20), (23, 31), (24, 39), (9, 7)])
def test_images_of_any_size_are_asked(size: tuple[int, int]) -> None:
    height, width = size
    camera = replace(DEFAULT_CAMERA.level(4), height=height, width=width)
    packed = jnp.zeros(size, jnp.uint32)
    view = View(Target(*(packed for _ in Target._fields)), jnp.zeros(6))
    opinion = jax.eval_shape(partial(ask_area, camera=camera), view, view, jnp.eye(4), jnp.ones(size))
    assert opinion.dissenting.shape == size


@pytest.mark.parametrize(("start", "shift"), [(0, 0), (5, 12), (35, 12), (60, 12)])
def test_half_an_image_that_moves_on_its_own_is_told(data_dir: Path, start: int, shift: int) -> None:
    """Unless the search ends on its motion exactly, which is the scene's as far as two first images tell."""
    clip = TumSequence(data_dir / "fr1_rpy")[start : start + 2]
    card = 120.0 + cv2.GaussianBlur(np.random.default_rng(0).normal(0.0, 1200.0, (480, 640)), (0, 0), 12.0)
    odometry, step = Odometry(clip.camera, preset("gauss-newton", "fast")), None
    for index, frame in enumerate(clip):
        grey, depth = frame.grey.copy(), frame.depth.copy()
        if shift:
            grey[70:410, 54:506] = np.clip(card[70:410, 100 - shift * index :][:, :452], 0, 255)
            depth[70:410, 54:506] = round(0.7 * float(clip.camera.depth_scale))
        step = odometry.register(replace(frame, grey=grey, depth=depth), frame.timestamp)
    assert step is not None
    assert step.alignment.status == (AlignmentStatus.MOVING_BODY if shift else AlignmentStatus.OK)
