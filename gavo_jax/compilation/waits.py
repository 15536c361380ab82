"""Time that a thread has waited for compiled programs, which is reported and excluded from the work's own time."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class _Waits(threading.local):
    """Waiting time and callback of each thread."""

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
    """Call a function whenever this thread begins to wait while the block runs."""
    before, _waits.tell = _waits.tell, tell
    try:
        yield
    finally:
        _waits.tell = before


class Stopwatch:
    """Measures this thread's time since the watch was made."""

    def __init__(self) -> None:
        self._start, self._waited = time.perf_counter(), _waits.seconds

    @property
    def waited(self) -> float:
        """Seconds spent waiting for programs."""
        return _waits.seconds - self._waited

    @property
    def seconds(self) -> float:
        """Seconds not spent waiting."""
        return time.perf_counter() - self._start - self.waited
