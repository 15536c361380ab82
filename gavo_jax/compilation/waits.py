"""Time that a thread has waited for compiled programs, which is reported and excluded from the work's own time."""

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


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


def counted_map(pool: Executor, work: Callable[[T], R], values: Iterable[T]) -> list[R]:
    """Map values by the threads of a pool; the longest of their waits counts as this thread's own."""

    def watched(value: T) -> tuple[R, int, float]:
        stopwatch = Stopwatch()
        result = work(value)
        return result, threading.get_ident(), stopwatch.waited

    done, by_thread = list(pool.map(watched, values)), dict[int, float]()
    for _, thread, waited in done:
        by_thread[thread] = by_thread.get(thread, 0.0) + waited
    _waits.seconds += max(by_thread.values(), default=0.0)
    return [result for result, *_ in done]


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
