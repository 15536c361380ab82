"""The live viewer on Rerun (extra `[viewer]`): window, server or file.

A separate thread prepares and sends a frame's pictures, so that a run hardly waits for them. There are two timelines:
`frame`, and `generation` for the populations within a frame, which counts on from frame to frame.
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
"""Suffix of a recording that is being written. A new run removes files that end in `PARTIAL`, but not these."""
WAITING_FRAMES = 8
"""Frames that may be queued before the run has to wait."""
SECONDS_TOGETHER = 0.25
"""Interval, seconds, at which data is sent; it delays a window by at most this."""
MEMORY = "512MiB"
"""Data that the web viewer's server keeps for browsers that connect later."""
HOST, WEB_PORT = "127.0.0.1", 9090
"""Address of all servers, on this machine only, and port of the web viewer's page, or a free one if it is taken.

The data have an unpredictable port, as Rerun serves them to anyone who asks there, under any name of the host.
"""
WINDOW_SECONDS = 1.0
"""Seconds after which a window that finds no screen has ended."""
PATIENCE = 60.0
"""Maximum wait, seconds, for a server or window to start or end, and for the last frames to arrive."""
NOT_STARTED = "Rerun did not start"
GUARD = """
import os, signal, subprocess, sys, threading
server = subprocess.Popen([sys.executable, "-m", "rerun", "--serve-web", *sys.argv[1:]], stdin=subprocess.DEVNULL)
threading.Thread(target=lambda: os._exit(server.wait() or 1), daemon=True).start()
sys.stdin.read()
os.killpg(0, signal.SIGTERM)
"""
"""Program that serves until its standard input closes, which happens however the run ends, or until its server ends.
Ctrl-C does not reach it.
"""
ATTEMPTS = 4
"""Number of port pairs that are tried, as another process may take a free port before the server does."""


def make_viewer(mode: ViewerMode, recording: Path) -> Viewer:
    """Return a viewer that is not open yet.

    Args:
        mode: `spawn` opens a window, `web` serves to a browser, `save` writes a file, `none` shows nothing.
        recording: The file to save to.

    Raises:
        GavoError: Rerun is not installed, there is no screen for a window, or the file is a folder.
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
        """URL of the viewer in mode `web`."""
        self._queue: Queue[Callable[[Scene], None] | None] = Queue(WAITING_FRAMES)
        """Additions to the scene; None ends the thread."""
        self._thread: threading.Thread | None = None
        self._fault: Exception | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._partial = recording.with_name(recording.name + UNFINISHED)

    def open(self, title: str, camera: Camera, stamps: Float[np.ndarray, " n"], truth: Trajectory | None) -> None:
        """Open the window, server or file, send the layout, and start the thread.

        Raises:
            GavoError: The file cannot be written, or Rerun cannot be started.
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
        """Queue a frame; wait while `WAITING_FRAMES` others are queued."""
        self._raise_fault()
        self._queue.put(lambda scene: scene.add(frame, step, populations))

    def show_corrected(self, trajectory: Trajectory, loops: Loops) -> None:
        """Queue the corrected trajectory and the loops."""
        self._raise_fault()
        self._queue.put(lambda scene: scene.add_loops(trajectory, loops))

    def close(self, is_cut_short: bool = False) -> None:
        """Wait until everything queued is shown, then end the recording.

        Args:
            is_cut_short: Whether an exception ended the run, whose recording is then not kept.

        Raises:
            GavoError: A frame could not be shown.
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
        """Rename a complete recording, replacing an earlier one; delete an incomplete one."""
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
        """Serve the browser until Ctrl-C; a window and a file do not need this process."""
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
        """Start Rerun's program, which outlives the run; unlike Rerun's Python call, for this machine only."""
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
        """Serve page and data with Rerun's command, which unlike its Python calls can listen on this machine only."""
        self._process, port, page = _serve_alone()
        address = f"rerun+http://{HOST}:{port}/proxy"
        stream.connect_grpc(address)
        self.url = f"http://{HOST}:{page}/?url={quote(address, safe='')}"
        print(f"viewer at {self.url}", file=sys.stderr, flush=True)
        if _has_screen():
            webbrowser.open(self.url)

    def _work(self, scene: Scene) -> None:
        """Add what is queued to the scene, and send it every `SECONDS_TOGETHER`, until None ends the queue."""
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
    """Start a server, check that its ports are its own, and return it with the ports for the data and the page.

    Raises:
        RuntimeError: It does not start.
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
    """End a server through its guard."""
    if process.stdin is not None:
        process.stdin.close()
    with suppress(subprocess.TimeoutExpired):
        process.wait(PATIENCE)


def _await_own(process: subprocess.Popen[bytes], ports: set[int]) -> None:
    """Wait until some ports are all listened on by a process or its descendants, not by another program.

    Raises:
        RuntimeError: The process ended, or does not listen within `PATIENCE` seconds.
    """
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline and process.poll() is None:
        if ports <= _listening(process.pid):
            return
        time.sleep(0.05)
    raise RuntimeError(NOT_STARTED)


def _listening(pid: int) -> set[int]:
    """Return the ports on which a process and its descendants listen."""
    import psutil  # Rerun needs it too

    ports: set[int] = set()
    with suppress(psutil.Error):
        first = psutil.Process(pid)
        for process in (first, *first.children(recursive=True)):
            listeners = (c for c in process.net_connections(kind="tcp") if c.status == psutil.CONN_LISTEN)
            ports.update(c.laddr.port for c in listeners)
    return ports


def _free_port(wanted: int) -> int:
    """Return the port, or a free one if it is taken or 0."""
    for port in (wanted, 0):
        with socket.socket() as probe:
            try:
                probe.bind((HOST, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise GavoError("--viewer: no free port")
