"""The exception for bad input, one-line messages, parsing of users' text files, and atomic writing."""

import contextlib
import json
import math
import operator
import os
import re
import reprlib
import sys
import threading
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

MAX_TEXT_BYTES = 128 * 2**20
MAX_SHOWN = 100
"""Characters of a value that a message shows."""
PARTIAL = ".partial"
"""Suffix of a file that is being written."""

OF_WINDOWS = re.compile(r"[-+]?1\.#[A-Z]{1,4}0*")
"""Infinity and NaN as older Windows programs write them: -1.#INF, 1.#QNAN."""


class GavoError(ValueError):
    """Input that cannot be used. The message is one line that names the file and says what is wrong with it."""

    def __init__(self, message: object = "") -> None:
        super().__init__(printable(" ".join(str(message).split())))


class GavoWarning(UserWarning):
    """Something is wrong or missing, and the work goes on without it."""


def printable(text: str) -> str:
    """Return a text with its unprintable characters escaped, so that it cannot control a terminal.

    Names of files, archive members and server entries are not trusted.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def print_message(line: str) -> None:
    """Print a message of the command on standard error, always as a single line."""
    print(f"gavo: {printable(' '.join(line.split()))}", file=sys.stderr, flush=True)


def line_of(error: BaseException) -> str:
    """Return an error's message as one line of limited length; the name of its type if it has none."""
    return " ".join(str(error).split())[:200] or type(error).__name__


@contextlib.contextmanager
def blamed(whose: str, kind: Callable[[str], Exception] = GavoError) -> Iterator[None]:
    """Turn whatever third-party code raises in the block into a one-line error that begins with `whose`."""
    try:
        yield
    except GavoError:
        raise
    except Exception as error:
        raise kind(f"{whose}: {line_of(error)}") from error


def shown(value: Any) -> str:
    """Return the `repr` of a value, cut to fit into a message."""
    cutter = reprlib.Repr()
    cutter.maxstring = cutter.maxother = cutter.maxlong = MAX_SHOWN
    try:
        return cutter.repr(value)
    except ValueError:  # Python refuses to print integers of thousands of digits
        return f"{type(value).__name__} with too many digits"


