"""What is drawn into every image of a run: a clock, a name, a frame around it. It stays put as the scene moves, and
would hold the camera where it is.

No sensor gives a pixel the same level twice for long: it has noise. What is drawn has none.
"""

import contextlib
from dataclasses import replace
from typing import NamedTuple, Self

import cv2
import numpy as np
from jaxtyping import Num, UInt8

from gavo_jax.datasets.base import Frame, FrameError, Sequence
from gavo_jax.datasets.rectified import rectified_at

STEP = 2
"""Pixels, down and to the right, of which one is looked at."""
STEEP = 10
"""Grey levels between the lowest and the highest of 3 x 3 such pixels, from which on there is something to see."""
CHANGED, MOVED = 2, 0.5
"""Of the pixels where there is, the share that changes by more than so many grey levels as the camera moves."""
FRAMES = 8
"""Images of a camera that moves, one after the other, in which what is drawn keeps its level to the digit."""
LEAST = 5e-3
"""Share of the pixels that has to be drawn and steep. Clean clips of the TUM benchmark have 0.002 at most."""
REACH = 5
"""Such pixels around, which coding and the search's interpolation mix with what is drawn."""
AROUND = 21
"""Such pixels across the surroundings of which the mean takes the place of what is drawn."""
LITTLE = 0.01
"""Share of the surroundings that the mean of the whole image counts as, for where all around is drawn."""


class Drawn(NamedTuple):
    """What is known of what is drawn, on every `STEP`th pixel."""

    last: Num[np.ndarray, "h w"] | None = None
    """The last image; None before the first."""
    counts: UInt8[np.ndarray, "h w"] = np.zeros((0, 0), np.uint8)
    """In so many images of a camera that moved each pixel kept its level, up to the last one."""

    @property
    def is_any(self) -> bool:
        """Whether enough of the image keeps its level for something to be drawn there."""
        return self.counts.size > 0 and bool(np.mean(self.counts >= FRAMES) >= LEAST)

    def after(self, grey: np.ndarray) -> Self:
        """Look at one more image."""
        some = np.ascontiguousarray(np.asarray(grey)[::STEP, ::STEP])
        if some.dtype != np.uint8:
            some = np.clip(np.nan_to_num(some.astype(np.float64)), 0.0, 255.0).astype(np.float32)
        if self.last is None or (self.last.shape, self.last.dtype) != (some.shape, some.dtype):
            return self._replace(last=some, counts=np.zeros(some.shape, np.uint8))
        change = cv2.absdiff(some, self.last)
        seen = change[::STEP, ::STEP][_is_steep(some)[::STEP, ::STEP]]
        if not seen.size or np.mean(seen > CHANGED) < MOVED:
            return self._replace(last=some)
        counts = np.where(change == 0, np.minimum(self.counts, FRAMES) + np.uint8(1), np.uint8(0))
        return self._replace(last=some, counts=counts)

    def without(self, frame: Frame) -> Frame:
        """The last frame with the mean of its surroundings, and no depth, where something is drawn."""
        if self.last is None or not self.is_any:
            return frame
        edges = (self.counts >= FRAMES) & _is_steep(self.last)
        if np.count_nonzero(edges) < LEAST * edges.size:
            return frame
        drawn = cv2.dilate(edges.astype(np.uint8), np.ones((2 * REACH + 1, 2 * REACH + 1), np.uint8)) > 0
        grey, depth = np.asarray(frame.grey), np.asarray(frame.depth)
        share = cv2.blur((~drawn).astype(np.float32), (AROUND, AROUND)) + LITTLE
        rest = np.where(drawn, np.float32(0), self.last.astype(np.float32))
        everywhere = LITTLE * float(np.mean(self.last[~drawn])) if not drawn.all() else 0.0
        mean = cv2.blur((cv2.blur(rest, (AROUND, AROUND)) + everywhere) / share, (AROUND, AROUND))
        size = grey.shape[::-1]
        mask = cv2.resize(drawn.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        filled = np.where(mask, cv2.resize(mean, size), grey).astype(grey.dtype)
        return replace(frame, grey=filled, depth=np.where(mask, depth.dtype.type(0), depth))


class AsTracked:
    """Frames of a run as they were tracked, read once more from the first one on.

    Without `is_drawn_on` nothing is drawn into them, and only those are decoded that are asked for.
    """

    def __init__(self, sequence: Sequence, is_drawn_on: bool = True) -> None:
        self._sequence, self._is_drawn_on = sequence, is_drawn_on
        self._drawn, self._next = Drawn(), 0

    def __getitem__(self, index: int) -> Frame:
        """A frame behind those that were asked for before: without distortion, and without what is drawn into it.

        Raises:
            FrameError: It cannot be read.
        """
        for number in range(self._next, index) if self._is_drawn_on else ():
            with contextlib.suppress(FrameError):
                self._drawn = self._drawn.after(rectified_at(self._sequence, number).grey)
        self._next = index + 1
        frame = rectified_at(self._sequence, index)
        if not self._is_drawn_on:
            return frame
        self._drawn = self._drawn.after(frame.grey)
        return self._drawn.without(frame)


def _is_steep(image: np.ndarray) -> np.ndarray:
    around = np.ones((3, 3), np.uint8)
    return cv2.dilate(image, around) - cv2.erode(image, around) > STEEP
