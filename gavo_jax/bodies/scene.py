"""What is kept of earlier images to tell what moves in the next one."""

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Integer

from gavo_jax.alignment.visits import levels_of
from gavo_jax.bodies.belief import Belief, form_belief
from gavo_jax.bodies.consensus import Opinion, ask_area, has_blocks
from gavo_jax.bodies.identity import BodyTracks
from gavo_jax.bodies.masking import without_points
from gavo_jax.bodies.pixel_evidence import View, seen_level, view_of
from gavo_jax.camera import Camera
from gavo_jax.compilation.programs import CachedProgram
from gavo_jax.image.levels import ImagePlane, Levels
from gavo_jax.image.sampling import Target
from gavo_jax.objective.points import Reference
from gavo_jax.odometry.tracking import TrackerState, readout_share
from gavo_jax.se3 import rigid_inverse
from gavo_jax.settings import Settings

OLD = 0.22
"""Seconds for which a view is kept as the middle one before it replaces the older one."""
FAR_OFF = 0.7
"""The older view is replaced at once if it sees less than this share of the static scene. Over a long way, pose errors
and other light look like bodies.
"""


class Scene(NamedTuple):
    """What is known of the last image, and of older ones to compare the next one with."""

    known: Float[Array, "h w"]
    """Belief about the last frame's pixels; see `Belief.known`."""
    suspected: Float[Array, "h w"]
    """Suspicion of the last frame's pixels; see `belief.suspect`."""
    tracks: BodyTracks
    """The bodies that the last frame shows."""
    views: View
    """Views of the last frame, of an older one and of one between them, [3]: slow motion shows in the older one."""
    views_T_last: Float[Array, "3 4 4"]
    """Motions from the last frame's camera into those of `views`."""
    age: Float[np.ndarray, ""]
    """Seconds since the middle view became that; it is of the frame before."""
    seconds_extrapolated: Float[np.ndarray, ""]
    """Seconds for which the last motion has stood in for one that was not found."""


class AwareState(NamedTuple):
    """State of a search and what is known of the scene."""

    tracker: TrackerState
    """State of the search; its references have no points on bodies."""
    scene: Scene
    whole: Reference
    """The last frame's points, including those on bodies."""
    is_doubted: Any = np.zeros((), bool)
    """Whether the last motion may be a body's, by a stricter measure than its status."""


class FrameView(NamedTuple):
    """A new frame, as it looks if some motion is the camera's."""

    belief: Belief
    """Belief about the new frame's pixels under that motion."""
    views: View
    """The scene's views under that motion, the new frame among them; `views_T_here` are the motions into them."""
    views_T_here: Float[Array, "3 4 4"]
    opinion: Opinion | None
    """Opinion of the last frame's area on that motion; None where the image is too small for blocks."""