def number(text: str) -> float:
    """Parse a number in a field of a text file; NaN for 1.#INF and the like.

    Raises:
        ValueError: not a number; unlike `float`, this refuses 1_000 and digits of other scripts.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"not a number: {text[:MAX_SHOWN]!r}")
    return math.nan if OF_WINDOWS.fullmatch(text) else float(text)


def as_number(name: str, value: Any, needed: str = "expected a number") -> float:
    """Return a value as a Python float.

    Raises:
        GavoError: It is not a single real number, but text or a list, say.
    """
    if np.ndim(value) or np.asarray(value).dtype.kind not in "iuf":
        raise GavoError(f"{name}: {needed}, got {shown(value)}")
    return float(value)


def as_whole(name: str, value: Any) -> int:
    """Return a value as a Python int.

    Raises:
        GavoError: It is not a whole number; nor is 2.0.
    """
    try:
        return operator.index(value)
    except TypeError:
        raise GavoError(f"{name}: expected a whole number, got {shown(value)}") from None


def as_path(value: Any) -> Path:
    """Return a path that is given as a text or a path.

    Raises:
        GavoError: It is neither.
    """
    try:
        return Path(value)
    except TypeError:
        raise GavoError(f"expected the path of a file or folder, got {shown(value)}") from None


def read_text(path: str | Path, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Return the text of a UTF-8 file.

    Raises:
        GavoError: the file is missing, not a regular file, unreadable, larger than `max_bytes` or not UTF-8.
    """
    path = as_path(path)
    try:
        if path.exists() and not path.is_file():
            raise GavoError(f"{path}: not a file")
        if path.stat().st_size > max_bytes:
            raise GavoError(f"{path}: larger than {max_bytes} bytes")
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise GavoError(f"{path}: no such file") from None
    except OSError as error:
        raise GavoError(f"{path}: cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise GavoError(f"{path}: not a text file (UTF-8): if it is text, save it as UTF-8") from None
    except ValueError as error:
        if isinstance(error, GavoError):
            raise
        raise GavoError(f"{str(path)!r}: not a usable path: {error}") from None


def read_json(path: str | Path, max_bytes: int = MAX_TEXT_BYTES) -> Any:
    """Return the contents of a JSON file.

    Raises:
        GavoError: as `read_text`, or it is not JSON.
    """
    return parse_json(path, read_text(path, max_bytes))


def read_json_object(path: str | Path, max_bytes: int = MAX_TEXT_BYTES) -> dict[str, Any]:
    """Return the object in a JSON file.

    Raises:
        GavoError: as `read_json`, or it holds something else.
    """
    values = read_json(path, max_bytes)
    if not isinstance(values, dict):
        raise GavoError(f"{path}: not a JSON object: expected names and values")
    return values


def parse_json(place: str | Path, text: str) -> Any:
    """Parse a JSON text.

    Raises:
        GavoError: it is not JSON; the message begins with `place`.
    """
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise GavoError(f"{place}: not JSON: {line_of(error)}") from None


def parse_toml(place: str | Path, text: str) -> dict[str, Any]:
    """Parse a TOML text.

    Raises:
        GavoError: it is not TOML, or holds a number of thousands of digits; the message begins with `place`.
    """
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise GavoError(f"{place}: not TOML: {line_of(error)}") from None


def read_toml(path: str | Path, max_bytes: int = MAX_TEXT_BYTES) -> dict[str, Any]:
    """Return the table of a TOML file.

    Raises:
        GavoError: as `read_text` and `parse_toml`.
    """
    return parse_toml(path, read_text(path, max_bytes))


COLUMN = re.compile(r"[A-Za-z_]\w*", re.ASCII)
"""Name of a column; paths and numbers do not match."""

TIME = re.compile(r"time|stamp|^t$", re.IGNORECASE)
"""Part of the name of a timestamp column."""


def data_rows(path: str | Path, max_bytes: int = MAX_TEXT_BYTES) -> list[tuple[str, list[str]]]:
    """Split a TUM text file into rows of fields; blank lines and `#` comments are skipped, commas count as blanks.

    Returns:
        A list of (`file:line`, fields), so that an error can say where its row is.

    Raises:
        GavoError: as `read_text`.
    """
    return rows_of(read_text(path, max_bytes), path)


def rows_of(text: str, path: str | Path) -> list[tuple[str, list[str]]]:
    """Split a text as `data_rows` does; `path` is only used to name its lines."""
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.replace(",", " ").split()
        if fields and not fields[0].startswith("#"):
            rows.append((f"{path}:{number}", fields))
    return rows


def without_heading(rows: list[tuple[str, list[str]]]) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """Split off a heading: a first row of column names, the first of which is a time.

    Returns:
        The column names, empty if there is no heading, and the remaining rows.
    """
    heading = rows[0][1] if rows else []
    if len(heading) < 2 or not (TIME.search(heading[0]) and all(map(COLUMN.fullmatch, heading))):
        return [], rows
    return heading, rows[1:]


def partial_of(path: Path) -> Path:
    """Return the temporary file, unique to this thread, that is written in place of a file."""
    return path.with_name(f"{path.name}.{os.getpid()}-{threading.get_ident()}{PARTIAL}")


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a file atomically: to a temporary file beside it, then renamed into place.

    Whatever lies at the temporary path, left by a killed process or planted as a link, is removed and not followed.
    Concurrent writers of one file do not interfere: the last one wins.

    Raises:
        GavoError: the file cannot be written.
    """
    path = as_path(path)
    partial = partial_of(path)
    try:
        partial.unlink(missing_ok=True)
        with partial.open("xb") as file:
            file.write(data)
        os.replace(partial, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        if not isinstance(error, OSError):
            raise
        raise GavoError(f"{path}: cannot be written: {error.strerror or error}") from None
