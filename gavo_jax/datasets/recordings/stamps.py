"""The stamps of a recording's messages: by which clock they are paired, and which of them count."""

from bisect import bisect, insort
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

JITTER = 0.5
"""Seconds by which stamps may go back in the order of arrival; by more, a clock was set back."""

HOLE, AMID = 1.5, 2
"""Times the usual step: the least that a message which comes late leaves open, into which its stamp belongs. So many
stamps one after the other that belong into none are of a clock that was set back by less than `JITTER`."""


class Topic(NamedTuple):
    """The messages of one topic, in the order in which they were received."""

    name: str
    kind: str
    received: np.ndarray
    """Nanoseconds."""
    stamps: np.ndarray
    """Seconds, of their headers; 0 where they have none."""
    repeated: int = 0
    """How many have the stamp of one before them."""
    aside: int = 0
    """How many are of another run of the clock than those that are used."""
    why: str = ""
    """Where the clock was set back."""

    @property
    def span(self) -> str:
        """The first and the last stamp, in words."""
        if not len(self.stamps):
            return f"{self.name} has no message"
        return f"{self.name} goes from {np.nanmin(self.stamps):.3f} to {np.nanmax(self.stamps):.3f}"


def in_one_time(color: Topic, depth: Topic) -> tuple[Topic, Topic]:
    """Stamp both by the headers, without which a message has no partner; where a topic has none, by arrival.

    Stamps that stand still are none.
    """
    topics = color, depth
    if all(topic.stamps.any() and (len(topic.stamps) < 2 or np.ptp(topic.stamps)) for topic in topics):
        color, depth = (topic._replace(stamps=np.where(topic.stamps > 0, topic.stamps, np.nan)) for topic in topics)
    else:
        color, depth = (topic._replace(stamps=topic.received * 1e-9) for topic in topics)
    return color, depth


def of_one_run(color: Topic, depth: Topic) -> tuple[Topic, Topic]:
    """Topics of which the longest run of colour's clock counts: a simulator that is reset sets the clock back.

    Messages of two runs may have the same stamps, and are of different places.
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
    """A topic of which a message that comes twice, by its stamp, counts the first time.

    Two publishers of one topic leave such, or a recording that was played while it was recorded again.
    """
    is_first = np.zeros(len(topic.stamps), bool)
    is_first[np.unique(topic.stamps, return_index=True)[1]] = True
    again = ~is_first & np.isfinite(topic.stamps)
    return topic._replace(stamps=np.where(again, np.nan, topic.stamps), repeated=int(again.sum()))


def _runs(stamps: np.ndarray) -> np.ndarray:
    """Which run of the clock each message is of; -1 for one without a stamp, or with one far from both beside it."""
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
    """Whether stamps lie amid earlier ones, in order, that leave none of them open; those that come again do not."""
    places = [bisect(earlier, float(stamp)) for stamp in stamps]
    return len(stamps) == AMID and all(
        0 < place < len(earlier) and earlier[place - 1] < stamp and earlier[place] - earlier[place - 1] < hole
        for place, stamp in zip(places, stamps, strict=True)
    )


def _longest(runs: np.ndarray) -> int:
    """The run that most messages are of, the first of several."""
    return int(np.bincount(runs[runs >= 0], minlength=1).argmax())


def _aside(topic: Topic, is_used: np.ndarray) -> Topic:
    """A topic of which some messages lose their stamps, with the place where the clock is set back the most."""
    aside = ~is_used & np.isfinite(topic.stamps)
    if not aside.any():
        return topic
    stamped = np.flatnonzero(np.isfinite(topic.stamps))
    steps = np.diff(topic.stamps[stamped])
    at, seconds = int(stamped[steps.argmin() + 1]), -float(steps.min())
    why = f"the stamps go back by {seconds:.1f} s at message {at + 1}, and the longest stretch alone is used"
    return topic._replace(stamps=np.where(aside, np.nan, topic.stamps), aside=int(aside.sum()), why=why)
