"""From a file to a table: resumed, interrupted, reported; and tuned."""

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gavo_jax import presets
from gavo_jax.cli import main
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.experiments import executors, tuning
from gavo_jax.experiments.executors import LocalExecutor, Outcome, git_state
from gavo_jax.experiments.plan_file import read_plan
from gavo_jax.experiments.runner import estimate_seconds, missing, run_experiment
from gavo_jax.experiments.table import COLUMNS, Table
from gavo_jax.experiments.tuning import measure, read_tuning, tune
from gavo_jax.odometry.run import OdometryRun, run_odometry
from gavo_jax.settings import Settings
from gavo_jax.settings_file import override

METHODS = """
[[methods]]
name = "gauss-newton"
solver.iterations = [0, 0, 15, 0, 0]
odometry.recover = false
odometry.bodies = "off"
printed.synthetic = 0.04
[[methods]]
name = "opencv-rgbd"
"""
SMALL = {"solver.iterations": [0, 0, 15, 0, 0], "odometry.recover": False, "odometry.bodies": "off"}
"""One level and no second search: soon compiled."""
LABEL = "gauss-newton, iterations=[0, 0, 15, 0, 0], recover=False, bodies=off"
NAME = '[[sequences]]\nname = "synthetic"\n'


@pytest.fixture
def small(write_experiment) -> Path:
    path = write_experiment("seeds = 3\nbatch = 2", METHODS, frames=34)
    path.write_text(path.read_text().replace("[[sequences]]\n", NAME))
    return path


class Interrupted(LocalExecutor):
    """Ctrl-C comes while the second batch runs."""

    def run(self, *arguments: Any, **options: Any) -> Iterator[Outcome]:
        yield next(iter(super().run(*arguments, **options)))
        raise KeyboardInterrupt


