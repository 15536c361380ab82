"""Runs that are cut short: killed, interrupted, out of disk; and their other half."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gavo_jax.camera import Camera
from gavo_jax.cli import main, run
from gavo_jax.datasets.synthetic import SyntheticSequence, write_tum
from gavo_jax.errors import GavoError
from gavo_jax.odometry.driver import Odometry, Progress, track
from gavo_jax.odometry.run import run_odometry
from gavo_jax.odometry.tracking import blank_state
from gavo_jax.output.checkpoint import load_checkpoint, save_checkpoint
from gavo_jax.output.run_folder import RunFolder
from gavo_jax.settings import AlignmentOptions, OdometryOptions, Settings
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.solvers.genetic import GeneticAlgorithm
from gavo_jax.trajectory import Trajectory

CAMERA = Camera(131.0, 131.0, 79.5, 59.5, 160, 120)
SOLVER = GaussNewton(iterations=(0, 0, 15, 0, 0))
GENETIC = GeneticAlgorithm(population=(0, 0, 16, 0, 0), iterations=(0, 0, 5, 0, 0))
READ_ONLY_CACHE = {**os.environ, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "1e9"}
"""JAX writes its cache of programs in place: a process that dies meanwhile would spoil it for the others."""
PLAIN = OdometryOptions(recover=False)
TIMINGS = {"compile_seconds", "milliseconds_per_pair_median", "frames_per_second"}
OFTEN = "import sys; from gavo_jax.cli import main, run; run.CHECKPOINT_SECONDS = 0.1; sys.exit(main(sys.argv[1:]))"
"""The command, with more checkpoints than it needs."""


@pytest.fixture(scope="session")
def clip(tmp_path_factory) -> Path:
    """Forty frames of 160×120 pixels, one of them torn, one white: no test changes them."""
    folder = tmp_path_factory.mktemp("clips") / "clip"
    write_tum(SyntheticSequence(frames=40, camera=CAMERA), folder)
    rgb = [folder / row.split()[1] for row in (folder / "rgb.txt").read_text().splitlines()[1:]]
    rgb[9].write_bytes(rgb[9].read_bytes()[:2000])
    return folder


def arguments(clip: Path, output: Path, *more: str) -> list[str]:
    camera = str(clip / "camera.toml")
    return ["run", str(clip), "--camera", camera, "--method", "gauss-newton", "--output", str(output), *more]


@pytest.fixture(scope="session")
def whole(clip, tmp_path_factory) -> Path:
    """The files of a run in one go."""
    folder = tmp_path_factory.mktemp("whole")
    assert main(arguments(clip, folder)) == 0
    return folder


def same_ending(one: Path, other: Path) -> bool:
    """Whether two runs ended with the same files, byte by byte but for the times they took."""

    def rows(folder: Path) -> list[list[str]]:
        return [row[:-1] for row in csv.reader((folder / "frames.csv").read_text().splitlines())]

    def figures(folder: Path) -> dict[str, Any]:
        metrics = json.loads((folder / "metrics.json").read_text())
        return {key: value for key, value in metrics.items() if key not in TIMINGS}

    names = [sorted(path.name for path in folder.iterdir()) for folder in (one, other)]
    return (
        names[0] == names[1]
        and (one / "trajectory.txt").read_bytes() == (other / "trajectory.txt").read_bytes()
        and rows(one) == rows(other)
        and figures(one) == figures(other)
    )


class Power(Exception):
    """Goes out."""


def cut_short(monkeypatch: pytest.MonkeyPatch, after: int, fault: type[BaseException], every: float = 0.0) -> None:
    """Let the fault happen in the middle of the row of frame `after` + 1, between its two files."""
    append = RunFolder.add
    count = 0

    def add(self: RunFolder, step: Any, progress: Progress | None = None) -> None:
        nonlocal count
        count += 1
        if count > after:
            self._files["frames.csv"].append("torn")
            raise fault
        append(self, step, progress)

    monkeypatch.setattr(RunFolder, "add", add)
    monkeypatch.setattr(run, "CHECKPOINT_SECONDS", every)


@pytest.mark.parametrize(("after", "every"), [(1, 0.0), (9, 0.0), (20, 0.05), (20, 1e9), (38, 0.0)])
def test_resumed_run_ends_as_one_in_one_go(clip, whole, tmp_path, monkeypatch, after, every):
    with monkeypatch.context() as patch:
        cut_short(patch, after, Power, every)
        with pytest.raises(Power):
            main(arguments(clip, tmp_path / "out"))
    assert not (tmp_path / "out" / "metrics.json").exists()
    assert len(Trajectory.read_tum(tmp_path / "out" / "trajectory.txt")) == after + 1
    assert main(arguments(clip, tmp_path / "out", "--resume")) == 0
    assert same_ending(tmp_path / "out", whole)


def test_interrupted_run_is_resumed(clip, whole, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        cut_short(patch, 5, KeyboardInterrupt, 1e9)
        assert main(arguments(clip, tmp_path / "out")) == 130
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["complete"] is False and metrics["frames"] == 6
    assert len((tmp_path / "out" / "frames.csv").read_text().splitlines()) == 6, "the torn row is gone"
    assert main(arguments(clip, tmp_path / "out", "--resume")) == 0
    assert same_ending(tmp_path / "out", whole)


def test_nothing_to_resume(clip, whole, tmp_path, capsys):
    """An empty folder is a run from the start; of a run that came to its end nothing is touched."""
    assert main(arguments(clip, tmp_path / "out", "--resume")) == 0
    assert same_ending(tmp_path / "out", whole)
    before = {path: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    capsys.readouterr()
    assert main(arguments(clip, tmp_path / "out", "--resume")) == 0
    done = capsys.readouterr()
    assert "nothing to resume" in done.err and "lost pairs" in done.out
    assert main(arguments(clip, tmp_path / "out", "--resume", "--strict")) == 3
    assert {path: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before


@pytest.fixture
def broken(clip, tmp_path, monkeypatch) -> Path:
    """The folder of a run that was cut short, with a checkpoint."""
    with monkeypatch.context() as patch:
        cut_short(patch, 4, Power)
        with pytest.raises(Power):
            main(arguments(clip, tmp_path / "out"))
    return tmp_path / "out"


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--seed", "1"), ("seed 0 there, 1 now",)),
        (("--frames", "20"), ("sequence.frames 40 there, 20 now",)),
        (("--on-lost", "predict"), ("odometry.on_lost",)),
        (("--preset", "fast"), ("config.json",)),
    ],
)
def test_another_run_is_not_resumed(clip, broken, capsys, more, words):
    before = {path: path.read_bytes() for path in broken.iterdir()}
    capsys.readouterr()
    assert main(arguments(clip, broken, "--resume", *more)) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and str(broken / "config.json") in error and all(word in error for word in words)
    assert {path: path.read_bytes() for path in broken.iterdir()} == before


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("checkpoint.npz", halve),
        ("checkpoint.npz", lambda path: path.write_bytes(b"")),
        ("checkpoint.npz", lambda path: np.savez(path, numbers=np.array("[]"))),
        ("checkpoint.npz", lambda path: np.savez(path, numbers=np.array([print], dtype=object))),
        ("checkpoint.npz", lambda path: np.savez_compressed(path, numbers=np.zeros(10**8))),
        ("trajectory.txt", halve),
        ("frames.csv", Path.unlink),
        ("config.json", halve),
        ("config.json", lambda path: path.write_text("[]")),
    ],
)
def test_damaged_files_are_not_resumed(clip, broken, capsys, name, damage):
    damage(broken / name)
    capsys.readouterr()
    assert main(arguments(clip, broken, "--resume")) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and str(broken / name) in error


def test_a_checkpoint_of_another_camera_is_refused(tmp_path):
    own, other = (blank_state(camera, SOLVER, AlignmentOptions()) for camera in (CAMERA, CAMERA.level(1)))
    save_checkpoint(tmp_path / "checkpoint.npz", Progress(own, 3), {})
    with pytest.raises(GavoError, match="another camera"):
        load_checkpoint(tmp_path / "checkpoint.npz", other)


@pytest.mark.parametrize(("solver", "at"), [(SOLVER, 1), (SOLVER, 4), (GENETIC, 3)])
def test_a_driver_goes_on_from_a_saved_progress(tmp_path, solver, at):
    sequence, settings = SyntheticSequence(frames=7, camera=CAMERA), Settings(solver, odometry=PLAIN)
    straight = run_odometry(sequence, settings).trajectory.world_T_camera
    first = Odometry(CAMERA, settings)
    for step in track(sequence, odometry=first):
        if step.index == at:
            break
    save_checkpoint(tmp_path / "checkpoint.npz", first.progress, {"frames.csv": 7})
    second = Odometry(CAMERA, settings)
    second.progress, sizes = load_checkpoint(
        tmp_path / "checkpoint.npz", blank_state(CAMERA, solver, settings.alignment)
    )
    rest = list(track(sequence, odometry=second))
    assert sizes == {"frames.csv": 7}
    assert [step.index for step in rest] == list(range(at + 1, 7))
    np.testing.assert_array_equal([step.world_T_camera for step in rest], straight[at + 1 :])


SMALL = """import resource, sys; from gavo_jax.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), resource.RLIM_INFINITY)); sys.exit(main(sys.argv[2:]))"""
"""The command where no file can grow beyond so many bytes: as with a full disk, only the error's words differ."""


