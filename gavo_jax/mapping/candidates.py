"""Which earlier keyframes may show what a new one shows: those that would look like it from where it stands."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from gavo_jax.alignment.corners import NEAREST
from gavo_jax.camera import Camera, in_image, to_pixels
from gavo_jax.mapping.keyframes import Keyframe
from gavo_jax.rigid_motions import length_and_angle
from gavo_jax.trajectory import inverse

MOST = 4
"""Candidates of one keyframe, which bounds the work."""
LOOKED_AT = 48
"""Earlier keyframes, those that see most of what the new one sees, that are compared with it: this bounds the work."""
FEW_POINTS = 60
"""Points of the new keyframe by which these are chosen."""
MIN_SECONDS = 0.2
"""Least time between the two keyframes: within that, the odometry's own keyframe saw both, and nothing is learnt."""
MIN_OVERLAP = 0.5
"""Smallest predicted share of either keyframe's points that the other one sees."""
NEARLY = 0.8
"""Part of that, by few points, from which on a keyframe is looked at more closely."""
MIN_LIKENESS = 0.88
"""Smallest correlation of the grey of what both keyframes see."""
APART = 2
"""Keyframes between two candidates: neighbours would say the same twice."""
ANOTHER_GUESS = (0.02, 0.02)
"""Metres and radians by which a guess has to differ from one that led to nothing."""


class LoopCandidate(NamedTuple):
    """A pair of keyframes that may overlap."""

    earlier: Keyframe
    later: Keyframe
    later_T_earlier: Float64[np.ndarray, "4 4"]
    """The motion between the two as it is known now: the guess."""
    overlap: float
    """Predicted share of the points of either keyframe that the other one sees, the smaller one of the two."""
    likeness: float
    """Correlation of the grey of what both see, the smaller one of the two directions."""


def find_candidates(new: Keyframe, others: list[Keyframe], camera: Camera) -> list[LoopCandidate]:
    """The candidates of a keyframe among earlier ones that have their images, the likest first; no more than `MOST`.

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
    return found[:MOST]


def _most_overlapping(new: Keyframe, others: list[Keyframe], camera: Camera) -> list[Keyframe]:
    """Those of some earlier keyframes that were not tried yet and see most of what a new one sees."""
    old = [o for o in others if new.timestamp - o.timestamp >= MIN_SECONDS and not _was_tried(new, o)]
    points = new.thumbnail.points[:, :: max(1, new.thumbnail.points.shape[1] // FEW_POINTS)]
    if not old or not points.size:
        return []
    old_T_new = inverse(np.stack([other.world_T_camera for other in old])) @ new.world_T_camera
    x, y, z = np.moveaxis(old_T_new[:, :3, :3] @ points + old_T_new[:, :3, 3:], 1, 0)
    ahead = z > NEAREST
    u, v = to_pixels(camera, x, y, 1.0 / np.where(ahead, z, 1.0))
    seen = np.mean(ahead & in_image(camera, u, v), axis=1)
    return [old[k] for k in np.argsort(-seen, kind="stable")[:LOOKED_AT] if seen[k] >= NEARLY * MIN_OVERLAP]


def _was_tried(new: Keyframe, other: Keyframe) -> bool:
    """Whether they are linked, or were aligned in vain from about the same guess."""
    if other.number in new.linked:
        return True
    guess = new.tried.get(other.number)
    if guess is None:
        return False
    later_T_earlier = inverse(new.world_T_camera) @ other.world_T_camera
    changes = length_and_angle(inverse(guess) @ later_T_earlier)
    return all(change < least for change, least in zip(changes, ANOTHER_GUESS, strict=True))
