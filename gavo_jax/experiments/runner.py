"""An experiment from its plan to its table: what is missing is run, each row is kept as soon as it is there."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from gavo_jax.experiments.executors import Executor, Outcome
from gavo_jax.experiments.plan import Batch, Plan, Run, batches, programs
from gavo_jax.experiments.table import Table
from gavo_jax.odometry.metrics import FRAMES_PER_SECOND

MILLISECONDS = {"ga": 40.0, "pso": 60.0, "gauss-newton": 40.0, "adam": 60.0}
"""A frame of 640 x 480 by the default preset on two cores, for a plan's estimate before anything was measured."""
PRESET_FACTOR = {"default": 1.0, "fast": 0.8, "paper": 12.0, "wide": 6.0}
PEER_MILLISECONDS = 120.0
COMPILE_SECONDS = 20.0
PIXELS = 640 * 480


class Finished(NamedTuple):
    """What an experiment came to."""

    rows: int
    """New rows in the table."""
    faults: list[str]
    """A line for each batch that could not be run."""


def missing(plan: Plan, table: Table) -> list[Run]:
    """The runs that the table does not have yet."""
    done = table.done()
    return [run for run in plan.runs if run.id not in done]


def fitted_batches(runs: Sequence[Run], largest: int, slots: int) -> list[Batch]:
    """Batches as large as leaves none of the executor's slots without one."""
    return batches(runs, max(1, min(largest, -(-len(runs) // slots))))


def estimate_seconds(runs: Sequence[Run], rows: Iterable[Mapping[str, Any]], slots: int) -> float:
    """How long the runs will take, roughly: by the table's own times of the same label, else by `MILLISECONDS`."""
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
    """Run what the table does not have yet and append each row as soon as it is known.

    Args:
        plan: What is to be there in the end.
        table: Where it goes; other processes may append to it meanwhile.
        executor: Who runs it.
        on_pairs: Hears of pairs that are done.
        on_outcome: Hears of each batch when its rows are in the table.

    Raises:
        GavoError: the table cannot be written.
    """
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
