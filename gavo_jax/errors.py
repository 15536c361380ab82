"""Bad input as one kind of exception, the text files that users hand in, and files that are written whole."""

import contextlib
import os
import reprlib
from pathlib import Path
from typing import Any

MAX_TEXT_BYTES = 128 * 2**20
MAX_SHOWN = 100
"""Characters of a value that a message shows."""
PARTIAL = ".partial"
"""Suffix of a file that is being written."""


class GavoError(ValueError):
    """Input that cannot be used. The message is one line that names the file and says what is wrong with it."""


def shown(value: Any) -> str:
    """Return a value as code would write it, cut to what fits into a message."""
    cutter = reprlib.Repr()
    cutter.maxstring = cutter.maxother = cutter.maxlong = MAX_SHOWN
    return cutter.repr(value)


def read_text(path: str | Path, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Return the text of a UTF-8 file.

    Raises:
        GavoError: the file is missing, no regular file, unreadable, larger than `max_bytes` or not UTF-8.
    """
    path = Path(path)
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
        raise GavoError(f"{path}: not a text file (UTF-8)") from None
    except ValueError as error:
        if isinstance(error, GavoError):
            raise
        raise GavoError(f"{str(path)!r}: not a usable path: {error}") from None


def data_rows(path: str | Path, max_bytes: int = MAX_TEXT_BYTES) -> list[tuple[str, list[str]]]:
    """Split a TUM text file into rows of fields; blank lines and `#` comments are skipped, commas count as blanks.

    Returns:
        A list of (`file:line`, fields), so that whoever refuses a row can say where it stands.

    Raises:
        GavoError: as `read_text`.
    """
    rows = []
    for number, line in enumerate(read_text(path, max_bytes).splitlines(), start=1):
        fields = line.replace(",", " ").split()
        if fields and not fields[0].startswith("#"):
            rows.append((f"{path}:{number}", fields))
    return rows


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a file whole or not at all: beside it first, then renamed into place.

    What lies where it is written first, left by a kill or planted by somebody, is removed and not followed.

    Raises:
        GavoError: the file cannot be written.
    """
    path = Path(path)
    partial = path.with_name(path.name + PARTIAL)
    try:
        partial.unlink(missing_ok=True)
        with partial.open("xb") as file:
            file.write(data)
        os.replace(partial, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise GavoError(f"{path}: cannot be written: {error.strerror or error}") from None
