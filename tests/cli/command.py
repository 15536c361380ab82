"""The command in this process, with what it printed."""

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest

from gavo_jax.cli import main


class Done(NamedTuple):
    status: int
    out: str
    err: str


def runner(capsys: pytest.CaptureFixture[str]) -> Callable[..., Done]:
    """A function that runs the command and returns status, standard output and standard error."""

    def run(*arguments: Any) -> Done:
        status = main([str(argument) for argument in arguments])
        printed = capsys.readouterr()
        return Done(status, printed.out, printed.err)

    return run
