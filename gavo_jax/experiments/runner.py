"""Runs an experiment: whatever its table lacks, saving each row as soon as it is known."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from gavo_jax.experiments.executors import Executor, Outcome
from gavo_jax.experiments.plan import Batch, Plan, Run, batches, programs
from gavo_jax.experiments.table import Table
from gavo_jax.odometry.metrics import FRAMES_PER_SECOND

MILLISECONDS = {"ga": 40.0, "pso": 60.0, "gauss-newton": 40.0, "adam": 60.0}
"""Typical time per 640 x 480 frame by method (default preset, two cores), for estimates before any measurement."""
PRESET_FACTOR = {"default": 1.0, "fast": 0.8, "paper": 12.0, "wide": 6.0}
PEER_MILLISECONDS = 120.0
COMPILE_SECONDS = 20.0
PIXELS = 640 * 480


class Finished(NamedTuple):
    """The outcome of an experiment."""

    rows: int
    """Number of new rows in the table."""
    faults: list[str]
    """One line for each batch that could not be run."""


def missing(plan: Plan, table: Table) -> list[Run]:
    """Return the runs that the table does not have yet."""
    done = table.done()
    return [run for run in plan.runs if run.id not in done]


def fitted_batches(runs: Sequence[Run], largest: int, slots: int) -> list[Batch]:
    """Group runs into the largest batches, up to `largest` runs each, that still give every slot one."""
    return batches(runs, max(1, min(largest, -(-len(runs) // slots))))


def estimate_seconds(runs: Sequence[Run], rows: Iterable[Mapping[str, Any]], slots: int) -> float:
    """Roughly estimate the runs' duration from the table's times of the same label, or else from `MILLISECONDS`."""
    measured: dict[str, list[float]] = {}
    for row in rows:
        if row[FRAMES_PER_SECOND]:
            measured.setdefault(row["label"], []).append(1e3 / row[FRAMES_PER_SECOND] * PIXELS / row["pixels"])
    seconds = COMPILE_SECONDS * programs(runs)
    for run in runs:
        typical = MILLISECONDS.get(run.method, PEER_MILLISECONDS) * PRESET_FACTOR.get(run.preset, 1.0)
        milliseconds = float(np.median(measured[run.label])) if run.label in measured else typical
        seconds += run.pairs * milliseconds * run.pixels / PIXELS / 1e3
    return seconds / slots


def run_experiment(
    plan: Plan,
    table: Table,
    executor: Executor,
    on_pairs: Callable[[int], None] = lambda _: None,
    on_outcome: Callable[[Outcome], None] = lambda _: None,
) -> Finished:
    """Run what the table does not have yet, and append each row as soon as it is known.

    Args:
        plan: All runs that the table should have in the end.
        table: Table to append to; other processes may append to it meanwhile.
        executor: Runs the batches.
        on_pairs: Called with the number of pairs just done.
        on_outcome: Called with each batch's outcome once its rows are in the table.

    Raises:
        GavoError: The table cannot be written, or pyarrow is missing.
    """
    table.require_library()
    todo = fitted_batches(missing(plan, table), plan.batch, executor.slots())
    rows, faults = 0, []
    for outcome in executor.run(plan.name, todo, on_pairs):
        for row in outcome.rows:
            table.append(row)
        rows += len(outcome.rows)
        if outcome.fault is not None:
            labels = ", ".join(dict.fromkeys(run.label for run in outcome.batch.runs))
            faults.append(f"{outcome.batch.part.name}: {labels}: {outcome.fault}")
        on_outcome(outcome)
    return Finished(rows, faults)
