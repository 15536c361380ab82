"""Several commands, or several configurations, in one folder: refused or told apart, never mixed."""

import json
import os
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from command import GENETIC, runner

from gavo_jax.experiments import tuning
from gavo_jax.locks import hold

EXPERIMENT = """
seeds = {seeds}
[[sequences]]
name = "room"
path = "clip"
camera = "clip/camera.toml"
frames = {frames}
[[methods]]
name = "gauss-newton"
solver.iterations = [0, 0, 15, 0, 0]
solver.damping = {damping}
odometry.recover = false
odometry.bodies = "off"
[[methods]]
name = "opencv-rgb"
"""
TUNING = """
method = "gauss-newton"
trials = {trials}
[[sequences]]
name = "clip"
path = "clip"
camera = "clip/camera.toml"
frames = {frames}
[space]
alignment.loss = {choices}
"""

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture
def gavo(capsys, monkeypatch, tmp_path, forty_frames):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(forty_frames, tmp_path / "clip")
    return runner(capsys)


def write(name: str, text: str, **values: Any) -> str:
    Path(name).write_text(text.format(**values))
    return name


def figures(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


RUN = ("run", "clip", "--camera", "clip/camera.toml", *GENETIC, "--output", "out")
COMPARE = ("compare", "clip", "--camera", "clip/camera.toml", "--methods", "opencv-rgb", "--output", "out")


@pytest.mark.parametrize("command", ["run", "compare", "experiment", "report", "tune", "view"])
def test_a_folder_in_use_is_refused_in_one_line_and_left_alone(gavo, tmp_path, monkeypatch, command):
    toml = write("e.toml", EXPERIMENT, seeds=1, frames=34, damping=0.001)
    monkeypatch.setattr(tuning, "measure", lambda *_: (0.1, 1.0))
    words: dict[str, tuple[Any, ...]] = {
        "run": RUN,
        "compare": COMPARE,
        "experiment": ("experiment", toml, "--output", "out"),
        "report": ("experiment", "report", "out"),
        "tune": ("tune", write("t.toml", TUNING, trials=1, frames=34, choices=["huber"]), "--output", "out"),
        "view": ("view", "out", "--viewer", "save"),
    }
    for first in {"report": ["experiment"], "view": ["run"]}.get(command, []):
        assert gavo(*words[first]).status == 0
    (tmp_path / "out").mkdir(exist_ok=True)
    with hold(tmp_path / "out"):
        before = figures(tmp_path / "out")
        done = gavo(*words[command])
        assert done.status == 2 and done.err.count("\n") == 1 and "out: in use by another gavo" in done.err, done.err
        assert figures(tmp_path / "out") == before
    assert gavo(*words[command]).status == 0


def test_a_comparison_leaves_no_trajectory_of_an_earlier_one(gavo, tmp_path):
    assert gavo(*COMPARE).status == 0
    for name in ("ga-seed3.txt", "pso.txt", "notes.txt"):
        (tmp_path / "out" / name).write_text("of an earlier one")
    assert gavo(*COMPARE).status == 0
    assert sorted(path.name for path in (tmp_path / "out").glob("*.txt")) == ["notes.txt", "opencv-rgb.txt"]


@pytest.mark.parametrize("name", ["report.html", "drift.png", "frames.csv", "comparison.json"])
def test_an_experiment_replaces_only_what_an_experiment_wrote(gavo, tmp_path, name):
    """A user's own files were replaced without a word, and results of two kinds lay in one folder."""
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_text("mine")
    toml = write("e.toml", EXPERIMENT, seeds=1, frames=34, damping=0.001)
    done = gavo("experiment", toml, "--output", "out")
    assert done.status == 2 and done.err.count("\n") == 1 and name in done.err, done.err
    assert (tmp_path / "out" / name).read_text() == "mine"


@pytest.mark.parametrize("name", ["..", "../../t"])
def test_a_studys_name_is_no_path(gavo, tmp_path, name):
    """Its results lay outside the folder of results."""
    text = TUNING.format(trials=1, frames=34, choices=["huber"])
    (tmp_path / "t.toml").write_text(f'name = "{name}"\n{text}')
    done = gavo("tune", "t.toml")
    assert done.status == 2 and "cannot be a path" in done.err, done.err


def test_a_run_that_is_refused_a_comparisons_folder_leaves_it_alone(gavo, tmp_path):
    assert gavo(*COMPARE).status == 0
    (tmp_path / "out" / "trajectory.csv").write_text("of somebody")
    before = figures(tmp_path / "out")
    assert gavo(*RUN).status == 2 and figures(tmp_path / "out") == before


def test_two_runs_at_once(gavo, tmp_path):
    """One of them has the folder; the other leaves it alone, and the first one's files are whole."""
    commands = [[sys.executable, "-m", "gavo_jax", *RUN, "--seed", str(seed)] for seed in (1, 2)]
    runs = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for command in commands]
    errors = [run.communicate(timeout=120)[1] for run in runs]
    statuses = [run.returncode for run in runs]
    if statuses != [0, 0]:  # else one was over before the other began
        assert sorted(statuses) == [0, 2]
        assert errors[statuses.index(2)].count("\n") == 1 and "in use" in errors[statuses.index(2)]
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    config = json.loads((tmp_path / "out" / "config.json").read_text())
    assert metrics["seed"] == config["options"]["seed"]
    assert len((tmp_path / "out" / "frames.csv").read_text().splitlines()) == 40


