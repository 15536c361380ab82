"""Timestamps of a recording's messages: which clock pairs them, and which messages are used."""

from bisect import bisect, insort
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

JITTER = 0.5
"""Largest step back of stamps in the order of arrival, seconds; after a larger one the clock was reset."""

HOLE, AMID = 1.5, 2
"""Smallest gap left by a late message, whose stamp falls into it, in median steps. `AMID` successive stamps that go
back but fall into no gap mean that the clock was reset by less than `JITTER`."""


class Topic(NamedTuple):
    """The messages of one topic, in the order in which they were received."""

    name: str
    kind: str
    received: np.ndarray
    """Time of arrival, nanoseconds."""
    stamps: np.ndarray
    """Stamps of the headers, seconds; 0 where they have none, NaN where a message is not used."""
    repeated: int = 0
    """Number of messages with the stamp of an earlier one."""
    aside: int = 0
    """Number of messages from other runs of the clock, which are not used."""
    why: str = ""
    """Description of where the clock was reset."""

    @property
    def span(self) -> str:
        """The first and last stamp, for messages."""
        if not len(self.stamps):
            return f"{self.name} has no message"
        return f"{self.name} goes from {np.nanmin(self.stamps):.3f} to {np.nanmax(self.stamps):.3f}"


def in_one_time(color: Topic, depth: Topic) -> tuple[Topic, Topic]:
    """Stamp both topics by their headers, or by arrival if either topic has no header stamps.

    Stamps that are all equal don't count. With header stamps, messages without one aren't paired.
    """
    topics = color, depth
    if all(topic.stamps.any() and (len(topic.stamps) < 2 or np.ptp(topic.stamps)) for topic in topics):
        color, depth = (topic._replace(stamps=np.where(topic.stamps != 0, topic.stamps, np.nan)) for topic in topics)
    else:
        color, depth = (topic._replace(stamps=topic.received * 1e-9) for topic in topics)
    return color, depth


def of_one_run(color: Topic, depth: Topic) -> tuple[Topic, Topic]:
    """Keep only the longest run of the clock: resetting a simulator resets its clock.

    Messages of two runs may have equal stamps although they show different places.
    """
    runs = _runs(color.stamps)
    is_used = runs == _longest(runs)
    if not is_used.any():
        return color, depth
    arrived, margin = color.received[is_used], int(JITTER * 1e9)
    runs = _runs(depth.stamps)
    is_near = (depth.received >= arrived[0] - margin) & (depth.received <= arrived[-1] + margin)
    return _aside(color, is_used), _aside(depth, runs == _longest(runs[is_near]))


def once(topic: Topic) -> Topic:
    """Keep only the first of messages with equal stamps.

    Repetitions come from two publishers of one topic, or from recording a recording that is played.
    """
    is_first = np.zeros(len(topic.stamps), bool)
    is_first[np.unique(topic.stamps, return_index=True)[1]] = True
    again = ~is_first & np.isfinite(topic.stamps)
    return topic._replace(stamps=np.where(again, np.nan, topic.stamps), repeated=int(again.sum()))


def _runs(stamps: np.ndarray) -> np.ndarray:
    """The run of the clock that each message belongs to; -1 if it has no stamp, or one far from both neighbours'."""
    stamped = np.flatnonzero(np.isfinite(stamps))
    before, here, after = (stamps[stamped[part]] for part in (slice(-2), slice(1, -1), slice(2, None)))
    is_stray = (before <= after + JITTER) & ((here > after + JITTER) | (here < before - JITTER))
    runs, run, earlier = np.full(len(stamps), -1), 0, []
    kept = np.setdiff1d(stamped, stamped[1:-1][is_stray])
    steps = np.diff(stamps[kept])
    hole = HOLE * float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    for place, number in enumerate(kept):
        if earlier and stamps[number] < earlier[-1]:
            coming = stamps[kept[place : place + AMID]]
            if stamps[number] < earlier[-1] - JITTER or _are_amid(coming, earlier, hole):
                run, earlier = run + 1, []
        insort(earlier, float(stamps[number]))
        runs[number] = run
    return runs


def _are_amid(stamps: np.ndarray, earlier: Sequence[float], hole: float) -> bool:
    """Whether all stamps fall strictly between earlier ones, but into no gap; repeated stamps don't."""
    places = [bisect(earlier, float(stamp)) for stamp in stamps]
    return len(stamps) == AMID and all(
        0 < place < len(earlier) and earlier[place - 1] < stamp and earlier[place] - earlier[place - 1] < hole
        for place, stamp in zip(places, stamps, strict=True)
    )


def _longest(runs: np.ndarray) -> int:
    """The run with most messages, the first if several have as many."""
    return int(np.bincount(runs[runs >= 0], minlength=1).argmax())


def _aside(topic: Topic, is_used: np.ndarray) -> Topic:
    """Remove the stamps of unused messages, and describe where the clock goes back the most."""
    aside = ~is_used & np.isfinite(topic.stamps)
    if not aside.any():
        return topic
    stamped = np.flatnonzero(np.isfinite(topic.stamps))
    steps = np.diff(topic.stamps[stamped])
    at, seconds = int(stamped[steps.argmin() + 1]), -float(steps.min())
    why = f"the stamps go back by {seconds:.1f} s at message {at + 1}; only the longest stretch is used"
    return topic._replace(stamps=np.where(aside, np.nan, topic.stamps), aside=int(aside.sum()), why=why)
