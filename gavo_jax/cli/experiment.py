"""`gavo experiment`: runs an experiment file into a table of results, and reports on that table."""

from contextlib import closing, nullcontext
from pathlib import Path

from gavo_jax.cli.experiment_report import FIGURE, report, report_held
from gavo_jax.cli.options import Experiment
from gavo_jax.cli.readiness import be_ready
from gavo_jax.errors import GavoError
from gavo_jax.experiments.executors import LocalExecutor, Outcome, RayExecutor
from gavo_jax.experiments.plan import Plan, Run, programs
from gavo_jax.experiments.plan_file import read_plan
from gavo_jax.experiments.record import read_record, write_record
from gavo_jax.experiments.runner import estimate_seconds, fitted_batches, missing, run_experiment
from gavo_jax.experiments.table import Table
from gavo_jax.locks import hold
from gavo_jax.output.files import (
    COMPARISON,
    EXPERIMENT,
    FIGURE_NAMES,
    FRAMES,
    prepare_folder,
    refuse_foreign,
    refuse_strange,
)
from gavo_jax.output.report import REPORT as PAGE
from gavo_jax.output.screen import counted, pair_progress, print_table, say

REPORT = "report"


def experiment(options: Experiment) -> int:
    """Print the plan, run what the table lacks, print and write the report; return the exit status."""
    if options.file == REPORT:
        if options.folder is None:
            raise GavoError("report: no folder given; use gavo experiment report DIR")
        if options.dry_run or options.output is not None or options.executor != "local":
            raise GavoError("report: runs nothing, so --dry-run, --output and --executor do not apply")
        return report(options.folder, options.markdown)
    if options.folder is not None:
        raise GavoError(f"unexpected argument {str(options.folder)!r}: pass the folder for results as --output DIR")
    plan = read_plan(options.file, options.output)
    table = Table(plan.folder)
    if options.dry_run:
        _print_plan(plan, table, missing(plan, table), 1)
        return 0
    be_ready()
    prepare_folder(plan.folder)
    with hold(plan.folder):
        _refuse_foreign(plan.folder, table)
        _run_missing(plan, table, options.executor)
        return report_held(plan.folder, options.markdown)


def _refuse_foreign(folder: Path, table: Table) -> None:
    """Refuse a folder with other results, or with files that the report would replace and no experiment wrote."""
    refuse_foreign(folder, FRAMES, COMPARISON)
    if not (read_record(folder).runs or table.done()):
        figures = (name for name in FIGURE_NAMES if name.startswith(f"{FIGURE}."))
        refuse_strange(folder, (EXPERIMENT, PAGE, *figures), "an experiment")


def _run_missing(plan: Plan, table: Table, executor_name: str) -> None:
    """Print the plan, then run it.

    Raises:
        GavoError: a batch failed, or the table cannot be written.
        KeyboardInterrupt: the user interrupted; the message says how many runs are done.
    """
    with closing(RayExecutor(plan.ray)) if executor_name == "ray" else nullcontext(LocalExecutor()) as executor:
        runs = missing(plan, table)
        _print_plan(plan, table, runs, executor.slots())
        write_record(plan)
        with pair_progress(plan.name, sum(run.pairs for run in runs)) as bar:
            try:
                finished = run_experiment(plan, table, executor, bar.advance, lambda found: bar.say(_news(found)))
            except KeyboardInterrupt:
                raise KeyboardInterrupt(
                    f": {len(plan.runs) - len(missing(plan, table))} of {len(plan.runs)} runs are in {table.folder}; "
                    "the same command resumes from there"
                ) from None
    if finished.faults:
        raise GavoError(
            f"{counted(len(finished.faults), 'batch', 'batches')} of runs failed: {'; '.join(finished.faults)}"
        )


def _news(outcome: Outcome) -> str:
    runs = outcome.batch.runs
    labels = "; ".join(dict.fromkeys(run.label for run in runs))
    return f"{outcome.batch.part.name}: {labels}: {outcome.fault or f'{len(runs)} done'}"


def _print_plan(plan: Plan, table: Table, runs: list[Run], slots: int) -> None:
    """Print which runs are planned, and the estimated time."""
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
