"""The command `gavo`: parses, hands over to a subcommand, and turns bad input into one line and exit status 2."""

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
from gavo_jax.errors import GavoError, GavoWarning, shown, tell
from gavo_jax.version import __version__

BAD_INPUT, BROKEN_PIPE = 2, 141
"""Exit statuses; 0 is done, 130 `early.INTERRUPTED`, 3 `early.LOST` (`--strict`)."""

NARROWEST = 20
"""Columns of a screen for which help is laid out at least."""
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of a full disk, quota or file."""
BAD_NAMES = (errno.ENAMETOOLONG, errno.ELOOP, errno.EACCES, errno.EPERM)
"""Errors of a name that no file can have, that leads in a circle, or to where this user may not go."""

DESCRIPTION = (
    "RGB-D visual odometry: the camera's motion between frames by a genetic algorithm, particle swarm, Gauss-Newton "
    "or Adam, on one compiled photometric objective."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with the arguments (of the process unless given) and return its exit status.

    Nothing is raised for bad input: one line on standard error names the file and the fault, and the status is 2.
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
            if not interrupts.came():  # else it is what a library made of the interrupt
                raise
            status = _stop("")
    interrupts.leave(status)
    return status


def _stop(words: str) -> int:
    interrupts.ignore()
    tell(f"interrupted{words}")
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
    """Print this package's warnings as one line each; others as they always are."""
    show = warnings.showwarning

    def show_line(message: Any, category: type[Warning], *where: Any) -> None:
        if issubclass(category, GavoWarning):
            tell(f"warning: {message}")
        else:
            show(message, category, *where)

    warnings.showwarning = show_line
    try:
        yield
    finally:
        warnings.showwarning = show


def _open_streams() -> None:
    """Make standard output and error take whatever is printed: closed ones swallow it, and where the encoding lacks a
    character a question mark stands for it.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def _execute(command: Command) -> int:
    """Import the subcommand only now, so that help and usage errors do not wait for JAX: the function of its name, in
    the module of its name.

    Raises:
        GavoError: this JAX is ruled out, and the subcommand is not the one that says what is wrong.
    """
    fault = compiler.unfit_compiler()
    if fault and not isinstance(command, Doctor):
        raise GavoError(fault)
    name = type(command).__name__.lower()
    return getattr(import_module(f"{__name__}.{name}"), name)(command)


def _parse(arguments: list[str]) -> Command | None:
    """Return the subcommand with its options, or None where help was printed.

    Raises:
        GavoError: unknown or missing arguments.
    """
    if fault := empty_argument(arguments):
        raise GavoError(fault)
    messages, page = io.StringIO(), HelpPage(sys.stdout)
    if shutil.get_terminal_size().columns < NARROWEST:
        os.environ["COLUMNS"] = str(NARROWEST)  # in less, the page of help never ends
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
    """Point standard output, which takes no more, elsewhere, so that closing it at exit stays quiet."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _refuse(message: str) -> int:
    tell(message)
    return BAD_INPUT
