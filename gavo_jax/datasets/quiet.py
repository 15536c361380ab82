"""What libraries of images say past Python, on standard error and output, kept from there and handed to who asks."""

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
"""In what OpenEXR prints of a torn file."""

_ASIDE = threading.Lock()
"""Held by whoever has standard error of the process put aside, and while the process forks."""


@contextlib.contextmanager
def without_log() -> Iterator[None]:
    """Keep OpenCV from saying on standard error, in lines of its own, what is wrong with a file."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


@contextlib.contextmanager
def without_words_on(name: str) -> Iterator[None]:
    """Leave out the lines that OpenEXR prints while it reads a file; what others print in that time comes after it."""
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
    """Leave out the lines on standard error, where libraries write past Python, that hold one of some words.

    The list that is yielded has them afterwards; what others write in that time comes after it.
    """
    left_out: list[str] = []
    with _ASIDE:
        try:
            said, kept = _notes(), _standard_error()
        except OSError:  # no descriptors are left: nothing is put aside
            yield left_out
            return
        try:
            os.dup2(said, 2)
            yield left_out
        finally:
            _restore(kept, said, words, left_out)


def _standard_error() -> int | None:
    """Another descriptor of it; None where it is closed."""
    try:
        return os.dup(2)
    except OSError as error:
        if error.errno == errno.EBADF:
            return None
        raise


@cache
def _notes() -> int:
    """Descriptor of a file of this process, for what is said meanwhile; it is open as long as the process lives."""
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def _renew() -> None:
    """Give a process that was forked a file of its own."""
    if _notes.cache_info().currsize:
        os.close(_notes())
    _notes.cache_clear()
    _ASIDE.release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_ASIDE.acquire, after_in_parent=_ASIDE.release, after_in_child=_renew)


def _restore(kept: int | None, said: int, words: tuple[str, ...], left_out: list[str]) -> None:
    """Put standard error in its place again, and pass on what was said but for lines with some words."""
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
