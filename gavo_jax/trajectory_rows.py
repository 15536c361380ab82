"""Rows of trajectory files: TUM's, also with their columns named, EuRoC's ground truth, and `rostopic echo -p`."""

import math
import re
from pathlib import Path

import numpy as np
from jaxtyping import Int

from gavo_jax.errors import GavoError, number, rows_of, without_heading

MAX_MAGNITUDE = 1e9
"""Largest absolute translation (metres) or quaternion component that a trajectory file may hold."""

MAX_STAMP = 1e19
"""Largest absolute timestamp in a trajectory file, which may count nanoseconds since 1970."""


SHORTEST_QUATERNION = 1e-6
"""Length below which a quaternion counts as zero."""

NO_POSE = "numbers that are not finite, or a zero quaternion"
"""What a trajectory's row holds where the tracker lost its target."""


COLUMNS = "timestamp tx ty tz qx qy qz qw"

TRAJECTORY_HEADER = f"# {COLUMNS} (camera to world, seconds and metres)"


SEGMENT_COMMENT = re.compile(r"# segment (\d{1,9})\b")
"""Start of the comment line before a new segment's first pose, with the segment's number from 1."""


_APART = r"[^\w\n]+"
W_FIRST = re.compile(
    rf"^#.*\bq\w*w{_APART}q\w*x{_APART}q\w*y{_APART}q\w*z[^\w\n]*$", re.MULTILINE | re.IGNORECASE | re.ASCII
)
"""Comment that ends with the names of the last columns, w before x, as EuRoC's does."""


_TURN_FIRST = re.compile(
    rf"^#.*\bq\w*[wz]{_APART}(?!q)\w*x{_APART}(?!q)\w*y{_APART}(?!q)\w*z[^\w\n]*$",
    re.MULTILINE | re.IGNORECASE | re.ASCII,
)
"""Comment whose columns end with the position, after the quaternion."""


W_FIRST_ORDER = "wxyz"

UNITS = re.compile(r"\s*\[.*?\]")
"""Matches the units behind a name, as EuRoC writes them."""

POSITION = re.compile(r"(?:p_\w+_|.*\b(?:position|translation)\.)([xyz])")
TURN = re.compile(r"(?:q_\w+_|.*\b(?:orientation|rotation)\.)([wxyz])")
"""Match the names of a pose's columns."""

STAMP = re.compile(r".*\bheader\.stamp")
"""Matches the name of the time of a measurement; the first column is that of the recording."""


def segment_comment(segment: int, before: float | None, after: float) -> str:
    """Return the comment line before the poses of a segment.

    Args:
        segment: its number, from 0.
        before: stamp of the pose before, which is of another segment, seconds; None if there is none.
        after: stamp of the first of its poses.
    """
    unknown = "" if before is None else f": the motion from {before:.6f} to {after:.6f} is unknown"
    return f"# segment {segment + 1}{unknown}"


def segments_of(text: str, lines: list[int]) -> Int[np.ndarray, " n"]:
    """Return the segments of the poses in the given lines of a trajectory file, counted from 1."""
    said = [(n, SEGMENT_COMMENT.match(line)) for n, line in enumerate(text.splitlines(), 1)]
    begun = [(n, int(match[1]) - 1) for n, match in said if match is not None and int(match[1]) > 0]
    numbers = np.array([0] + [segment for _, segment in begun])
    return numbers[np.searchsorted([n for n, _ in begun], lines)]


def rows_of_poses(text: str, path: str | Path) -> tuple[list[tuple[str, list[str]]], bool]:
    """Split a trajectory file into rows, with their places; and tell whether quaternions begin with w.

    Raises:
        GavoError: the columns are named, and are not those of a pose.
    """
    if (named := _named_poses(text, path)) is not None:
        return named, False
    heading, rows = without_heading(rows_of(text, path))
    order = _order_of(heading, path)
    if comment := _TURN_FIRST.search(text):
        raise GavoError(f"{path}: {comment[0][:100]}: expected {COLUMNS}")
    return rows, order == W_FIRST_ORDER or W_FIRST.search(text) is not None


def _order_of(heading: list[str], path: str | Path) -> str:
    """Return the order of a quaternion's components by the names of the columns; empty if there are none.

    Raises:
        GavoError: they are not those of a pose in one of the two orders.
    """
    ends = "".join(word[-1].lower() for word in heading[1:])
    turn_first = any(word.lower().startswith("q") for word in heading[1:4])
    if heading and (turn_first or ends not in ("xyzxyzw", "xyz" + W_FIRST_ORDER)):
        raise GavoError(f"{path}: columns {' '.join(heading)[:100]}: expected {COLUMNS}")
    return ends[3:]


def parse_row(place: str, fields: list[str]) -> list[float] | None:
    """Parse the numbers of a row; None if they are not a pose."""
    if len(fields) != 8:
        raise GavoError(f"{place}: expected 8 numbers (timestamp tx ty tz qx qy qz qw), found {len(fields)} fields")
    try:
        values = [number(field) for field in fields]
    except ValueError:
        raise GavoError(f"{place}: expected 8 numbers (timestamp tx ty tz qx qy qz qw), found text") from None
    if not all(map(math.isfinite, values)):
        return None
    if max(map(abs, values[1:])) > MAX_MAGNITUDE or abs(values[0]) > MAX_STAMP:
        raise GavoError(f"{place}: contains an absurdly large value")
    return values if math.hypot(*values[4:]) >= SHORTEST_QUATERNION else None


def _named_poses(text: str, path: object) -> list[tuple[str, list[str]]] | None:
    """The rows of a table whose heading names the columns of a pose among others.

    Args:
        text: The file's content, separated by commas.
        path: Its path, for messages.

    Returns:
        `file:line` and the fields timestamp, tx, ty, tz, qx, qy, qz and qw of each row; None for other files.

    Raises:
        GavoError: a row has not as many fields as the heading.
    """
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    names = [UNITS.sub("", name).strip(" #%") for name in lines[0][1].split(",")] if lines else []
    columns = _columns(names)
    if columns is None:
        return None
    rows = [(f"{path}:{number}", [field.strip() for field in line.split(",")]) for number, line in lines[1:]]
    rows = [(place, fields) for place, fields in rows if not fields[0].startswith("#")]
    for place, fields in rows:
        if len(fields) != len(names):
            raise GavoError(f"{place}: expected {len(names)} fields, as in the heading, found {len(fields)}")
    stamp = next((at for at, name in enumerate(names) if STAMP.fullmatch(name)), 0)
    if not any(fields[stamp].strip("0.") for _, fields in rows):  # messages without a time of their own
        stamp = 0
    return [(place, [fields[at] for at in (stamp, *columns)]) for place, fields in rows]


def _columns(names: list[str]) -> list[int] | None:
    """The places of a pose's columns, tx ty tz qx qy qz qw; None if not all are there, or nothing but them."""
    found: dict[str, int] = {}
    for at, name in enumerate(names):
        for pattern, what in ((POSITION, "t"), (TURN, "q")):
            if match := pattern.fullmatch(name):
                found.setdefault(what + match[1], at)
    wanted = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")
    return [found[name] for name in wanted] if found.keys() >= set(wanted) and len(names) > len(wanted) + 1 else None
