"""Ctrl-C while modules are imported ends the command at once, as there is nothing to clean up yet.

This module is imported first, and itself imports nothing slow.
"""

import os
import signal
import sys

INTERRUPTED = 130
"""Exit status after Ctrl-C."""
LOST = 3
"""Exit status, under `--strict`, of a run that lost a pair."""

is_ours = False
"""Whether the command handles Ctrl-C; in other programs it is left alone."""


def end_at_once() -> None:
    """Let Ctrl-C end the process at once, if it is the command and doesn't ignore Ctrl-C."""
    global is_ours
    if is_command() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        is_ours = True
        signal.signal(signal.SIGINT, end)


def end(number: int, frame: object) -> None:
    """Handle the signal: end the process with one line."""
    os.write(2, b"gavo: interrupted\n")
    os._exit(INTERRUPTED)


def is_command() -> bool:
    """Whether this process was started as `gavo` or `python -m gavo_jax`, judged by names alone this early."""
    name = os.path.basename(sys.argv[0]) if sys.argv else ""
    if name == "-m":
        return any(words == ("-m", "gavo_jax") for words in zip(sys.orig_argv, sys.orig_argv[1:], strict=False))
    return name in ("gavo", "gavo.exe")
