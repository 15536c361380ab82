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
from queue import Queue
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self
from urllib.parse import quote

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8

from gavo_jax.alignment import Population
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.errors import GavoError
from gavo_jax.odometry import Step
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
WAITING_FRAMES = 4
"""Frames that wait to be shown before the run waits for them."""
MEMORY = "512MiB"
"""What the server of the web viewer keeps for browsers that come later."""
HOST, GRPC_PORT, WEB_PORT = "127.0.0.1", 9876, 9090
"""Where the web viewer is found: on this machine only; at other ports where something else is at these."""
PATIENCE = 60.0
"""Seconds for the server to start, and for the last frames to arrive."""
GUARD = """
import os, signal, subprocess, sys
subprocess.Popen([sys.executable, "-m", "rerun", "--serve-web", *sys.argv[1:]], stdin=subprocess.DEVNULL)
sys.stdin.read()
os.killpg(0, signal.SIGTERM)
"""
"""Serves until its standard input closes, which it does however the run ends; Ctrl-C does not reach it."""

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
        self._server: subprocess.Popen[bytes] | None = None

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
                stream.spawn(hide_welcome_screen=True)
            else:
                self._serve(stream)
        except (OSError, RuntimeError) as error:
            where = f"{self.recording}: cannot be written" if self.mode == "save" else f"--viewer {self.mode}"
            raise GavoError(f"{where}: {error}") from None

    def _serve(self, stream: RecordingStream) -> None:
        """Serve page and data by a process of Rerun's command: unlike its Python calls, it can keep to this machine."""
        port, page = _free_port(GRPC_PORT), _free_port(WEB_PORT)
        options = {"bind": HOST, "port": port, "web-viewer-port": page, "server-memory-limit": MEMORY}
        command = [sys.executable, "-c", GUARD]
        command += [word for name, value in options.items() for word in (f"--{name}", str(value))]
        quiet = subprocess.DEVNULL
        self._server = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet, start_new_session=True
        )
        for served in (port, page):
            _await_port(served)
        address = f"rerun+http://{HOST}:{port}/proxy"
        stream.connect_grpc(address)
        self.url = f"http://{HOST}:{page}/?url={quote(address, safe='')}"
        print(f"viewer at {self.url}", file=sys.stderr, flush=True)
        if _has_screen():
            webbrowser.open(self.url)

    def _work(self, scene: Scene) -> None:
        while (item := self._queue.get()) is not None:
            if self._fault is None:
                try:
                    scene.add(*item)
                except Exception as fault:
                    self._fault = fault

    def _raise_fault(self) -> None:
        if self._fault is not None:
            raise GavoError(f"--viewer {self.mode}: {self._fault}") from self._fault


def _has_screen() -> bool:
    return sys.platform != "linux" or bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ))


def _await_port(port: int) -> None:
    """Wait until something answers at a port.

    Raises:
        GavoError: nothing does for `PATIENCE` seconds.
    """
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        with socket.socket() as probe:
            if probe.connect_ex((HOST, port)) == 0:
                return
        time.sleep(0.05)
    raise GavoError("--viewer web: Rerun's server does not start")


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
    images = [
        layout.Spatial2DView(origin=f"images/{name}", name=title)
        for name, title in (
            ("reference", "Reference"),
            ("target", "Target"),
            ("warped", "Target, warped"),
            ("residual", "Residual (blue below, orange above)"),
        )
    ]
    return layout.Blueprint(
        layout.Vertical(
            layout.Horizontal(search, world, curves, column_shares=[3, 3, 2]),
            layout.Horizontal(*images),
            row_shares=[5, 2],
        ),
        layout.TimePanel(timeline="frame", state="collapsed"),
        collapse_panels=True,
    )


