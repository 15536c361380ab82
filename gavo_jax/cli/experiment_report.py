"""Turns a table of results into a report: tables, a figure and an HTML page."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gavo_jax import presets
from gavo_jax.errors import GavoError, printable
from gavo_jax.experiments.distinction import tell_apart
from gavo_jax.experiments.record import Record, read_record
from gavo_jax.experiments.summary import Comparison, Summary, compare, summarise
from gavo_jax.experiments.table import Table
from gavo_jax.locks import hold
from gavo_jax.odometry.metrics import DRIFT, drifts_of
from gavo_jax.output import plots
from gavo_jax.output.drawing import save_figure
from gavo_jax.output.files import environment, prepare_folder
from gavo_jax.output.report import REPORT as PAGE
from gavo_jax.output.report import Picture, write_report
from gavo_jax.output.report import Table as ReportTable
from gavo_jax.output.screen import DASH, counted, known_columns, markdown_table, number, print_table, say

FIGURE = "drift"
SUMMARY_COLUMNS = (
    "method",
    "runs",
    "m/s",
    "from",
    "to",
    "printed",
    "deg/s",
    "m/frame",
    "lost",
    "ms/frame",
    "together",
)
COMPARISON_COLUMNS = ("", "paired runs", "ratio", "p")
MEANINGS = {
    "m/s": "m/s, deg/s: drift (relative pose error over 1 s, RMSE), median over the runs.",
    "from": "from, to: quartiles of the m/s.",
    "printed": "printed: the m/s that a publication prints.",
    "m/frame": "m/frame: relative pose error from frame to frame, RMSE, median over the runs.",
    "lost": "lost: frame pairs without a usable motion, in the worst run.",
    "ms/frame": "ms/frame: time, decoding included, median over the runs.",
    "together": "together: largest number of runs that shared the machine and its time.",
}
"""Explanations of the table's columns."""
TEST = (
    "Methods paired by sequence and seed: median of the ratio of their drifts, and p of the two-sided Wilcoxon "
    "signed-rank test, not corrected for the number of comparisons"
)


def report(folder: Path, markdown: bool = False) -> int:
    """Print the tables of an experiment's folder, optionally as Markdown; write report.html and the figure there."""
    if not folder.is_dir():
        raise GavoError(f"{folder}: no experiment results: no such folder")
    with hold(prepare_folder(folder)):
        return report_held(folder, markdown)


def report_held(folder: Path, markdown: bool) -> int:
    """Do the same as `report` for a folder whose lock is already held."""
    record = read_record(folder)
    rows = tell_apart(Table(folder).read(), record.runs)
    order = record.order
    rows.sort(key=lambda row: (order.get((row["sequence"], row["label"]), len(order)), row["seed"] or 0))
    others = [row for row in rows if record.runs and row["run"] not in record.runs]
    earlier = {row["sequence"] for row in others} - {row["sequence"] for row in rows if row["run"] in record.runs}
    missing = len(record.runs - {row["run"] for row in rows})
    summaries, comparisons = summarise(rows), [] if missing else compare(rows, earlier)
    tables = [*_summary_tables(summaries, record), *_comparison_tables(comparisons)]
    for table in tables:
        table.show(markdown)
    notes = _notes(rows, others, summaries)
    if missing:
        notes.append(
            f"{missing} of the {len(record.runs)} planned runs are not done, so methods are not compared yet; gavo "
            "experiment FILE does them."
        )
    columns = {heading for table in tables for heading in table.columns}
    for line in (*(words for heading, words in MEANINGS.items() if heading in columns), *notes):
        say(line)
    if comparisons:
        say(f"{TEST}.")
    page = folder / PAGE
    write_report(
        page,
        f"Experiment {record.name or rows[0]['experiment']}",
        [ReportTable(table.caption, table.columns, table.cells) for table in tables],
        _figures(folder, rows),
        {row["run"]: json.loads(row["configuration"]) for row in rows},
        environment(),
        " ".join(notes),
    )
    say(f"{counted(len(rows), 'run')} in {Table(folder).folder}, report in {page}")
    return 0


class Shown(NamedTuple):
    """A table for the terminal and for the HTML page."""

    title: str
    caption: str
    """Replaces the title on the page."""
    columns: Sequence[str]
    cells: Sequence[Sequence[Any]]

    def show(self, markdown: bool) -> None:
        """Print it."""
        if markdown:
            print(f"{printable(self.title)}\n\n{markdown_table(self.columns, self.cells)}\n")
        else:
            print_table(self.title, self.columns, self.cells)


