"""Whether depth is registered to the image: depth jumps at occlusion boundaries, where most images have an edge.

This needs no motion, so it works where `depth_change` has nothing to go by. Depth counts as misplaced only where
another placement fits clearly better: mirrored, upside down, both, zoomed, or shifted beyond the parallax of adjacent
cameras.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32

from gavo_jax.camera import Camera, inverse_depth
from gavo_jax.datasets.base import Frame

WIDTH = 160
"""Width of the images that are compared, pixels."""
REACH, NEAR = 24, 8
"""Largest shift of depth that is tried, and the largest that unregistered depth may have, in pixels of these images
(7-Scenes: 20 of 640 pixels, which are 5)."""
JUMP = 0.08
"""Range of inverse depth around a pixel, 1/m, above which depth jumps."""
FEWEST_JUMPS = 0.003
"""Smallest share of pixels with a jump for a frame to be used."""
CONTRAST = 21
"""Width of the neighbourhood that an image edge is compared with, pixels."""
ZOOMS = (1.5, 1.3, 0.77, 0.67)
"""Zoom factors that are tried on depth, for another field of view. Those of depth cameras that are merely unregistered
(1.11 in 7-Scenes) are nearer to 1."""
FAULTS = ("shifted", "mirrored", "upside down", "turned by half", *("of another angle of view" for _ in ZOOMS))
"""Name of the fault by the placement that fits better: a shift, then each other way."""
EVERY, SELDOM, EARLY = 3, 30, 24
"""One in `EVERY` of the first `EARLY` references is examined, one in `SELDOM` after them."""
SUM_DECAY = 0.95
"""Decay of the earlier sums with each reference that is added."""
MIN_SEEN = 5
"""Number of frames that must be added before a fault is reported."""
BETTER, CLEAR = 2.0, 5.0
"""Another placement must fit `BETTER` times as well, and `CLEAR` standard deviations better than its other shifts."""


class DepthEdges(NamedTuple):
    """Strength of the image's edges where depth jumps, summed over frames, for each placement of depth."""

    sums: Float32[np.ndarray, "ways n n"]
    """For depth as given, mirrored, upside down, both, and zoomed by each of `ZOOMS`: by the shift down and right."""
    references: int = 0
    """Number of references so far."""
    seen: int = 0
    """Number of references that were examined and had enough jumps."""
    fault: str = ""
    """One of `FAULTS`; empty unless another placement fits clearly better."""

    @classmethod
    def none(cls) -> "DepthEdges":
        """Return the state before the first frame."""
        return cls(np.zeros((len(FAULTS), 2 * REACH + 1, 2 * REACH + 1), np.float32))

    def pairs_covered(self, pairs: int) -> int:
        """Return how many of the last pairs the figures describe, out of `pairs` so far."""
        return pairs if self.references <= EARLY + SELDOM else SELDOM

    def after(self, frame: Frame, camera: Camera) -> "DepthEdges":
        """Return the state after one more reference."""
        number = self.references
        counted = self._replace(references=number + 1)
        if number % (EVERY if number < EARLY else SELDOM):
            return counted
        jumps = depth_jumps(np.asarray(frame.depth), camera)
        if np.mean(jumps) < FEWEST_JUMPS:
            return counted
        sums = SUM_DECAY * self.sums + likeness(edges(np.asarray(frame.grey)), jumps)
        fault = fault_by(sums) if self.seen + 1 >= MIN_SEEN else ""
        return counted._replace(sums=sums, seen=self.seen + 1, fault=fault)


def fault_by(sums: Float32[np.ndarray, "ways n n"]) -> str:
    """Return the fault that `DepthEdges.sums` show; empty unless another placement is clearly better."""
    as_it_is = _near(sums[0]).max()
    shifted = sums[0].copy()
    _near(shifted)[:] = -np.inf
    best = np.array([shifted.max(), *(_near(way).max() for way in sums[1:])])
    clear = sums.mean(axis=(1, 2)) + CLEAR * sums.std(axis=(1, 2))
    is_better = (best > BETTER * as_it_is) & (best > clear)
    return FAULTS[int(np.argmax(np.where(is_better, best, -np.inf)))] if is_better.any() else ""


def edges(grey: np.ndarray) -> Float32[np.ndarray, "h w"]:
    """Edge strength of each pixel of the reduced image, relative to its surroundings."""
    grey = grey if grey.dtype == np.uint8 else grey.astype(np.float32)  # OpenCV resizes bytes faster
    small = cv2.resize(grey, _size(*grey.shape[::-1]), interpolation=cv2.INTER_AREA).astype(np.float32)
    slope = cv2.log(1.0 + cv2.magnitude(cv2.Sobel(small, cv2.CV_32F, 1, 0), cv2.Sobel(small, cv2.CV_32F, 0, 1)))
    return slope - cv2.blur(slope, (CONTRAST, CONTRAST))


def depth_jumps(depth: np.ndarray, camera: Camera) -> Float32[np.ndarray, "h w"]:
    """Reduced image that is 1 where depth jumps around a pixel; 0 elsewhere and without a reading."""
    width, height = _size(*depth.shape[::-1])
    row, column = np.arange(height) * depth.shape[0] // height, np.arange(width) * depth.shape[1] // width
    small = depth[row[:, None], column]
    inverse = inverse_depth(small, camera).astype(np.float32)
    known, around = inverse > 0, np.ones((3, 3), np.uint8)
    nearest = cv2.dilate(inverse, around)
    farthest = cv2.erode(np.where(known, inverse, np.float32(np.inf)), around)
    return (known & (nearest - farthest > JUMP)).astype(np.float32)


def likeness(edges: Float32[np.ndarray, "h w"], jumps: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "ways n n"]:
    """Mean edge strength at the jumps of depth, for each placement and each shift within `REACH`."""
    size = [cv2.getOptimalDFTSize(length + REACH) for length in edges.shape]  # padded against wrap-around
    flipped = [jumps, jumps[:, ::-1], jumps[::-1], jumps[::-1, ::-1]]
    ways = np.stack([*flipped, *(_zoomed(jumps, factor) for factor in ZOOMS)])
    there, here = (np.fft.rfft2(images, size) for images in (edges, ways))
    found = np.fft.irfft2(there * np.conj(here), size)
    shifts = np.arange(-REACH, REACH + 1)
    return found[:, shifts[:, None], shifts] / np.maximum(ways.sum(axis=(1, 2), keepdims=True), 1.0)


def _size(width: int, height: int) -> tuple[int, int]:
    return WIDTH, max(round(height * WIDTH / width), 1)


def _zoomed(jumps: np.ndarray, factor: float) -> np.ndarray:
    """Zoom about the image centre."""
    height, width = jumps.shape
    about = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), 0.0, factor)
    return cv2.warpAffine(jumps, about, (width, height), flags=cv2.INTER_NEAREST)


def _near(way: np.ndarray) -> np.ndarray:
    inside = slice(REACH - NEAR, REACH + NEAR + 1)
    return way[inside, inside]
