"""Ablation of the GA: a preset with one ingredient switched off at a time.

Prints, for each clip, one row per variant: drift of translation (m/s) and rotation (deg/s), median over the seeds with
its spread, lost pairs of the worst run, milliseconds per pair. A last table has the ratios of each variant's medians to
the full preset's: geometric mean over the clips, best and worst clip. A ratio of 1 means that the ingredient gains
nothing.

    python benchmarks/ablation.py
    python benchmarks/ablation.py --clips fr1_desk:40 --variants depth,prior --seeds 2 --json ablation.json
    python benchmarks/ablation.py --preset fast --variants views,stagnation

On 2 cores the defaults (3 clips, 5 seeds, 16 rows) take about 25 minutes.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import common

from gavo_jax import presets
from gavo_jax.objective.losses import l2
from gavo_jax.output.screen import number
from gavo_jax.presets import PAPER_OBJECTIVE
from gavo_jax.settings import Settings

FULL = "full"


def _alignment(**changes: Any) -> Callable[[Settings], Settings]:
    return lambda preset: replace(preset, alignment=replace(preset.alignment, **changes))


def _odometry(**changes: Any) -> Callable[[Settings], Settings]:
    return lambda preset: replace(preset, odometry=replace(preset.odometry, **changes))


def _without_preconditioner(preset: Settings) -> Settings:
    """The preset with plain genes: first population, mutation and bounds in metres and radians, as in the paper."""
    return replace(
        preset,
        solver=replace(preset.solver, spread=None, mutation_step=None),
        alignment=replace(
            preset.alignment,
            precondition=False,
            bounds=PAPER_OBJECTIVE.bounds,
            bounds_factor=PAPER_OBJECTIVE.bounds_factor,
        ),
    )


VARIANTS: dict[str, tuple[str, Callable[[Settings], Settings]]] = {
    "precondition": ("plain genes", _without_preconditioner),
    "surrogate": (
        "no offspring from a quadratic fit",
        lambda preset: replace(preset, solver=replace(preset.solver, surrogate=False)),
    ),
    "robust": ("plain L2", _alignment(loss=l2)),
    "last_step": ("the best candidate as it is", _alignment(last_step=False)),
    "depth": ("no depth term", _alignment(depth=False)),
    "brightness": ("no brightness model", _alignment(brightness=False)),
    "synchronise": ("depth as it was read", _odometry(synchronise=False)),
    "shutter": ("all rows exposed at once", _odometry(rolling_shutter=False)),
    "sway": ("each frame's velocity the mean since the last", _odometry(sway=False)),
    "keyframe": ("previous frame only", _odometry(reference="previous")),
    "prior": ("no constant velocity", _odometry(prior=False)),
    "relight": ("in the light as it was", _odometry(relight=False)),
    "recover": ("no second try", _odometry(recover=False)),
    "points": ("every pixel", _alignment(points=None)),
    "views": ("both references on every level", _alignment(views=(2, 2, 2, 2, 2))),
    "stagnation": (
        "every generation",
        lambda preset: replace(preset, solver=replace(preset.solver, patience=max(preset.solver.iterations))),
    ),
}
"""For each ingredient: what a run without it is called, and the function that switches it off."""
OF_DEFAULT = ",".join(name for name in VARIANTS if name != "stagnation")
"""Ingredients of the default preset, which never stops a level before its last generation."""


def contenders(variants: str, preset_name: str = "default") -> list[common.Contender]:
    """The full preset and its variants.

    Raises:
        GavoError: an unknown variant.
    """
    full = presets.preset("ga", preset_name)
    chosen = [common.preset_contender(FULL, full)]
    for name in common.names_among(VARIANTS, "ingredient", variants):
        title, switch_off = VARIANTS[name]
        chosen.append(common.preset_contender(f"{name}: {title}", switch_off(full)))
    return chosen


def compare(summaries: list[common.Summary]) -> list[dict[str, Any]]:
    """Ratios of each variant to the full preset, over the clips."""
    full = {summary.clip: summary for summary in summaries if summary.name == FULL}
    compared = []
    for name in dict.fromkeys(summary.name for summary in summaries if summary.name != FULL):
        entry: dict[str, Any] = {"name": name}
        for what in ("translation", "rotation", "milliseconds"):
            ratios = [getattr(s, what) / getattr(full[s.clip], what) for s in summaries if s.name == name]
            entry[what] = {"mean": common.geometric_mean(ratios), "best": min(ratios), "worst": max(ratios)}
        compared.append(entry)
    return compared


def main(
    clips: str = common.CLIPS,
    variants: str = OF_DEFAULT,
    seeds: int = 5,
    preset: str = "default",
    json: Path | None = None,
) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clips: comma-separated, as for drift.py.
        variants: comma-separated ingredients to switch off.
        seeds: runs of each variant.
        preset: preset of the GA to start from.
        json: file for all runs and the summary.
    """
    runs = common.measure_drift(common.names(clips), contenders(variants, preset), seeds)
    summaries = common.summarise(runs)
    for clip in common.names(clips):
        rows = [common.drift_row(summary) for summary in summaries if summary.clip == clip]
        common.print_table(f"GA without one ingredient, {clip}", ("without", *common.DRIFT_COLUMNS[1:]), rows)
    compared = compare(summaries)
    rows = [
        [
            entry["name"],
            *(number(entry[what][which], 3) for what in ("translation", "rotation") for which in entry[what]),
            number(entry["milliseconds"]["mean"], 2),
        ]
        for entry in compared
    ]
    columns = ("without", "m/s", "best clip", "worst", "deg/s", "best clip", "worst", "ms")
    common.print_table("ratios to the full preset, geometric mean over the clips", columns, rows)
    results = {"runs": runs, "summary": [summary._asdict() for summary in summaries], "ratios": compared}
    common.record(json, "ablation", results)
    return results


if __name__ == "__main__":
    common.command(main)
