"""The live viewer on Rerun (extra `[viewer]`): window, server or file.

A frame's pictures are prepared and sent by a thread of their own, so that a run hardly waits for them. Two time lines:
`frame`, and `generation`, which counts on from frame to frame, for the evolution of the populations inside a frame.
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
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from queue import Empty, Queue
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np
from jaxtyping import Float

from gavo_jax.alignment.search import Population
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.errors import GavoError, printable
from gavo_jax.mapping.mapper import Loops
from gavo_jax.odometry.driver import Step
from gavo_jax.trajectory import Trajectory
from gavo_jax.viewer.base import NO_VIEWER, Viewer, ViewerMode
from gavo_jax.viewer.layout import make_blueprint
from gavo_jax.viewer.scene import Scene

if TYPE_CHECKING:
    from rerun import RecordingStream


UNFINISHED = ".part"
"""After the name of a recording that is being written; not the ending of what a new run clears away."""
WAITING_FRAMES = 8
"""Frames that may be queued before the run has to wait."""
SECONDS_TOGETHER = 0.25
"""What is shown within this time is sent together; a window lags behind the run by at most this."""
MEMORY = "512MiB"
"""What the server of the web viewer keeps for browsers that come later."""
HOST, WEB_PORT = "127.0.0.1", 9090
"""Where the web viewer's page is found: on this machine only, and at another port where something else is at this one.
The data have a port that nobody can foretell: Rerun gives them to whoever asks there, by whatever name of the host."""
WINDOW_SECONDS = 1.0
"""After which a window that found no screen would have ended."""
PATIENCE = 60.0
"""Seconds for the server to start, and for the last frames to arrive."""
NOT_STARTED = "Rerun did not start"
GUARD = """
import os, signal, subprocess, sys, threading
server = subprocess.Popen([sys.executable, "-m", "rerun", "--serve-web", *sys.argv[1:]], stdin=subprocess.DEVNULL)
threading.Thread(target=lambda: os._exit(server.wait() or 1), daemon=True).start()
sys.stdin.read()
os.killpg(0, signal.SIGTERM)
"""
"""Serves until its standard input closes, which it does however the run ends, or until its server ends; Ctrl-C does not
reach it."""
ATTEMPTS = 4
"""Pairs of ports that are tried: one that is free may be somebody else's before the server has it."""


def make_viewer(mode: ViewerMode, recording: Path) -> Viewer:
    """Return a viewer, not open yet.

    Args:
        mode: `spawn` a window, serve to a browser on the `web`, `save` to a file, or `none` of these.
        recording: the file to save to.

    Raises:
        GavoError: Rerun is not installed, there is no screen for a window, or a folder in place of the file.
    """
    if mode == "none":
        return NO_VIEWER
    if importlib.util.find_spec("rerun") is None:
        raise GavoError(f"--viewer {mode}: rerun is not installed: pip install 'gavo-jax[viewer]'")
    if mode == "spawn" and not _has_screen():
        raise GavoError("--viewer spawn: no screen here: use --viewer web or --viewer save")
    if mode == "save" and recording.is_dir():
        raise GavoError(f"{recording}: cannot be written: it is a folder")
    return RerunViewer(mode, recording)


