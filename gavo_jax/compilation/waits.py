"""How long a thread has waited for compiled programs: that is told, and does not count as the work's own time."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class _Waits(threading.local):
    """Of each thread its own."""

    seconds = 0.0
    tell: Callable[[], None] | None = None


_waits = _Waits()


@contextmanager
def counted_wait() -> Iterator[None]:
    """Count the block's time as a wait."""
    if _waits.tell is not None:
        _waits.tell()
    start = time.perf_counter()
    try:
        yield
    finally:
        _waits.seconds += time.perf_counter() - start


@contextmanager
def told_of_waits(tell: Callable[[], None]) -> Iterator[None]:
    """Have a function called whenever this thread begins to wait, while the block runs."""
    before, _waits.tell = _waits.tell, tell
    try:
        yield
    finally:
        _waits.tell = before


class Stopwatch:
    """Time of this thread since the watch was made."""

    def __init__(self) -> None:
        self._start, self._waited = time.perf_counter(), _waits.seconds

    @property
    def waited(self) -> float:
        """Seconds that it waited for programs."""
        return _waits.seconds - self._waited

    @property
    def seconds(self) -> float:
        """All others."""
        return time.perf_counter() - self._start - self.waited
