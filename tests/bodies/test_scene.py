"""The views that a scene keeps, and that its state keeps its shape."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from carded import CAMERA, TRACKED, Carded

from gavo_jax.bodies.scene import MotionSegmenter
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.odometry.aligners import Search
from gavo_jax.odometry.composition import blank_of
from gavo_jax.odometry.driver import Odometry


@pytest.mark.parametrize(("rate", "frames"), [(30, 7), (10, 3), (5, 2)])
def test_the_oldest_view_is_of_about_a_quarter_of_a_second_ago_at_any_frame_rate(rate: int, frames: int) -> None:
    """Counted in frames it lay two seconds back where there are five a second, and all the drift since was a body."""
    segmenter = MotionSegmenter(CAMERA, TRACKED)
    tracker = Search(CAMERA, TRACKED, jax.random.key(0)).start(SyntheticSequence(frames=1, camera=CAMERA)[0])
    tracker = tracker._replace(seconds=np.float32(1 / rate))
    scene, kept = segmenter.first(tracker), []
    for _ in range(frames):
        before = scene.age
        look = segmenter.look(scene, tracker, np.eye(4), 1 / rate)
        scene = segmenter.renewed(scene, look, 1 / rate)
        kept.append(float(scene.age) > float(before))
    assert kept == [True] * (frames - 1) + [False]


@pytest.mark.parametrize(("in_view", "goes"), [(0.5, True), (0.95, False)])
def test_an_older_view_that_sees_little_of_the_image_goes_at_once(in_view: float, goes: bool) -> None:
    odometry = Odometry(CAMERA, TRACKED)
    odometry.register(Carded()[0], 0.0)
    state, segmenter = odometry.progress.tracker.first, MotionSegmenter(CAMERA, TRACKED)
    state = state._replace(tracker=state.tracker._replace(seconds=np.float32(1 / 30)))
    look = segmenter.look(state.scene, state.tracker, np.eye(4), 1 / 30)
    belief = look.belief._replace(in_view=jnp.array([1.0, in_view]))
    scene = segmenter.renewed(state.scene, look._replace(belief=belief), 1 / 30)
    older, between = scene.views_T_last[1], jnp.eye(4).at[0, 3].set(0.1)
    scene = scene._replace(views_T_last=scene.views_T_last.at[2].set(between))
    after = segmenter.renewed(scene, segmenter.look(scene, state.tracker, np.eye(4), 1 / 30), 1 / 30)
    np.testing.assert_allclose(after.views_T_last[1], between if goes else older, atol=1e-6)


def test_a_state_keeps_its_shape() -> None:
    odometry = Odometry(CAMERA, TRACKED)
    odometry.register(Carded()[0], 0.0)
    shapes = [
        [(np.shape(leaf), np.asarray(leaf).dtype) for leaf in jax.tree.leaves(state)]
        for state in (blank_of(odometry.aligner), odometry.progress.tracker)
    ]
    assert shapes[0] == shapes[1]
