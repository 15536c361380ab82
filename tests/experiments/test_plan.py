"""An experiment's file: what it comes to, and what is refused."""

import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from small import CAMERA

from gavo_jax.datasets.layouts.tum_writing import write_tum
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.experiments.plan import Part, batches, frames_of, programs
from gavo_jax.experiments.plan_file import read_plan
from gavo_jax.experiments.runner import fitted_batches
from gavo_jax.trajectory import Trajectory

GRID = """
[[methods]]
name = "ga"
presets = ["fast", "default"]
solver.patience = 5
sweep.solver.mutation_decay = [0.7, 0.9]
sweep.alignment.loss = ["huber", "l2"]
[[methods]]
name = "gauss-newton"
seeds = [7]
[[methods]]
name = "opencv-rgb"
"""


def test_a_grid(write_experiment, tmp_path):
    plan = read_plan(write_experiment("seeds = 3", GRID))
    assert plan.name == "small" and plan.folder == Path("runs/small")
    assert len(plan.runs) == 2 * 4 * 3 + 1 + 1 == len({run.id for run in plan.runs})
    labels = list(dict.fromkeys(run.label for run in plan.runs))
    assert labels[0] == "ga, fast, patience=5, mutation_decay=0.7, loss=huber"
    assert labels[-2:] == ["gauss-newton", "opencv-rgb"]
    assert [run.seed for run in plan.runs[-2:]] == [7, None]
    # the loss and the preset shape a program, the rate does not
    assert programs(plan.runs) == 2 * 2 + 1
    assert sorted(len(batch.runs) for batch in batches(plan.runs, 100)) == [1, 1, 6, 6, 6, 6]
    assert max(len(batch.runs) for batch in batches(plan.runs, 4)) == 4
    assert len(fitted_batches(plan.runs, 100, slots=13)) == 14


def test_runs_with_loops_are_alone_with_their_maps(write_experiment, monkeypatch):
    loops = '[[methods]]\nname = "ga"\nsweep.odometry.loops = [true, false]\n'
    plan = read_plan(write_experiment("seeds = 3", loops))
    assert [len(batch.runs) for batch in batches(plan.runs, 100)] == [1, 1, 1, 3]
    assert programs(plan.runs) == 1
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(GavoError, match=r"methods\[1\]: loops need GTSAM: pip install") as refused:
        read_plan(write_experiment("seeds = 3", loops))
    assert "\n" not in str(refused.value)


def test_a_run_is_known_by_what_it_does_not_by_where(write_experiment, tmp_path):
    first = read_plan(write_experiment("seeds = 2", GRID))
    (tmp_path / "elsewhere").mkdir()
    for name in ("small.toml", "camera.toml"):
        shutil.copy(tmp_path / name, tmp_path / "elsewhere" / name)
    again = read_plan(tmp_path / "elsewhere" / "small.toml")
    assert [run.id for run in again.runs] == [run.id for run in first.runs]
    longer = read_plan(write_experiment("seeds = 2", GRID, frames=5))
    assert not {run.id for run in longer.runs} & {run.id for run in first.runs}


def test_other_images_or_another_truth_are_another_sequence():
    """Two recordings of one name, of the same stamps and camera, had one another's results."""
    one, other = (SyntheticSequence(4, seed=seed, camera=CAMERA) for seed in (0, 1))
    same = SyntheticSequence(4, seed=0, camera=CAMERA)
    kinds = [frames_of("room", sequence) for sequence in (one, same, other)]
    assert kinds[0] == kinds[1] and kinds[0]["timestamps_sha256"] == kinds[2]["timestamps_sha256"]
    assert kinds[0]["images_sha256"] != kinds[2]["images_sha256"] and frames_of("hall", one) != kinds[0]


class Clocked(SyntheticSequence):
    """A room whose depth or truth is late, in seconds."""

    depth_late, truth_late = 0.0, 0.0

    def __getitem__(self, index: Any) -> Any:
        frame = super().__getitem__(index)
        return replace(frame, depth_timestamp=frame.timestamp + self.depth_late)

    @property
    def ground_truth(self) -> Trajectory:
        truth = super().ground_truth
        return Trajectory(truth.timestamps + self.truth_late, truth.world_T_camera)


@pytest.mark.parametrize("clock", ["depth_late", "truth_late"])
def test_other_clocks_are_another_sequence(clock: str) -> None:
    """A corrected delay of depth, or clock of the truth, left "0 to do" and the old errors."""
    room, late = Clocked(4, camera=CAMERA), Clocked(4, camera=CAMERA)
    assert frames_of("room", room) == frames_of("room", late)
    setattr(late, clock, 0.02)
    assert frames_of("room", room) != frames_of("room", late)


def test_a_camera_file_without_a_size_takes_the_images(write_experiment, tmp_path):
    """`gavo run` took such a file, and an experiment refused it."""
    write_tum(SyntheticSequence(frames=3, camera=CAMERA), tmp_path / "walk")
    (tmp_path / "matrix.txt").write_text("131 0 79.5\n0 131 59.5\n0 0 1\n")
    path = tmp_path / "walk.toml"
    path.write_text('[[sequences]]\npath = "walk"\ncamera = "matrix.txt"\n[[methods]]\nname = "ga"\n')
    (run,) = read_plan(path).runs
    assert run.pixels == 160 * 120 and run.pairs == 2


