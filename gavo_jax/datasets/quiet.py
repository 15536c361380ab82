"""Suppression of messages that image libraries print to stdout and stderr, bypassing Python; callers can get them."""

import contextlib
import errno
import io
import os
import tempfile
import threading
from collections.abc import Iterator
from functools import cache

import cv2

EXR_WARNING = "Exception raised reading pixel data"
"""Part of OpenEXR's message about a truncated file."""

_ASIDE = threading.Lock()
"""Held while the process's stderr is redirected, and while the process forks."""


@contextlib.contextmanager
def without_log() -> Iterator[None]:
    """Silence OpenCV's own log messages on stderr about faulty files."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


@contextlib.contextmanager
def without_words_on(name: str) -> Iterator[None]:
    """Suppress the lines that OpenEXR prints while it reads a file; other output of that time is printed afterwards."""
    with without_lines(name):
        said = io.StringIO()
        try:
            with contextlib.redirect_stdout(said):
                yield
        finally:
            if others := [line for line in said.getvalue().splitlines(True) if EXR_WARNING not in line]:
                print(*others, sep="", end="")


@contextlib.contextmanager
def without_lines(*words: str) -> Iterator[list[str]]:
    """Suppress lines on stderr, also those written by libraries directly, that contain one of the words.

    The yielded list holds them on exit; other lines of that time are written then.
    """
    left_out: list[str] = []
    with _ASIDE:
        try:
            said, kept = _notes(), _standard_error()
        except OSError:  # no descriptors left: nothing is redirected
            yield left_out
            return
        try:
            os.dup2(said, 2)
            yield left_out
        finally:
            _restore(kept, said, words, left_out)


def _standard_error() -> int | None:
    """Duplicate the descriptor of stderr; None where it is closed."""
    try:
        return os.dup(2)
    except OSError as error:
        if error.errno == errno.EBADF:
            return None
        raise


@cache
def _notes() -> int:
    """Descriptor of this process's temporary file for redirected stderr, open for the life of the process."""
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def _renew() -> None:
    """Make a forked process open its own temporary file."""
    if _notes.cache_info().currsize:
        os.close(_notes())
    _notes.cache_clear()
    _ASIDE.release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_ASIDE.acquire, after_in_parent=_ASIDE.release, after_in_child=_renew)


def _restore(kept: int | None, said: int, words: tuple[str, ...], left_out: list[str]) -> None:
    """Restore stderr, and write the redirected lines to it except those with one of the words."""
    if kept is None:
        os.close(2)
    else:
        os.dup2(kept, 2)
        os.close(kept)
    with os.fdopen(os.dup(said), "rb") as file:
        file.seek(0)
        lines = file.readlines()
        os.ftruncate(said, 0)
        file.seek(0)
    for line in lines:
        if any(word.encode() in line for word in words):
            left_out.append(line.decode(errors="replace"))
        else:
            with contextlib.suppress(OSError):
                os.write(2, line)
