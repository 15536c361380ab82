"""Whether depth lies on the image: where depth jumps, one thing ends before another, and most images have an edge.

No motion is needed to see that, so it tells where `depth_change` has nothing to go by. Depth is taken to lie elsewhere
only where it lies clearly better there: mirrored, upside down, turned by both, larger or smaller, or shifted by more
than two cameras beside each other would see.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32

from gavo_jax.camera import Camera, inverse_depth
from gavo_jax.datasets.base import Frame

WIDTH = 160
"""Pixels across the images that are compared."""
REACH, NEAR = 24, 8
"""Pixels of these by which depth may be shifted: those that are looked at, and those of depth that is not registered
to the image (20 of 640 in 7-Scenes are 5)."""
JUMP = 0.08
"""1/m between neighbours of these pixels, from which on depth jumps."""
FEWEST_JUMPS = 0.003
"""Fewest jumps, as a share of all pixels, for a frame to tell anything."""
CONTRAST = 21
"""Pixels across the surroundings that an edge of the image is set against."""
ZOOMS = (1.5, 1.3, 0.77, 0.67)
"""How many times as large depth may belong on the image: it is of another angle of view then. That of a depth camera
that is not registered (1.11 in 7-Scenes) lies nearer to 1."""
FAULTS = ("shifted", "mirrored", "upside down", "turned by half", *("of another angle of view" for _ in ZOOMS))
"""What depth is that would lie better elsewhere, or each other way."""
EVERY, SELDOM, EARLY = 3, 30, 24
"""One in `EVERY` references is looked at among the first `EARLY`, one in `SELDOM` after them."""
KEPT = 0.95
"""Factor at each reference on what the ones before said."""
MIN_SEEN = 5
"""Frames that have to be seen before anything is said."""
BETTER, CLEAR = 2.0, 5.0
"""How many times as well, and how many standard deviations better than at other places, depth has to lie elsewhere."""


class DepthEdges(NamedTuple):
    """How much of an edge the image has where depth jumps, summed over frames, for each way depth may lie."""

    sums: Float32[np.ndarray, "ways n n"]
    """For depth as it is, mirrored, upside down, both, and by each of `ZOOMS`: by the shift, down and to the right."""
    references: int = 0
    """So many there were."""
    seen: int = 0
    """So many of them were looked at and had enough jumps."""
    fault: str = ""
    """How depth lies, where it would lie clearly better otherwise: one of `FAULTS`."""

    @classmethod
    def none(cls) -> "DepthEdges":
        """Before the first frame."""
        return cls(np.zeros((len(FAULTS), 2 * REACH + 1, 2 * REACH + 1), np.float32))

    def pairs_covered(self, pairs: int) -> int:
        """Return how many of the last pairs its figures speak of, of so many so far."""
        return pairs if self.references <= EARLY + SELDOM else SELDOM

    def after(self, frame: Frame, camera: Camera) -> "DepthEdges":
        """Take one more reference into account."""
        number = self.references
        counted = self._replace(references=number + 1)
        if number % (EVERY if number < EARLY else SELDOM):
            return counted
        jumps = depth_jumps(np.asarray(frame.depth), camera)
        if np.mean(jumps) < FEWEST_JUMPS:
            return counted
        sums = KEPT * self.sums + likeness(edges(np.asarray(frame.grey)), jumps)
        fault = fault_by(sums) if self.seen + 1 >= MIN_SEEN else ""
        return counted._replace(sums=sums, seen=self.seen + 1, fault=fault)


def fault_by(sums: Float32[np.ndarray, "ways n n"]) -> str:
    """How depth lies by `DepthEdges.sums`, or an empty string where no other way is clearly better."""
    as_it_is = _near(sums[0]).max()
    shifted = sums[0].copy()
    _near(shifted)[:] = -np.inf
    best = np.array([shifted.max(), *(_near(way).max() for way in sums[1:])])
    clear = sums.mean(axis=(1, 2)) + CLEAR * sums.std(axis=(1, 2))
    is_better = (best > BETTER * as_it_is) & (best > clear)
    return FAULTS[int(np.argmax(np.where(is_better, best, -np.inf)))] if is_better.any() else ""


def edges(grey: np.ndarray) -> Float32[np.ndarray, "h w"]:
    """How much more of an edge each pixel is on than its surroundings, in a small image."""
    grey = grey if grey.dtype == np.uint8 else grey.astype(np.float32)  # quicker, and all that OpenCV needs to know
    small = cv2.resize(grey, _size(*grey.shape[::-1]), interpolation=cv2.INTER_AREA).astype(np.float32)
    slope = cv2.log(1.0 + cv2.magnitude(cv2.Sobel(small, cv2.CV_32F, 1, 0), cv2.Sobel(small, cv2.CV_32F, 0, 1)))
    return slope - cv2.blur(slope, (CONTRAST, CONTRAST))


def depth_jumps(depth: np.ndarray, camera: Camera) -> Float32[np.ndarray, "h w"]:
    """1 where the depths around a pixel are of two things, in a small image; 0 elsewhere and without readings."""
    width, height = _size(*depth.shape[::-1])
    row, column = np.arange(height) * depth.shape[0] // height, np.arange(width) * depth.shape[1] // width
    small = depth[row[:, None], column]
    inverse = inverse_depth(small, camera).astype(np.float32)
    known, around = inverse > 0, np.ones((3, 3), np.uint8)
    nearest = cv2.dilate(inverse, around)
    farthest = cv2.erode(np.where(known, inverse, np.float32(np.inf)), around)
    return (known & (nearest - farthest > JUMP)).astype(np.float32)


def likeness(edges: Float32[np.ndarray, "h w"], jumps: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "ways n n"]:
    """Mean edge under the jumps of depth, for each way that it may lie and each shift within reach."""
    size = [cv2.getOptimalDFTSize(length + REACH) for length in edges.shape]  # nothing comes round from the other side
    flipped = [jumps, jumps[:, ::-1], jumps[::-1], jumps[::-1, ::-1]]
    ways = np.stack([*flipped, *(_zoomed(jumps, factor) for factor in ZOOMS)])
    there, here = (np.fft.rfft2(images, size) for images in (edges, ways))
    found = np.fft.irfft2(there * np.conj(here), size)
    shifts = np.arange(-REACH, REACH + 1)
    return found[:, shifts[:, None], shifts] / np.maximum(ways.sum(axis=(1, 2), keepdims=True), 1.0)


def _size(width: int, height: int) -> tuple[int, int]:
    return WIDTH, max(round(height * WIDTH / width), 1)


def _zoomed(jumps: np.ndarray, factor: float) -> np.ndarray:
    """Seen about the middle of the image, so many times as large."""
    height, width = jumps.shape
    about = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), 0.0, factor)
    return cv2.warpAffine(jumps, about, (width, height), flags=cv2.INTER_NEAREST)


def _near(way: np.ndarray) -> np.ndarray:
    inside = slice(REACH - NEAR, REACH + NEAR + 1)
    return way[inside, inside]
