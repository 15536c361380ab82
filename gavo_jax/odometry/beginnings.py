"""Whose motion a run has followed since its beginning, or since it was broken.

A body that fills the image is taken for the scene: nothing moves against it. It shows only when it leaves. Then the
track breaks. Nothing had been seen to move before; now a large part of the first pair behind the break moves on its
own, or something came to move just before the break: the scene, seen from the body. So the body was what the pairs
before the break had followed.
"""

from typing import NamedTuple

PROVEN_AFTER = 1.0
"""Seconds of an unbroken track in which nothing moved, after which that was the scene."""
SURVIVED = 0.3
"""Seconds for which a track has to last once something moves in it: who follows what leaves loses it sooner."""
LARGE = 0.25
"""Share of an image that a body covers which may have filled an earlier one."""


class Beginning(NamedTuple):
    """A track of which it is not known yet whether it followed the scene."""

    since: float
    """Stamp of its first frame, or of the first one behind its last break."""
    references: int = 0
    """Frames that became the reference since its first one."""
    is_broken: bool = True
    """Whether the reference begins a segment."""
    moving_since: float | None = None
    """Stamp of the first frame in which something was seen to move; None before there is one."""


def begun(before: Beginning | None, stamp: float) -> Beginning:
    """Begin a segment with a frame: what was not known before it is not known yet."""
    if before is None:
        return Beginning(stamp)
    return before._replace(since=stamp, references=before.references + 1, is_broken=True)


def followed(before: Beginning | None, stamp: float, share: float, *, is_reference: bool) -> Beginning | None:
    """Add a frame whose motion was found.

    Args:
        before: The track up to it; None if that is known to have followed the scene.
        stamp: Of the frame.
        share: Of the image that its bodies cover.
        is_reference: Whether it became the reference.
    """
    if before is None:
        return None
    if revised_by(before, share):
        before = Beginning(before.since)
    moving_since = stamp if before.moving_since is None and share > 0 else before.moving_since
    is_proven = stamp - before.since > PROVEN_AFTER if moving_since is None else stamp - moving_since > SURVIVED
    if is_proven:
        return None
    after = before._replace(moving_since=moving_since)
    return after._replace(references=before.references + 1, is_broken=False) if is_reference else after


def revised_by(before: Beginning | None, share: float) -> int:
    """How many of the pairs before a frame it shows to have followed a body; see `Step.revises`."""
    if before is None or not before.is_broken:
        return 0
    return before.references if share > LARGE or before.moving_since is not None else 0
