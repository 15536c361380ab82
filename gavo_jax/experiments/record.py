"""What is kept beside a table of runs: which runs are the experiment's, in which order, and what publications give."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from gavo_jax.errors import GavoError, read_json_object
from gavo_jax.experiments.plan import Plan
from gavo_jax.output.files import write_json

FILE = "experiment.json"


class Record(NamedTuple):
    """What a report needs of an experiment beside the table."""

    name: str
    printed: Mapping[tuple[str, str], float]
    """Drift that a publication gives, by sequence and label, m/s."""
    order: Mapping[tuple[str, str], int]
    """Of sequence and label."""
    runs: frozenset[str]
    """Hashes of the experiment's runs as its file was last."""


def write_record(plan: Plan) -> None:
    """Write the record of a plan into its folder."""
    order = list(dict.fromkeys((run.part.name, run.label) for run in plan.runs))
    printed = [{"sequence": name, "label": label, "drift": value} for (name, label), value in plan.printed.items()]
    runs = [run.id for run in plan.runs]
    write_json(plan.folder / FILE, {"name": plan.name, "order": order, "printed": printed, "runs": runs})


def read_record(folder: Path) -> Record:
    """Read the record in a folder; an empty one where none was written.

    Raises:
        GavoError: It cannot be read.
    """
    path = folder / FILE
    if not path.is_file():
        return Record("", {}, {}, frozenset())
    record = read_json_object(path)
    try:
        printed = {(entry["sequence"], entry["label"]): float(entry["drift"]) for entry in record["printed"]}
        order = {(name, label): i for i, (name, label) in enumerate(record["order"])}
        return Record(str(record["name"]), printed, order, frozenset(record.get("runs", ())))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise GavoError(f"{path}: not the record of an experiment: {error}") from None
