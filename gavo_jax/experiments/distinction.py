"""Distinct names for table rows that share a name but differ in configuration.

A table keeps the rows of earlier versions of an experiment's file, where the same name may stand for other frames or
settings.
"""

import itertools
import json
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from gavo_jax.output.files import differences

Row = Mapping[str, Any]

FRAMES, SETTINGS = ("sequence",), ("method", "preset", "settings")
"""Keys of a row's configuration that identify its frames, and its settings regardless of the seed."""
DIGESTS = {"timestamps_sha256": "stamps", "images_sha256": "images", "truth_sha256": "truth"}
TOLD_BY_OTHERS = ("first_timestamp", "last_timestamp", *DIGESTS)
"""Keys that differ whenever the frames do, but tell a reader little."""
MOST_SHOWN = 3


def tell_apart(rows: Sequence[Row], planned: Collection[str] = ()) -> list[dict[str, Any]]:
    """Return the rows with sequence names and labels that each stand for a single configuration.

    Args:
        rows: Rows of a results table.
        planned: Hashes of the experiment's current runs, which keep their plain names. If no row of a name is among
            them, the newest keeps it. The other rows' names are extended by what differs.
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
    """Map each run of (run, name, configuration) to a name that only runs of equal configuration share."""
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
