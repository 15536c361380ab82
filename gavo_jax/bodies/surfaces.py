"""Surfaces in front of others: what may be a body, according to one depth image.

A body occludes the scene, not the other way round. So surfaces in front of their neighbours may move, whatever the
motion.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Integer

FLAT, FLAT_NOISE = 0.02, 0.004
"""Relative and absolute (1/m) part of the step in inverse depth below which two neighbours lie on one surface."""
STEP, STEP_NOISE = 0.04, 0.01
"""Relative and absolute (1/m) part of the step in inverse depth above which one neighbour is in front of the other."""
WIDEST_SHADOW = 6
"""Distance in pixels, across missing depth, up to which two surfaces are still neighbours."""
BEFORE = 0.75
"""Share of its border along which a surface has to be in front of its neighbours to count as a candidate."""
LEAST_BORDER = 8
"""Fewest pixels of border along which a candidate is in front of its neighbours."""
LEAST_AREA = 0.015
"""Smallest share of the image that a candidate covers."""
MOST_TOGETHER = 0.5
"""Share of the image up to which smaller candidates than the largest one count, too."""
LEAST_NEAR, MOST_NEAR = 0.04, 0.95
"""Smallest and largest share of the image worth setting aside as a possible body."""
PART, LARGEST_COMPLETED = 0.3, 0.6
"""Share of a surface that has to move for all of it to count as moving, and the largest share of the image that it
fills.
"""
BINS = 64


class NearerPart(NamedTuple):
    """Pixels that may be a body; none where nothing may."""

    mask: Bool[np.ndarray, "h w"]
    stands_before: bool
    """Whether these surfaces are in front of others, and are not just the nearer part of the image."""


def nearer_part(inverse_depth: Float[np.ndarray, "h w"]) -> NearerPart:
    """Surfaces that are in front of others, or else the nearer part of the image.

    Args:
        inverse_depth: Inverse depth, 1/m; 0 where there is no reading.
    """
    for find, stands_before in ((standing_before, True), (_nearer_class, False)):
        mask = find(inverse_depth)
        if LEAST_NEAR < mask.mean() < MOST_NEAR:
            return NearerPart(mask, stands_before)
    return NearerPart(np.zeros(inverse_depth.shape, bool), False)


def standing_before(inverse_depth: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels of surfaces that are in front of their neighbours along most of their border."""
    return _standing_surfaces(inverse_depth) > 0


def whole_surfaces(
    bodies: Integer[np.ndarray, "h w"], lately: Bool[np.ndarray, "h w"], inverse_depth: Float[np.ndarray, "h w"]
) -> Integer[np.ndarray, "h w"]:
    """Extend each body to the whole of a surface that is in front of others and of which a large part is the body's.

    A body that turns is nearly at rest about its axis. Where no body was recently seen on the rest of the surface, the
    two only seem to be one surface.

    Args:
        bodies: Number of the body that each pixel shows, 0 for none.
        lately: Where a body was seen recently.
        inverse_depth: Inverse depth, 1/m; 0 where there is no reading.
    """
    if not np.any(bodies):
        return bodies
    whole, surfaces = bodies.copy(), _standing_surfaces(inverse_depth)
    for surface in np.unique(surfaces[(bodies > 0) & (surfaces > 0)]):
        on_it = surfaces == surface
        shown, rest = np.bincount(bodies[on_it]), on_it & (bodies == 0)
        is_part = PART * shown.sum() < shown[1:].sum() < shown.sum() < LARGEST_COMPLETED * bodies.size
        if is_part and np.mean(lately[rest]) > 0.5:
            whole[rest] = 1 + np.argmax(shown[1:])
    return whole


def _standing_surfaces(inverse_depth: Float[np.ndarray, "h w"]) -> Integer[np.ndarray, "h w"]:
    """Label each pixel of a surface that is in front of its neighbours along most of its border; 0 elsewhere."""
    labels, count = _surfaces(inverse_depth)
    before, behind = np.zeros(count), np.zeros(count)
    for q, surface in ((inverse_depth, labels), (inverse_depth.T, labels.T)):
        row, column = np.nonzero(q > 0)
        q, surface = q[row, column], surface[row, column]
        a, b = q[:-1], q[1:]
        meet = (np.diff(row) == 0) & (np.diff(column) <= WIDEST_SHADOW) & (np.diff(surface) != 0)
        meet &= np.abs(a - b) > STEP * np.maximum(a, b) + STEP_NOISE
        first, second, is_nearer = surface[:-1][meet], surface[1:][meet], (a > b)[meet]
        before += np.bincount(np.where(is_nearer, first, second), minlength=count)
        behind += np.bincount(np.where(is_nearer, second, first), minlength=count)
    area = np.bincount(labels.ravel(), minlength=count) / labels.size
    chosen = (area > LEAST_AREA) & (before > BEFORE * (before + behind)) & (before >= LEAST_BORDER)
    largest_first = np.argsort(-np.where(chosen, area, 0.0))
    together = np.cumsum(np.where(chosen, area, 0.0)[largest_first])
    chosen[largest_first[1:][together[1:] > MOST_TOGETHER]] = False
    return np.where(chosen[labels] & (inverse_depth > 0), labels, 0)


def _surfaces(q: Float[np.ndarray, "h w"]) -> tuple[Integer[np.ndarray, "h w"], int]:
    """Label each pixel's surface, and count the labels; pixels and the ties between them form one image."""
    height, width = q.shape
    ties = np.zeros((2 * height - 1, 2 * width - 1), np.uint8)
    ties[::2, ::2] = q > 0
    ties[::2, 1::2] = _tied(q[:, :-1], q[:, 1:])
    ties[1::2, ::2] = _tied(q[:-1], q[1:])
    count, labels = cv2.connectedComponents(ties, connectivity=4)
    return labels[::2, ::2], count


def _tied(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (np.abs(a - b) < FLAT * np.maximum(a, b) + FLAT_NOISE) & (a > 0) & (b > 0)


def _nearer_class(q: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The nearer of two classes of inverse depth, by Otsu's threshold."""
    known = q[q > 0]
    if known.size == 0 or known.min() == known.max():
        return np.zeros(q.shape, bool)
    low, high = float(known.min()), float(known.max())
    scaled = np.round((known - low) / (high - low) * (BINS - 1)).astype(np.uint8)
    threshold, _ = cv2.threshold(scaled, 0, BINS - 1, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    return q > low + (threshold + 0.5) / (BINS - 1) * (high - low)
