"""`gavo run`: estimates a sequence's trajectory, with errors and figures."""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from gavo_jax.calibration.darkness import darkness_of
from gavo_jax.camera import Camera
from gavo_jax.cli.map_file import check_map_options, save_map
from gavo_jax.cli.options import Run
from gavo_jax.cli.readiness import be_ready
from gavo_jax.cli.run_table import print_run
from gavo_jax.cli.selection import (
    choose_settings,
    open_sequence,
    settings_line,
    unchanged_preset,
    with_shortcuts,
    with_whole_paths,
)
from gavo_jax.datasets.assembly import recorded_as
from gavo_jax.datasets.base import Sequence
from gavo_jax.datasets.depth_doubts import doubt_of_limit
from gavo_jax.datasets.depth_unit import doubt_of_guess, first_depths, unit_of_file
from gavo_jax.datasets.live.devices import is_live
from gavo_jax.datasets.selection import SYNTHETIC
from gavo_jax.early import INTERRUPTED, LOST
from gavo_jax.errors import GavoError, print_message
from gavo_jax.inspection import left_out, left_out_in_short, summary
from gavo_jax.interrupts import interruptible
from gavo_jax.mapping.background import BackgroundMapper, mapper_of
from gavo_jax.odometry.composition import blank_of
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.hindsight import revised
from gavo_jax.odometry.metrics import run_identity
from gavo_jax.odometry.progress import Progress
from gavo_jax.odometry.run import finish_run
from gavo_jax.output.drawing import draw, draw_search
from gavo_jax.output.files import FIGURE_FORMATS, ODOMETRY, RECORDING, TRAJECTORY, circumstances
from gavo_jax.output.loops import write_loops
from gavo_jax.output.run_folder import RunFolder
from gavo_jax.output.screen import say, waiting
from gavo_jax.output.tracked import track_visibly
from gavo_jax.output.trajectories import formats, remove_trajectories, write_trajectories
from gavo_jax.settings import Settings
from gavo_jax.settings_check import as_seed
from gavo_jax.trajectory import Trajectory
from gavo_jax.trajectory_doubts import is_inverse, is_w_first, other_axes, relative_size, unit_of_length
from gavo_jax.viewer.base import Viewer
from gavo_jax.viewer.live import make_viewer

MANY_FLAGGED = 0.2
"""Share of pairs that are `moving_body` above which the rolling shutter may be the reason."""
CHECKPOINT_SECONDS = 2.0
"""Seconds between two checkpoints; writing one takes about 20 ms."""


def run(options: Run) -> int:
    """Track the sequence, writing its files along the way, and print a table; return the exit status."""
    if is_live(options.sequence):
        from gavo_jax.cli.live import run_live

        return run_live(options)
    as_seed(options.seed, "--seed")
    trajectory_formats = formats(options.trajectory_format)
    shape = check_map_options(options.map, options.map_shape, options.voxel)
    method, preset, settings = choose_settings(options)
    options, settings = replace(options, method=method, preset=preset), with_shortcuts(settings, options)
    sequence = open_sequence(options, color=options.map is not None or options.viewer != "none")
    name = f"{sequence.name}-{options.method}-{options.preset}"
    path = options.output or Path("runs") / name
    viewer = make_viewer(options.viewer, path / RECORDING)
    be_ready()
    mapper = mapper_of(sequence.camera, settings.odometry)
    poses = ODOMETRY if mapper else TRAJECTORY
    with RunFolder(path, getattr(sequence, "files", ()), poses) as folder, viewer:
        odometry = Odometry(
            sequence.camera,
            settings,
            seed=options.seed,
            record=viewer.wants_populations,
            relocaliser=mapper,
        )
        config = _configuration(options, sequence, settings)
        progress = folder.resume(config, blank_of(odometry.aligner)) if options.resume else None
        metrics, interrupted = folder.finished() if options.resume else None, False
        if metrics is not None:
            shown = "" if options.viewer == "none" else f"; gavo view {folder.path} shows it"
            print_message(f"{folder.path}: the run {_end(metrics, folder, settings)}: nothing to resume{shown}")
            _draw_if_missing(options, sequence, folder)
        else:
            # before an earlier run is replaced, as opening may fail
            viewer.open(name, sequence.camera, sequence.timestamps, sequence.ground_truth)
            if progress is None:
                _start(options, sequence, folder, config)
            else:
                _go_on(progress, sequence, odometry, folder, viewer, mapper)
            say(summary(sequence))
            for line in _remarks(options, sequence):
                say(line)
            metrics, interrupted = _track(name, options, sequence, odometry, folder, viewer, mapper)
        if not (metrics.get("complete", True) or interrupted):
            say(f"{folder.path}: the run ended at its first lost pair: {metrics['frames']} of {len(sequence)} frames")
        trajectory = Trajectory.read_tum(folder.path / TRAJECTORY)
        truth, is_rendered = sequence.ground_truth, options.sequence == SYNTHETIC
        print_run(name, metrics, folder.path, trajectory, truth=truth, is_rendered=is_rendered)
        write_trajectories(trajectory, folder.path, trajectory_formats)
        if options.map is not None:
            save_map(options.map, sequence, folder, trajectory, shape, options.voxel)
    doubts = [] if truth is None else list(_doubts(trajectory, truth, unit_of_file(sequence)))
    for line in (*doubts, *(() if is_rendered else _doubts_about_shutter(sequence.camera, metrics))):
        say(line)
    if not (interrupted or is_rendered) and (dark := darkness_of(sequence, trajectory)) is not None and dark.is_harmful:
        darker = f"The images' corners are {100 * dark.share:.0f} % darker than their middle"
        say(f"{darker}, which may have drawn the motion with them. gavo calibrate finds the camera's vignetting.")
    if interrupted:
        return INTERRUPTED
    viewer.stay()
    return LOST if options.strict and metrics["lost_pairs"] else 0


