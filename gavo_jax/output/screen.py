"""What people see: lines and tables on standard output, progress and warnings on standard error.

All of it passes through `printable`: names of files and sequences are other people's.
"""

import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.measure import Measurement
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from gavo_jax.errors import printable


class _Console(Console):
    """The screen; where who reads has gone, the command is told, as by `print`."""

    def on_broken_pipe(self) -> None:
        """Leave it to the command."""
        raise BrokenPipeError


DASH = "–"
"""Table cell for an unknown value."""


def say(line: str) -> None:
    """Print a line on standard output: on a terminal between words to its width, elsewhere as one line for programs."""
    line = printable(line)
    print(_wrapped(line) if sys.stdout.isatty() else line, flush=True)


def _wrapped(line: str) -> str:
    """A line as several that fit the terminal; a path is never broken."""
    width = _Console().width
    return textwrap.fill(line, width, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


class PairProgress:
    """A bar that counts pairs; it says `compiling …` until the first one is done, and whenever that is so again."""

    def __init__(self, progress: Progress, task: TaskID, label: str) -> None:
        self._progress, self._task, self._label = progress, task, label

    def compiling(self) -> None:
        """Say that a program is compiled, until the next pair is done."""
        self._progress.update(self._task, description=_compiling(self._label))

    def advance(self, pairs: int = 1) -> None:
        """Count a pair, or several."""
        self._progress.update(self._task, advance=pairs, description=self._label)

    def say(self, line: str) -> None:
        """Print a line above the bar; also where there is no bar."""
        console, line = self._progress.console, printable(line)
        console.print(Text(_wrapped(line) if console.is_terminal else line), soft_wrap=True)


@contextmanager
def pair_progress(label: str, pairs: int, done: int = 0) -> Iterator[PairProgress]:
    """Show a bar on standard error while the block runs; nothing where that is no terminal."""
    label = printable(label)
    with progress_bar(MofNCompleteColumn(), TextColumn("pairs")) as progress:
        yield PairProgress(progress, progress.add_task(_compiling(label), total=pairs, completed=done), label)


@contextmanager
def frame_progress(label: str, frames: int) -> Iterator[Callable[[], None]]:
    """Show a bar that counts frames while the block runs, as `pair_progress` does; what is given counts one."""
    with progress_bar(MofNCompleteColumn(), TextColumn("frames")) as progress:
        task = progress.add_task(printable(label), total=frames)
        yield lambda: progress.update(task, advance=1)


def progress_bar(*columns: ProgressColumn) -> Progress:
    """A label, a bar, some columns and the time that is left, on standard error while that is a terminal."""
    console = _Console(stderr=True)
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), *columns, TimeRemainingColumn())
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


def _compiling(label: str) -> str:
    return f"{label}: compiling …"


@contextmanager
def waiting(words: str) -> Iterator[None]:
    """Show a few words on standard error while the block runs; nothing where that is no terminal."""
    console = _Console(stderr=True)
    if not console.is_terminal:
        yield
        return
    with console.status(Text(printable(words))):
        yield


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print a table whose first column is text and whose others are numbers.

    Nothing of it is cut: columns that the screen has no room for follow below, the first column beside them once more.
    """
    say(title)
    width = _Console().width
    for table in _parts(columns, rows, width):
        _Console(width=max(width, _width(table))).print(table)


def known_columns(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> tuple[list[str], list[list[Any]]]:
    """Return the table without columns that contain only dashes."""
    kept = [i for i in range(len(columns)) if not rows or any(row[i] != DASH for row in rows)]
    return [columns[i] for i in kept], [[row[i] for i in kept] for row in rows]


def _parts(columns: Sequence[str], rows: Sequence[Sequence[Any]], width: int) -> Iterator[Table]:
    """A table as one that fits the width or, the first column in each, as several."""
    start = 1
    while start < len(columns):
        end = len(columns)
        while _width(table := _table(*_columns(columns, rows, start, end))) > width and end > start + 1:
            end -= 1
        yield table
        start = end


def _columns(
    columns: Sequence[str], rows: Sequence[Sequence[Any]], start: int, end: int
) -> tuple[list[str], list[list[Any]]]:
    """Return the first column and columns start to end - 1."""
    return [columns[0], *columns[start:end]], [[row[0], *row[start:end]] for row in rows]


def _table(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> Table:
    table = Table()
    for i, name in enumerate(columns):
        table.add_column(Text(printable(name)), justify="right" if i else "left", no_wrap=True)
    for row in rows:
        table.add_row(*(Text(printable(str(cell))) for cell in row))
    return table


def _width(table: Table) -> int:
    unlimited = _Console(width=10_000)
    return Measurement.get(unlimited, unlimited.options, table).maximum


def markdown_table(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a Markdown table whose first column is text and whose others are numbers."""
    rule = ["---", *["---:"] * (len(columns) - 1)]
    lines = ([printable(str(cell)) for cell in cells] for cells in (columns, rule, *rows))
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def counted(count: int, one: str, many: str = "") -> str:
    """Return a count with what it counts: 1 run, 2 runs; `many` where an s is not enough."""
    return f"{count} {one if count == 1 else many or f'{one}s'}"


def number(value: float | None, digits: int = 4) -> str:
    """Return a number of fixed decimals, or a dash for what is not known."""
    return DASH if value is None else f"{value:.{digits}f}"
