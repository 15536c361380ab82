"""Summary of a results table: median and spread of each method, and tests of whether two methods differ."""

import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from gavo_jax.evaluation import quantiles_of
from gavo_jax.odometry.metrics import DRIFT, DRIFT_PER_FRAME, FRAMES_PER_SECOND, drifts_of

ALL = "all sequences"

Row = Mapping[str, Any]


class Summary(NamedTuple):
    """Figures of one method on one sequence, over its seeds."""

    sequence: str
    label: str
    runs: int
    drift: tuple[float, float, float] | None
    """Lower quartile, median and upper quartile of the drift, m/s; None where no run has one. Where others have one, a
    run without, of a camera that was lost, counts as infinite.
    """
    known: int
    """Number of runs with a drift."""
    rotation: float | None
    """Median of the rotational drift, deg/s, of the same runs."""
    per_frame: float | None
    """Median of the translational error per frame, m; None where there is no ground truth."""
    lost: int
    """Largest number of lost pairs in a run."""
    milliseconds: float
    """Median over the runs of the wall time per frame, decoding included; runs tracked together share it equally."""
    together: int
    """Largest number of runs that were tracked together."""


class Comparison(NamedTuple):
    """Comparison of two methods, paired by sequence and seed."""

    sequence: str
    first: str
    second: str
    pairs: int
    ratio: float
    """Median of first / second drift over the pairs."""
    p: float | None
    """p-value of the two-sided Wilcoxon signed-rank test of the drifts' differences; None where all are zero."""


def summarise(rows: Iterable[Row]) -> list[Summary]:
    """Summarise each sequence and label, in order of first appearance."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["sequence"], row["label"]), []).append(row)
    return [_summary(sequence, label, group) for (sequence, label), group in groups.items()]


def _summary(sequence: str, label: str, rows: Sequence[Row]) -> Summary:
    drifts, turns = zip(*map(drifts_of, rows), strict=True)
    steps = [row[DRIFT_PER_FRAME] for row in rows if row[DRIFT_PER_FRAME] is not None]
    quartiles = quantiles_of(drifts, (0.25, 0.5, 0.75)) if min(drifts) < np.inf else None
    return Summary(
        sequence,
        label,
        len(rows),
        None if quartiles is None else (quartiles[0], quartiles[1], quartiles[2]),
        sum(drift < np.inf for drift in drifts),
        quantiles_of(turns, (0.5,))[0] if quartiles else None,
        float(np.median(steps)) if steps else None,
        max(row["lost_pairs"] for row in rows),
        float(np.median([1e3 / row[FRAMES_PER_SECOND] for row in rows])),
        max(row["runs_together"] for row in rows),
    )


def compare(rows: Sequence[Row], earlier: Collection[str] = ()) -> list[Comparison]:
    """Compare every two labels on each sequence, and over all sequences if there are several.

    A method with a single result on a sequence, as one without chance has it for every seed, is compared with every
    seed of the other; two such methods make a single pair. A single pair is not compared. A run without a drift, of a
    camera that was lost, is worse than any with one.

    Args:
        rows: Rows in which a sequence's name always stands for the same frames, and a label for the same settings.
        earlier: Sequences of earlier versions of the experiment's file, left out of the comparison over all.
    """
    drifts: dict[str, dict[str, dict[Any, float]]] = {}
    known = {row["sequence"] for row in rows if row[DRIFT] is not None}
    for row in rows:
        if row["sequence"] in known:
            drifts.setdefault(row["label"], {}).setdefault(row["sequence"], {})[row["seed"]] = drifts_of(row)[0]
    sequences = list(dict.fromkeys(row["sequence"] for row in rows))
    found = []
    for first, second in itertools.combinations(drifts, 2):
        matched = {name: _matched(drifts[first].get(name, {}), drifts[second].get(name, {})) for name in sequences}
        present = [pairs for name, pairs in matched.items() if pairs and name not in earlier]
        if len(present) > 1:
            matched[ALL] = list(itertools.chain(*present))
        found += [_test(name, first, second, pairs) for name, pairs in matched.items() if len(pairs) > 1]
    return sorted(found, key=lambda comparison: [*sequences, ALL].index(comparison.sequence))


def _matched(first: Mapping[Any, float], second: Mapping[Any, float]) -> list[tuple[float, float]]:
    one, other = set(first.values()), set(second.values())
    if len(one) == len(other) == 1:
        pairs = list(zip(one, other, strict=True))
    elif len(one) == 1:
        pairs = list(itertools.product(one, second.values()))
    elif len(other) == 1:
        pairs = list(itertools.product(first.values(), other))
    else:
        pairs = [(first[seed], second[seed]) for seed in first if seed in second]
    return [pair for pair in pairs if min(pair) < np.inf]


def _test(sequence: str, first: str, second: str, pairs: Sequence[tuple[float, float]]) -> Comparison:
    from scipy.stats import wilcoxon

    a, b = np.array(pairs).T
    p = float(np.asarray(wilcoxon(a, b))[1]) if np.any(a != b) else None
    return Comparison(sequence, first, second, len(pairs), float(np.median(a / b)), p)