@dataclass(frozen=True)
class MotionSegmenter:
    """Forms beliefs about what moves, on the level of the pyramid that bodies are seen on.

    Attributes:
        full: Camera of level 0.
        settings: Settings of the search.
    """

    full: Camera
    settings: Settings

    @cached_property
    def levels(self) -> Levels:
        """The searched levels."""
        return levels_of(self.full, self.settings.solver, self.settings.alignment)

    @cached_property
    def camera(self) -> Camera:
        """Camera of the level that bodies are seen on."""
        return self.full.level(self.levels.numbers[seen_level(self.levels)])

    @cached_property
    def planes(self) -> ImagePlane:
        """Image planes of the searched levels, on the host."""
        return jax.tree.map(np.asarray, self.levels.planes(self.full))

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the level that bodies are seen on."""
        return self.camera.height, self.camera.width

    def view(self, tracker: TrackerState) -> View:
        """Return a tracker's last frame on the host: slicing an array on the device would compile a program."""
        sweep = np.asarray(tracker.instant_motion) * readout_share(self.full, np.asarray(tracker.seconds))
        return self._cut(tracker, sweep)

    def blank(self) -> Scene:
        """A scene before the first frame, in the shapes and types of every scene."""
        words: Any = np.zeros((3, *self.size), np.uint32)
        sweeps: Any = np.zeros((3, 6), np.float32)
        unknown: Any = np.zeros(self.size, np.float32)
        still: Any = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
        nothing: Any = np.zeros((), np.float32)
        views = View(Target(words, words), sweeps)
        return Scene(unknown, unknown, BodyTracks.empty(self.size), views, still, nothing, nothing)

    def first(self, tracker: TrackerState) -> Scene:
        """A scene with a single known frame."""
        unknown = np.full(6, np.nan, np.float32)  # the dtype of every scene: another one would compile another program
        view = self._cut(tracker, unknown)
        return self.blank()._replace(views=jax.tree.map(lambda leaf: np.stack([leaf] * 3), view))

    def _cut(self, tracker: TrackerState, sweep: Any) -> View:
        image = jax.tree.map(np.asarray, tracker.previous_image)
        return view_of(image, self.levels, sweep)

    def look(self, scene: Scene, tracker: TrackerState, target_T_reference: Any, elapsed: float) -> FrameView:
        """The belief about a new frame's pixels under a motion, and the last frame's opinion on that motion."""
        keep = (1, 2) if _age_after(scene, elapsed) else (2, 0)
        return _look(
            (scene.known, scene.suspected, scene.views, scene.views_T_last),
            (tracker.previous_image, tracker.instant_motion, tracker.seconds),
            np.asarray(target_T_reference, np.float32),
            np.array(keep, np.int32),
            self.full,
            levels=self.levels,
        )

    def look_back(self, scene: Scene, tracker: TrackerState, target_T_reference: Any) -> Belief:
        """The belief about the last frame's pixels under a motion, on the host."""
        belief = _look_back(
            (scene.known, scene.views),
            (tracker.previous_image, tracker.instant_motion, tracker.seconds),
            np.asarray(target_T_reference, np.float32),
            self.full,
            levels=self.levels,
        )
        return jax.device_get(belief)

    def renewed(self, scene: Scene, look: FrameView, elapsed: float) -> Scene:
        """The scene with the new frame as its last one, after `elapsed` seconds."""
        is_far_off = np.asarray(look.belief.in_view)[1] < FAR_OFF
        age = OLD if is_far_off else _age_after(scene, elapsed)
        return scene._replace(
            known=look.belief.known,
            views=look.views,
            views_T_last=look.views_T_here,
            age=np.asarray(age, np.float32),
        )

    def without(self, tracker: TrackerState, mask: Bool[Array | np.ndarray, "h w"]) -> TrackerState:
        """A tracker whose references have lost the points on a mask."""
        return without_points(tracker, self.planes, np.asarray(mask), self.levels)


def _age_after(scene: Scene, elapsed: float) -> float:
    """Return the scene's `age` at the new frame: 0 where the last frame's view becomes the middle one."""
    age = float(scene.age) + elapsed
    return age if age < OLD else 0.0


@partial(CachedProgram, static=("levels",), returns=(FrameView,))
def _look(
    known: tuple[Float[Array, "h w"], Float[Array, "h w"], View, Float[Array, "3 4 4"]],
    new: tuple[Target, Float[Array, " 6"], Float[Array, ""]],
    target_T_reference: Float[Array, "4 4"],
    keep: Integer[Array, " 2"],
    camera: Camera,
    *,
    levels: Levels,
) -> FrameView:
    """Evaluate in one program all that every frame needs: a call costs more than what it computes."""
    before, suspected, views, views_T_last = known
    image, instant_motion, seconds = new
    here = view_of(image, levels, instant_motion * readout_share(camera, seconds))
    views = views.moving_as(here.sweep)
    views_T_here = views_T_last @ rigid_inverse(target_T_reference)
    two = jax.tree.map(lambda leaf: leaf[:2], views)
    seen = camera.level(levels.numbers[seen_level(levels)])
    belief = form_belief(here, two, views_T_here[:2], seen, before, suspected, carried=True)
    credit = jnp.clip(0.5 - jnp.maximum(before, suspected), 0.0, 1.0)
    last = jax.tree.map(lambda leaf: leaf[0], views)
    opinion = ask_area(last, here, target_T_reference, credit, seen) if has_blocks(seen) else None
    views = jax.tree.map(lambda own, others: jnp.concatenate([own[None], others[keep]]), here, views)
    return FrameView(belief, views, jnp.concatenate([jnp.eye(4)[None], views_T_here[keep]]), opinion)


@partial(CachedProgram, static=("levels",), returns=(Belief,))
def _look_back(
    known: tuple[Float[Array, "h w"], View],
    new: tuple[Target, Float[Array, " 6"], Float[Array, ""]],
    target_T_reference: Float[Array, "4 4"],
    camera: Camera,
    *,
    levels: Levels,
) -> Belief:
    """Form the belief in a program that is cached between processes: it is first needed in the middle of a run."""
    before, views = known
    image, instant_motion, seconds = new
    here = view_of(image, levels, instant_motion * readout_share(camera, seconds))
    last = jax.tree.map(lambda leaf: leaf[0], views)
    seen = camera.level(levels.numbers[seen_level(levels)])
    here = jax.tree.map(lambda leaf: leaf[None], here)
    return form_belief(last, here, target_T_reference[None], seen, before, carried=False)
