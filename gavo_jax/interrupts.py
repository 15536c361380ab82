"""Ctrl-C at any moment of the command: one line on standard error, and exit status 130.

While modules are imported the process ends at once (`early`). After that Ctrl-C is a KeyboardInterrupt, as in any
program, with two additions. Where Python would drop it (in a finaliser, or a callback of the garbage collector) it is
raised again, and a compiler that cannot be interrupted is not waited for.

This applies to the command only; other programs are unaffected.
"""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any, TypeVar

from gavo_jax import early

R = TypeVar("R")

AGAIN_AFTER = 0.02
"""Seconds after which a dropped interrupt is raised again: the callback that dropped it has ended by then."""

_came = False
"""Whether Ctrl-C was pressed."""


@contextlib.contextmanager
def raised() -> Iterator[None]:
    """Let Ctrl-C raise KeyboardInterrupt while the block runs; after it the command ignores Ctrl-C."""
    before = signal.getsignal(signal.SIGINT)
    is_ours = before is early.end
    if threading.current_thread() is not threading.main_thread() or not (
        is_ours or before is signal.default_int_handler
    ):
        yield
        return
    global _came
    _came = False
    hook = sys.unraisablehook

    def raise_again(dropped: Any) -> None:
        if dropped.exc_type is not KeyboardInterrupt:
            hook(dropped)
            return
        timer = threading.Timer(AGAIN_AFTER, _send_again)
        timer.daemon = True
        timer.start()

    sys.unraisablehook = raise_again
    signal.signal(signal.SIGINT, _raise)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN if is_ours else before)
        sys.unraisablehook = hook


def leave(status: int) -> None:
    """End the command's process at once if Ctrl-C was pressed, as compiler threads may still be running.

    A normal exit would wait for them, or free what they still use.
    """
    if early.is_ours and _came:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        os._exit(status)


def came() -> bool:
    """Whether Ctrl-C was pressed in the last `raised` block."""
    return _came


def ignore() -> None:
    """Ignore further Ctrl-C in a `raised` block: it was pressed, and little is left to do."""
    if signal.getsignal(signal.SIGINT) is _raise:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextlib.contextmanager
def postponed() -> Iterator[None]:
    """Let Ctrl-C in a `raised` block wait for the end of this one, which should be short."""
    if signal.getsignal(signal.SIGINT) is not _raise or threading.current_thread() is not threading.main_thread():
        yield
        return
    pressed: list[int] = []
    signal.signal(signal.SIGINT, lambda number, frame: pressed.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, _raise)
        if pressed:
            _raise(signal.SIGINT, None)


def interruptible(work: Callable[[], R]) -> R:
    """Call a function that spends long in compiled code, without making Ctrl-C wait for its end.

    In a `raised` block it runs in its own thread; elsewhere this is a plain call.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed. The function keeps running until the process ends, so it must write files
            atomically only.
    """
    if signal.getsignal(signal.SIGINT) is not _raise or threading.current_thread() is not threading.main_thread():
        return work()
    results: list[R] = []
    faults: list[BaseException] = []

    def do() -> None:
        try:
            results.append(work())
        except BaseException as fault:
            faults.append(fault)

    thread = threading.Thread(target=do, daemon=True)
    thread.start()
    thread.join()
    if faults:
        raise faults[0]
    return results[0]


def _raise(number: int, frame: FrameType | None) -> None:
    global _came
    _came = True
    raise KeyboardInterrupt


def _send_again() -> None:
    """Send the signal again, to the main thread, and wake it if it is waiting."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        signal.raise_signal(signal.SIGINT)
