"""Insert an independently moving rigid body into any clip with ground truth: a textured card with grey and depth.

It swings sideways and back and forth in front of the first camera, and turns. Occlusion is rendered both ways. A clip
with a card has the same ground truth for it as `SyntheticSequence` for its bodies.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np

from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.base import Sequence as FrameSequence
from gavo_jax.datasets.rendered.actors import turn
from gavo_jax.datasets.rendered.moving import BodyTruth
from gavo_jax.errors import GavoError
from gavo_jax.trajectory import inverse

MARGIN = 0.03
"""Seconds of truth that a frame needs on either side: its depth may be exposed before or after its colour."""
ASPECT = 0.75
NEAREST = 0.2
"""Least distance from the camera at which the card is rendered, metres."""
DEPTH_NOISE = 0.0012
"""Standard deviation of the card's depth at one metre, metres; it grows with the square of the depth."""
GREY_NOISE = 1.3
SIZING_FRAMES, SIZING_ROUNDS = 12, 3


class Look(NamedTuple):
    """How a card looks and moves."""

    texture: str
    speed: float
    """Mean, m/s."""
    turn: float
    """Amplitude, degrees."""
    near: float
    """Distance from the first camera over the 20th percentile of the first frame's depth."""


LOOKS = (
    Look("blotches", 0.4, 20.0, 0.75),
    Look("fine", 0.2, 10.0, 0.6),
    Look("plain", 0.7, 30.0, 0.75),
    Look("stripes", 0.4, 20.0, 0.9),
)
"""Looks that the seeds take in turn."""