def test_an_interrupted_command_says_what_is_kept(small, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("gavo_jax.cli.experiment.LocalExecutor", Interrupted)
    assert main(["experiment", str(small), "--output", str(tmp_path / "out")]) == 130
    assert "gavo: interrupted: 2 of 4 runs are in" in capsys.readouterr().err
    assert main(["experiment", "report", str(tmp_path / "out")]) == 0
    shown = capsys.readouterr().out
    assert "2 of the 4 planned runs are not done" in shown and "first / second" not in shown


def test_a_run_with_loops_is_that_of_run_odometry(write_experiment, tmp_path, monkeypatch):
    """Here without its map, which takes long to compile: what matters is that it was asked for."""
    asked, done = [], []

    def run(sequence: Any, settings: Settings, **options: Any) -> OdometryRun:
        asked.append((settings.odometry.loops, options["seed"]))
        found = run_odometry(sequence, override(settings, {"odometry.loops": False}), **options)
        return replace(found, metrics={**found.metrics, "ate_translation_rmse_m": 0.25, "keyframes": 2})  # pyright: ignore

    monkeypatch.setattr(executors, "run_odometry", run)
    methods = METHODS.partition("printed")[0] + "odometry.loops = true\n"
    plan = read_plan(write_experiment("seeds = 2", methods, frames=4), tmp_path / "out")
    assert run_experiment(plan, Table(plan.folder), LocalExecutor(), done.append) == (2, [])
    assert asked == [(True, 0), (True, 1)] and sum(done) == 6
    rows = Table(plan.folder).read()
    assert [(row["pairs"], row["runs_together"], row["ate_translation_rmse_m"]) for row in rows] == [(3, 1, 0.25)] * 2


def test_interrupted_and_resumed(small, tmp_path):
    plan, table = read_plan(small, tmp_path / "out"), Table(tmp_path / "out")
    assert len(missing(plan, table)) == 4 and estimate_seconds(plan.runs, [], 1) > 0
    with pytest.raises(KeyboardInterrupt):
        run_experiment(plan, table, Interrupted())
    kept = {row["run"]: row["finished"] for row in table.read()}
    assert len(kept) == 2 and len(missing(plan, table)) == 2
    ran: list[str] = []

    class Counting(LocalExecutor):
        def run(self, *arguments: Any, **options: Any) -> Iterator[Outcome]:
            for outcome in super().run(*arguments, **options):
                ran.extend(row["run"] for row in outcome.rows)
                yield outcome

    pairs: list[int] = []
    assert run_experiment(plan, table, Counting(), pairs.append) == (2, [])
    assert sum(pairs) == 2 * 33 and not set(ran) & set(kept)
    rows = table.read()
    assert {row["run"] for row in rows} == {run.id for run in plan.runs} and len(rows) == 4
    assert run_experiment(plan, table, Counting()) == (0, []) and len(ran) == 2
    check_columns(rows)


def check_columns(rows) -> None:
    ours = next(row for row in rows if row["seed"] == 2)
    assert tuple(ours) == tuple(COLUMNS)
    assert ours["label"] == LABEL and ours["pairs"] == 33
    assert 0 < ours["rpe_translation_rmse_m_per_s"] < 0.5 and ours["lost_pairs"] == 0
    configuration = json.loads(ours["configuration"])
    assert configuration["settings"]["solver"]["iterations"] == [0, 0, 15, 0, 0]
    assert configuration["sequence"]["camera"]["width"] == 160 and configuration["seed"] == 2
    assert "jax" in json.loads(ours["versions"]) and (ours["git_commit"], ours["git_modified"]) == git_state()


def test_without_the_library_for_tables_nothing_runs(small, tmp_path, monkeypatch):
    """It was missed after the first batch, whose results were lost."""
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    plan = read_plan(small, tmp_path / "out")
    with pytest.raises(GavoError, match="need pyarrow"):
        run_experiment(plan, Table(plan.folder), Interrupted(), lambda _: pytest.fail("it ran"))


def test_a_batch_that_fails_leaves_the_others(small, tmp_path):
    class Failing(LocalExecutor):
        def run(self, *arguments: Any, **options: Any) -> Iterator[Outcome]:
            first, *others = super().run(*arguments, **options)
            yield Outcome(first.batch, (), "frame 0: torn")
            yield from others

    plan, table = read_plan(small, tmp_path / "out"), Table(tmp_path / "out")
    finished = run_experiment(plan, table, Failing())
    assert finished.rows == 2 and len(finished.faults) == 1 and "frame 0: torn" in finished.faults[0]
    assert len(missing(plan, table)) == 2


def test_command(small, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["experiment", str(small), "--output", str(out), "--dry-run"]) == 0
    planned = capsys.readouterr().out
    assert "4 runs, 0 of them done; 4 to do in 3 batches, 1 compiled program," in planned and not out.exists()
    assert " frame pairs " in planned
    assert main(["experiment", str(small), "--output", str(out)]) == 0
    printed, news = capsys.readouterr()
    assert "0.04000" in printed and "lost: frame pairs without" in printed
    assert " paired runs " not in printed  # each of the two methods has a single result
    assert news.splitlines()[0] == f"synthetic: {LABEL}: 2 done"
    assert (out / "report.html").stat().st_size and (out / "drift.svg").stat().st_size
    assert main(["experiment", "report", str(out), "--markdown"]) == 0
    assert f"| {LABEL} | 3 | 0.1" in capsys.readouterr().out
    assert main(["experiment", "report", str(out)]) == 0
    again = capsys.readouterr().out
    assert again.splitlines()[-1] == printed.splitlines()[-1] and again.splitlines()[1] in printed


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["experiment", "nowhere.toml"], ["nowhere.toml", "no such file"]),
        (["experiment", "report", "nowhere"], ["nowhere", "no experiment results"]),
        (["experiment", "report"], ["no folder given"]),
        (["experiment", "report", "nowhere", "--dry-run"], ["report", "--dry-run"]),
        (["experiment", "report", "nowhere", "--output", "there"], ["report", "--output"]),
        (["tune", "nowhere.toml"], ["nowhere.toml"]),
    ],
)
def test_refusals_are_one_line(arguments, words, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert not captured.out and captured.err.count("\n") == 1 and all(word in captured.err for word in words)


TUNED = """
[space]
solver.damping = { low = 1e-6, high = 1e-2, log = true }
solver.iterations.4 = { low = 8, high = 9 }
alignment.robust_scale = [true, false]
"""


@pytest.fixture
def tuned(small) -> Path:
    path = small.with_name("tuned.toml")
    sequences = small.read_text().partition("[[methods]]")[0].partition("[[")[2]
    path.write_text(f'method = "gauss-newton"\npreset = "fast"\ntrials = 2\n[[{sequences}{TUNED}')
    return path


def test_tune(tuned, tmp_path, capsys, monkeypatch):
    def measured(sequences, preset, seeds):
        assert len(sequences[0]) == 34 and seeds == (0,)
        return preset.solver.damping, 1.0 / preset.solver.damping

    monkeypatch.setattr(tuning, "measure", measured)
    monkeypatch.setenv("COLUMNS", "120")
    out = tmp_path / "study"
    assert main(["tune", str(tuned), "--output", str(out)]) == 0
    assert "Pareto front" in capsys.readouterr().out and (out / "study.db").exists()
    assert main(["tune", str(tuned), "--output", str(out), "--trials", "5"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("trial ") == 3 + 1  # three more, and the table's heading
    front = json.loads((out / "front.json").read_text())
    assert len(front) == 5 and [f["milliseconds"] for f in front] == sorted(f["milliseconds"] for f in front)
    assert set(front[0]["settings"]) == {"solver.damping", "solver.iterations.4", "alignment.robust_scale"}


def test_a_study_says_which_sequences_it_skips(tuned, tmp_path, capsys, monkeypatch):
    """An optional one that is missing was left out without a word, as if the front were of all of them."""
    monkeypatch.setattr(tuning, "measure", lambda *_: (0.1, 1.0))
    tuned.write_text(tuned.read_text() + '\n[[sequences]]\npath = "nowhere"\noptional = true\n')
    assert main(["tune", str(tuned), "--output", str(tmp_path / "study")]) == 0
    assert "skipped nowhere: nowhere: no such folder" in capsys.readouterr().out


@pytest.mark.parametrize("drifts", [(np.inf, 0.1, np.inf), (np.inf,)])
def test_a_trial_that_loses_the_camera_is_one_of_many(tuned, tmp_path, capsys, monkeypatch, drifts):
    """It ended the study, which said that there was no ground truth."""
    told = iter(zip(drifts, (1.0, 3.0, 2.0), strict=False))
    monkeypatch.setattr(tuning, "measure", lambda *_: next(told))
    command = ["tune", str(tuned), "--output", str(tmp_path / "study"), "--trials", str(len(drifts))]
    assert main(command) == (0 if len(drifts) > 1 else 2)
    words = capsys.readouterr()
    assert "trial 0: lost the camera, 1.0 ms/pair" in words.out
    if len(drifts) > 1:
        assert [choice["trial"] for choice in json.loads((tmp_path / "study" / "front.json").read_text())] == [1]
    else:
        assert "every trial lost the camera" in words.err and words.err.count("\n") == 1


def test_an_interrupted_study_says_how_it_goes_on(tuned, tmp_path, capsys, monkeypatch):
    def stopped(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("gavo_jax.cli.tune.search", stopped)
    assert main(["tune", str(tuned), "--output", str(tmp_path / "study")]) == 130
    assert capsys.readouterr().err == "gavo: interrupted: the same command resumes from there\n"


def test_the_setting_says_whether_a_range_is_of_whole_numbers(tuned, tmp_path, monkeypatch):
    """Of a weight from 0 to 1 a study tried 0 and 1."""
    tried = []
    monkeypatch.setattr(tuning, "measure", lambda _, settings, seeds: (tried.append(settings.alignment) or 0.1, 1.0))
    weight = "alignment.depth_weight = { low = 0, high = 1 }"
    points = "alignment.points = { low = 600, high = 1250, step = 100 }"
    tuned.write_text(tuned.read_text().replace(TUNED, f"\n[space]\n{weight}\n{points}\n"))
    tune(read_tuning(tuned), f"sqlite:///{tmp_path / 's.db'}", 8)
    weights = [one.depth_weight[0] for one in tried]
    assert any(weight not in (0.0, 1.0) for weight in weights) and len(set(weights)) > 2
    assert {one.points for one in tried} <= {600, 700, 800, 900, 1000, 1100, 1200}
    tuned.write_text(tuned.read_text().replace("step = 100", "step = 0.5"))
    with pytest.raises(GavoError, match="space.alignment.points: step: must be a whole number, not 0.5"):
        read_tuning(tuned)


@pytest.mark.parametrize("truth", [True, False])
def test_frames_without_a_drift_are_refused_before_a_study_is_made(tuned, tmp_path, truth, capsys, monkeypatch):
    tuned.write_text(tuned.read_text().replace("frames = 34", "frames = 4" if truth else "frames = 34"))
    if not truth:
        monkeypatch.setattr(SyntheticSequence, "ground_truth", None)
    assert main(["tune", str(tuned), "--output", str(tmp_path / "study")]) == 2
    words = capsys.readouterr().err
    assert ("these frames last 0.10 s" if truth else "no ground truth") in words and words.count("\n") == 1
    assert not (tmp_path / "study" / "study.db").exists()


def test_what_a_trial_measures(tuned):
    preset = override(presets.preset("gauss-newton"), SMALL)
    drift, milliseconds = measure([read_tuning(tuned).parts[0].open()], preset, (0,))
    assert 0 < drift < 0.5 and milliseconds > 0


def test_what_a_trial_measures_of_a_camera_that_is_lost(tuned):
    preset = override(presets.preset("gauss-newton"), SMALL | {"alignment.min_overlap": 1.0})
    drift, _ = measure([read_tuning(tuned).parts[0].open()], preset, (0,))
    assert drift == np.inf


def test_loops_are_not_tuned_without_what_they_need(tuned, monkeypatch):
    """The first trial with them ended the study."""
    tuned.write_text(tuned.read_text() + "odometry.loops = [false, true]\n")
    assert read_tuning(tuned).space["odometry.loops"] == [False, True]
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(GavoError, match=r"space.odometry.loops: loops need GTSAM: pip install"):
        read_tuning(tuned)


@pytest.mark.parametrize(
    "space, words",
    [
        ("solver.dampng = [1.0]", ["'dampng'", "'damping'"]),
        ("solver.damping = { low = 1.0 }", ["low and high"]),
        ("solver.damping = { low = 0.0, high = 1.0, log = true }", ["log"]),
        ("solver.damping = { low = 0.1, high = 1.0, stp = 1 }", ["'stp'", "'step'"]),
        ("solver.damping = 3", ["space.solver.damping"]),
        ("", ["nothing to tune"]),
    ],
)
def test_what_tuning_refuses(write_experiment, space, words):
    path = write_experiment('method = "gauss-newton"', f"[space]\n{space}", name="t.toml")
    with pytest.raises(GavoError) as refused:
        read_tuning(path)
    assert all(word in str(refused.value) for word in (str(path), *words))


def test_an_unusable_storage_is_refused(tuned):
    with pytest.raises(GavoError, match="storage"):
        tune(read_tuning(tuned), "nosuchdatabase://x", 1)
