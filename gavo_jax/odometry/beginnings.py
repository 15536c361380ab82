"""Whose motion a run has followed since its beginning, or since it was broken.

A body that fills the image is taken for the scene: nothing moves against it. It shows only when it leaves. Then the
track breaks, and a large part of the first pair behind the break moves on its own. Nothing had been seen to move
before, so that was what the pairs before the break had followed.
"""

from typing import NamedTuple

PROVEN_AFTER = 1.0
"""Seconds of a track in which nothing moved, after which that was the scene."""
LARGE = 0.25
"""Share of an image that a body covers which may have filled an earlier one."""


class Beginning(NamedTuple):
    """A track of which it is not known yet whether it followed the scene."""

    since: float
    """Stamp of its first frame."""
    references: int = 0
    """Frames that became the reference since then."""
    is_broken: bool = True
    """Whether the reference begins a segment."""


def begun(before: Beginning | None, stamp: float) -> Beginning:
    """Begin a segment with a frame: what was not known before it is not known yet."""
    return Beginning(stamp) if before is None else before._replace(references=before.references + 1, is_broken=True)


def followed(before: Beginning | None, stamp: float, share: float, *, is_reference: bool) -> Beginning | None:
    """Add a frame whose motion was found.

    Args:
        before: The track up to it; None if that is known to have followed the scene.
        stamp: Of the frame.
        share: Of the image that its bodies cover.
        is_reference: Whether it became the reference.
    """
    if before is None or share > 0 or stamp - before.since > PROVEN_AFTER:
        return None
    return before._replace(references=before.references + 1, is_broken=False) if is_reference else before


def revised_by(before: Beginning | None, share: float) -> int:
    """How many of the pairs before a frame it shows to have followed a body; see `Step.revises`."""
    return before.references if before is not None and before.is_broken and share > LARGE else 0
