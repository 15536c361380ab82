"""`gavo run` on a live camera, until Ctrl-C, the end of the stream or `--frames`."""

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.camera_files.calibration import load_calibration
from gavo_jax.cli.map_file import check_map_options, write_map
from gavo_jax.cli.options import Run
from gavo_jax.cli.readiness import be_ready
from gavo_jax.cli.run_table import print_run
from gavo_jax.cli.selection import check_positive, choose_settings, unchanged_preset, with_shortcuts
from gavo_jax.compilation.waits import Stopwatch
from gavo_jax.datasets.base import Frame, FrameError
from gavo_jax.datasets.live.devices import open_device
from gavo_jax.datasets.live.frames import LiveDevice, LiveImages, Newest, frame_of
from gavo_jax.early import INTERRUPTED, LOST
from gavo_jax.errors import GavoError, print_message
from gavo_jax.interrupts import interruptible
from gavo_jax.map_fusion import LiveMap, MapBuilder
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.metrics import run_identity
from gavo_jax.odometry.run import finish_run
from gavo_jax.output.files import RECORDING, TRAJECTORY, circumstances
from gavo_jax.output.run_folder import RunFolder
from gavo_jax.output.screen import say, waiting
from gavo_jax.output.trajectories import formats, remove_trajectories, write_trajectories
from gavo_jax.scene_map import Shape
from gavo_jax.settings import Settings
from gavo_jax.settings_check import as_seed
from gavo_jax.trajectory import Trajectory
from gavo_jax.viewer.base import Viewer
from gavo_jax.viewer.live import make_viewer

NOT_LIVE = "not available for the live source '{}': record it, and run over the recording"


def run_live(options: Run) -> int:
    """Track a camera, always taking the newest frame, and write the files of a run; return the exit status."""
    as_seed(options.seed, "--seed")
    _refuse_what_cannot_be(options)
    shape = check_map_options(options.map, options.map_shape, options.voxel)
    method, preset, settings = choose_settings(options)
    options, settings = replace(options, method=method, preset=preset), with_shortcuts(settings, options)
    if settings.odometry.loops:
        raise GavoError(f"--loops: {NOT_LIVE.format(options.sequence)}")
    with contextlib.closing(open_device(options.sequence)) as device:
        return _follow(options, device, settings, shape)


def _follow(options: Run, device: LiveDevice, settings: Settings, shape: Shape) -> int:
    """Track the device's frames and write the files of the run; return the exit status."""
    camera = _camera(options, device)
    name = f"{device.name}-{options.method}-{options.preset}"
    path = options.output or Path("runs") / name
    be_ready()
    with Newest(device) as newest, RunFolder(path) as folder, make_viewer(options.viewer, path / RECORDING) as viewer:
        odometry = Odometry(camera.rectified(), settings, seed=options.seed, record=viewer.wants_populations)
        with waiting(f"{device.name}: compiling …"):
            compile_seconds = interruptible(lambda: odometry.warm_up(wholly=True))
        say(f"{device.name}: live, {camera.width}x{camera.height}; Ctrl-C ends the run")
        scene = None if options.map is None else LiveMap(MapBuilder(odometry.camera, options.voxel))
        end = _track(options, newest, camera, odometry, folder, viewer, settings, scene)
        if odometry.progress.last_index < 1:
            tracked = odometry.progress.last_index + 1
            seen = f"{tracked} of {newest.received} frames" if newest.received > tracked else f"{tracked} frames"
            raise end.fault or GavoError(f"{device.name}: ended after {seen}: needs at least two")
        steps = folder.steps()  # this drops a step that an interruption left incomplete
        trajectory = Trajectory.read_tum(folder.path / TRAJECTORY)
        first = float(trajectory.timestamps[0])
        metrics: dict[str, Any] = {
            **run_identity(device.name, options.method, unchanged_preset(settings, options), options.seed),
            "complete": end.fault is None,
            **finish_run(first, steps, None, None, end.seconds, compile_seconds + end.waited).figures,
            "frames_received": newest.received,
            "frames_dropped": newest.dropped,
        }
        folder.finish(metrics)
        if steps[-1].lost and settings.odometry.on_lost == "stop":
            say(f"{folder.path}: the run ended at its first lost pair")
        print_run(name, metrics, folder.path, trajectory, truth=None)
        write_trajectories(trajectory, folder.path, formats(options.trajectory_format))
        if options.map is not None and scene is not None:
            write_map(scene.finish(shape), options.map)
    dropped = f"{newest.dropped} of {newest.received} frames were dropped for newer ones"
    say(f"{dropped}: they came while another was tracked, or programs were compiled")
    if end.fault is not None:
        raise end.fault
    if end.interrupted:
        return INTERRUPTED
    viewer.stay()
    return LOST if options.strict and metrics["lost_pairs"] else 0


