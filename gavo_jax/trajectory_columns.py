"""Poses in tables with more columns than a trajectory needs: EuRoC's ground truth, and `rostopic echo -p`."""

import re

from gavo_jax.errors import GavoError

UNITS = re.compile(r"\s*\[.*?\]")
"""Matches the units behind a name, as EuRoC writes them."""

POSITION = re.compile(r"(?:p_\w+_|.*\b(?:position|translation)\.)([xyz])")
TURN = re.compile(r"(?:q_\w+_|.*\b(?:orientation|rotation)\.)([wxyz])")
"""Match the names of a pose's columns."""

STAMP = re.compile(r".*\bheader\.stamp")
"""Matches the name of the time of a measurement; the first column is that of the recording."""


def named_poses(text: str, path: object) -> list[tuple[str, list[str]]] | None:
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
