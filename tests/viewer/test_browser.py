"""The web viewer and the report in a browser: they draw, and the report asks the network for nothing.

Needs Chromium and playwright-core (`apt-get install chromium`, `npm install playwright-core`; NODE_PATH names the
folder that npm put it into). Without a GPU a page takes half a minute.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.evaluation import distance_error
from gavo_jax.output.plots import plot_distance_error, save
from gavo_jax.output.report import Picture, Table, write_report
from gavo_jax.trajectory import Trajectory

pytestmark = pytest.mark.slow
SCRIPT = Path(__file__).with_name("screenshot.cjs")


@pytest.fixture(scope="module")
def photograph(tmp_path_factory):
    """Return what opens an address, waits so many seconds and gives back the picture and what the page did."""
    chromium, node = shutil.which("chromium"), shutil.which("node")
    if chromium is None or node is None:
        pytest.skip("chromium and node are needed to draw a page")
    if subprocess.run([node, "-e", 'require("playwright-core")'], capture_output=True, check=False).returncode:
        pytest.skip("playwright-core is not found: npm install playwright-core, and name its folder in NODE_PATH")
    folder = tmp_path_factory.mktemp("pictures")

    def take(url: str, seconds: float) -> tuple[np.ndarray, dict]:
        image = folder / "page.png"
        command = [node, SCRIPT, chromium, url, image, str(seconds), "1400", "800"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=180 + seconds, check=False)
        assert done.returncode == 0, done.stderr
        picture = cv2.imread(str(image))
        assert picture is not None
        return picture, json.loads(done.stdout)

    return take


def distinct(picture: np.ndarray) -> int:
    """Number of colours, told apart in steps of 16: a blank or a loading page has a handful."""
    return len(np.unique((picture // 16).reshape(-1, 3), axis=0))


def test_report_draws_without_a_network(photograph, tmp_path):
    sequence = SyntheticSequence(frames=5)
    truth = sequence.ground_truth
    moved = truth.world_T_camera.copy()
    moved[:, 0, 3] += np.linspace(0, 0.1, len(moved))
    errors = {"ga": distance_error(Trajectory(truth.timestamps, moved), truth)}
    _, figure = save(plot_distance_error(errors), tmp_path, "distance_error")
    path = tmp_path / "report.html"
    write_report(path, "A run", [Table("drift", ("method", "m/s"), [("ga", "0.01")])], [Picture("it", figure)], {}, {})
    figure.unlink()
    picture, page = photograph(path.as_uri(), 1)
    assert page == {"title": "A run", "outside": [], "faults": []}
    assert distinct(picture) > 20
    blue = np.all(np.abs(picture.astype(int) - (0xB2, 0x72, 0x00)) < 24, axis=-1)
    assert blue.sum() > 200, "the figure's curve is not there"


def test_web_viewer_draws_a_run(photograph, tmp_path):
    command = [sys.executable, "-m", "gavo_jax", "run", "--viewer", "web", "--frames", "6", "--method", "gauss-newton"]
    with (tmp_path / "log").open("w") as log:
        run = subprocess.Popen(
            command,
            cwd=tmp_path,
            stdout=log,
            stderr=log,
            env={**os.environ, "BROWSER": "true"},
            # a process started in the background of a shell ignores Ctrl-C, and so would its children
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        try:
            deadline = time.monotonic() + 300
            while "open until Ctrl-C" not in (text := (tmp_path / "log").read_text()):
                assert run.poll() is None and time.monotonic() < deadline, text
                time.sleep(1.0)
            [url] = set(re.findall(r"viewer at (\S+)", text))
            picture, page = photograph(url + "&renderer=webgl", 40)
            run.send_signal(signal.SIGINT)
            assert run.wait(timeout=30) == 0
        finally:
            run.kill()
    assert not page["faults"]
    upper, lower = picture[60:540], picture[560:780]
    assert distinct(upper) > 60 and distinct(lower) > 20
