"""Medians, spreads and tests from rows whose answers are known."""

import json
from collections.abc import Sequence

import numpy as np
import pytest

from gavo_jax.cli.experiment_report import _comparison_tables, _ended, _without_drift
from gavo_jax.experiments.summary import ALL, compare, summarise


def rows(sequence: str, label: str, drifts: list[float | None], seeds: Sequence[int | None] | None = None):
    return [
        {
            "sequence": sequence,
            "label": label,
            "seed": seed,
            "rpe_translation_rmse_m_per_s": drift,
            "rpe_rotation_rmse_deg_per_s": None if drift is None else 100 * drift,
            "rpe_translation_rmse_m_per_frame": 0.001 * (1 + i),
            "lost_pairs": i,
            "frames_per_second": 50.0 * (1 + i),
            "runs_together": 4,
        }
        for i, (drift, seed) in enumerate(zip(drifts, seeds or range(len(drifts)), strict=True))
    ]


def test_median_and_quartiles():
    (found,) = summarise(rows("a", "ga", [0.01, 0.02, 0.03, 0.04, 0.05]))
    assert found.drift == pytest.approx((0.02, 0.03, 0.04)) and found.rotation == pytest.approx(3.0)
    assert (found.runs, found.lost, found.together) == (5, 4, 4) and found.milliseconds == pytest.approx(1e3 / 150)
    (unknown,) = summarise(rows("a", "ga", [None, None]))
    assert unknown.drift is None and unknown.rotation is None and unknown.per_frame == pytest.approx(0.0015)


def test_figures_per_frame_are_of_the_runs_that_have_one():
    """Catches a traceback where the truth covers one of two runs only, and the least of the runs tracked together."""
    table = rows("a", "ga", [0.01, 0.02, 0.03])
    table[2]["rpe_translation_rmse_m_per_frame"], table[1]["runs_together"] = None, 1
    (found,) = summarise(table)
    assert found.per_frame == pytest.approx(0.0015) and found.together == 4


def test_runs_that_ended_early_are_told():
    """Their figures, of the frames before the first lost pair, stood beside those of whole runs without a word."""
    planned = json.dumps({"sequence": {"frames": 90}})
    table = [row | {"frames": 90, "configuration": planned} for row in rows("desk", "ga", [0.01, 0.02])]
    assert _ended(table) == []
    table[1]["frames"] = 12
    assert _ended(table) == ["1 of 2 runs of ga on desk ended at the first lost pair: figures of the frames before."]


def test_a_method_that_got_lost_does_not_speak_for_the_sequence():
    table = summarise(rows("desk", "ga", [0.01, 0.02]) + rows("desk", "orb-pnp", [None, None]))
    assert _without_drift(table) == ["No drift of desk by orb-pnp: no tracked part lasts 1 s."]
    (alone,) = _without_drift(summarise(rows("desk", "orb-pnp", [None])))
    assert alone.startswith("No drift of desk: no two frames")


def test_a_run_that_got_lost_is_worse_than_any_that_did_not() -> None:
    """A method that lost the camera in five of six runs was the best of all: only the sixth counted, for all six."""
    table = rows("a", "x", [0.01, None, None, None, None, None])
    table += rows("a", "y", [0.02, 0.021, 0.022, 0.023, 0.024, 0.025])
    first, second = summarise(table)
    assert (first.runs, first.known, first.rotation) == (6, 1, np.inf) and first.drift == (np.inf, np.inf, np.inf)
    assert second.drift == pytest.approx((0.02125, 0.0225, 0.02375))
    (note,) = _without_drift([first, second])
    assert note.startswith("No drift of a by x in 5 of 6 runs, which count as infinite")
    (found,) = compare(table)
    assert found.pairs == 6 and found.ratio == np.inf and found.p == pytest.approx(0.0625)
    assert compare(rows("b", "x", [None, None]) + rows("b", "y", [None, None])) == []


