"""From a mask to bodies: its connected parts, and which body of the last frame each one is."""

import itertools
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int32, Integer

from gavo_jax.odometry.plausibility import UNKNOWN_SECONDS

MIN_BODY_SHARE = 0.008
"""Smallest share of the image that a body covers."""
MIN_NEW_EVIDENCE = 0.03
"""Evidence above which a component is a new body: summed belief that its pixels move, as a share of the image."""
MIN_EXPLAINING_EVIDENCE = 0.015
"""Evidence that suffices for the largest component where depth disagrees with the motion found: a body would explain
that.
"""
MIN_KNOWN_EVIDENCE = 0.006
"""Evidence that suffices for a body known from the last frame."""
THICK = 6 / 160
"""Radius, over the image's width, of a disc that has to fit inside a new body."""
MAX_BODIES = 8
"""Maximum number of bodies at a time; the largest ones are kept."""
REACH = 2.0
"""Distance up to which a part that overlaps no body can be one, over the square root of the smaller one's area."""
MAX_UNSEEN = 15
"""Frames after which an unseen body is forgotten."""


class BodyTracks(NamedTuple):
    """The known bodies, and where each was last seen."""

    labels: Integer[np.ndarray, "h w"]
    """Number of the body that each pixel of the last frame shows, 0 for none."""
    numbers: Integer[np.ndarray, " n"]
    """Numbers of the known bodies; 0 in free places."""
    ages: Integer[np.ndarray, " n"]
    """Frames since each was seen."""
    motions: Float[np.ndarray, "n 6"]
    """Twist of each body's last motion in the camera; 0 where it is unknown."""
    seconds: Float[np.ndarray, " n"]
    """Duration of each body's last motion, seconds; `UNKNOWN_SECONDS` where it is unknown."""
    last: Integer[np.ndarray, ""]
    """The largest number given so far."""

    @classmethod
    def empty(cls, size: tuple[int, int]) -> "BodyTracks":
        """No known bodies, for an image of some height and width."""
        return cls(
            np.zeros(size, np.int32),
            np.zeros(MAX_BODIES, np.int32),
            np.zeros(MAX_BODIES, np.int32),
            np.zeros((MAX_BODIES, 6), np.float32),
            np.full(MAX_BODIES, UNKNOWN_SECONDS, np.float32),
            np.int32(0),  # pyright: ignore[reportArgumentType]
        )


def body_components(
    moving: Float[np.ndarray, "h w"],
    known: Float[np.ndarray, "h w"],
    before: Bool[np.ndarray, "h w"],
    depth_disagrees: bool = False,
) -> Integer[np.ndarray, "h w"]:
    """Connected parts of a mask that are bodies, numbered 1, 2, … from the largest one; 0 elsewhere.

    Thin parts, and parts with little evidence, are dropped: depth and grey disagree along edges of a correct motion,
    too. The limits are lower for a body that was already known.

    Args:
        moving: Positive where something moves; see `Belief`.
        known: See `Belief`.
        before: Where bodies were in the last frame.
        depth_disagrees: Whether depth disagrees with the motion found.
    """
    mask = moving > 0
    labels = np.zeros(mask.shape, np.int32)
    if mask.mean() < MIN_BODY_SHARE:
        return labels
    found = 0
    count, split, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    depth = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3)
    thick = THICK * mask.shape[1]
    for k in np.argsort(-stats[1:, cv2.CC_STAT_AREA]) + 1:
        if stats[k, cv2.CC_STAT_AREA] < MIN_BODY_SHARE * mask.size or found == MAX_BODIES:
            break
        part = split == k
        was_known = np.mean(before[part]) > 0.3
        evidence = np.sum(np.maximum(known[part], 0.0)) / mask.size
        least = MIN_EXPLAINING_EVIDENCE if depth_disagrees and found == 0 else MIN_NEW_EVIDENCE
        least = MIN_KNOWN_EVIDENCE if was_known else least
        if depth[part].max() > (0.5 * thick if was_known else thick) and evidence > least:
            found += 1
            labels[part] = found
    return labels


def associate(found: Integer[np.ndarray, "h w"], tracks: BodyTracks) -> BodyTracks:
    """Give each part of a mask the number of the known body that it overlaps most, or a new one.

    Args:
        found: Parts from `body_components`, in the new frame.
        tracks: Tracks of the last frame.
    """
    given = _numbers(found, tracks)
    seen = given[1:]
    labels = given[found]
    lasting = [i for i, n in enumerate(tracks.numbers) if n > 0 and n not in seen and tracks.ages[i] < MAX_UNSEEN]
    for i in lasting:  # hidden, or at rest for a moment: expected where it was last seen
        labels = np.where((labels == 0) & (tracks.labels == tracks.numbers[i]), tracks.numbers[i], labels)
    last = np.int32(max(int(tracks.last), *given))
    after = BodyTracks.empty((labels.shape[0], labels.shape[1]))._replace(labels=labels, last=last)  # pyright: ignore[reportArgumentType]
    entries = [(n, 0) for n in seen] + [(tracks.numbers[i], tracks.ages[i] + 1) for i in lasting]
    for place, (number, age) in enumerate(entries[:MAX_BODIES]):
        after.numbers[place], after.ages[place] = number, age
        for old in np.flatnonzero(tracks.numbers == number):
            after.motions[place], after.seconds[place] = tracks.motions[old], tracks.seconds[old]
    return after


def _numbers(found: Integer[np.ndarray, "h w"], tracks: BodyTracks) -> Int32[np.ndarray, " parts"]:
    """The body number of each part of a mask, after a 0 for the background.

    Parts are matched with known bodies one to one, the largest overlap first. A part that overlaps none is the nearest
    body of the last frame within reach, as in a fast pan; the other parts get new numbers.
    """
    parts = range(1, int(found.max(initial=0)) + 1)
    is_recent = dict(zip(tracks.numbers.tolist(), (tracks.ages == 0).tolist(), strict=True))
    matches = []
    for part, number in itertools.product(parts, tracks.numbers[tracks.numbers > 0].tolist()):
        here, there = found == part, tracks.labels == number
        if not np.any(there):
            continue
        if overlap := int(np.sum(here & there)):
            matches.append((-overlap, 0.0, part, number))
        elif is_recent[number]:
            apart = _distance(here, there)
            if apart < REACH * np.sqrt(min(np.sum(here), np.sum(there))):
                matches.append((0, apart, part, number))
    given: dict[int, int] = {}
    for _, _, part, number in sorted(matches):
        if part not in given and number not in given.values():
            given[part] = number
    new = itertools.count(int(tracks.last) + 1)
    return np.array([0, *(given[part] if part in given else next(new) for part in parts)], np.int32)


def _distance(one: Bool[np.ndarray, "h w"], other: Bool[np.ndarray, "h w"]) -> float:
    """Distance between the centroids of two masks, pixels."""
    return float(np.linalg.norm(np.argwhere(one).mean(axis=0) - np.argwhere(other).mean(axis=0)))
