"""`gavo run`: a sequence to a trajectory, its errors and figures."""

import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

from gavo_jax import plots
from gavo_jax.cli.compilation_cache import enable_compilation_cache
from gavo_jax.cli.options import Run
from gavo_jax.cli.screen import number, pair_progress, print_table
from gavo_jax.cli.selection import check_seed, open_sequence
from gavo_jax.datasets.base import Sequence
from gavo_jax.errors import GavoError
from gavo_jax.evaluation import distance_error
from gavo_jax.odometry import Odometry, Step, compute_metrics, track, trajectory_of
from gavo_jax.presets import Preset, get_preset
from gavo_jax.results import DISTANCE_FIGURE, TRAJECTORY_FIGURE, RunFolder, environment
from gavo_jax.trajectory import Trajectory

INTERRUPTED, LOST = 130, 3
"""Exit statuses: ended with Ctrl-C; a pair was lost and `--strict` asked to know."""

FIGURES_OF_MERIT = (
    ("drift: RPE over 1 s, translation, RMSE", "rpe_translation_rmse_m_per_s", 4, "m/s"),
    ("drift: RPE over 1 s, rotation, RMSE", "rpe_rotation_rmse_deg_per_s", 3, "deg/s"),
    ("RPE over 1 frame, translation, RMSE", "rpe_translation_rmse_m_per_frame", 5, "m"),
    ("absolute error after alignment, RMSE", "ate_translation_rmse_m", 4, "m"),
    ("distance error at the end", "distance_error_final_m", 4, "m"),
    ("frames", "frames", 0, ""),
    ("lost pairs", "lost_pairs", 0, ""),
    ("compilation", "compile_seconds", 1, "s"),
    ("time a pair, median", "milliseconds_per_pair_median", 1, "ms"),
    ("speed, decoding included", "frames_per_second", 1, "frames/s"),
)
"""Rows of the table: what, key in metrics.json, decimals, unit."""


def run(options: Run) -> int:
    """Track the sequence, write its files as it goes, print a table; return the exit status."""
    check_seed(options.seed)
    preset = _effective_preset(options)
    sequence = open_sequence(options)
    name = f"{sequence.name}-{options.method}-{options.preset}"
    enable_compilation_cache()
    steps: list[Step] = []
    with RunFolder(options.output or Path("runs") / name) as folder:
        folder.start(_config(options, preset, sequence), float(sequence.timestamps[0]))
        odometry = Odometry(sequence.camera, preset.solver, preset.alignment, preset.odometry, options.seed)
        with pair_progress(name, len(sequence) - 1) as bar:
            compile_seconds = odometry.warm_up()
            start = time.perf_counter()
            try:
                for step in track(sequence, odometry=odometry):
                    folder.add(step)
                    steps.append(step)
                    bar.advance()
            except KeyboardInterrupt:
                print(f"gavo: interrupted after {len(steps)} of {len(sequence) - 1} pairs", file=sys.stderr)
                status = INTERRUPTED
            else:
                status = LOST if options.strict and any(step.lost for step in steps) else 0
            seconds = time.perf_counter() - start
        if not steps:
            return status
        trajectory = trajectory_of(float(sequence.timestamps[0]), steps)
        metrics = {
            "sequence": sequence.name,
            "method": options.method,
            "preset": options.preset,
            "seed": options.seed,
            **compute_metrics(trajectory, sequence.ground_truth, steps, seconds, compile_seconds),
        }
        draw(folder.folder, {options.method: trajectory}, sequence.ground_truth)
        folder.finish(metrics)
    _report(name, metrics, folder.folder)
    return status


def draw(folder: Path, estimates: Mapping[str, Trajectory], truth: Trajectory | None) -> None:
    """Write the figures of named trajectories, where matplotlib is installed; errors where there is a truth.

    Raises:
        GavoError: a figure cannot be written.
    """
    if not plots.available():
        return
    plots.save(plots.plot_trajectories(estimates, truth), folder, TRAJECTORY_FIGURE)
    if truth is None:
        return
    try:
        errors = {name: distance_error(estimate, truth) for name, estimate in estimates.items()}
    except GavoError:
        return
    plots.save(plots.plot_distance_error(errors), folder, DISTANCE_FIGURE)


def _effective_preset(options: Run) -> Preset:
    preset = get_preset(options.method, options.preset)
    odometry = preset.odometry
    if options.reference is not None:
        odometry = replace(odometry, reference=options.reference)
    if options.on_lost is not None:
        odometry = replace(odometry, on_lost=options.on_lost)
    return replace(preset, odometry=odometry)


def _config(options: Run, preset: Preset, sequence: Sequence) -> dict[str, Any]:
    """Return what config.json says: enough to repeat the run and to know what it did."""
    return {
        "options": options,
        "sequence": {
            "name": sequence.name,
            "frames": len(sequence),
            "first_timestamp": float(sequence.timestamps[0]),
            "last_timestamp": float(sequence.timestamps[-1]),
            "camera": sequence.camera,
        },
        "solver": preset.solver,
        "alignment": preset.alignment,
        "odometry": preset.odometry,
        "device": jax.devices()[0].device_kind,
        "versions": environment(),
    }


def _report(name: str, metrics: Mapping[str, Any], folder: Path) -> None:
    rows = [(what, number(metrics[key], digits), unit) for what, key, digits, unit in FIGURES_OF_MERIT]
    print_table(name, ("", "", "unit"), rows)
    print(f"files in {folder}")
