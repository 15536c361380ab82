"""Loop candidates: earlier keyframes that, from where a new one stands, would look like it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from gavo_jax.alignment.corners import NEAREST
from gavo_jax.camera import Camera, in_image, to_pixels
from gavo_jax.mapping.keyframes import Keyframe
from gavo_jax.rigid_motions import length_and_angle
from gavo_jax.trajectory import inverse

MAX_CANDIDATES = 4
"""Maximum number of candidates per keyframe, which bounds the work."""
MAX_COMPARED = 48
"""Maximum number of earlier keyframes compared with a new one, those that see most of the same; it bounds the work."""
FEW_POINTS = 60
"""About how many of the new keyframe's points are used to choose the earlier ones."""
MIN_SECONDS = 0.2
"""Shortest time between the two keyframes, seconds: within it, the odometry's own keyframe saw both, and nothing is
learnt.
"""
MIN_OVERLAP = 0.5
"""Smallest predicted share of the points of either keyframe that the other one sees."""
NEARLY = 0.8
"""Part of `MIN_OVERLAP`, by `FEW_POINTS`, from which on a keyframe is examined more closely."""
MIN_LIKENESS = 0.88
"""Smallest correlation of the grey of what both keyframes see."""
APART = 2
"""Least distance between two candidates, in keyframes: neighbours would add no information."""
ANOTHER_GUESS = (0.02, 0.02)
"""Metres or radians by which a guess has to differ from one that led to nothing."""


class LoopCandidate(NamedTuple):
    """A pair of keyframes that may overlap."""

    earlier: Keyframe
    later: Keyframe
    later_T_earlier: Float64[np.ndarray, "4 4"]
    """Current estimate of the motion between the two: the guess."""
    overlap: float
    """Predicted share of the points of either keyframe that the other one sees; the smaller one of the two."""
    likeness: float
    """Correlation of the grey of what both keyframes see; the smaller one of the two directions."""


def find_candidates(new: Keyframe, others: list[Keyframe], camera: Camera) -> list[LoopCandidate]:
    """Find a keyframe's candidates among earlier ones that have their images.

    There are at most `MAX_CANDIDATES`, the most similar first.

    Args:
        new: The later keyframe.
        others: The earlier keyframes.
        camera: Camera of the keyframes' images.
    """
    possible = []
    for other in _most_overlapping(new, others, camera):
        later_T_earlier = inverse(new.world_T_camera) @ other.world_T_camera
        back = new.thumbnail.agreement(other.thumbnail, inverse(later_T_earlier), camera)
        if back[0] < MIN_OVERLAP or back[1] < MIN_LIKENESS:
            continue
        there = other.thumbnail.agreement(new.thumbnail, later_T_earlier, camera)
        overlap, likeness = min(there[0], back[0]), min(there[1], back[1])
        if overlap >= MIN_OVERLAP and likeness >= MIN_LIKENESS:
            possible.append(LoopCandidate(other, new, later_T_earlier, overlap, likeness))
    possible.sort(key=lambda candidate: -candidate.likeness)
    found: list[LoopCandidate] = []
    for candidate in possible:
        if all(abs(candidate.earlier.number - chosen.earlier.number) >= APART for chosen in found):
            found.append(candidate)
    return found[:MAX_CANDIDATES]


def _most_overlapping(new: Keyframe, others: list[Keyframe], camera: Camera) -> list[Keyframe]:
    """Earlier keyframes that were not tried yet and see most of what the new one sees."""
    old = [o for o in others if abs(new.timestamp - o.timestamp) >= MIN_SECONDS and not _was_tried(new, o)]
    points = new.thumbnail.points[:, :: max(1, new.thumbnail.points.shape[1] // FEW_POINTS)]
    if not old or not points.size:
        return []
    old_T_new = inverse(np.stack([other.world_T_camera for other in old])) @ new.world_T_camera
    x, y, z = np.moveaxis(old_T_new[:, :3, :3] @ points + old_T_new[:, :3, 3:], 1, 0)
    ahead = z > NEAREST
    u, v = to_pixels(camera, x, y, 1.0 / np.where(ahead, z, 1.0))
    seen = np.mean(ahead & in_image(camera, u, v), axis=1)
    return [old[k] for k in np.argsort(-seen, kind="stable")[:MAX_COMPARED] if seen[k] >= NEARLY * MIN_OVERLAP]


def _was_tried(new: Keyframe, other: Keyframe) -> bool:
    """Whether two keyframes are linked, or an alignment from about the same guess failed."""
    if other.number in new.linked:
        return True
    guess = new.tried.get(other.number)
    if guess is None:
        return False
    later_T_earlier = inverse(new.world_T_camera) @ other.world_T_camera
    changes = length_and_angle(inverse(guess) @ later_T_earlier)
    return all(change < least for change, least in zip(changes, ANOTHER_GUESS, strict=True))
