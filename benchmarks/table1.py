"""The paper's Table 1 from the runs of `gavo experiment examples/table1.toml`: each method's drift, and paired tests.

Prints, for each sequence, one row per method: its runs, the drift's median and quartiles in m/s, the paper's figure,
and the rotation's median in deg/s. A second table compares `ga` with the other methods, paired by seed, with p of a
Wilcoxon signed-rank test.

    gavo experiment examples/table1.toml
    python benchmarks/table1.py
    python benchmarks/table1.py --record benchmarks/records/table1.toml

The runs take 20 to 30 minutes on 2 cores; this takes a second.
"""

import json as json_files
from pathlib import Path
from typing import Any

import common

from gavo_jax.errors import GavoError
from gavo_jax.experiments.summary import compare, summarise
from gavo_jax.experiments.table import Table
from gavo_jax.output.files import EXPERIMENT
from gavo_jax.output.screen import number

COLUMNS = ("method", "runs", "m/s", "from", "to", "printed", "deg/s")


def main(results: Path = Path("runs/table1"), json: Path | None = None) -> dict[str, Any]:
    """Print and return the figures.

    Args:
        results: folder of the experiment.
        json: file for the figures.

    Raises:
        GavoError: the folder has no results.
    """
    table = Table(results)
    if not table.done():
        raise GavoError(f"{results}: no results: run `gavo experiment examples/table1.toml` first")
    rows, plan = table.read(), json_files.loads((results / EXPERIMENT).read_text(encoding="utf-8"))
    printed = {(entry["sequence"], entry["label"]): entry["drift"] for entry in plan["printed"]}
    order = [tuple(entry) for entry in plan["order"]]
    rows.sort(key=lambda row: (order.index((row["sequence"], row["label"])), row["seed"] or 0))
    summaries, comparisons = summarise(rows), compare(rows)
    for sequence in dict.fromkeys(summary.sequence for summary in summaries):
        cells = []
        for found in (summary for summary in summaries if summary.sequence == sequence):
            low, median, high = found.drift or (None, None, None)
            drifts = [number(value, 5) for value in (median, low, high, printed.get((sequence, found.label)))]
            cells.append((found.label, found.runs, *drifts, number(found.rotation, 3)))
        common.print_table(f"{sequence}, m/s and deg/s", COLUMNS, cells)
        tests = [found for found in comparisons if found.sequence == sequence and found.first == "ga"]
        cells = []
        for found in tests:
            p = 1.0 if found.p is None else found.p
            cells.append((f"ga / {found.second}", number(found.ratio, 4), f"{p:.1e}"))
        common.print_table(f"{sequence}, paired by seed (Wilcoxon)", ("", "ratio", "p"), cells)
    figures = {
        "summary": [summary._asdict() for summary in summaries],
        "paired": [found._asdict() for found in comparisons],
    }
    common.record(json, "table1", figures)
    return figures


if __name__ == "__main__":
    common.command(main)