class _End(NamedTuple):
    """How tracking ended."""

    seconds: float
    """Seconds of tracking since the first frame, excluding time spent waiting for compilation."""
    waited: float
    """Seconds spent waiting for compilation."""
    interrupted: bool
    """Whether Ctrl-C ended it."""
    fault: GavoError | None
    """What went wrong with the device, if anything."""


def _track(
    options: Run,
    newest: Newest,
    camera: Camera,
    odometry: Odometry,
    folder: RunFolder,
    viewer: Viewer,
    settings: Settings,
    scene: LiveMap | None,
) -> _End:
    """Track until the stream ends, Ctrl-C, a fault, the `--frames` limit, or a lost pair with `on_lost` stop."""
    count, stopwatch = 0, Stopwatch()
    interrupted, fault = False, None
    sequence = {"name": newest.device.name, "frames": None, "camera": camera}
    try:
        for timestamp, frame in _frames(newest, camera, color=scene is not None or viewer.wants_populations):
            if count == 0:
                viewer.open(newest.device.name, odometry.camera, np.array([timestamp]), None)
                folder.start({"options": options, "sequence": sequence, **circumstances(settings)}, timestamp)
                remove_trajectories(folder.path)
                stopwatch = Stopwatch()
            step = odometry.register(frame, timestamp)
            viewer.watch(odometry.frame, step, odometry.candidates)
            if scene is not None and odometry.frame is not None:
                scene.watch(odometry.frame, step)
            if step is not None:
                folder.add(step, odometry.progress)
            count += 1
            is_stopped = step is not None and step.lost and settings.odometry.on_lost == "stop"
            if is_stopped or count == options.frames:
                break
    except KeyboardInterrupt:
        if count < 2:
            raise
        print_message(f"{newest.device.name}: interrupted after {count} frames")
        interrupted = True
    except GavoError as error:  # keep what was tracked so far
        if count < 2:
            raise
        fault = error
    return _End(stopwatch.seconds, stopwatch.waited, interrupted, fault)


def _frames(newest: Newest, camera: Camera, *, color: bool) -> Iterator[tuple[float, Frame | FrameError]]:
    """Yield timestamps and frames as they arrive; images that don't fit the first ones yield a `FrameError`."""
    images: LiveImages
    for index, images in enumerate(newest):
        try:
            frame = frame_of(images, camera, color=color)
        except GavoError as error:
            if index == 0:
                raise
            frame = FrameError(str(error))
        yield images.timestamp, frame


def _camera(options: Run, device: LiveDevice) -> Camera:
    """Return the device's camera or the one given by `--camera`, whose depth unit defaults to the device's."""
    camera = device.camera
    if options.camera != "auto":
        calibration = load_calibration(options.camera, (camera.width, camera.height), camera.depth_scale)
        if calibration.depth is not None:
            raise GavoError(f"{options.camera}: [depth]: {NOT_LIVE.format(options.sequence)}")
        camera = calibration.color
    check_positive("--depth-scale", options.depth_scale, 1e6)
    return camera if options.depth_scale is None else replace(camera, depth_scale=options.depth_scale)


def _refuse_what_cannot_be(options: Run) -> None:
    """Raise GavoError for options that don't apply to a live camera, and for unknown trajectory formats."""
    formats(options.trajectory_format)
    for option, is_given in (
        ("--resume", options.resume),
        ("--start", options.start != 0),
        ("--stride", options.stride != 1),
        ("--moving", options.moving != 0),
        ("--rate", options.rate is not None),
        ("--colour-topic", options.colour_topic is not None),
        ("--depth-topic", options.depth_topic is not None),
    ):
        if is_given:
            raise GavoError(f"{option}: {NOT_LIVE.format(options.sequence)}")
    if options.frames is not None and options.frames < 2:
        raise GavoError(f"--frames: must be at least 2, not {options.frames}")