def test_a_dataset_of_ones_own_need_not_be_hashable(write_experiment, monkeypatch):
    class Own(SyntheticSequence):
        __hash__: Any = None

    monkeypatch.setattr(Part, "open", lambda part: Own(3, camera=CAMERA))
    (run,) = read_plan(write_experiment("", '[[methods]]\nname = "ga"\n')).runs
    assert run.pairs == 2


def test_a_folder_whose_name_has_brackets_is_found(tmp_path):
    write_tum(SyntheticSequence(frames=3, camera=CAMERA), tmp_path / "scan [2]")
    (tmp_path / "x.toml").write_text('[[sequences]]\npath = "scan [2]"\n[[methods]]\nname = "ga"\n')
    assert [run.part.name for run in read_plan(tmp_path / "x.toml").runs] == ["scan [2]"]


def test_globs_parts_and_missing_sequences(tmp_path, monkeypatch):
    for name in ("walk_a", "walk_b"):
        write_tum(SyntheticSequence(frames=6, camera=CAMERA), tmp_path / "data" / name)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("GAVO_DATA", "~/data")  # as an environment file has it
    shutil.copy(tmp_path / "data" / "walk_a" / "camera.toml", tmp_path)
    (tmp_path / "x.toml").write_text(
        """
        [[sequences]]
        path = "walk_*"
        camera = "camera.toml"
        [[sequences]]
        path = ["nowhere", "walk_b"]
        camera = "camera.toml"
        start = 1
        frames = 2
        stride = 2
        [[sequences]]
        path = "fr2_desk"
        name = "desk"
        optional = true
        [[methods]]
        name = "ga"
        printed = { walk_a = 0.5, desk = 0.25 }
        """
    )
    plan = read_plan(tmp_path / "x.toml")
    assert [(run.part.name, run.pairs) for run in plan.runs] == [("walk_a", 5), ("walk_b", 5), ("walk_b[1:5:2]", 1)]
    assert len(plan.skipped) == 1 and "desk" in plan.skipped[0] and "gavo download" in plan.skipped[0]
    assert plan.printed == {("walk_a", "ga"): 0.5}


METHOD = '[[methods]]\nname = "ga"\n'
REFUSED = {
    "unknown key": ("sedes = 3", METHOD, ["'sedes'", "'seeds'"]),
    "unknown key of a method": ("", METHOD + "preset = 'fast'", ["methods[1]", "'preset'", "'presets'"]),
    "unknown key of a sequence": ("[[sequences]]\npth = 'synthetic'", METHOD, ["sequences[1]", "'pth'", "'path'"]),
    "unknown hyperparameter": ("", METHOD + "solver.mutatoin_rate = 1", ["'mutatoin_rate'", "'mutation_rate'"]),
    "unknown swept one": ("", METHOD + "sweep.solver.presure = [1]", ["'presure'", "'pressure'"]),
    "unknown method": ("", '[[methods]]\nname = "gauss"', ["'gauss'", "'gauss-newton'"]),
    "unknown preset": ("", METHOD + "presets = ['quick']", ["presets", "'quick'"]),
    "unknown printed sequence": ("", METHOD + "printed.sinthetic = 1", ["'sinthetic'", "synthetic"]),
    "fixed and swept": (
        "",
        METHOD + "solver.pressure = 8\nsweep.solver.pressure = [4]",
        ["pressure", "a fixed value, too"],
    ),
    "a fixed entry of a swept schedule": (
        "",
        METHOD + "solver.population.4 = 48\nsweep.solver.population = [[16, 16, 16, 16, 16]]",
        ["population", "a fixed value, too"],
    ),
    "name of another folder": ('name = "../../x"', METHOD, ["name", "'../../x'", "cannot be a path"]),
    "name of the folder above": ('name = ".."', METHOD, ["name", "'..'", "cannot be a path"]),
    "no path": ("[[sequences]]\npath = []\n", METHOD, ["path: an empty list"]),
    "sweep without a list": ("", METHOD + "sweep.solver.pressure = 8", ["sweep.solver.pressure", "list"]),
    "settings of a peer": ("", '[[methods]]\nname = "opencv-rgb"\nseeds = 3', ["opencv-rgb", "'seeds'"]),
    "the same twice": ("", METHOD + METHOD, ["ga", "twice"]),
    "no methods": ("", "", ["methods"]),
    "seed of the wrong kind": ("seeds = 1.5", METHOD, ["seeds", "1.5"]),
    "seed too large": ("seeds = [4294967296]", METHOD, ["seeds"]),
    "one frame": ("[[sequences]]\nframes = 1", METHOD, ["sequences[1]: frames", "at least 2"]),
    "no such sequence": ("[[sequences]]\npath = 'nowhere'", METHOD, ["sequences[1]", "nowhere"]),
    "no TOML": ("seeds = ", METHOD, ["not TOML"]),
    "a number of 5000 digits": ("seeds = 1" + 5000 * "0", METHOD, ["not TOML"]),
    "ray": ("[ray]\ncpu = 2", METHOD, ["ray", "'cpu'", "'cpus'"]),
}


@pytest.mark.parametrize("top, rest, words", REFUSED.values(), ids=REFUSED.keys())
def test_what_is_refused(write_experiment, top, rest, words):
    path = write_experiment(top, rest)
    with pytest.raises(GavoError) as refused:
        read_plan(path)
    assert "\n" not in str(refused.value) and all(word in str(refused.value) for word in (str(path), *words))