def test_a_clear_difference_is_significant_and_none_is_not():
    better = np.linspace(0.01, 0.02, 12)
    worse = better * np.linspace(1.1, 1.3, 12)
    (found,) = compare(rows("a", "x", better.tolist()) + rows("a", "y", worse.tolist()[::-1], list(range(12))[::-1]))
    assert found.pairs == 12 and found.ratio == pytest.approx(1 / 1.2, rel=0.02)
    assert found.p == pytest.approx(2 * 0.5**12, rel=1e-6)  # every sign alike: the exact test's smallest p
    (same,) = compare(rows("a", "x", better.tolist()) + rows("a", "y", better.tolist()))
    assert same.p is None and same.ratio == 1.0


def test_seeds_of_a_method_without_chance_are_one_result() -> None:
    """Twenty equal drifts against one of another such method were twenty pairs, with a p of 8e-6."""
    table = rows("a", "newton", [0.1] * 20) + rows("a", "peer", [0.3], [None])
    assert compare(table) == []
    (found,) = compare(table + rows("b", "newton", [0.2] * 20) + rows("b", "peer", [0.8], [None]))
    assert (found.sequence, found.pairs, found.ratio) == (ALL, 2, pytest.approx(7 / 24))
    (found,) = compare(table + rows("a", "ga", [0.2, 0.3, 0.4]))[:1]
    assert (found.first, found.second, found.pairs, found.ratio) == ("newton", "ga", 3, pytest.approx(1 / 3))


def test_rotation_of_runs_that_got_lost_counts_as_infinite_too() -> None:
    (found,) = summarise(rows("a", "x", [0.01, 0.02, 0.03, None]))
    assert found.drift is not None and (found.drift[1], found.rotation) == (0.03, 3.0)


def test_a_sequence_on_which_no_methods_meet_is_no_second_one() -> None:
    """Catches a line over all sequences that repeats the only one that both methods ran on."""
    table = rows("a", "x", [0.1, 0.2]) + rows("a", "y", [0.2, 0.4]) + rows("b", "x", [0.1, 0.3])
    assert [found.sequence for found in compare(table)] == ["a"]


def test_pairs_are_matched_by_seed_and_over_sequences():
    table = rows("a", "x", [0.1, 0.2], [0, 1]) + rows("a", "y", [0.1, 0.3], [1, 2])
    table += rows("b", "x", [0.4, 0.2], [0, 1]) + rows("b", "y", [0.1], [None])
    found = {comparison.sequence: comparison for comparison in compare(table)}
    assert list(found) == ["b", ALL]  # a single pair, as on a, is no comparison
    assert (found["b"].pairs, found["b"].ratio) == (2, 3.0)  # the one run of y stands against both seeds
    assert found[ALL].pairs == 3


def test_a_pair_of_runs_that_both_got_lost_says_nothing() -> None:
    """Catches a ratio of infinities, which is not a number; and a single tie that takes the test away."""
    (found,) = compare(rows("a", "x", [0.1, None, 0.3, 0.2]) + rows("a", "y", [0.1, None, 0.6, 0.4]))
    assert found.pairs == 3 and found.ratio == 0.5 and found.p is not None


def test_a_comparison_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    (found,) = compare(rows("a", "x", [0.1, 0.2, 0.3]) + rows("a", "y", [0.2, 0.4, 0.6]))
    (table,) = _comparison_tables([found])
    table.show(markdown=True)
    assert "| x / y | 3 | 0.5000 | 0.25 |" in capsys.readouterr().out and "Wilcoxon" in table.caption


def test_sequences_of_earlier_versions_are_not_compared_over_all() -> None:
    """Catches a line over all sequences that repeats the only one of the present version."""
    table = rows("a", "x", [0.1, 0.2]) + rows("a", "y", [0.2, 0.4]) + rows("old", "x", [9.0]) + rows("old", "y", [1.0])
    assert [found.sequence for found in compare(table, earlier=["old"])] == ["a"]
    table += rows("b", "x", [0.1, 0.2]) + rows("b", "y", [0.2, 0.4])
    found = {comparison.sequence: comparison for comparison in compare(table, earlier=["old"])}
    assert list(found) == ["a", "b", ALL] and found[ALL].pairs == 4
