"""What a search meets on each level."""

import jax
import jax.numpy as jnp
import numpy as np

from gavo_jax.alignment.visits import prepare_pair, stack_levels
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.image.levels import Levels
from gavo_jax.image.pyramid import build_pyramid
from gavo_jax.settings import AlignmentOptions


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