def _end(metrics: dict[str, Any], folder: RunFolder, settings: Settings) -> str:
    """Say how an earlier run without a checkpoint ended.

    Raises:
        GavoError: It was interrupted, and its checkpoint is gone.
    """
    if metrics.get("complete", True):
        return "is already complete"
    if metrics.get("lost_pairs") and settings.odometry.on_lost == "stop":
        return "ended at its first lost pair"
    raise GavoError(f"{folder.path}: the run was interrupted, and its checkpoint is gone: run again without --resume")


def _remarks(options: Run, sequence: Sequence) -> Iterator[str]:
    """Yield a line for what of the source is not used, each doubt about its depth, and the settings."""
    if line := left_out_in_short(sequence):
        yield f"{line}; metrics.json says why (left_out)"
    depths = [] if options.sequence == SYNTHETIC else first_depths(sequence)  # rendering them would take time
    for line in filter(None, (doubt_of_guess(sequence, depths), doubt_of_limit(sequence, depths))):
        yield f"depth in doubt: {line}"
    if line := settings_line(options):
        yield line


def _doubts(trajectory: Trajectory, truth: Trajectory, units: float) -> Iterator[str]:
    """Yield a line for each reason for which the run and the ground truth disagree as a whole.

    Args:
        trajectory: The estimate.
        truth: The ground truth.
        units: Depth units per metre in the source's files.
    """
    if is_w_first(truth, trajectory):
        yield "The ground truth agrees only if its quaternions are read as w x y z; write them as x y z w."
    elif is_inverse(truth, trajectory):
        yield "The ground truth agrees only if its poses are inverted; write them from camera to world."
        return
    if axes := other_axes(truth, trajectory):
        yield f"The ground truth agrees only if {axes}; write it for a camera with x right, y down and z forward."
    if size := relative_size(trajectory, truth):
        unit = f"{size * units:.4g} units per metre (--depth-scale), not {units:g}"
        cause = f"It would agree if depth had {unit}."
        if name := unit_of_length(1 / size):
            cause = f"The ground truth seems to be in {name}; write it in metres."
        yield f"The trajectory has {size:.3g} times the size of the ground truth. {cause}"


def _doubts_about_shutter(camera: Camera, metrics: dict[str, Any]) -> Iterator[str]:
    """Yield a line if a rolling shutter that the camera does not state may be taken for moving bodies."""
    flagged = metrics.get("statuses", {}).get("moving_body", 0)
    if not camera.readout and flagged > MANY_FLAGGED * metrics.get("pairs", 0):
        yield (
            "The camera file states no readout, and an unknown rolling shutter makes a scene look as if it moved. gavo "
            "calibrate finds the readout."
        )


def _start(options: Run, sequence: Sequence, folder: RunFolder, config: dict[str, Any]) -> None:
    """Start the files of a run, replacing an earlier run's."""
    if options.resume:
        say(f"nothing to resume in {folder.path}: starting a new run")
    had_run = folder.has_run()
    folder.start(config, float(sequence.timestamps[0]))
    if had_run:
        say(f"the earlier run in {folder.path} is replaced")
    remove_trajectories(folder.path)


