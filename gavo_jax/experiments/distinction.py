"""Rows of one name whose configurations differ, told apart by their names.

A table keeps what an experiment once was: after a change of its file, frames and settings of the same name are others.
"""

import itertools
import json
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from gavo_jax.output.files import differences

Row = Mapping[str, Any]

FRAMES, SETTINGS = ("sequence",), ("method", "preset", "settings")
"""Parts of a row's configuration: which frames it is of, and what is done with them by any seed."""
DIGESTS = {"timestamps_sha256": "stamps", "images_sha256": "images", "truth_sha256": "truth"}
TOLD_BY_OTHERS = ("first_timestamp", "last_timestamp", *DIGESTS)
"""Differ where the frames do, and say little."""
MOST_SHOWN = 3


def tell_apart(rows: Sequence[Row], planned: Collection[str] = ()) -> list[dict[str, Any]]:
    """Return the rows with names of sequences and labels that stand for one configuration each.

    Args:
        rows: Of a table.
        planned: Hashes of the runs that the experiment has now: these keep their plain names. Else, or where there are
            none of a name, the newest one does; to the others what differs is added.
    """
    order = sorted(rows, key=lambda row: row["finished"] or "", reverse=True)
    order.sort(key=lambda row: row["run"] not in planned)
    configurations = {row["run"]: json.loads(row["configuration"]) for row in rows}
    names = {
        column: _names([(row["run"], row[column], _part(configurations[row["run"]], keys)) for row in order])
        for column, keys in (("sequence", FRAMES), ("label", SETTINGS))
    }
    return [{**row, **{column: named[row["run"]] for column, named in names.items()}} for row in rows]


def _part(configuration: Any, keys: tuple[str, ...]) -> dict[str, Any]:
    return {key: configuration.get(key) for key in keys} if isinstance(configuration, dict) else {}


def _names(entries: Sequence[tuple[str, str, dict[str, Any]]]) -> dict[str, str]:
    """Name each run of (run, name, configuration): equal names only where configurations are equal."""
    plain: dict[str, dict[str, Any]] = {}
    given: dict[tuple[str, str], str] = {}
    found = {}
    for run, name, configuration in entries:
        first = plain.setdefault(name, configuration)
        key = name, json.dumps(configuration, sort_keys=True)
        if key not in given:
            told = name if configuration == first else f"{name} ({_what_differs(first, configuration)})"
            taken = {*given.values(), *(other for _, other, _ in entries)} - {name}
            numbered = (f"{told} #{i}" for i in itertools.count(2))
            given[key] = told if told not in taken else next(free for free in numbered if free not in taken)
        found[run] = given[key]
    return found


def _what_differs(first: dict[str, Any], other: dict[str, Any]) -> str:
    found = {name.partition(".")[2] or name: after for name, _, after in differences(first, other)}
    what = next((word for name, word in DIGESTS.items() if name in found), "stamps")
    telling = {name: value for name, value in found.items() if name not in TOLD_BY_OTHERS} or {what: "other"}
    words = [f"{name}={value}" for name, value in list(telling.items())[:MOST_SHOWN]]
    return ", ".join([*words, "…"] if len(telling) > MOST_SHOWN else words)
