"""The live viewer: the particles at work and what comes of them, on Rerun (extra `[viewer]`).

`Viewer` shows nothing and costs nothing; `make_viewer` gives one that does. A frame's pictures are prepared and sent by
a thread of their own, so that a run hardly waits for them. Two time lines: `frame`, and `generation`, which counts on
from frame to frame, for the evolution of the populations inside a frame.
"""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
import threading
import time
import webbrowser
from collections import deque
from pathlib import Path
from queue import Empty, Queue
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self
from urllib.parse import quote

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8, UInt32

from gavo_jax.alignment import Population
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.errors import GavoError
from gavo_jax.odometry.driver import Step
from gavo_jax.trajectory import Trajectory, inverse

if TYPE_CHECKING:
    from rerun import RecordingStream
    from rerun.blueprint import Blueprint

ViewerMode = Literal["none", "spawn", "web", "save"]

IMAGE_WIDTH = 320
"""Pixels: images are shown at the pyramid level of at most this width."""
JPEG_QUALITY = 85
CLOUD_STRIDE = 4
"""Every so many shown pixels along either side make a point of the cloud."""
MAX_PARTICLES = 256
"""Particles shown of a generation; of a larger one every k-th by rank, the best included."""
RESIDUAL_RANGE = 40.0
"""Grey levels at which the residual image's colours saturate."""
MILLIMETRES = 1e3
"""Of the search space: its particles lie millimetres apart."""
WAITING_FRAMES = 8
"""Frames that wait to be shown before the run waits for them."""
SECONDS_TOGETHER = 0.25
"""What is shown within this time is sent together; a window lags behind the run by at most this."""
MEMORY = "512MiB"
"""What the server of the web viewer keeps for browsers that come later."""
HOST, GRPC_PORT, WEB_PORT = "127.0.0.1", 9876, 9090
"""Where the web viewer is found: on this machine only; at other ports where something else is at these."""
WINDOW_SECONDS = 1.0
"""After which a window that found no screen would have ended."""
PATIENCE = 60.0
"""Seconds for the server to start, and for the last frames to arrive."""
NOTHING_NEW: Any = ()
"""In place of a frame, where none came for a while."""
GUARD = """
import os, signal, subprocess, sys
subprocess.Popen([sys.executable, "-m", "rerun", "--serve-web", *sys.argv[1:]], stdin=subprocess.DEVNULL)
sys.stdin.read()
os.killpg(0, signal.SIGTERM)
"""
"""Serves until its standard input closes, which it does however the run ends; Ctrl-C does not reach it."""

IMAGES = {
    "reference": "Reference",
    "target": "Target",
    "warped": "Target, warped",
    "residual": "Residual (blue below, orange above)",
}
"""Entities below `images`, and the titles of their views."""

BLUE, WHITE, VERMILION, GREEN = (86, 180, 233), (245, 245, 245), (213, 94, 0), (0, 158, 115)
GREY, DARK = (120, 120, 120), (24, 26, 32)
"""Okabe and Ito's colours; blue is best, or below."""