def _go_on(
    progress: Progress,
    sequence: Sequence,
    odometry: Odometry,
    folder: RunFolder,
    viewer: Viewer,
    mapper: BackgroundMapper | None,
) -> None:
    """Restore driver, viewer and map to where an earlier run stopped; remove the trajectories exported at its end."""
    remove_trajectories(folder.path)
    odometry.progress = progress
    steps = folder.steps()
    for step in (None, *steps):
        viewer.watch(None, step)
    if mapper is not None:
        mapper.replay(sequence, steps, folder.moving, progress.overlays.is_any)


def _configuration(options: Run, sequence: Sequence, settings: Settings) -> dict[str, Any]:
    """Return the contents of config.json."""
    return {
        "options": with_whole_paths(options),
        "sequence": {
            "name": sequence.name,
            "frames": len(sequence),
            "first_timestamp": float(sequence.timestamps[0]),
            "last_timestamp": float(sequence.timestamps[-1]),
            "camera": sequence.camera,
            "recorded": recorded_as(sequence),
            **({"bodies": options.moving} if options.moving else {}),
        },
        **circumstances(settings),
    }


def _track(
    name: str,
    options: Run,
    sequence: Sequence,
    odometry: Odometry,
    folder: RunFolder,
    viewer: Viewer,
    mapper: BackgroundMapper | None,
) -> tuple[dict[str, Any], bool]:
    """Track the remaining frames and write the files; return the metrics and whether Ctrl-C interrupted.

    Errors are computed from the files, so that a resumed run gets the same ones as an uninterrupted run.
    """
    saved: float | None = None

    def on_step(step: Step) -> None:
        nonlocal saved
        folder.add(step, odometry.progress)
        if saved is None:
            saved = time.monotonic()
        elif time.monotonic() - saved > CHECKPOINT_SECONDS:
            folder.save_checkpoint()
            saved = time.monotonic()

    tracked = track_visibly(name, sequence, odometry, on_step, viewer, mapper)
    if tracked.interrupted:
        folder.save_checkpoint()
        say("Run the same command with --resume to continue from there.")
    outcome = interruptible(
        lambda: finish_run(
            float(sequence.timestamps[0]),
            folder.steps(),
            sequence.ground_truth,
            mapper,
            tracked.seconds,
            tracked.compile_seconds,
            len(tracked.steps),
        )
    )
    if outcome.loops is not None:
        outcome.trajectory.write_tum(folder.path / TRAJECTORY)
        write_loops(folder.path, outcome.loops)
        viewer.show_corrected(outcome.trajectory, outcome.loops)
    metrics = {
        **run_identity(sequence.name, options.method, unchanged_preset(odometry.settings, options), options.seed),
        "complete": len(outcome.steps) == len(sequence) - 1 and not tracked.interrupted,
        "left_out": left_out(sequence),
        **outcome.figures,
    }
    folder.finish(metrics, complete=not tracked.interrupted)

    def draw_figures() -> None:
        _draw(options.base[0], folder, outcome.trajectory, outcome.odometry, sequence.ground_truth)
        draw_search(folder.path, sequence, odometry, revised(tracked.steps))

    try:
        with waiting("drawing figures …"):
            interruptible(draw_figures)
    except KeyboardInterrupt:
        say("Run the same command with --resume to draw the figures of the trajectory.")
        raise
    return metrics, tracked.interrupted


def _draw(
    method: str, folder: RunFolder, trajectory: Trajectory, odometry: Trajectory | None, truth: Trajectory | None
) -> None:
    """Draw a run's trajectory, beside the odometry's if loops corrected it."""
    curves = {method: trajectory}
    if odometry is not None:
        curves = {f"{method} with loops": trajectory, "odometry": odometry}
    draw(folder.path, curves, truth, list(curves)[:1])


def _draw_if_missing(options: Run, sequence: Sequence, folder: RunFolder) -> None:
    """Draw the trajectory of a complete run that was interrupted before it had all figures of it."""
    drawn = ("trajectory",) if sequence.ground_truth is None else ("trajectory", "distance_error")
    if all((folder.path / f"{name}.{suffix}").exists() for name in drawn for suffix in FIGURE_FORMATS):
        return
    trajectory, odometry = (
        Trajectory.read_tum(path) if (path := folder.path / name).exists() else None for name in (TRAJECTORY, ODOMETRY)
    )
    if trajectory is not None:
        with waiting("drawing figures …"):
            interruptible(lambda: _draw(options.base[0], folder, trajectory, odometry, sequence.ground_truth))
