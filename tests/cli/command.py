"""The command in this process, with what it printed."""

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest

from gavo_jax.cli import main

GENETIC = (
    *("--set", "solver.population=[0, 0, 0, 8, 16]", "--set", "solver.iterations=[0, 0, 0, 6, 8]"),
    *("--set", "alignment.last_step=false", "--set", "odometry.recover=false", "--set", "odometry.bodies=off"),
)
"""The settings `small.GENETIC`: recorded, their program is that of the viewer's tests."""


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
