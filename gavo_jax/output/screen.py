"""Terminal output: lines and tables on standard output, progress on standard error.

All text passes through `printable`, as names of files and sequences come from outside.
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
    """A console that raises BrokenPipeError if the reader is gone, as `print` does."""

    def on_broken_pipe(self) -> None:
        """Leave the error to the command."""
        raise BrokenPipeError


DASH = "–"
"""Table cell for an unknown value."""


def say(line: str) -> None:
    """Print a line on standard output: wrapped on a terminal, in one piece elsewhere, for programs."""
    line = printable(line)
    print(_wrapped(line) if sys.stdout.isatty() else line, flush=True)


def _wrapped(line: str) -> str:
    """Wrap a line at spaces to the terminal's width; words, such as paths, are never broken."""
    width = _Console().width
    return textwrap.fill(line, width, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


class PairProgress:
    """A progress bar of pairs; it says `compiling …` until the first is done, and after each call of `compiling`."""

    def __init__(self, progress: Progress, task: TaskID, label: str) -> None:
        self._progress, self._task, self._label = progress, task, label

    def compiling(self) -> None:
        """Say until the next pair is done that a program is being compiled."""
        self._progress.update(self._task, description=_compiling(self._label))

    def advance(self, pairs: int = 1) -> None:
        """Count a pair, or several."""
        self._progress.update(self._task, advance=pairs, description=self._label)

    def say(self, line: str) -> None:
        """Print a line on standard error, above the bar if there is one."""
        console, line = self._progress.console, printable(line)
        console.print(Text(_wrapped(line) if console.is_terminal else line), soft_wrap=True)


@contextmanager
def pair_progress(label: str, pairs: int, done: int = 0) -> Iterator[PairProgress]:
    """Show a bar on standard error while the block runs; nothing if that is not a terminal."""
    label = printable(label)
    with progress_bar(MofNCompleteColumn(), TextColumn("pairs")) as progress:
        yield PairProgress(progress, progress.add_task(_compiling(label), total=pairs, completed=done), label)


@contextmanager
def frame_progress(label: str, frames: int) -> Iterator[Callable[[], None]]:
    """Show a bar of frames while the block runs, as `pair_progress` does; the yielded function counts one frame."""
    with progress_bar(MofNCompleteColumn(), TextColumn("frames")) as progress:
        task = progress.add_task(printable(label), total=frames)
        yield lambda: progress.update(task, advance=1)


def progress_bar(*columns: ProgressColumn) -> Progress:
    """Return a bar with a label, some columns and the time left, shown on standard error if that is a terminal."""
    console = _Console(stderr=True)
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), *columns, TimeRemainingColumn())
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


def _compiling(label: str) -> str:
    return f"{label}: compiling …"


@contextmanager
def waiting(words: str) -> Iterator[None]:
    """Show a few words on standard error while the block runs; nothing if that is not a terminal."""
    console = _Console(stderr=True)
    if not console.is_terminal:
        yield
        return
    with console.status(Text(printable(words))):
        yield


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print a table whose first column is text and whose others are numbers.

    Nothing is cut off: columns that do not fit the screen follow below, with the first column repeated.
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
    """Split a table into as many as fit the width, each with the first column."""
    start = 1
    while start < len(columns) or start == 1:
        end = max(len(columns), 2)
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
    lines = ([printable(str(cell)).replace("|", r"\|") for cell in cells] for cells in (columns, rule, *rows))
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def counted(count: int, one: str, many: str = "") -> str:
    """Return a count with what it counts: 1 run, 2 runs; `many` is the plural if an s is not enough."""
    return f"{count} {one if count == 1 else many or f'{one}s'}"


def number(value: float | None, digits: int = 4) -> str:
    """Return a number with fixed decimals, or a dash for None."""
    return DASH if value is None else f"{value:.{digits}f}"
