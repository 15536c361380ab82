"""`gavo view`: a finished run in the viewer."""

from contextlib import nullcontext
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.camera_check import require_camera
from gavo_jax.cli.options import Source, View
from gavo_jax.cli.readiness import be_ready
from gavo_jax.cli.selection import open_sequence
from gavo_jax.datasets.base import Frame, FrameError, Sequence
from gavo_jax.errors import GavoError, print_message
from gavo_jax.interrupts import interruptible
from gavo_jax.locks import hold
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.stream import track
from gavo_jax.output.files import CONFIG, VIEW
from gavo_jax.output.frames import RecordedRun, read_run
from gavo_jax.output.recorded_bodies import RecordedBodies
from gavo_jax.output.screen import pair_progress, say
from gavo_jax.settings_file import load_settings
from gavo_jax.viewer.base import Viewer
from gavo_jax.viewer.live import make_viewer


def view(options: View) -> int:
    """Show a folder's run, without images if the sequence is gone."""
    run = read_run(options.folder)
    bodies = RecordedBodies(options.folder)
    viewer = make_viewer(options.viewer, options.folder / VIEW)
    sequence = _find_sequence(run, options.folder)
    if sequence is None:
        camera, stamps, truth = _recorded_camera(run, options.folder), run.trajectory.timestamps, None
    else:
        camera, stamps, truth = sequence.camera, sequence.timestamps, sequence.ground_truth
    search = _find_search(run, options.folder, sequence) if options.search and sequence is not None else None
    with hold(options.folder) if options.viewer == "save" else nullcontext(), viewer:
        viewer.open(options.folder.resolve().name, camera, stamps, truth)
        if sequence is not None and search is not None:
            _show_with_search(run, bodies, sequence, search, viewer)
        else:
            viewer.watch(_read(sequence, 0), None)
            for step in run.steps:
                viewer.watch(_read(sequence, step.index), bodies.restore(step))
    if options.viewer == "save":
        say(f"wrote {options.folder / VIEW}")
    viewer.stay()
    return 0


def _find_search(run: RecordedRun, folder: Path, sequence: Sequence) -> Odometry | None:
    """Return a new driver with the run's settings; None, with a printed reason, if they cannot be read."""
    try:
        settings = load_settings(folder / CONFIG).settings
        settings = replace(settings, odometry=replace(settings.odometry, loops=False))  # the run closed them
        seed = int(run.config["options"]["seed"])
        return Odometry(sequence.camera, settings, seed=seed, record=True)
    except (GavoError, KeyError, TypeError, ValueError) as error:
        print_message(f"shown without the search: {error}")
        return None


def _show_with_search(
    run: RecordedRun, bodies: RecordedBodies, sequence: Sequence, odometry: Odometry, viewer: Viewer
) -> None:
    """Track the frames again for the particles; the poses shown are those of the run."""
    be_ready()
    recorded = {step.index: step for step in run.steps}
    apart = 0.0

    def watch(frame: Frame | None, step: Step | None) -> None:
        shown = None if step is None else bodies.restore(recorded[step.index])
        viewer.watch(frame, shown, odometry.candidates)

    with pair_progress("the search", len(recorded)) as bar:
        interruptible(odometry.warm_up)
        for step in track(sequence[: len(recorded) + 1], odometry=odometry, watch=watch):
            if _is_of_the_search(recorded[step.index]):
                before, now = (s.alignment.target_T_reference for s in (recorded[step.index], step))
                apart = max(apart, float(np.linalg.norm(np.asarray(now - before)[:3, 3])))
            bar.advance()
    if apart > SAME:
        off = f"{1e3 * apart:.1f} mm"
        print_message(f"the repeated search differs from that of the run by up to {off}")


def _is_of_the_search(step: Step) -> bool:
    """Whether a step's motion in the run's files was found by the search.

    For a lost pair they hold what was recorded instead; a relocalised pair starts at a keyframe of the map.
    """
    return not step.lost and step.origin != "relocalised"


SAME = 1e-3
"""Largest distance, metres, by which rounding on another machine moves the result of a search."""


def _find_sequence(run: RecordedRun, folder: Path) -> Sequence | None:
    """Return the run's sequence; None, with a printed reason, if it is not available."""
    settings = run.config.get("options")
    try:
        if not isinstance(settings, dict):
            raise GavoError(f"{folder / CONFIG}: does not name the sequence")
        try:
            source = Source(**{field.name: settings[field.name] for field in fields(Source) if field.name in settings})
            sequence = open_sequence(source, color=True)
        except (KeyError, TypeError) as error:
            raise GavoError(f"{folder / CONFIG}: does not name the sequence: {error}") from None
        if not all(_is_of(step, sequence) for step in run.steps):
            raise GavoError(f"{source.sequence}: contains other frames than those of the run")
        return sequence
    except GavoError as error:
        print_message(f"shown without images and truth: {error}")
        return None


def _is_of(step: Step, sequence: Sequence) -> bool:
    return step.index < len(sequence) and abs(sequence.timestamps[step.index] - step.timestamp) < ROUNDED


ROUNDED = 1e-6
"""Tolerance, seconds: timestamps in a run's files are rounded to microseconds."""


def _recorded_camera(run: RecordedRun, folder: Path) -> Camera:
    entry: Any = run.config.get("sequence")
    try:
        values = {name: value for name, value in entry["camera"].items() if name != "type"}
        lists: Any = {name: tuple(value) for name, value in values.items() if isinstance(value, list)}
        camera = Camera(**{**values, **lists})
        require_camera(camera)
    except (AttributeError, KeyError, TypeError):
        raise GavoError(f"{folder / CONFIG}: does not name the camera") from None
    except GavoError as error:
        raise GavoError(f"{folder / CONFIG}: {error}") from None
    return camera


def _read(sequence: Sequence | None, index: int) -> Frame | None:
    try:
        return None if sequence is None else sequence[index]
    except FrameError:
        return None
