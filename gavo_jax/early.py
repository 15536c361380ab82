"""Ctrl-C while modules are imported: the command ends where it stands, as there is nothing to put in order yet.

This is the first module that is imported, and imports nothing that takes time.
"""

import os
import signal
import sys

INTERRUPTED = 130
"""Exit status after Ctrl-C."""
LOST = 3
"""Exit status of a run in which a pair was lost, where `--strict` asked to know."""

is_ours = False
"""Whether Ctrl-C is the command's: in other people's programs it is left alone."""


def end_at_once() -> None:
    """Let Ctrl-C end the process, if that is the command and heeds Ctrl-C at all."""
    global is_ours
    if is_command() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        is_ours = True
        signal.signal(signal.SIGINT, end)


def end(number: int, frame: object) -> None:
    """The handler of the signal."""
    os.write(2, b"gavo: interrupted\n")
    os._exit(INTERRUPTED)


def is_command() -> bool:
    """Whether this process was started as `gavo` or `python -m gavo_jax`: only names tell at this time."""
    name = os.path.basename(sys.argv[0]) if sys.argv else ""
    if name == "-m":
        return any(words == ("-m", "gavo_jax") for words in zip(sys.orig_argv, sys.orig_argv[1:], strict=False))
    return name in ("gavo", "gavo.exe")
