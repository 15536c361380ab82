"""Reading of OpenCV's FileStorage (its dialects of YAML, XML and JSON) to numbers, text, lists and tables."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

from gavo_jax.errors import GavoError, line_of

Read = TypeVar("Read")


def read_storage(path: Path, text: str, read: Callable[[Any], Read], what: str = "a camera") -> Read:
    """Open a FileStorage and return what `read` makes of it.

    Args:
        path: names the file in messages.
        text: its content.
        read: is handed the storage.
        what: it should hold, for messages.

    Raises:
        GavoError: none that OpenCV can read, or what it holds is of another kind than `read` needs.
    """
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError) as error:
        raise GavoError(f"{path}: not readable by OpenCV's FileStorage: {line_of(error)}") from None
    try:
        return read(storage)
    except GavoError:
        raise
    except (cv2.error, SystemError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise GavoError(f"{path}: not {what} of OpenCV's FileStorage: {line_of(error)}") from None
    finally:
        storage.release()


def values_of(storage: Any) -> dict[str, Any]:
    """All entries of a FileStorage by name; see `plain_value`."""
    root = storage.root()
    return {name: plain_value(root.getNode(name)) for name in root.keys()}


def plain_value(node: Any) -> Any:
    """A node of a FileStorage as numbers, text, lists and tables; a matrix as rows, None where it is nothing."""
    if node.isMap():
        names = node.keys()
        if {"rows", "cols", "data"} <= set(names):
            return _matrix_of(node).tolist()
        return {name: plain_value(node.getNode(name)) for name in names}
    if node.isSeq():
        return [plain_value(node.at(i)) for i in range(node.size())]
    if node.isString():
        return node.string()
    if node.isInt():
        return int(node.real())
    return node.real() if node.isReal() else None


def _matrix_of(node: Any) -> np.ndarray:
    """A matrix of a FileStorage. Not by its own `mat()`, which writes beyond its memory where sizes do not agree."""
    data = node.getNode("data")
    numbers = [real_of(data.at(i)) for i in range(data.size())] if data.isSeq() else []
    rows, columns = (node.getNode(name) for name in ("rows", "cols"))
    if not (rows.isInt() and columns.isInt()) or int(rows.real()) * int(columns.real()) != len(numbers):
        raise TypeError("the rows and columns of a matrix do not match its data")
    return np.array(numbers).reshape(int(rows.real()), int(columns.real()))


def real_of(node: Any, name: str = "a list") -> float:
    """The number that a node of a FileStorage is, which itself takes text for 0."""
    if not (node.isReal() or node.isInt()):
        raise TypeError(f"{name}: not a number")
    return node.real()
