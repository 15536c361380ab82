"""`gavo experiment`: a file of runs to a table of results, and a table of results to a report."""

import json
from collections.abc import Mapping, Sequence
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gavo_jax import presets
from gavo_jax.cli.options import Experiment
from gavo_jax.compilation.cache import enable_compilation_cache
from gavo_jax.errors import GavoError, printable, read_text
from gavo_jax.experiments.distinction import tell_apart
from gavo_jax.experiments.executors import LocalExecutor, Outcome, RayExecutor
from gavo_jax.experiments.plan import Plan, Run, programs
from gavo_jax.experiments.plan_file import read_plan
from gavo_jax.experiments.runner import estimate_seconds, fitted_batches, missing, run_experiment
from gavo_jax.experiments.summary import DRIFT, ROTATION_DRIFT, Comparison, Summary, compare, summarise
from gavo_jax.experiments.table import Table
from gavo_jax.locks import hold
from gavo_jax.output import plots
from gavo_jax.output.drawing import save_figure
from gavo_jax.output.files import environment, prepare_folder, write_json
from gavo_jax.output.report import REPORT as PAGE
from gavo_jax.output.report import Picture, write_report
from gavo_jax.output.report import Table as ReportTable
from gavo_jax.output.screen import DASH, counted, known_columns, markdown_table, number, pair_progress, print_table, say

REPORT = "report"
PLAN, FIGURE = "experiment.json", "drift"
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
    "lost": "lost: frame pairs without a usable motion, of the worst run.",
    "ms/frame": "ms/frame: time, decoding included, median over the runs.",
    "together": "together: most runs that shared the machine and its time.",
}
"""What the columns of the table are."""
TEST = (
    "Methods paired by sequence and seed: median of the ratio of their drifts, and p of the two-sided Wilcoxon "
    "signed-rank test, not corrected for the number of comparisons"
)
Printed = Mapping[tuple[str, str], float]


class Record(NamedTuple):
    """What a report needs of an experiment beside the table."""

    name: str
    printed: Printed
    """Drift that a publication gives, by sequence and label, m/s."""
    order: Mapping[tuple[str, str], int]
    """Of sequence and label."""
    runs: frozenset[str]
    """Hashes of the experiment's runs as its file was last."""


def experiment(options: Experiment) -> int:
    """Print the plan, run what the table does not have yet, print and write the report; return the exit status."""
    if options.file == REPORT:
        if options.folder is None:
            raise GavoError("report: which folder? gavo experiment report DIR")
        return report(options.folder, options.markdown)
    if options.folder is not None:
        raise GavoError(f"unexpected argument {str(options.folder)!r}: the folder for results is --output DIR")
    plan = read_plan(options.file, options.output)
    table = Table(plan.folder)
    if options.dry_run:
        _print_plan(plan, table, missing(plan, table), 1)
        return 0
    prepare_folder(plan.folder)
    enable_compilation_cache()
    with hold(plan.folder):
        _run_missing(plan, table, options.executor)
        return _report(plan.folder, options.markdown)


def _run_missing(plan: Plan, table: Table, executor_name: str) -> None:
    """Say what will be run, and run it.

    Raises:
        GavoError: a batch failed, or the table cannot be written.
        KeyboardInterrupt: it says how far the runs have come.
    """
    with closing(RayExecutor(plan.ray)) if executor_name == "ray" else nullcontext(LocalExecutor()) as executor:
        runs = missing(plan, table)
        _print_plan(plan, table, runs, executor.slots())
        write_json(plan.folder / PLAN, _record(plan))
        with pair_progress(plan.name, sum(run.pairs for run in runs)) as bar:
            try:
                finished = run_experiment(plan, table, executor, bar.advance, lambda found: bar.say(_news(found)))
            except KeyboardInterrupt:
                raise KeyboardInterrupt(
                    f": {len(plan.runs) - len(missing(plan, table))} of {len(plan.runs)} runs are in {table.folder}; "
                    "the same command goes on from there"
                ) from None
    if finished.faults:
        raise GavoError(
            f"{counted(len(finished.faults), 'batch', 'batches')} of runs failed: {'; '.join(finished.faults)}"
        )


def _news(outcome: Outcome) -> str:
    runs = outcome.batch.runs
    labels = "; ".join(dict.fromkeys(run.label for run in runs))
    return f"{outcome.batch.part.name}: {labels}: {outcome.fault or f'{len(runs)} done'}"


def report(folder: Path, markdown: bool = False) -> int:
    """Print the tables of an experiment's folder, as Markdown if so asked; write report.html and the figure there."""
    if not folder.is_dir():
        raise GavoError(f"{folder}: no results of an experiment: no such folder")
    with hold(prepare_folder(folder)):
        return _report(folder, markdown)


