"""Which surfaces stand before others: what may be a body, told from one depth image.

A body hides the scene and not the other way round. So the surfaces that stand before their neighbours are those that
may move, whatever the motion.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Integer

FLAT, FLAT_NOISE = 0.02, 0.004
"""Share of the larger inverse depth, and 1/m added to it: two neighbours that differ by less lie on one surface."""
STEP, STEP_NOISE = 0.04, 0.01
"""The same: of two neighbours that differ by more, one stands before the other."""
WIDEST_SHADOW = 6
"""Pixels without depth across which two surfaces still are neighbours."""
BEFORE = 0.75
"""Share of its border along which a surface has to stand before its neighbours to count as one that may move."""
LEAST_BORDER = 8
"""Fewest pixels of such a border."""
LEAST_AREA = 0.015
"""Smallest share of the image that such a surface covers."""
MOST_TOGETHER = 0.5
"""Share of the image up to which smaller surfaces than the largest one count, too."""
LEAST_NEAR, MOST_NEAR = 0.04, 0.95
"""Share of the image that may move together; less or more is not worth to ask about."""
PART, LARGEST_COMPLETED = 0.3, 0.6
"""Share of such a surface that moves, from which on all of it does, if it fills no more of the image than this."""
BINS = 64


class NearerPart(NamedTuple):
    """The pixels of what may be a body; none where nothing may."""

    mask: Bool[np.ndarray, "h w"]
    stands_before: bool
    """Whether these are surfaces that stand before others, and not just the nearer part of the image."""


def nearer_part(inverse_depth: Float[np.ndarray, "h w"]) -> NearerPart:
    """Surfaces that stand before others, or else the nearer part of the image.

    Args:
        inverse_depth: 1/m; 0 where there is no reading.
    """
    for find, stands_before in ((standing_before, True), (_nearer_class, False)):
        mask = find(inverse_depth)
        if LEAST_NEAR < mask.mean() < MOST_NEAR:
            return NearerPart(mask, stands_before)
    return NearerPart(np.zeros(inverse_depth.shape, bool), False)


def standing_before(inverse_depth: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The pixels of surfaces that stand before their neighbours along most of their border."""
    return _standing_surfaces(inverse_depth) > 0


def whole_surfaces(
    bodies: Integer[np.ndarray, "h w"], lately: Bool[np.ndarray, "h w"], inverse_depth: Float[np.ndarray, "h w"]
) -> Integer[np.ndarray, "h w"]:
    """Bodies with all of each surface that stands before others and of which a part is theirs: a body that turns is
    nearly at rest about its axis. Where no body was seen on the rest they only seem to be one surface.

    Args:
        bodies: Number of the body that each pixel shows, 0 for none.
        lately: Where a body was seen lately.
        inverse_depth: 1/m; 0 where there is no reading.
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
    """A number for each pixel of a surface that stands before its neighbours along most of its border; else 0."""
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
    """A number for each pixel's surface, and how many there are; pixels and the ties between them make one image."""
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
    """The nearer one of two classes of inverse depth, by Otsu's threshold."""
    known = q[q > 0]
    if known.size == 0 or known.min() == known.max():
        return np.zeros(q.shape, bool)
    low, high = float(known.min()), float(known.max())
    scaled = np.round((known - low) / (high - low) * (BINS - 1)).astype(np.uint8)
    threshold, _ = cv2.threshold(scaled, 0, BINS - 1, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    return q > low + (threshold + 0.5) / (BINS - 1) * (high - low)
