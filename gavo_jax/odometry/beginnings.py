"""Whether a run has followed the scene or a body since its beginning, or since its last break.

A body that fills the image is taken for the scene, as nothing moves against it. This shows only when the body leaves
and the track breaks. Nothing had been seen to move before. But a large part of the first pair after the break moves on
its own, or something began to move just before the break: the scene, seen from the body. Then the pairs before the
break followed the body.
"""

from typing import NamedTuple

PROVEN_AFTER = 1.0
"""Seconds of an unbroken track in which nothing moved after which it has followed the scene."""
SURVIVED = 0.3
"""Seconds for which a track has to last once something moves in it: one that follows a leaving body breaks sooner."""
LARGE = 0.25
"""Share of an image covered by bodies above which a body may have filled an earlier image."""


class Beginning(NamedTuple):
    """A track that is not yet known to have followed the scene."""

    since: float
    """Timestamp of its first frame, or of the first one after its last break."""
    references: int = 0
    """Frames that became the reference since its first one."""
    is_broken: bool = True
    """Whether the reference begins a segment."""
    moving_since: float | None = None
    """Timestamp of the first frame in which something was seen to move; None if there is none yet."""


def begun(before: Beginning | None, stamp: float) -> Beginning:
    """Begin a segment with a frame; what was in question before still is."""
    if before is None:
        return Beginning(stamp)
    return before._replace(since=stamp, references=before.references + 1, is_broken=True)


def followed(before: Beginning | None, stamp: float, share: float, *, is_reference: bool) -> Beginning | None:
    """Add a frame whose motion was found.

    Args:
        before: The track so far; None if it is known to have followed the scene.
        stamp: Timestamp of the frame.
        share: Share of the image that its bodies cover.
        is_reference: Whether it became the reference.
    """
    if before is None:
        return None
    if stamp < before.since:  # the clock was set back
        before = before._replace(since=stamp, moving_since=None if before.moving_since is None else stamp)
    if revised_by(before, share):
        before = Beginning(before.since)
    moving_since = stamp if before.moving_since is None and share > 0 else before.moving_since
    is_proven = stamp - before.since > PROVEN_AFTER if moving_since is None else stamp - moving_since > SURVIVED
    if is_proven:
        return None
    after = before._replace(moving_since=moving_since)
    return after._replace(references=before.references + 1, is_broken=False) if is_reference else after


def revised_by(before: Beginning | None, share: float) -> int:
    """Number of pairs before a frame that turn out to have followed a body; see `Step.revises`."""
    if before is None or not before.is_broken:
        return 0
    return before.references if share > LARGE or before.moving_since is not None else 0