def rows_of(out: str) -> dict[str, list[str]]:
    """The lines of printed tables by their first cell, after the title that stands above them."""
    lines = [line.replace("│", "|").strip() for line in out.splitlines()]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    return {row[0]: row[1:] for row in cells}


def test_a_changed_experiment_is_told_apart_from_what_it_was(gavo, monkeypatch):
    """Frames and settings of one name are not one method, and are not paired by seed."""
    monkeypatch.setenv("COLUMNS", "200")
    for frames, damping in ((40, 0.002), (34, 0.002), (34, 0.003)):
        toml = write("e.toml", EXPERIMENT, seeds=3, frames=frames, damping=damping)
        done = gavo("experiment", toml, "--output", "out")
        assert done.status == 0, done.err
    titles = [line for line in done.out.splitlines() if line.startswith("room")]
    assert titles[0] == "room" and "room (frames=40)" in titles
    before, _, earlier = done.out.partition("\nroom (frames=40)\n")
    now = rows_of(before[before.index("\nroom\n") :])
    label = "gauss-newton, iterations=[0, 0, 15, 0, 0], damping={}, recover=False, bodies=off"
    assert now[label.format(0.003)][0] == "3" and now[label.format(0.002)][0] == "3" and now["opencv-rgb"][0] == "1"
    assert rows_of(earlier)[label.format(0.002)][0] == "3"
    assert "first / second" not in done.out  # each of these methods has a single result
    assert "4 of 11 runs are from earlier versions of the experiment's file" not in done.out
    assert "7 of 11 runs are from earlier versions of the experiment's file." in done.out
    again = gavo("experiment", "report", "out")
    assert again.out.splitlines()[:3] == done.out[done.out.index("\nroom\n") + 1 :].splitlines()[:3]


def test_a_study_of_something_else_is_not_gone_on_with(gavo, tmp_path, monkeypatch):
    monkeypatch.setattr(tuning, "measure", lambda *_: (0.1, 1.0))
    first = {"trials": 1, "frames": 34, "choices": ["huber", "student-t"]}
    assert gavo("tune", write("t.toml", TUNING, **first), "--output", "out").status == 0
    before = (tmp_path / "out" / "front.json").read_bytes()
    for change, words in (
        ({"frames": 36}, "sequences.clip.frames was 34, now 36"),
        ({"choices": ["huber"]}, "space.alignment.loss"),
    ):
        done = gavo("tune", write("t.toml", TUNING, **first | change), "--output", "out")
        assert done.status == 2 and done.err.count("\n") == 1 and words in done.err, done.err
        assert (tmp_path / "out" / "front.json").read_bytes() == before
    other = write("t.toml", TUNING.replace('name = "clip"', 'name = "hall"'), **first)
    assert "is for clip, not for hall: give" in gavo("tune", other, "--output", "out").err
    (tmp_path / "out" / "trial-99.toml").write_text("of an earlier front")
    own = write("out/trial-desk.toml", TUNING, **first | {"trials": 2})
    assert gavo("tune", own, "--output", "out").status == 0
    assert not (tmp_path / "out" / "trial-99.toml").exists()
    assert (tmp_path / own).exists(), "what the study does not write it does not remove"
    taken = write("out/trial-1.toml", TUNING, **first)
    assert "choose another --output" in gavo("tune", taken, "--output", "out").err


def tables(study: Path) -> list[str]:
    with sqlite3.connect(study) as connection:
        return [name for (name,) in connection.execute("select name from sqlite_master where type = 'table'")]


def test_a_damaged_study_is_one_line(gavo, tmp_path, monkeypatch):
    monkeypatch.setattr(tuning, "measure", lambda *_: (0.1, 1.0))
    toml = write("t.toml", TUNING, trials=2, frames=34, choices=["huber", "student-t"])
    assert gavo("tune", toml, "--output", "out").status == 0
    study = tmp_path / "out" / "study.db"
    whole = study.read_bytes()
    for name in tables(study):
        study.write_bytes(whole)
        connection = sqlite3.connect(study)
        connection.execute(f"drop table {name}")
        connection.commit()
        connection.close()
        done = gavo("tune", toml, "--output", "out", "--trials", "3")
        assert done.status in (0, 2) and "Traceback" not in done.err, (name, done.err)
        assert done.status == 0 or (done.err.count("\n") == 1 and "study.db" in done.err), (name, done.err)
    for damaged in (whole[: len(whole) // 2], b"no database", b""):
        study.write_bytes(damaged)
        done = gavo("tune", toml, "--output", "out", "--trials", "3")
        assert done.status == (0 if not damaged else 2) and "Traceback" not in done.err
    os.unlink(study)