@pytest.mark.parametrize("limit", [1000, 4000])
def test_a_full_disk_is_one_line_and_leaves_whole_rows(clip, whole, tmp_path, limit):
    command = [sys.executable, "-c", SMALL, str(limit), *arguments(clip, tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=READ_ONLY_CACHE)
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1 and str(tmp_path / "out") in done.stderr and "File too large" in done.stderr
    assert not (tmp_path / "out" / "metrics.json").exists()
    if (tmp_path / "out" / "trajectory.txt").exists():
        rows = (tmp_path / "out" / "trajectory.txt").read_text()
        assert rows.endswith("\n") and (whole / "trajectory.txt").read_text().startswith(rows)
    assert main(arguments(clip, tmp_path / "out", "--resume")) == 0
    assert same_ending(tmp_path / "out", whole)


def test_full_standard_output_is_one_line(clip, tmp_path):
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "gavo_jax", "--help"], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "No space left" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("method", ["gauss-newton", "ga"])
def test_killed_at_twenty_random_moments(clip, tmp_path, method):
    """SIGKILL at any time, then --resume: the same bytes each time."""
    rng = np.random.default_rng(0)
    whole = tmp_path / "whole"
    assert main(arguments(clip, whole, "--method", method)) == 0
    killed = 0
    for moment in range(20):
        output = tmp_path / str(moment)
        rows, delay = int(rng.integers(0, 39)), rng.uniform(0.0, 0.1)
        command = [sys.executable, "-c", OFTEN, *arguments(clip, output, "--method", method)]
        process = subprocess.Popen(command, env=READ_ONLY_CACHE)
        frames = output / "frames.csv"
        while process.poll() is None:
            if frames.exists() and frames.read_bytes().count(b"\n") > rows:
                break
            time.sleep(0.002)
        time.sleep(delay)
        process.send_signal(signal.SIGKILL)
        killed += process.wait() == -signal.SIGKILL
        left = Trajectory.read_tum(output / "trajectory.txt")
        assert len(left) >= rows + 1
        assert subprocess.run([*command, "--resume"], check=False, env=READ_ONLY_CACHE).returncode == 0
        assert same_ending(output, whole), f"killed after {rows} rows and {delay:.3f} s"
        shutil.rmtree(output)
    assert killed >= 15