class Scene:
    """Turns frames, steps and populations into what Rerun shows; remembers what a segment or a warp starts from."""

    def __init__(
        self, stream: RecordingStream, camera: Camera, stamps: Float[np.ndarray, " n"], truth: Trajectory | None
    ) -> None:
        import rerun

        self._rr, self._stream = rerun, stream
        self._camera = shown_camera(camera)
        self._shrink = camera.width // self._camera.width
        self._depth_scale = camera.depth_scale
        self._rays = rays(self._camera)
        self._truth = Truth(stamps, truth)
        self._frame, self._generation = 0, 0
        self._world_T_camera = np.eye(4)
        self._last_truth: Float64[np.ndarray, "4 4"] | None = None
        self._shown: deque[Shown] = deque(maxlen=8)
        """The last frames that could be read; an older one is never a reference."""
        self._send_static()

    def add(self, frame: Frame | None, step: Step | None, populations: tuple[Population, ...]) -> None:
        """Send one frame."""
        self._frame = 0 if step is None else step.index
        self._stream.set_time("frame", sequence=self._frame)
        self._stream.set_time("generation", sequence=self._generation)
        world_T_camera = np.eye(4) if step is None else step.world_T_camera
        truth = self._truth.at(self._frame, world_T_camera)
        shown = None if frame is None else self._shrunk(frame)
        if shown is not None:
            self._send_camera(world_T_camera, shown)
        if step is not None:
            self._send_trajectory(world_T_camera, truth)
            self._send_images(shown, step)
        generations = 0
        if step is not None and populations:
            generations = self._send_search(populations, self._truth.motion(step))
        self._generation += max(generations, 1)
        self._world_T_camera, self._last_truth = world_T_camera, truth
        if shown is not None:
            self._shown.append(shown)

    def _send_static(self) -> None:
        rr, log = self._rr, self._stream.log
        camera = self._camera
        log("world", rr.ViewCoordinates.RDF, static=True)
        log("search", rr.ViewCoordinates.RDF, static=True)
        pinhole = rr.Pinhole(
            focal_length=[camera.fx, camera.fy],
            principal_point=[camera.cx + 0.5, camera.cy + 0.5],
            resolution=[camera.width, camera.height],
            image_plane_distance=0.4,
        )
        log("world/camera/image", pinhole, static=True)
        for path, color, name in (
            ("curves/rmse", BLUE, "RMSE of the pair"),
            ("curves/distance_error", VERMILION, "distance error"),
        ):
            log(path, rr.SeriesLines(colors=[color], widths=[2], names=[name]), static=True)
        last = rr.Points3D(
            [[0, 0, 0]], radii=[rr.Radius.ui_points(5)], colors=[WHITE], labels=["last camera"], show_labels=False
        )
        log("search/last_camera", last, static=True)

    def _shrunk(self, frame: Frame) -> Shown:
        size, k = (self._camera.width, self._camera.height), self._shrink
        grey = np.asarray(frame.grey)
        if k > 1:
            grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        raw = np.asarray(frame.depth)[k // 2 :: k, k // 2 :: k][: size[1], : size[0]]
        return Shown(frame.timestamp, grey, raw.astype(np.float32) / np.float32(self._depth_scale))

    def _image(self, image: UInt8[np.ndarray, "h w *channels"]) -> Any:
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        return self._rr.EncodedImage(contents=data.tobytes(), media_type="image/jpeg")

    def _send_camera(self, world_T_camera: Float64[np.ndarray, "4 4"], shown: Shown) -> None:
        rr, log = self._rr, self._stream.log
        log("world/camera", rr.Transform3D(translation=world_T_camera[:3, 3], mat3x3=world_T_camera[:3, :3]))
        picture = self._image(shown.grey)
        log("world/camera/image", picture)
        log("images/target", picture)
        every = np.s_[CLOUD_STRIDE // 2 :: CLOUD_STRIDE, CLOUD_STRIDE // 2 :: CLOUD_STRIDE]
        points = self._rays[every] * shown.depth[every][..., None]
        seen = points[..., 2] > 0
        grey = np.repeat(shown.grey[every][seen][:, None], 3, axis=1)
        log("world/camera/cloud", rr.Points3D(points[seen], colors=grey, radii=rr.Radius.ui_points(1.5)))

    def _send_trajectory(
        self, world_T_camera: Float64[np.ndarray, "4 4"], truth: Float64[np.ndarray, "4 4"] | None
    ) -> None:
        """Send this frame's piece of either path; the view gathers the pieces."""
        rr, log = self._rr, self._stream.log
        for path, start, end, color in (
            ("world/estimate", self._world_T_camera, world_T_camera, BLUE),
            ("world/truth", self._last_truth, truth, WHITE),
        ):
            if start is not None and end is not None:
                piece = np.stack([start[:3, 3], end[:3, 3]])
                log(path, rr.LineStrips3D([piece], colors=[color], radii=rr.Radius.ui_points(2)))
        if truth is not None:
            error = float(np.linalg.norm(world_T_camera[:3, 3] - truth[:3, 3]))
            log("curves/distance_error", rr.Scalars(error))

    def _send_images(self, shown: Shown | None, step: Step) -> None:
        rr, log = self._rr, self._stream.log
        if np.isfinite(step.alignment.error):
            log("curves/rmse", rr.Scalars(float(np.sqrt(step.alignment.error))))
        reference = next((s for s in reversed(self._shown) if s.timestamp == step.reference_timestamp), None)
        if shown is None or reference is None:
            return
        motion = np.asarray(step.alignment.target_T_reference)
        warped, seen = warp_target(reference, shown, motion, self._camera, self._rays)
        log("images/reference", self._image(reference.grey))
        log("images/warped", self._image(warped))
        log("images/residual", self._image(color_residual(warped, reference.grey, seen)))

    def _send_search(self, populations: tuple[Population, ...], motion: Float64[np.ndarray, "4 4"] | None) -> int:
        """Send every generation of a frame, each entity's in one call; return how many there are."""
        generations = [g for population in populations for g in generations_of(population)]
        if not generations:
            return 0
        rr, count = self._rr, len(generations)
        times = [
            rr.TimeColumn("frame", sequence=np.full(count, self._frame)),
            rr.TimeColumn("generation", sequence=self._generation + np.arange(count)),
        ]

        def send(path: str, columns: Any) -> None:
            self._stream.send_columns(path, times, columns)

        sizes = [len(g.positions) for g in generations]
        positions, colors = (np.concatenate([g[i] for g in generations]) for i in (0, 1))
        points = rr.Points3D.columns(positions=positions, colors=colors, radii=np.full(len(colors), -2.5))
        send("search/particles", points.partition(sizes))
        send("state", rr.TextDocument.columns(text=[g.text for g in generations], media_type=["text/markdown"] * count))
        boxes = rr.Boxes3D.columns(
            centers=[g.centre for g in generations],
            half_sizes=[g.half_sizes for g in generations],
            colors=[GREY] * count,
        )
        send("search/bounds", boxes)
        if motion is None:
            return count
        true = motion[:3, 3] * MILLIMETRES
        best = np.stack([g.positions[0] for g in generations])
        errors = np.linalg.norm(true - best, axis=1)
        arrows = rr.Arrows3D.columns(
            origins=best,
            vectors=true - best,
            colors=[VERMILION] * count,
            radii=np.full(count, -1.5),
            labels=[f"error {error:.1f} mm" for error in errors],
        )
        send("search/error", arrows)
        size = max(0.05 * float(np.linalg.norm(true)), 0.5)
        star = rr.LineStrips3D(star_strips(true, size), colors=[GREEN], radii=rr.Radius.ui_points(2))
        self._stream.log("search/truth", star)
        return count


class Shown(NamedTuple):
    """A frame as it is shown."""

    timestamp: float
    grey: UInt8[np.ndarray, "h w"]
    depth: Float[np.ndarray, "h w"]
    """Metres; 0 = no reading."""


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


class Generation(NamedTuple):
    """One iteration of a level's search, as it is shown."""

    positions: Float[np.ndarray, "p 3"]
    """Where each particle puts the camera, seen from the last one, millimetres; the best first."""
    colors: UInt8[np.ndarray, "p 3"]
    centre: Float[np.ndarray, " 3"]
    half_sizes: Float[np.ndarray, " 3"]
    text: str


def generations_of(population: Population) -> list[Generation]:
    """Return a level's generations. Blue is the level's best error, vermilion that of its worst particles."""
    population = population.trimmed()
    xi, error = np.asarray(population.xi), np.asarray(population.error)
    rmse = np.sqrt(np.where(np.isfinite(error), error, np.inf))
    finite = rmse[np.isfinite(rmse)]
    if finite.size == 0:
        return []
    iterations, count = rmse.shape
    order = np.argsort(rmse, axis=1, kind="stable")[:, :: -(-count // MAX_PARTICLES)]
    xi, rmse = np.take_along_axis(xi, order[..., None], axis=1), np.take_along_axis(rmse, order, axis=1)
    low = finite.min()
    high = max(np.quantile(finite, 0.95), low + 1e-6)
    colors = blend(2 * (np.minimum(rmse, high) - low) / (high - low) - 1)
    positions = camera_positions(xi) * MILLIMETRES
    centre = camera_positions(np.asarray(population.centre)) * MILLIMETRES
    half_sizes = np.asarray(population.half_widths)[:3] * MILLIMETRES
    level = int(population.level)
    texts = [
        f"| particles | level | DSR | iteration | best RMSE |\n|---|---|---|---|---|\n"
        f"| {count} | {level} | 1/{2**level} | {i + 1} of {iterations} | {rmse[i, 0]:.2f} grey levels |\n\n{KEY}"
        for i in range(iterations)
    ]
    return [
        Generation(place, color, centre, half_sizes, text)
        for place, color, text in zip(positions, colors, texts, strict=True)
    ]


def camera_positions(xi: Float[np.ndarray, "*batch 6"]) -> Float64[np.ndarray, "*batch 3"]:
    """Return where twists of target_T_reference put the target camera, seen from the reference: −V(−w) v, metres."""
    v, w = np.moveaxis(np.asarray(xi, np.float64).reshape(*xi.shape[:-1], 2, 3), -2, 0)
    angle = np.linalg.norm(w, axis=-1, keepdims=True)
    safe = np.maximum(angle, 1e-4)
    first = np.where(angle < 1e-4, 0.5, (1 - np.cos(safe)) / safe**2)
    second = np.where(angle < 1e-4, 1 / 6, (safe - np.sin(safe)) / safe**3)
    turned = np.cross(w, v)
    return -(v - first * turned + second * np.cross(w, turned))


def blend(place: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape 3"]:
    """Return RGB from blue (−1) over white (0) to vermilion (1)."""
    channels = [np.interp(place, (-1.0, 0.0, 1.0), values) for values in zip(BLUE, WHITE, VERMILION, strict=True)]
    return np.stack(channels, axis=-1).astype(np.uint8)


RESIDUAL_COLORS = np.ascontiguousarray(blend(np.linspace(-1, 1, 256))[:, None, ::-1])
"""BGR, from −RESIDUAL_RANGE to RESIDUAL_RANGE."""


def color_residual(
    warped: UInt8[np.ndarray, "h w"], reference: UInt8[np.ndarray, "h w"], seen: Bool[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return BGR of the residuals warped − reference; black where nothing is seen."""
    scaled = (warped.astype(np.float32) - reference) * np.float32(127.5 / RESIDUAL_RANGE) + np.float32(127.5)
    colored = cv2.applyColorMap(np.clip(scaled, 0, 255).astype(np.uint8), RESIDUAL_COLORS)
    colored[~seen] = 0
    return colored


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
    reference: Shown,
    target: Shown,
    target_T_reference: Float[np.ndarray, "4 4"],
    camera: Camera,
    rays: Float[np.ndarray, "h w 3"],
) -> tuple[UInt8[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Return I_{t+1}(ω(ξ, p)) at every reference pixel, black where it is not defined, and where it is.

    Args:
        reference: with its depth.
        target: the image that is sampled.
        target_T_reference: g(ξ).
        camera: of both.
        rays: of the camera, see `rays`.
    """
    moved = np.asarray(target_T_reference, np.float32)
    points = (rays * reference.depth[..., None]) @ moved[:3, :3].T + moved[:3, 3]
    z = points[..., 2]
    before = (reference.depth > 0) & (z > 1e-3)
    z = np.where(before, z, np.float32(1.0))
    u = np.float32(camera.fx) * points[..., 0] / z + np.float32(camera.cx)
    v = np.float32(camera.fy) * points[..., 1] / z + np.float32(camera.cy)
    seen = before & (u >= 0) & (v >= 0) & (u <= camera.width - 1) & (v <= camera.height - 1)
    sampled = cv2.remap(target.grey, u, v, cv2.INTER_LINEAR)
    sampled[~seen] = 0
    return sampled, seen


def star_strips(centre: Float[np.ndarray, " 3"], size: float) -> list[Float[np.ndarray, "2 3"]]:
    """Return the strokes of a star in space."""
    directions = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1, -1, 1], [-1, 1, 1], [1, 1, -1]], float)
    directions *= size / np.linalg.norm(directions, axis=1, keepdims=True)
    return [np.stack([centre - d, centre + d]) for d in directions]