def _report(folder: Path, markdown: bool) -> int:
    record = _read_record(folder)
    printed, order = record.printed, record.order
    rows = tell_apart(Table(folder).read(), record.runs)
    rows.sort(key=lambda row: (order.get((row["sequence"], row["label"]), len(order)), row["seed"] or 0))
    others = [row for row in rows if record.runs and row["run"] not in record.runs]
    earlier = {row["sequence"] for row in others} - {row["sequence"] for row in rows if row["run"] in record.runs}
    summaries, comparisons = summarise(rows), compare(rows, earlier)
    sequences = list(dict.fromkeys(summary.sequence for summary in summaries))
    tables, explained = [], {}
    for name in sequences:
        cells = [_summary_row(summary, printed) for summary in summaries if summary.sequence == name]
        columns, cells = known_columns(SUMMARY_COLUMNS, cells)
        meanings = {heading: words for heading, words in MEANINGS.items() if heading in columns}
        explained |= meanings
        tables.append(ReportTable(" ".join([f"{name}.", *meanings.values()]), columns, cells))
        _show(name, columns, cells, markdown)
    for name in dict.fromkeys(comparison.sequence for comparison in comparisons):
        cells = [_comparison_row(found) for found in comparisons if found.sequence == name]
        tables.append(ReportTable(f"{name}. {TEST}.", COMPARISON_COLUMNS, cells))
        _show(f"{name}: first / second", COMPARISON_COLUMNS, cells, markdown)
    states = {_state(row) for row in rows}
    notes = _without_drift(summaries)
    if len(states) > 1:
        notes.append(f"The rows come from {len(states)} versions of the software or of what it uses.")
    if others:
        notes.append(f"{len(others)} of {len(rows)} runs are none of the experiment's as its file is now.")
    for line in (*(MEANINGS[heading] for heading in MEANINGS if heading in explained), *notes):
        say(line)
    if comparisons:
        say(f"{TEST}.")
    configurations = {row["run"]: json.loads(row["configuration"]) for row in rows}
    page = folder / PAGE
    write_report(
        page,
        f"Experiment {record.name or rows[0]['experiment']}",
        tables,
        _figures(folder, rows),
        configurations,
        environment(),
        " ".join(notes),
    )
    say(f"{counted(len(rows), 'run')} in {Table(folder).folder}, report in {page}")
    return 0


def _without_drift(summaries: Sequence[Summary]) -> list[str]:
    """A sentence for the sequences without drift, and why."""
    none = {summary.sequence: summary.per_frame for summary in summaries if summary.drift is None}
    short = [name for name, per_frame in none.items() if per_frame is not None]
    blind = [name for name, per_frame in none.items() if per_frame is None]
    notes = [f"No drift of {', '.join(short)}: no two frames that the truth covers are 1 s apart."] if short else []
    return notes + ([f"No errors of {', '.join(blind)}: no ground truth covers it."] if blind else [])


def _show(title: str, columns: Sequence[str], cells: Sequence[Sequence[Any]], markdown: bool) -> None:
    if markdown:
        print(f"{printable(title)}\n\n{markdown_table(columns, cells)}\n")
    else:
        print_table(title, columns, cells)


def _state(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """What a row's software was, without the libraries that one peer alone brings."""
    versions = json.loads(row["versions"])
    return (*(versions.get(name) for name in environment()), row["git_commit"], row["git_modified"])


def _print_plan(plan: Plan, table: Table, runs: list[Run], slots: int) -> None:
    """Say what will be run, before it is."""
    todo = fitted_batches(runs, plan.batch, slots)
    ours = {run.id for run in runs}
    rows = []
    for name, label in dict.fromkeys((run.part.name, run.label) for run in plan.runs):
        group = [run for run in plan.runs if (run.part.name, run.label) == (name, label)]
        rows.append((f"{name}: {label}", len(group), sum(run.id in ours for run in group), group[0].pairs))
    print_table(f"experiment {plan.name}", ("", "runs", "to do", "frame pairs"), rows)
    for line in plan.skipped:
        say(line)
    seconds = estimate_seconds(runs, table.read() if table.done() else [], slots)
    done, batches = len(plan.runs) - len(runs), counted(len(todo), "batch", "batches")
    say(
        f"{counted(len(plan.runs), 'run')}, {done} of them done; {len(runs)} to do in {batches}, "
        f"{counted(programs(runs), 'compiled program')}, about {_duration(seconds)}; results in {plan.folder}"
    )


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _record(plan: Plan) -> dict[str, Any]:
    """`Record` as it is written."""
    order = list(dict.fromkeys((run.part.name, run.label) for run in plan.runs))
    printed = [{"sequence": name, "label": label, "drift": value} for (name, label), value in plan.printed.items()]
    return {"name": plan.name, "order": order, "printed": printed, "runs": [run.id for run in plan.runs]}


def _read_record(folder: Path) -> Record:
    path = folder / PLAN
    if not path.is_file():
        return Record("", {}, {}, frozenset())
    try:
        record = json.loads(read_text(path))
        printed = {(entry["sequence"], entry["label"]): float(entry["drift"]) for entry in record["printed"]}
        order = {(name, label): i for i, (name, label) in enumerate(record["order"])}
        return Record(str(record["name"]), printed, order, frozenset(record.get("runs", ())))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise GavoError(f"{path}: not the record of an experiment: {error}") from None


def _summary_row(summary: Summary, printed: Printed) -> list[Any]:
    low, median, high = summary.drift or (None, None, None)
    return [
        summary.label,
        summary.runs,
        *(number(value, 5) for value in (median, low, high)),
        number(printed.get((summary.sequence, summary.label)), 5),
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
    """Write the drift of every method on every sequence as a figure, where matplotlib is installed."""
    clips: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for row in rows:
        if row[DRIFT] is not None:
            clips.setdefault(row["sequence"], {}).setdefault(row["label"], []).append((row[DRIFT], row[ROTATION_DRIFT]))
    if not clips or not plots.available():
        return []
    drifts = {clip: {name: np.array(runs) for name, runs in methods.items()} for clip, methods in clips.items()}
    ours = list({row["label"] for row in rows if row["method"] in presets.methods()})
    return [save_figure(plots.plot_drift(drifts, ours), folder, FIGURE)]