def texture(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Texture of a card, float grey [480, 640].

    Raises:
        GavoError: no such kind.
    """
    if kind == "stripes":
        grey = np.repeat(rng.uniform(40, 210, 24), 27)[:640] + rng.normal(0, 8, (480, 640))
    elif kind in ("blotches", "fine", "plain"):
        cells, contrast = {"blotches": ((6, 15, 40), 1.0), "fine": ((40, 90, 180), 1.0), "plain": ((6, 15, 40), 0.1)}[
            kind
        ]
        color = np.zeros((480, 640, 3))
        for i, n in enumerate(cells):
            noise = rng.normal(0, 60, (n, n * 4 // 3, 3))
            color += cv2.resize(noise, (640, 480), interpolation=cv2.INTER_CUBIC) / (1 + i)
        grey = 120 + contrast * color @ [0.299, 0.587, 0.114]
    else:
        raise GavoError(f"unknown texture {kind!r}: not one of blotches, fine, plain, stripes")
    return cv2.GaussianBlur(np.clip(grey, 0, 255).astype(np.float32), (0, 0), 1.0)


@dataclass(eq=False)
class CardClip:
    """A clip with a card in it.

    Attributes:
        clip: frames with ground truth.
        share: share of the image that the card covers, median over the frames.
        seed: seed of its texture and of the phases of its path.
        look: how it looks and moves.
    """

    clip: FrameSequence
    share: float
    seed: int = 0
    look: Look = LOOKS[0]

    def __post_init__(self) -> None:
        """Find the frames that the truth covers, and the size at which the card covers the share.

        Raises:
            GavoError: the clip has no ground truth.
        """
        clip, truth = self.clip, self.clip.ground_truth
        if truth is None:
            raise GavoError(f"{clip.name}: no ground truth")
        self.name, self.camera, self.ground_truth = f"{clip.name}+card", clip.camera, truth
        covered = (clip.timestamps > truth.timestamps[0] + MARGIN) & (clip.timestamps < truth.timestamps[-1] - MARGIN)
        self.frames = np.flatnonzero(covered)
        self.timestamps = clip.timestamps[self.frames]
        rng = np.random.default_rng(self.seed)
        self._texture = texture(self.look.texture, rng)
        self._phases = rng.uniform(0, 2 * np.pi, 3)
        first = clip[int(self.frames[0])].depth
        self._distance = self.look.near * float(np.percentile(first[first > 0], 20)) / float(self.camera.depth_scale)
        self._width = np.sqrt(self.share * self.camera.width * self.camera.height / ASPECT) * self._distance
        self._width /= float(self.camera.fx)
        self._fit()

    def _fit(self) -> None:
        some = self.frames[:: max(1, len(self.frames) // SIZING_FRAMES)]
        looked = [self.clip[int(index)] for index in some]
        for _ in range(SIZING_ROUNDS):
            median = np.median([self._seen(frame, frame.timestamp)[0].mean() for frame in looked])
            self._width *= np.sqrt(self.share / max(median, 0.1 * self.share))

    def camera_at(self, timestamps: np.ndarray) -> np.ndarray:
        """`world_T_camera` at some timestamps, [n, 4, 4]."""
        return self.ground_truth.interpolate(timestamps, max_gap=np.inf)[0]

    @cached_property
    def _world_T_first(self) -> np.ndarray:
        return self.camera_at(self.timestamps[:1])[0]

    def card_at(self, timestamps: np.ndarray) -> np.ndarray:
        """`world_T_card` at some timestamps, [n, 4, 4]; its origin is the card's middle, x and y span the card."""
        reach, phases = 0.35 * self._distance, self._phases
        angle = self.look.speed / reach * np.pi / 2 * (timestamps - self.timestamps[0])
        poses = np.tile(np.eye(4), (len(timestamps), 1, 1))
        swing = [(reach, 1.0, 0), (0.3 * reach, 0.7, 1), (0.25 * reach, 0.5, 2)]
        poses[:, :3, 3] = np.stack([a * np.sin(rate * angle + phases[k]) for a, rate, k in swing], axis=1)
        poses[:, 2, 3] += self._distance
        tilt = [(0.5, 0.9, 1), (1.0, 0.8, 2), (0.7, 0.6, 0)]
        x, y, z = (
            turn(np.radians(self.look.turn) * a * np.sin(rate * angle + phases[k]), axis)
            for axis, (a, rate, k) in enumerate(tilt)
        )
        poses[:, :3, :3] = z @ y @ x
        return self._world_T_first @ poses

    @cached_property
    def _rays(self) -> np.ndarray:
        rows, columns = np.mgrid[: self.camera.height, : self.camera.width].astype(np.float64)
        return np.asarray(self.camera.back_project(np.stack([columns, rows], axis=-1), np.ones_like(rows)))

    def _render(self, timestamp: float) -> tuple[np.ndarray, np.ndarray]:
        """Depth of the card along each ray, 0 off the card, and where it meets the card's plane (card: ±1/2)."""
        stamp = np.array([timestamp])
        camera_T_card = inverse(self.camera_at(stamp)[0]) @ self.card_at(stamp)[0]
        normal, middle = camera_T_card[:3, 2], camera_T_card[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (normal @ middle) / (self._rays @ normal)
            on = (self._rays * z[..., None] - middle) @ camera_T_card[:3, :2] / (self._width * np.array([1.0, ASPECT]))
            inside = (z > NEAREST) & (np.abs(on) < 0.5).all(axis=-1)
        return np.where(inside, z, 0.0), on

    def _seen(self, frame: Frame, timestamp: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the mask of the card's visible part at a moment, its depth, and the coordinates on it."""
        z, on = self._render(timestamp)
        scene = frame.depth / float(self.camera.depth_scale)
        return (z > 0) & ((scene == 0) | (z < scene)), z, on

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[Frame]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> Frame:
        frame = self.clip[int(self.frames[index])]
        rng = np.random.default_rng([self.seed, int(self.frames[index])])
        seen, _, on = self._seen(frame, frame.timestamp)
        size = np.array(self._texture.shape[::-1]) - 1
        places = np.clip(np.nan_to_num((on + 0.5) * size), 0, 4096).astype(np.float32)
        card = cv2.remap(
            self._texture, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        card = card + rng.normal(0, GREY_NOISE, card.shape)
        alpha = cv2.GaussianBlur(seen.astype(np.float64), (0, 0), 0.7)
        grey = np.clip(alpha * card + (1 - alpha) * frame.grey, 0, 255).astype(np.uint8)
        front, z, _ = self._seen(frame, frame.depth_timestamp or frame.timestamp)
        raw = np.rint((z + rng.normal(0, DEPTH_NOISE, z.shape) * z**2) * float(self.camera.depth_scale))
        return replace(frame, grey=grey, depth=np.where(front, raw, frame.depth).astype(np.uint16), color=None)

    def check(self) -> None:
        """Check the clip."""
        self.clip.check()

    @property
    def bodies_truth(self) -> tuple[BodyTruth, ...]:
        """The card's poses at the colour timestamps."""
        return (BodyTruth("card", 1, (1,), self.timestamps, self.card_at(self.timestamps)[None]),)

    def part_labels(self, index: int) -> np.ndarray:
        """1 where the colour image of a frame shows the card, 0 elsewhere: uint8 [H, W]."""
        frame = self.clip[int(self.frames[index])]
        return self._seen(frame, frame.timestamp)[0].astype(np.uint8)