def _summary_tables(summaries: Sequence[Summary], record: Record) -> Iterator[Shown]:
    for name in dict.fromkeys(summary.sequence for summary in summaries):
        cells = [_summary_row(summary, record) for summary in summaries if summary.sequence == name]
        columns, cells = known_columns(SUMMARY_COLUMNS, cells)
        meanings = [words for heading, words in MEANINGS.items() if heading in columns]
        yield Shown(name, " ".join([f"{name}.", *meanings]), columns, cells)


def _comparison_tables(comparisons: Sequence[Comparison]) -> Iterator[Shown]:
    for name in dict.fromkeys(comparison.sequence for comparison in comparisons):
        cells = [_comparison_row(found) for found in comparisons if found.sequence == name]
        yield Shown(f"{name}: first / second", f"{name}. {TEST}.", COMPARISON_COLUMNS, cells)


def _notes(
    rows: Sequence[Mapping[str, Any]], others: Sequence[Mapping[str, Any]], summaries: Sequence[Summary]
) -> list[str]:
    """Return notes on the tables; `others` are rows of runs that are not in the experiment's current plan."""
    notes = _without_drift(summaries) + _ended(rows)
    if (states := len({_state(row) for row in rows})) > 1:
        notes.append(f"The rows come from {states} versions of the software or its dependencies.")
    if others:
        notes.append(f"{len(others)} of {len(rows)} runs are from earlier versions of the experiment's file.")
    return notes


def _without_drift(summaries: Sequence[Summary]) -> list[str]:
    """Return sentences that say which sequences have no drift, and why."""
    told = {summary.sequence for summary in summaries if summary.drift is not None}
    by_frame = {summary.sequence for summary in summaries if summary.per_frame is not None}
    none = [name for name in dict.fromkeys(summary.sequence for summary in summaries) if name not in told]
    short, blind = ([name for name in none if (name in by_frame) is known] for known in (True, False))
    lost = [summary for summary in summaries if summary.drift is None and summary.sequence in told]
    notes = [f"No drift of {one.sequence} by {one.label}: no tracked part lasts 1 s." for one in lost]
    some = [summary for summary in summaries if 0 < summary.known < summary.runs]
    notes += [
        f"No drift of {one.sequence} by {one.label} in {one.runs - one.known} of {one.runs} runs, which count as "
        "infinite: no tracked part lasts 1 s."
        for one in some
    ]
    notes += [f"No drift of {', '.join(short)}: no two frames that the truth covers are 1 s apart."] if short else []
    return notes + ([f"No errors of {', '.join(blind)}: no ground truth covers it."] if blind else [])


def _ended(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return sentences that say which runs `on_lost` ended: their errors are of the frames before."""
    groups: dict[tuple[str, str], list[bool]] = {}
    for row in rows:
        planned = json.loads(row["configuration"]).get("sequence", {}).get("frames", 0)
        groups.setdefault((row["sequence"], row["label"]), []).append(row["frames"] < planned)
    return [
        f"{sum(ended)} of {counted(len(ended), 'run')} of {label} on {name} ended at the first lost pair: figures of "
        "the frames before."
        for (name, label), ended in groups.items()
        if any(ended)
    ]


def _state(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return the software versions behind a row, without libraries that only one peer uses."""
    versions = json.loads(row["versions"])
    return (*(versions.get(name) for name in environment()), row["git_commit"], row["git_modified"])


def _summary_row(summary: Summary, record: Record) -> list[Any]:
    low, median, high = summary.drift or (None, None, None)
    return [
        summary.label,
        summary.runs,
        *(number(value, 5) for value in (median, low, high)),
        number(record.printed.get((summary.sequence, summary.label)), 5),
        number(summary.rotation, 3),
        number(None if summary.drift else summary.per_frame, 5),
        summary.lost,
        number(summary.milliseconds, 1),
        summary.together,
    ]


def _comparison_row(found: Comparison) -> list[Any]:
    p = DASH if found.p is None else f"{found.p:.2g}"
    return [f"{found.first} / {found.second}", found.pairs, number(found.ratio, 4), p]


def _figures(folder: Path, rows: Sequence[Mapping[str, Any]]) -> list[Picture]:
    """Draw the drift of every method on every sequence, if matplotlib is installed."""
    clips: dict[str, dict[str, list[tuple[float, float]]]] = {}
    known = {row["sequence"] for row in rows if row[DRIFT] is not None}
    for row in rows:
        if row["sequence"] in known:
            clips.setdefault(row["sequence"], {}).setdefault(row["label"], []).append(drifts_of(row))
    if not clips or not plots.available():
        return []
    drifts = {clip: {name: np.array(runs) for name, runs in methods.items()} for clip, methods in clips.items()}
    ours = list({row["label"] for row in rows if row["method"] in presets.methods()})
    return [save_figure(plots.plot_drift(drifts, ours), folder, FIGURE)]
