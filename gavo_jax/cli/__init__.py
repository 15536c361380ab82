"""The `gavo` command: parses the arguments, runs a subcommand, and reports bad input in one line with status 2."""

import contextlib
import errno
import io
import os
import shutil
import sys
import warnings
from collections.abc import Iterator, Sequence
from importlib import import_module
from typing import Any

import tyro

from gavo_jax import interrupts
from gavo_jax.cli.options import Command, Doctor
from gavo_jax.cli.usage import HelpPage, asking_for_help, empty_argument, fault_of_usage
from gavo_jax.compilation import compiler
from gavo_jax.compilation.precision import choose_usual
from gavo_jax.early import INTERRUPTED
from gavo_jax.errors import GavoError, GavoWarning, print_message, shown
from gavo_jax.version import __version__

BAD_INPUT, BROKEN_PIPE = 2, 141
"""Exit statuses; others are 0 for success, 130 for `early.INTERRUPTED` and 3 for `early.LOST` (`--strict`)."""

NARROWEST = 20
"""Smallest terminal width, in columns, that help is laid out for."""
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors raised when a disk or quota is full, or a file is too large."""
BAD_NAMES = (errno.ENAMETOOLONG, errno.ELOOP, errno.EACCES, errno.EPERM)
"""Errors for paths that are too long, contain a cycle of links, or may not be accessed by this user."""

DESCRIPTION = (
    "RGB-D visual odometry: the camera's motion between frames by a genetic algorithm, particle swarm, Gauss-Newton "
    "or Adam, on one compiled photometric objective."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with the given arguments (by default the process's) and return its exit status.

    Bad input raises nothing: one line on standard error names the file and the fault, and the status is 2.
    """
    _open_streams()
    arguments = list(sys.argv[1:] if argv is None else argv)
    choose_usual()
    with interrupts.raised(), _told_warnings():
        try:
            status = _run(arguments)
        except KeyboardInterrupt as interrupt:
            status = _stop(str(interrupt))
        except Exception:
            if not interrupts.came():  # otherwise a library turned the interrupt into this exception
                raise
            status = _stop("")
    interrupts.leave(status)
    return status


def _stop(words: str) -> int:
    interrupts.ignore()
    print_message(f"interrupted{words}")
    return INTERRUPTED


def _run(arguments: list[str]) -> int:
    """Parse and execute; return the exit status."""
    try:
        if arguments == ["--version"]:
            print(f"gavo-jax {__version__}", flush=True)
            return 0
        command = _parse(arguments)
        status = 0 if command is None else _execute(command)
        sys.stdout.flush()
        return status
    except GavoError as error:
        return _refuse(str(error))
    except BrokenPipeError:
        _silence_output()
        return BROKEN_PIPE
    except OSError as error:
        if error.errno in BAD_NAMES:
            return _refuse(f"{shown(str(error.filename or ''))}: {error.strerror}")
        if error.errno not in NO_SPACE:
            raise
        _silence_output()
        return _refuse(f"{error.filename or 'output'}: cannot be written to: {error.strerror}")


@contextlib.contextmanager
def _told_warnings() -> Iterator[None]:
    """Print each of this package's warnings on one line, also where all are errors; leave other warnings unchanged."""

    def show_line(message: Any, category: type[Warning], *where: Any) -> None:
        if issubclass(category, GavoWarning):
            print_message(f"warning: {message}")
        else:
            show(message, category, *where)

    with warnings.catch_warnings():
        show, warnings.showwarning = warnings.showwarning, show_line
        warnings.simplefilter("default", GavoWarning)
        yield


def _open_streams() -> None:
    """Make standard output and error accept any text.

    Closed streams discard it; characters missing from the encoding become question marks.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def _execute(command: Command) -> int:
    """Import and run the subcommand: the function in the module of the same name.

    It is imported this late so that help and usage errors don't wait for JAX.

    Raises:
        GavoError: this version of JAX is unusable, and the subcommand is not `doctor`, which explains why.
    """
    fault = compiler.unfit_compiler()
    if fault and not isinstance(command, Doctor):
        raise GavoError(fault)
    name = type(command).__name__.lower()
    return getattr(import_module(f"{__name__}.{name}"), name)(command)


def _parse(arguments: list[str]) -> Command | None:
    """Return the subcommand with its options, or None if help was printed.

    Raises:
        GavoError: unknown or missing arguments.
    """
    if fault := empty_argument(arguments):
        raise GavoError(fault)
    messages, page = io.StringIO(), HelpPage(sys.stdout)
    if shutil.get_terminal_size().columns < NARROWEST:
        os.environ["COLUMNS"] = str(NARROWEST)  # in a narrower one, laying out the help never ends
    try:
        with contextlib.redirect_stderr(messages), contextlib.redirect_stdout(page):
            return tyro.cli(
                Command,
                prog="gavo",
                description=DESCRIPTION,
                args=asking_for_help(arguments),
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as stop:
        if not stop.code:
            print(page.fitted())
            return None
    raise GavoError(fault_of_usage(messages.getvalue(), arguments))


def _silence_output() -> None:
    """Redirect the broken standard output to the null device, so that closing it at exit raises no error."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _refuse(message: str) -> int:
    print_message(message)
    return BAD_INPUT
