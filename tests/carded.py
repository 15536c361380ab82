"""A card that moves before a wall, and what is made of it."""

from functools import partial
from itertools import pairwise

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from gavo_jax.alignment.visits import prepare_target
from gavo_jax.bodies.belief import Belief, form_belief
from gavo_jax.bodies.pixel_evidence import View, view_of
from gavo_jax.bodies.scene import MotionSegmenter
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.synthetic import DEFAULT_CAMERA, SyntheticSequence
from gavo_jax.image.levels import Levels
from gavo_jax.image.pyramid import build_pyramid
from gavo_jax.settings import OdometryOptions, Settings
from gavo_jax.solvers.gauss_newton import GaussNewton

CAMERA = DEFAULT_CAMERA.level(1)
FRAMES = 5

DISTANCE, STEP = 1.5, 0.03
"""Of the card from the camera, and its way from frame to frame, to the right, metres."""

TRACKED = Settings(GaussNewton(iterations=(0, 15, 0, 0, 20)), odometry=OdometryOptions(recover=False, bodies="track"))
"""Of a program that other tests use, too."""


class Carded:
    """A still camera before a room; a textured card that covers a sixth of the image moves to the right, and stops.

    Args:
        moves: Whether it moves at all.
        stops: Frame from which on it stands still.
        step: Its way from frame to frame, metres.
        is_fine: Whether its texture is finer than what bodies are seen with.
    """

    name, camera, ground_truth = "card", CAMERA, None

    def __init__(self, moves: bool = True, stops: int = FRAMES, step: float = STEP, is_fine: bool = False) -> None:
        self.scene = SyntheticSequence(frames=1, camera=CAMERA)[0]
        self.timestamps = np.arange(FRAMES) / 30
        rng = np.random.default_rng(0)
        blotches = [
            cv2.resize(rng.normal(0, 60, (n, 2 * n)), (144, 108), interpolation=cv2.INTER_CUBIC) for n in (6, 15)
        ]
        grain = rng.normal(0, 40, (108, 144)) if is_fine else blotches[0] + 0.5 * blotches[1]
        self.texture = np.clip(grain + 120, 10, 240)
        self.left = 60 + CAMERA.fx * step / DISTANCE * np.minimum(np.arange(FRAMES), stops) * moves

    def __len__(self) -> int:
        return FRAMES

    def mask(self, index: int) -> np.ndarray:
        """Pixels of the card."""
        left = self.left[index]
        mask = np.zeros((CAMERA.height, CAMERA.width), bool)
        mask[40:148, round(left) : round(left) + 144] = True
        return mask

    def __getitem__(self, index: int) -> Frame:
        left = self.left[index]
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
