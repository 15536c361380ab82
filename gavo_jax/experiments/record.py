"""The record beside a results table: the experiment's runs, their order in tables, and published figures."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from gavo_jax.errors import GavoError, read_json_object
from gavo_jax.experiments.plan import Plan
from gavo_jax.output.files import EXPERIMENT, write_json


class Record(NamedTuple):
    """What a report needs to know of an experiment in addition to its table."""

    name: str
    printed: Mapping[tuple[str, str], float]
    """Published drift by sequence and label, m/s."""
    order: Mapping[tuple[str, str], int]
    """Rank in tables, by sequence and label."""
    runs: frozenset[str]
    """Hashes of the runs that the experiment's file last asked for."""


def write_record(plan: Plan) -> None:
    """Write a plan's record to its folder."""
    order = list(dict.fromkeys((run.part.name, run.label) for run in plan.runs))
    printed = [{"sequence": name, "label": label, "drift": value} for (name, label), value in plan.printed.items()]
    runs = [run.id for run in plan.runs]
    write_json(plan.folder / EXPERIMENT, {"name": plan.name, "order": order, "printed": printed, "runs": runs})


def read_record(folder: Path) -> Record:
    """Read the record in a folder; an empty one if none was written.

    Raises:
        GavoError: The record cannot be read.
    """
    path = folder / EXPERIMENT
    if not path.is_file():
        return Record("", {}, {}, frozenset())
    record = read_json_object(path)
    try:
        printed = {(entry["sequence"], entry["label"]): float(entry["drift"]) for entry in record["printed"]}
        order = {(name, label): i for i, (name, label) in enumerate(record["order"])}
        return Record(str(record["name"]), printed, order, frozenset(record.get("runs", ())))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise GavoError(f"{path}: not the record of an experiment: {error}") from None
