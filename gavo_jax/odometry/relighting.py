"""Searches repeated with local changes of light built into the references.

A search estimates one gain and bias per reference. Where a lamp flickers while rows are exposed, is switched on, or
throws a shadow, neither fits. The motion is then drawn to one that explains the light.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Integer

from gavo_jax.alignment.visits import levels_of
from gavo_jax.bodies.pixel_evidence import compare, seen_level, view_of
from gavo_jax.camera import Camera, to_pixels
from gavo_jax.compilation.programs import CachedProgram
from gavo_jax.datasets.base import Frame
from gavo_jax.image.levels import Levels
from gavo_jax.image.sampling import Target
from gavo_jax.objective.estimates import LARGE_GREY_RESIDUAL
from gavo_jax.objective.points import Reference
from gavo_jax.odometry.aligners import Attempt, FrameSearch
from gavo_jax.odometry.second_thoughts import SecondThought
from gavo_jax.odometry.tracking import Clock, TrackerState, as_exposed, readout_share
from gavo_jax.settings import Settings

UNEXPLAINED = 0.7
"""Share of small grey residuals below which the light is examined: most clips lie above."""
EXPLAINED = 0.5
"""Part of the large residuals, over the whole image, that a change of light has to explain for another search. Flicker,
lamps and shadows explain 0.6 to 1 of them. Bodies, which are textured, explain up to 0.3: a search that takes them for
light would follow them.
"""


@dataclass(frozen=True)
class Relighting(SecondThought):
    """An aligner that searches again where light changed locally.

    Attributes:
        first: The aligner that is tried first.
        search: The search that is repeated.
    """

    search: FrameSearch

    @property
    def camera(self) -> Camera:
        """Camera of the search."""
        return self.search.camera

    @property
    def settings(self) -> Settings:
        """Settings of the search."""
        return self.search.settings

    @property
    def plain(self) -> FrameSearch:
        """The search without second thoughts."""
        return self.search.plain

    def blank_state(self) -> TrackerState:
        """The search's state before the first frame."""
        return self.search.blank_state()

    def warm_up_second(self) -> None:
        """Compile the estimate of the light."""
        state = self.blank_state()
        new = NewFrame(state.previous_image, state.instant_motion, state.seconds)
        jax.block_until_ready(self._in_light_of(new, state, np.eye(4, dtype=np.float32)))

    def align(self, state: TrackerState, frame: Frame, clock: Clock) -> Attempt:
        """The first attempt, or one with references in the frame's own light if that is usable or explains more."""
        attempt = self.first.align(state, frame, clock)
        result = attempt.result
        explained = float(result.explained.grey)
        if not explained < UNEXPLAINED or not np.all(np.isfinite(result.target_T_reference)):
            return attempt
        new = NewFrame(attempt.state.previous_image, attempt.state.instant_motion, clock.elapsed)
        lit, left = self._in_light_of(new, state, np.asarray(result.target_T_reference, np.float32))
        if not float(left) < 1.0 - EXPLAINED:
            return attempt
        again = self.search.align(lit, frame, clock)
        is_better = (again.usable, float(again.result.explained.grey)) > (attempt.usable, explained)
        return again if is_better else attempt

    def _in_light_of(
        self, new: "NewFrame", state: TrackerState, motion: Float[np.ndarray, "4 4"]
    ) -> tuple[TrackerState, Float[Array, ""]]:
        """Run `_with_light` for the search's camera and levels."""
        settings = self.settings
        camera = as_exposed(self.camera, settings.odometry)
        levels = levels_of(camera, settings.solver, settings.alignment)
        return _with_light(state, new, motion, camera, levels=levels)


class NewFrame(NamedTuple):
    """A frame as its first attempt sees it."""

    image: Target
    instant_motion: Float[Array, " 6"]
    """Twist of the motion, had the camera always moved as it did at the frame's own moment."""
    elapsed: Float[Array, ""]
    """Seconds since the reference."""


@partial(CachedProgram, static=("levels",), returns=(TrackerState,))
def _with_light(
    state: TrackerState, new: NewFrame, target_T_reference: Float[Array, "4 4"], camera: Camera, *, levels: Levels
) -> tuple[TrackerState, Float[Array, ""]]:
    """Relight a state's references as in a new frame, given the motion to it.

    Returns:
        The state, and the part of the large residuals that the light leaves.
    """
    is_moving = jnp.any(state.motion != 0.0)  # as far as is known: a first frame's rolling shutter is not undone
    sweep = jnp.where(is_moving, state.instant_motion * readout_share(camera, state.seconds), jnp.nan)
    here = view_of(state.previous_image, levels, sweep)
    there = view_of(new.image, levels, new.instant_motion * readout_share(camera, new.elapsed))
    level = camera.level(levels.numbers[seen_level(levels)])
    compared = compare(here, jax.tree.map(lambda leaf: leaf[None], there), target_T_reference[None], level)
    light, residual = compared.light[0], compared.residuals.grey[0]
    without = residual + light * compared.as_bright[0]
    before, after = (jnp.sum(compared.same[0] * (jnp.abs(one) >= LARGE_GREY_RESIDUAL)) for one in (without, residual))
    planes = jax.tree.map(lambda leaf: leaf[:, None], levels.planes(camera))

    def in_new_light(reference: Reference) -> Reference:
        """Adjust points by the light of the nearest pixel of the level that is examined."""
        x, y, _ = reference.points
        u, v = to_pixels(planes, x, y)
        column = _index_at((u + 0.5) / planes.width, level.width)
        row = _index_at((v + 0.5) / planes.height, level.height)
        return reference.brightened(1.0 + light.reshape(level.height, level.width)[row, column])

    lit = state._replace(previous=in_new_light(state.previous), keyframe=in_new_light(state.keyframe))
    return lit, (after + 1.0) / (before + 1.0)


def _index_at(share: Float[Array, "*n"], size: int) -> Integer[Array, "*n"]:
    """Index, along a side of `size` pixels, of the one that lies at a share of its length."""
    return jnp.clip(share * size, 0, size - 1).astype(jnp.int32)