class Viewer:
    """A viewer that shows nothing."""

    wants_populations: bool = False
    """Whether `watch` makes anything of the candidates."""

    def open(self, title: str, camera: Camera, stamps: Float[np.ndarray, " n"], truth: Trajectory | None) -> None:
        """Begin to show a run.

        Args:
            title: its name.
            camera: of the frames, without distortion.
            stamps: of all frames, seconds.
            truth: the true trajectory, where it is known.
        """

    def watch(self, frame: Frame | None, step: Step | None, populations: tuple[Population, ...] = ()) -> None:
        """Show one more frame.

        Args:
            frame: the frame, or None where it could not be read.
            step: what the odometry said of it; None for the first frame.
            populations: candidates of its search, coarsest level first.
        """

    def close(self) -> None:
        """Show what is still waiting, then end the recording."""

    def stay(self) -> None:
        """Keep what was shown in reach until the user has seen enough (Ctrl-C), where it would go with the process."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


NO_VIEWER = Viewer()


def make_viewer(mode: ViewerMode, recording: Path) -> Viewer:
    """Return a viewer, not open yet.

    Args:
        mode: `spawn` a window, serve to a browser on the `web`, `save` to a file, or `none` of these.
        recording: the file to save to.

    Raises:
        GavoError: Rerun is not installed, or there is no screen for a window.
    """
    if mode == "none":
        return NO_VIEWER
    if importlib.util.find_spec("rerun") is None:
        raise GavoError(f"--viewer {mode}: rerun is not installed: pip install 'gavo-jax[viewer]'")
    if mode == "spawn" and not _has_screen():
        raise GavoError("--viewer spawn: no screen here: use --viewer web or --viewer save")
    return RerunViewer(mode, recording)


class RerunViewer(Viewer):
    """Shows a run in Rerun, live or in a file."""

    wants_populations = True

    def __init__(self, mode: ViewerMode, recording: Path) -> None:
        self.mode, self.recording = mode, recording
        self.url = ""
        """Where a browser finds it, in mode `web`."""
        self._queue: Queue[Any] = Queue(WAITING_FRAMES)
        self._thread: threading.Thread | None = None
        self._fault: Exception | None = None
        self._process: subprocess.Popen[bytes] | None = None

    def open(self, title: str, camera: Camera, stamps: Float[np.ndarray, " n"], truth: Trajectory | None) -> None:
        """Open window, server or file, send the layout, and start the thread.

        Raises:
            GavoError: the file cannot be written, or Rerun cannot be started.
        """
        import rerun

        stream = rerun.RecordingStream("gavo-jax")
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        self._connect(stream)
        stream.send_recording_name(title)
        stream.send_blueprint(make_blueprint())
        self._stream = stream
        self._thread = threading.Thread(target=self._work, args=(Scene(stream, camera, stamps, truth),), daemon=True)
        self._thread.start()

    def watch(self, frame: Frame | None, step: Step | None, populations: tuple[Population, ...] = ()) -> None:
        """Queue a frame; waits while `WAITING_FRAMES` others are yet to be shown."""
        self._raise_fault()
        self._queue.put((frame, step, populations))

    def close(self) -> None:
        """Wait for what is queued.

        Raises:
            GavoError: a frame could not be shown.
        """
        if self._thread is None:
            return
        self._queue.put(None)
        self._thread.join()
        self._thread = None
        try:
            self._stream.flush(timeout_sec=PATIENCE)
        except Exception as fault:
            self._fault = self._fault or fault
        if self.mode == "save":
            self._stream.disconnect()
        self._raise_fault()

    def stay(self) -> None:
        """Serve the browser until Ctrl-C; a window of its own and a file need nothing."""
        if self.mode != "web":
            return
        print(f"viewer at {self.url} (Ctrl-C ends it)", flush=True)
        try:
            while True:
                time.sleep(1.0)
        except KeyboardInterrupt:
            return

    def _connect(self, stream: RecordingStream) -> None:
        try:
            if self.mode == "save":
                stream.save(self.recording)
            elif self.mode == "spawn":
                self._open_window(stream)
            else:
                self._serve(stream)
        except (OSError, RuntimeError) as error:
            where = f"{self.recording}: cannot be written" if self.mode == "save" else f"--viewer {self.mode}"
            raise GavoError(f"{where}: {error}") from None

    def _open_window(self, stream: RecordingStream) -> None:
        """Start Rerun's own program, which stays when the run ends; unlike Rerun's call, for this machine alone."""
        port, quiet = _free_port(GRPC_PORT), subprocess.DEVNULL
        command = [sys.executable, "-m", "rerun", "--hide-welcome-screen", "--bind", HOST, "--port", str(port)]
        self._process = subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True)
        try:
            _await_port(port, self._process)
            self._process.wait(timeout=WINDOW_SECONDS)
        except subprocess.TimeoutExpired:
            stream.connect_grpc(f"rerun+http://{HOST}:{port}/proxy")
            return
        except RuntimeError:
            pass
        raise RuntimeError("Rerun's window does not open on this screen: use --viewer web or --viewer save")

    def _serve(self, stream: RecordingStream) -> None:
        """Serve page and data by a process of Rerun's command: unlike its Python calls, it can keep to this machine."""
        port, page = _free_port(GRPC_PORT), _free_port(WEB_PORT)
        options = {"bind": HOST, "port": port, "web-viewer-port": page, "server-memory-limit": MEMORY}
        command = [sys.executable, "-c", GUARD]
        command += [word for name, value in options.items() for word in (f"--{name}", str(value))]
        quiet = subprocess.DEVNULL
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet, start_new_session=True
        )
        for served in (port, page):
            _await_port(served, self._process)
        address = f"rerun+http://{HOST}:{port}/proxy"
        stream.connect_grpc(address)
        self.url = f"http://{HOST}:{page}/?url={quote(address, safe='')}"
        print(f"viewer at {self.url}", file=sys.stderr, flush=True)
        if _has_screen():
            webbrowser.open(self.url)

    def _work(self, scene: Scene) -> None:
        """Add what is queued to the scene, and send it every `SECONDS_TOGETHER`, until None comes."""
        sent, item = time.monotonic(), NOTHING_NEW
        while item is not None:
            try:
                item = self._queue.get(timeout=SECONDS_TOGETHER)
            except Empty:
                item = NOTHING_NEW
            try:
                if item and self._fault is None:
                    scene.add(*item)
                if not item or time.monotonic() - sent > SECONDS_TOGETHER:
                    scene.send()
                    sent = time.monotonic()
            except Exception as fault:
                self._fault = fault

    def _raise_fault(self) -> None:
        if self._fault is not None:
            raise GavoError(f"--viewer {self.mode}: {self._fault}") from self._fault