class RerunViewer(Viewer):
    """Shows a run in Rerun, live or in a file."""

    wants_populations = True

    def __init__(self, mode: ViewerMode, recording: Path) -> None:
        self.mode, self.recording = mode, recording
        self.url = ""
        """Where a browser finds it, in mode `web`."""
        self._queue: Queue[Callable[[Scene], None] | None] = Queue(WAITING_FRAMES)
        """What is to be added to the scene; None ends it."""
        self._thread: threading.Thread | None = None
        self._fault: Exception | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._partial = recording.with_name(recording.name + UNFINISHED)

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
        stream.send_recording_name(printable(title))
        stream.send_blueprint(make_blueprint())
        self._stream = stream
        self._thread = threading.Thread(target=self._work, args=(Scene(stream, camera, stamps, truth),), daemon=True)
        self._thread.start()

    def watch(self, frame: Frame | None, step: Step | None, populations: tuple[Population, ...] = ()) -> None:
        """Queue a frame; waits while `WAITING_FRAMES` others are yet to be shown."""
        self._raise_fault()
        self._queue.put(lambda scene: scene.add(frame, step, populations))

    def show_corrected(self, trajectory: Trajectory, loops: Loops) -> None:
        """Queue the corrected trajectory and the loops."""
        self._raise_fault()
        self._queue.put(lambda scene: scene.add_loops(trajectory, loops))

    def close(self, is_cut_short: bool = False) -> None:
        """Wait for what is queued.

        Args:
            is_cut_short: an exception ended the run: a recording of it is not kept.

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
            self._keep(self._fault is None and not is_cut_short)
        self._raise_fault()

    def _keep(self, is_whole: bool) -> None:
        """Give a recording its name once it is whole: until then an earlier one keeps it."""
        try:
            if is_whole:
                self._partial.replace(self.recording)
            else:
                self._partial.unlink(missing_ok=True)
        except OSError as error:
            self._fault = self._fault or error

    def __exit__(self, *exception: object) -> None:
        self.close(is_cut_short=exception[0] is not None)

    def stay(self) -> None:
        """Serve the browser until Ctrl-C; a window of its own and a file need nothing."""
        if not self.url:
            return
        print("the viewer stays open until Ctrl-C", flush=True)
        try:
            while True:
                time.sleep(1.0)
        except KeyboardInterrupt:
            return

    def _connect(self, stream: RecordingStream) -> None:
        try:
            if self.mode == "save":
                self._partial.unlink(missing_ok=True)
                stream.save(self._partial)
            elif self.mode == "spawn":
                self._open_window(stream)
            else:
                self._serve(stream)
        except (OSError, RuntimeError, UnicodeError) as error:
            where = f"{self.recording}: cannot be written" if self.mode == "save" else f"--viewer {self.mode}"
            raise GavoError(f"{where}: {error}") from None

    def _open_window(self, stream: RecordingStream) -> None:
        """Start Rerun's own program, which stays when the run ends; unlike Rerun's call, for this machine alone."""
        port, quiet = _free_port(0), subprocess.DEVNULL
        command = [sys.executable, "-m", "rerun", "--hide-welcome-screen", "--bind", HOST, "--port", str(port)]
        self._process = subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True)
        try:
            _await_own(self._process, {port})
            self._process.wait(timeout=WINDOW_SECONDS)
        except subprocess.TimeoutExpired:
            stream.connect_grpc(f"rerun+http://{HOST}:{port}/proxy")
            return
        except RuntimeError:
            self._process.terminate()
        raise RuntimeError("Rerun's window did not open on this screen: use --viewer web or --viewer save")

    def _serve(self, stream: RecordingStream) -> None:
        """Serve page and data by a process of Rerun's command: unlike its Python calls, it can keep to this machine."""
        self._process, port, page = _serve_alone()
        address = f"rerun+http://{HOST}:{port}/proxy"
        stream.connect_grpc(address)
        self.url = f"http://{HOST}:{page}/?url={quote(address, safe='')}"
        print(f"viewer at {self.url}", file=sys.stderr, flush=True)
        if _has_screen():
            webbrowser.open(self.url)

    def _work(self, scene: Scene) -> None:
        """Add what is queued to the scene, and send it every `SECONDS_TOGETHER`, until None comes."""
        sent, is_open = time.monotonic(), True
        while is_open:
            try:
                add, waited = self._queue.get(timeout=SECONDS_TOGETHER), False
            except Empty:
                add, waited = None, True
            is_open = waited or add is not None
            try:
                if add is not None and self._fault is None:
                    add(scene)
                if add is None or time.monotonic() - sent > SECONDS_TOGETHER:
                    scene.send()
                    sent = time.monotonic()
            except Exception as fault:
                self._fault = fault

    def _raise_fault(self) -> None:
        if self._fault is not None:
            raise GavoError(f"--viewer {self.mode}: {self._fault}") from self._fault


def _has_screen() -> bool:
    return sys.platform != "linux" or bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ))


def _serve_alone() -> tuple[subprocess.Popen[bytes], int, int]:
    """Start a server and see that it has its two ports to itself: for data and for the page.

    Raises:
        RuntimeError: it does not start.
    """
    for site in (WEB_PORT, *[0] * (ATTEMPTS - 1)):
        port, page = _free_port(0), _free_port(site)
        process = _start_server(port, page)
        try:
            _await_own(process, {port, page})
            return process, port, page
        except RuntimeError:
            _end(process)
    raise RuntimeError(NOT_STARTED)


def _start_server(port: int, page: int) -> subprocess.Popen[bytes]:
    options = {"bind": HOST, "port": port, "web-viewer-port": page, "server-memory-limit": MEMORY}
    command = [sys.executable, "-c", GUARD]
    command += [word for name, value in options.items() for word in (f"--{name}", str(value))]
    quiet = subprocess.DEVNULL
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet, start_new_session=True)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a server by its guard."""
    if process.stdin is not None:
        process.stdin.close()
    with suppress(subprocess.TimeoutExpired):
        process.wait(PATIENCE)


def _await_own(process: subprocess.Popen[bytes], ports: set[int]) -> None:
    """Wait until it is this process, or one that it started, that listens at ports, and not somebody else's.

    Raises:
        RuntimeError: it has ended, or does not listen for `PATIENCE` seconds.
    """
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline and process.poll() is None:
        if ports <= _listening(process.pid):
            return
        time.sleep(0.05)
    raise RuntimeError(NOT_STARTED)


def _listening(pid: int) -> set[int]:
    """Ports at which a process and those that it started listen."""
    import psutil  # Rerun needs it too

    ports: set[int] = set()
    with suppress(psutil.Error):
        first = psutil.Process(pid)
        for process in (first, *first.children(recursive=True)):
            listeners = (c for c in process.net_connections(kind="tcp") if c.status == psutil.CONN_LISTEN)
            ports.update(c.laddr.port for c in listeners)
    return ports


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