def _has_screen() -> bool:
    return sys.platform != "linux" or bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ))


def _await_port(port: int, process: subprocess.Popen[bytes]) -> None:
    """Wait until a process that was started answers at a port.

    Raises:
        RuntimeError: it has ended, or does not answer for `PATIENCE` seconds.
    """
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline and process.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex((HOST, port)) == 0:
                return
        time.sleep(0.05)
    raise RuntimeError("Rerun does not start")


def _free_port(wanted: int) -> int:
    """Return the port, or one that is free where that one is taken."""
    for port in (wanted, 0):
        with socket.socket() as probe:
            try:
                probe.bind((HOST, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise GavoError("--viewer web: no free port")


def make_blueprint() -> Blueprint:
    """Return the layout: search space, trajectories, state and curves above, the four images below.

    On the time line `frame` the particles of all generations of a frame are shown at once, on `generation` one's.
    """
    import rerun.blueprint as layout

    everything = [
        layout.VisibleTimeRange(
            timeline, start=layout.TimeRangeBoundary.infinite(), end=layout.TimeRangeBoundary.cursor_relative()
        )
        for timeline in ("frame", "generation")
    ]
    now = [
        layout.VisibleTimeRange(
            timeline,
            start=layout.TimeRangeBoundary.cursor_relative(seq=0),
            end=layout.TimeRangeBoundary.cursor_relative(seq=0),
        )
        for timeline in ("frame", "generation")
    ]
    search = layout.Spatial3DView(
        origin="search",
        name="Search space (mm)",
        background=DARK,
        eye_controls=layout.EyeControls3D(position=(30, -30, -50), look_target=(0, 0, 0), eye_up=(0, -1, 0)),
        overrides={"search/particles": layout.VisibleTimeRanges(now)},
    )
    world = layout.Spatial3DView(
        origin="world",
        name="Trajectory (m): estimate blue, truth white",
        background=DARK,
        overrides={path: layout.VisibleTimeRanges(everything) for path in ("world/estimate", "world/truth")},
    )
    curves = layout.Vertical(
        layout.TextDocumentView(origin="state", name="State"),
        layout.TimeSeriesView(origin="curves/rmse", name="RMSE of the best particle (grey levels)"),
        layout.TimeSeriesView(origin="curves/distance_error", name="Distance error (m)"),
    )
    images = [layout.Spatial2DView(origin=f"images/{name}", name=title) for name, title in IMAGES.items()]
    return layout.Blueprint(
        layout.Vertical(
            layout.Horizontal(search, world, curves, column_shares=[3, 3, 2]),
            layout.Horizontal(*images),
            row_shares=[5, 2],
        ),
        layout.TimePanel(timeline="frame", state="collapsed"),
        collapse_panels=True,
    )


class Rows(NamedTuple):
    """Rows of one entity that belong to one frame."""

    generations: list[int]
    """Where each stands on that time line."""
    sizes: list[int]
    """Number of instances (points, boxes, …) of each."""
    values: dict[str, Any]
    """Components of all instances: arrays, or lists of text or bytes."""
    frame: int


class Scene:
    """Turns frames, steps and populations into what Rerun shows; remembers what a segment or a warp starts from.

    What is to be shown gathers until `send`: a call to Rerun costs much the same for one row as for hundreds.
    """

    def __init__(
        self, stream: RecordingStream, camera: Camera, stamps: Float[np.ndarray, " n"], truth: Trajectory | None
    ) -> None:
        import rerun as rr

        self._stream = stream
        self._camera = shown_camera(camera)
        self._shrink = camera.width // self._camera.width
        self._depth_scale = camera.depth_scale
        self._cloud = np.s_[CLOUD_STRIDE // 2 :: CLOUD_STRIDE, CLOUD_STRIDE // 2 :: CLOUD_STRIDE]
        self._rays = rays(self._camera)[self._cloud]
        self._truth = Truth(stamps, truth)
        self._frame, self._generation = 0, 0
        self._world_T_camera = np.eye(4)
        self._last_truth: Float64[np.ndarray, "4 4"] | None = None
        self._shown: deque[Shown] = deque(maxlen=8)
        """The last frames that could be read; an older one is never a reference."""
        # in the order of sending: particles, shown at their own frame alone, are there before the time moves on
        self._archetypes: dict[str, Any] = {
            "search/particles": rr.Points3D,
            "world/camera": rr.Transform3D,
            "world/camera/image": rr.EncodedImage,
            "world/camera/cloud": rr.Points3D,
            "world/estimate": rr.LineStrips3D,
            "world/truth": rr.LineStrips3D,
            "curves/rmse": rr.Scalars,
            "curves/distance_error": rr.Scalars,
            **{f"images/{name}": rr.EncodedImage for name in IMAGES},
            "search/bounds": rr.Boxes3D,
            "search/error": rr.Arrows3D,
            "search/truth": rr.LineStrips3D,
            "state": rr.TextDocument,
        }
        self._waiting: dict[str, list[Rows]] = {path: [] for path in self._archetypes}
        self._send_static()

    def add(self, frame: Frame | None, step: Step | None, populations: tuple[Population, ...]) -> None:
        """Add one frame to what is to be sent."""
        self._frame = 0 if step is None else step.index
        world_T_camera = np.eye(4) if step is None else step.world_T_camera
        truth = self._truth.at(self._frame, world_T_camera)
        shown = None if frame is None else self._shrunk(frame)
        if shown is not None:
            self._add_camera(world_T_camera, shown)
        if step is not None:
            self._add_trajectory(world_T_camera, truth)
            self._add_images(shown, step)
        generations = 0
        if step is not None and populations:
            search = [level for level in map(level_of, populations) if level is not None]
            generations = self._add_search(search, self._truth.motion(step))
        self._generation += max(generations, 1)
        self._world_T_camera, self._last_truth = world_T_camera, truth
        if shown is not None:
            self._shown.append(shown)

    def send(self) -> None:
        """Send what was added since the last time, each entity's in one call."""
        import rerun as rr

        for path, rows in self._waiting.items():
            if not rows:
                continue
            frames = np.repeat([part.frame for part in rows], [len(part.generations) for part in rows])
            times = [
                rr.TimeColumn("frame", sequence=frames),
                rr.TimeColumn("generation", sequence=sum((part.generations for part in rows), [])),
            ]
            values = {name: _joined([part.values[name] for part in rows]) for name in rows[0].values}
            columns = self._archetypes[path].columns(**values)
            self._stream.send_columns(path, times, columns.partition(sum((part.sizes for part in rows), [])))
            rows.clear()

    def _add(self, path: str, generations: list[int] | None = None, sizes: list[int] | None = None, **values: Any):
        """Add rows of an entity, one or one for each of some generations, each of one instance or of `sizes`."""
        generations = [self._generation] if generations is None else generations
        sizes = [1] * len(generations) if sizes is None else sizes
        self._waiting[path].append(Rows(generations, sizes, values, self._frame))

    def _send_static(self) -> None:
        """Send what stays as it is, among it the looks of what does not."""
        import rerun as rr

        camera, points = self._camera, rr.Radius.ui_points
        pinhole = rr.Pinhole(
            focal_length=[camera.fx, camera.fy],
            principal_point=[camera.cx + 0.5, camera.cy + 0.5],
            resolution=[camera.width, camera.height],
            image_plane_distance=0.4,
        )
        last = rr.Points3D([[0, 0, 0]], radii=points(5), colors=[WHITE], labels=["last camera"], show_labels=False)
        jpeg = rr.EncodedImage.from_fields(media_type="image/jpeg")
        looks = {
            "world": [rr.ViewCoordinates.RDF],
            "search": [rr.ViewCoordinates.RDF],
            "world/camera/image": [pinhole, jpeg],
            "world/camera/cloud": [rr.Points3D.from_fields(radii=points(1.5))],
            "world/estimate": [rr.LineStrips3D.from_fields(colors=[BLUE], radii=points(2))],
            "world/truth": [rr.LineStrips3D.from_fields(colors=[WHITE], radii=points(2))],
            "curves/rmse": [rr.SeriesLines(colors=[BLUE], widths=[2], names=["RMSE of the pair"])],
            "curves/distance_error": [rr.SeriesLines(colors=[VERMILION], widths=[2], names=["distance error"])],
            **{f"images/{name}": [jpeg] for name in IMAGES},
            "search/particles": [rr.Points3D.from_fields(radii=points(2.5))],
            "search/bounds": [rr.Boxes3D.from_fields(colors=[GREY])],
            "search/error": [rr.Arrows3D.from_fields(colors=[VERMILION], radii=points(1.5))],
            "search/truth": [rr.LineStrips3D.from_fields(colors=[GREEN], radii=points(2))],
            "search/last_camera": [last],
            "state": [rr.TextDocument.from_fields(media_type="text/markdown")],
        }
        for path, archetypes in looks.items():
            self._stream.log(path, *archetypes, static=True)

    def _shrunk(self, frame: Frame) -> Shown:
        size, k = (self._camera.width, self._camera.height), self._shrink
        grey = np.asarray(frame.grey)
        if k > 1:
            grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        raw = np.asarray(frame.depth)[k // 2 :: k, k // 2 :: k][: size[1], : size[0]]
        return Shown(frame.timestamp, grey, raw.astype(np.float32) * np.float32(1 / self._depth_scale), _jpeg(grey))

    def _add_camera(self, world_T_camera: Float64[np.ndarray, "4 4"], shown: Shown) -> None:
        self._add("world/camera", translation=world_T_camera[None, :3, 3], mat3x3=world_T_camera[None, :3, :3])
        self._add("world/camera/image", blob=[shown.jpeg])
        self._add("images/target", blob=[shown.jpeg])
        depth = shown.depth[self._cloud]
        seen = depth > 0
        points = self._rays[seen] * depth[seen][:, None]
        grey = shown.grey[self._cloud][seen]
        self._add("world/camera/cloud", sizes=[len(points)], positions=points, colors=GREYS[grey])

    def _add_trajectory(
        self, world_T_camera: Float64[np.ndarray, "4 4"], truth: Float64[np.ndarray, "4 4"] | None
    ) -> None:
        """Add this frame's piece of either path; the view gathers the pieces."""
        for path, start, end in (
            ("world/estimate", self._world_T_camera, world_T_camera),
            ("world/truth", self._last_truth, truth),
        ):
            if start is not None and end is not None:
                self._add(path, strips=np.stack([start[:3, 3], end[:3, 3]])[None])
        if truth is not None:
            error = float(np.linalg.norm(world_T_camera[:3, 3] - truth[:3, 3]))
            self._add("curves/distance_error", scalars=[error])

    def _add_images(self, shown: Shown | None, step: Step) -> None:
        if np.isfinite(step.alignment.error):
            self._add("curves/rmse", scalars=[float(np.sqrt(step.alignment.error))])
        reference = next((s for s in reversed(self._shown) if s.timestamp == step.reference_timestamp), None)
        if shown is None or reference is None:
            return
        warped, seen = warp_target(reference, shown, np.asarray(step.alignment.target_T_reference), self._camera)
        self._add("images/reference", blob=[reference.jpeg])
        self._add("images/warped", blob=[_jpeg(warped)])
        self._add("images/residual", blob=[_jpeg(color_residual(warped, reference.grey, seen))])

    def _add_search(self, search: list[Level], motion: Float64[np.ndarray, "4 4"] | None) -> int:
        """Add every generation of a frame; return how many there are."""
        if not search:
            return 0
        sizes = [level.positions.shape[1] for level in search for _ in level.texts]
        count = len(sizes)
        generations = list(range(self._generation, self._generation + count))
        positions = np.concatenate([level.positions.reshape(-1, 3) for level in search])
        colors = np.concatenate([level.colors.ravel() for level in search])
        self._add("search/particles", generations, sizes, positions=positions, colors=colors)
        self._add("state", generations, text=[text for level in search for text in level.texts])
        starts = np.cumsum([0, *(len(level.texts) for level in search[:-1])]) + self._generation
        self._add(
            "search/bounds",
            starts.tolist(),
            centers=np.stack([level.centre for level in search]),
            half_sizes=np.stack([level.half_sizes for level in search]),
        )
        if motion is None:
            return count
        true = motion[:3, 3] * MILLIMETRES
        best = np.concatenate([level.positions[:, 0] for level in search])
        arrows = true - best
        labels = [f"error {error:.1f} mm" for error in np.linalg.norm(arrows, axis=1)]
        self._add("search/error", generations, origins=best, vectors=arrows, labels=labels)
        strips = star_strips(true, max(0.05 * float(np.linalg.norm(true)), 0.5))
        self._add("search/truth", sizes=[len(strips)], strips=strips)
        return count


def _joined(parts: list[Any]) -> Any:
    return np.concatenate(parts) if isinstance(parts[0], np.ndarray) else sum(parts, [])


def _jpeg(image: UInt8[np.ndarray, "h w *channels"]) -> bytes:
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


class Shown(NamedTuple):
    """A frame as it is shown."""

    timestamp: float
    grey: UInt8[np.ndarray, "h w"]
    depth: Float[np.ndarray, "h w"]
    """Metres; 0 = no reading."""
    jpeg: bytes
    """The grey image, encoded."""


class Truth:
    """Where the camera was, in the estimate's world: the first pose that is known is laid on the estimate's."""

    def __init__(self, stamps: Float[np.ndarray, " n"], truth: Trajectory | None) -> None:
        self._stamps = stamps
        self._truth_T_camera = np.zeros((len(self._stamps), 4, 4))
        self._known = np.zeros(len(self._stamps), bool)
        if truth is not None:
            self._truth_T_camera, self._known = truth.interpolate(stamps)
        self._world_T_truth: Float64[np.ndarray, "4 4"] | None = None

    def at(self, index: int, world_T_camera: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"] | None:
        """Return the true world_T_camera of a frame, None where it is not known."""
        if not self._known[index]:
            return None
        if self._world_T_truth is None:
            self._world_T_truth = world_T_camera @ inverse(self._truth_T_camera[index])
        return self._world_T_truth @ self._truth_T_camera[index]

    def motion(self, step: Step) -> Float64[np.ndarray, "4 4"] | None:
        """Return the true reference_T_target of a step, None where it is not known."""
        reference = min(int(np.searchsorted(self._stamps, step.reference_timestamp)), len(self._stamps) - 1)
        if not (self._known[reference] and self._known[step.index]):
            return None
        return inverse(self._truth_T_camera[reference]) @ self._truth_T_camera[step.index]


KEY = (
    "Particles: blue is best. White: the last camera. Green star: the true next one. Arrow: error of the best "
    "particle. Step through a search on the time line `generation`."
)


class Level(NamedTuple):
    """The search of a level as it is shown, g generations of p particles."""

    positions: Float[np.ndarray, "g p 3"]
    """Where each particle puts the camera, seen from the last one, millimetres; the best first."""
    colors: UInt32[np.ndarray, "g p"]
    """RGBA, a byte each. Blue is the level's best error, vermilion that of its worst particles."""
    centre: Float[np.ndarray, " 3"]
    half_sizes: Float[np.ndarray, " 3"]
    texts: list[str]
    """A generation's state, as Markdown."""


def level_of(population: Population) -> Level | None:
    """Return what is shown of a level's candidates, None where none of them is worth anything."""
    population = population.trimmed()
    xi, error = np.asarray(population.xi), np.asarray(population.error)
    finite = np.sqrt(error[np.isfinite(error)])
    if finite.size == 0:
        return None
    iterations, count = error.shape
    order = np.argsort(error, axis=1, kind="stable")[:, :: -(-count // MAX_PARTICLES)]
    rows = np.arange(iterations)[:, None]
    xi, rmse = xi[rows, order], np.sqrt(error[rows, order])
    worst = int(0.95 * (finite.size - 1))
    low, high = finite.min(), np.partition(finite, worst)[worst]
    place = (np.minimum(rmse, high) - low) * (255 / max(high - low, 1e-6))
    twists = np.concatenate([xi.reshape(-1, 6), np.asarray(population.centre)[None]])
    positions = (camera_positions(twists) * MILLIMETRES).astype(np.float32)
    level = int(population.level)
    texts = [
        f"| particles | level | DSR | iteration | best RMSE |\n|---|---|---|---|---|\n"
        f"| {count} | {level} | 1/{2**level} | {i} of {iterations} | {best:.2f} grey levels |\n\n{KEY}"
        for i, best in enumerate(rmse[:, 0].tolist(), 1)
    ]
    return Level(
        positions[:-1].reshape(*rmse.shape, 3),
        PARTICLE_COLORS[place.astype(np.uint8)],
        positions[-1],
        np.asarray(population.half_widths)[:3] * np.float32(MILLIMETRES),
        texts,
    )


def camera_positions(xi: Float[np.ndarray, "*batch 6"]) -> Float64[np.ndarray, "*batch 3"]:
    """Return where twists of target_T_reference put the target camera, seen from the reference: −V(−w) v, metres."""
    v, w = np.asarray(xi[..., :3], np.float64), np.asarray(xi[..., 3:], np.float64)
    square = np.sum(w * w, axis=-1, keepdims=True)
    safe = np.sqrt(np.maximum(square, 1e-8))
    first = np.where(square < 1e-8, 0.5, (1 - np.cos(safe)) / safe**2)
    second = np.where(square < 1e-8, 1 / 6, (safe - np.sin(safe)) / safe**3)
    twice_turned = np.sum(w * v, axis=-1, keepdims=True) * w - square * v
    return -(v - first * np.cross(w, v) + second * twice_turned)


def blend(place: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape 3"]:
    """Return RGB from blue (−1) over white (0) to vermilion (1)."""
    channels = [np.interp(place, (-1.0, 0.0, 1.0), values) for values in zip(BLUE, WHITE, VERMILION, strict=True)]
    return np.stack(channels, axis=-1).astype(np.uint8)


def packed(rgb: UInt8[np.ndarray, "n 3"]) -> UInt32[np.ndarray, " n"]:
    """Return colours as Rerun takes them without converting: opaque RGBA, a byte each."""
    return (rgb.astype(np.uint32) << np.array([24, 16, 8], np.uint32)).sum(axis=1, dtype=np.uint32) | np.uint32(255)


SCALE = blend(np.linspace(-1, 1, 256))
PARTICLE_COLORS = packed(SCALE)
"""From the best error to the worst."""
RESIDUAL_COLORS = np.ascontiguousarray(SCALE[:, None, ::-1])
"""BGR, from −RESIDUAL_RANGE to RESIDUAL_RANGE."""
GREYS = packed(np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1))


def color_residual(
    warped: UInt8[np.ndarray, "h w"], reference: UInt8[np.ndarray, "h w"], seen: Bool[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return BGR of the residuals warped − reference; black where nothing is seen."""
    factor = 127.5 / RESIDUAL_RANGE
    colored = cv2.applyColorMap(cv2.addWeighted(warped, factor, reference, -factor, 127.5), RESIDUAL_COLORS)
    return cv2.bitwise_and(colored, colored, mask=seen.view(np.uint8))


def shown_camera(camera: Camera) -> Camera:
    """Return the camera of the images that are shown: of the finest level at most `IMAGE_WIDTH` wide."""
    level = 0
    while camera.width >> level > IMAGE_WIDTH:
        level += 1
    return camera.level(level)


def rays(camera: Camera) -> Float[np.ndarray, "h w 3"]:
    """Return the points at depth 1 that pixels see."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32))
    return np.asarray(camera.back_project(np.stack([u, v], axis=-1), np.ones_like(u)), np.float32)


def warp_target(
    reference: Shown, target: Shown, target_T_reference: Float[np.ndarray, "4 4"], camera: Camera
) -> tuple[UInt8[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Return I_{t+1}(ω(ξ, p)) at every reference pixel, black where it is not defined, and where it is.

    Args:
        reference: with its depth.
        target: the image that is sampled.
        target_T_reference: g(ξ).
        camera: of both, without distortion.
    """
    height, width = reference.grey.shape
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    u, v = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    known = reference.depth > 0
    inverse_depth = np.divide(1, reference.depth, out=np.zeros_like(reference.depth), where=known)
    turn = (matrix @ target_T_reference[:3, :3] @ np.linalg.inv(matrix)).astype(np.float32)
    shift = (matrix @ target_T_reference[:3, 3]).astype(np.float32)
    x, y, z = (a * u + (b * v + c) + d * inverse_depth for (a, b, c), d in zip(turn, shift, strict=True))
    seen = known & (z > 1e-3)
    x /= z
    y /= z
    seen &= (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    sampled = cv2.remap(target.grey, x, y, cv2.INTER_LINEAR)
    return cv2.bitwise_and(sampled, sampled, mask=seen.view(np.uint8)), seen


def star_strips(centre: Float[np.ndarray, " 3"], size: float) -> list[Float[np.ndarray, "2 3"]]:
    """Return the strokes of a star in space."""
    directions = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1, -1, 1], [-1, 1, 1], [1, 1, -1]], float)
    directions *= size / np.linalg.norm(directions, axis=1, keepdims=True)
    return [np.stack([centre - d, centre + d]) for d in directions]
