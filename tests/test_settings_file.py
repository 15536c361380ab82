"""Hyperparameters by name."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import optax
import pytest

from gavo_jax import presets
from gavo_jax.cli.options import Run
from gavo_jax.cli.selection import settings_line
from gavo_jax.errors import GavoError
from gavo_jax.objective.losses import huber
from gavo_jax.output.files import describe
from gavo_jax.settings import Settings
from gavo_jax.settings_file import assignments, flatten, load_settings, override, save_settings
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.solvers.genetic import GeneticAlgorithm
from gavo_jax.solvers.gradient import GradientDescent


def test_the_loss_of_a_method_that_was_registered_keeps_its_name():
    """config.json of such a run could not be given back, and was told to take another loss."""

    def my_huber(s):
        return huber(s)

    own = replace(presets.preset(), alignment=replace(presets.preset().alignment, loss=my_huber))
    assert override(own, {"alignment.loss": "my_huber"}) == own
    assert override(own, {"alignment.loss": "huber"}).alignment.loss is huber


def test_values_of_every_kind():
    values = {
        "solver.mutation_decay": 1,
        "solver.population": [0, 8, 8, 8, 8],
        "solver.iterations.4": 3,
        "solver.spread": 2.5,
        "solver.mutation_step": "none",
        "solver.surrogate": False,
        "alignment.loss": "huber",
        "alignment.outside_cost": 0.5,
        "alignment.bounds": [0.1, 0.2],
        "odometry.on_lost": "stop",
    }
    preset = override(presets.preset("ga", "default"), values)
    assert isinstance(preset.solver, GeneticAlgorithm)
    assert preset.solver.mutation_decay == 1.0 and isinstance(preset.solver.mutation_decay, float)
    assert preset.solver.population == (0, 8, 8, 8, 8) and preset.solver.iterations[3:] == (10, 3)
    assert preset.solver.spread == (2.5,) * 5 and preset.solver.mutation_step is None
    assert preset.solver.surrogate is False and preset.alignment.loss is huber
    assert preset.alignment.outside_cost == 0.5 and preset.alignment.bounds == (0.1, 0.2)
    assert preset.odometry.on_lost == "stop"
    for name in ("default", "fast", "paper"):
        for points in (900, [1200 * (name == "paper"), 900, 600, 300, 300]):
            chosen = override(presets.preset("ga", name), {"alignment.points": points}).alignment.points
            assert chosen == (points if isinstance(points, int) else tuple(points))
        assert override(presets.preset("ga", name), {"alignment.points": "none"}).alignment.points is None
    by_lion = override(presets.preset("adam"), {"solver.optimizer": "lion"}).solver
    assert isinstance(by_lion, GradientDescent) and by_lion.optimizer is optax.lion


@pytest.mark.parametrize(
    "name, value, words",
    [
        ("solver.mutaton_rate", 0.1, ["'mutaton_rate'", "'mutation_rate'"]),
        ("slover.patience", 1, ["'slover'", "'solver'"]),
        ("alignment.loss", "hubert", ["'hubert'", "'huber'"]),
        ("solver.mutation_rate", "high", ["mutation_rate", "number"]),
        ("solver.mutation_rate", True, ["mutation_rate", "number"]),
        ("solver.mutation_rate", float("nan"), ["mutation_rate", "number"]),
        ("solver.mutation_rate", "none", ["mutation_rate", "cannot be none"]),
        ("solver.mutation_rate", 0.9, ["solver.mutation_rate applies only if solver.mutation_step is none"]),
        ("solver.patience", 2.5, ["patience", "whole"]),
        ("solver.patience", -1, ["patience", "at least 1"]),
        ("solver.population", [16, 16], ["population", "list of 5 whole numbers"]),
        ("solver.population", [0, 16, 20, 24, 2], ["population", "level 4"]),
        ("solver.population.5", 16, ["population.5", "no such entry"]),
        ("solver.population.-1", 16, ["population.-1", "no such entry"]),
        ("solver.population.x", 16, ["population.x", "no such entry"]),
        ("solver.population", 3, ["population", "at least 4"]),
        ("solver.iterations", 16, ["iterations", "list of 5 whole numbers"]),
        ("solver.iterations", [0, 0, 0, 0, 0], ["iterations"]),
        ("solver.iterations.4", "many", ["iterations", "list of 5 whole numbers"]),
        ("solver.iterations", [[1]], ["iterations", "list of 5 whole numbers"]),
        ("alignment.points", [900, 900], ["points", "list of 5"]),
        ("alignment.points", 0.5, ["points", "whole"]),
        ("alignment.points", 0, ["points", "at least 1"]),
        ("alignment.points", [0, 900, 900, 0, 900], ["points, level 3", "at least 1"]),
        ("alignment.islands", [1, 1, 1, 1, 0], ["islands", "at least 1"]),
        ("alignment.depth_weight", -1, ["depth_weight", "at least 0"]),
        ("alignment.bounds", 0, ["bounds", "at least"]),
        ("odometry.keyframe_overlap", -0.1, ["keyframe_overlap", "at least 0"]),
        ("odometry.keyframe_overlap", 70, ["keyframe_overlap", "at most 1"]),
        ("odometry.on_lost", "panic", ["on_lost", "hold, predict, stop"]),
        ("odometry.prior", 1, ["prior", "true or false"]),
        ("solver.mutants", [[1], [1, 2]], ["mutants", "must be a number"]),
        ("solver.population.4", [1], ["population", "whole number"]),
    ],
)
def test_what_is_refused(name, value, words):
    with pytest.raises(GavoError) as refused:
        override(presets.preset("ga", "default"), {name: value}, "file.toml: methods[1]")
    assert all(word in str(refused.value) for word in ("file.toml: methods[1]", *words))


def test_a_rate_that_does_not_count_is_read_from_a_file_of_every_setting(tmp_path):
    default = presets.preset("ga")
    settings = replace(default, solver=replace(default.solver, mutation_rate=0.9))
    save_settings(tmp_path / "settings.toml", settings)
    assert load_settings(tmp_path / "settings.toml").settings == settings


def test_a_rate_counts_without_a_step():
    values = {"solver.mutation_step": "none", "solver.mutation_rate": 0.9}
    solver = override(presets.preset("ga"), values).solver
    assert isinstance(solver, GeneticAlgorithm) and solver.mutation_rate == 0.9
    override(presets.preset("ga", "paper"), {"solver.mutation_rate": 0.9})
    override(presets.preset("ga"), {"solver.mutation_rate": 0.1})  # as it is


def test_nested_tables_have_dotted_names():
    assert flatten("", {"solver": {"population": {"4": 8}, "patience": 3}}) == {
        "solver.population.4": 8,
        "solver.patience": 3,
    }


@pytest.mark.parametrize("method", presets.METHODS)
@pytest.mark.parametrize("name", presets.PRESETS)
def test_every_preset_comes_back_from_its_file(method, name, tmp_path):
    settings = presets.preset(method, name)
    save_settings(tmp_path / "settings.toml", settings)
    assert load_settings(tmp_path / "settings.toml").settings == settings
    described = {room: describe(getattr(settings, room)) for room in ("solver", "alignment", "odometry")}
    config = {"options": {"method": method, "preset": name, "seed": 3}, "device": "cpu", **described}
    (tmp_path / "config.json").write_text(json.dumps(config))
    assert load_settings(tmp_path / "config.json") == (method, name, settings)


@pytest.mark.parametrize("other", [None, "fast", presets.preset("ga").solver])
def test_what_are_no_settings_is_not_written(tmp_path, other):
    with pytest.raises(GavoError, match=rf"s\.toml: expected Settings, got {type(other).__name__}"):
        save_settings(tmp_path / "s.toml", other)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({}, "no settings: a run's config.json has solver, alignment, odometry"),
        ({"method": "gauss-newton", "preset": "fast", "segments": 1}, "no settings"),
        ({"alignment": {}, "odometri": {}}, "unknown key 'odometri'; did you mean 'odometry'?"),
    ],
)
def test_json_that_holds_no_settings_is_refused(table, words, tmp_path):
    """Of a metrics.json nothing was taken, and the default was run without a word."""
    (tmp_path / "metrics.json").write_text(json.dumps(table))
    with pytest.raises(GavoError, match=re.escape(words)):
        load_settings(tmp_path / "metrics.json")


def test_a_run_says_what_it_takes_of_an_earlier_one(tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    earlier = Run(sequence=str(tmp_path), seed=3, frames=40)
    path.write_text(json.dumps({"options": describe(earlier)}))
    same = replace(earlier, settings=path, output=tmp_path / "out", viewer="web")
    assert settings_line(same) == f"only the settings of {path} are used; frames and seed are the same"
    line = settings_line(Run(settings=path, frames=40))
    assert line and line.endswith(f"are used; sequence synthetic (there {tmp_path}), seed 0 (there 3)")
    assert settings_line(earlier) is None and settings_line(replace(earlier, settings=tmp_path / "some.toml")) is None


def test_a_file_says_what_differs(tmp_path):
    path = tmp_path / "own.toml"
    path.write_text('method = "pso"\npreset = "fast"\n[solver]\npatience = 4\n[alignment]\nloss = "huber"\n')
    method, name, settings = load_settings(path)
    fast = presets.preset("pso", "fast")
    assert (method, name) == ("pso", "fast")
    assert settings == replace(
        fast, solver=replace(fast.solver, patience=4), alignment=replace(fast.alignment, loss=huber)
    )
    path.write_text("[solver]\ndamping = 0.5\n")
    assert load_settings(path, "gauss-newton").settings.solver == GaussNewton(damping=0.5)


@pytest.mark.parametrize(
    "text, words",
    [
        ("solver = 3", ["solver", "not a table"]),
        ("[solver]\npatiense = 3", ["'patiense'", "'patience'"]),
        ("[solvr]\npatience = 3", ["'solvr'", "'solver'"]),
        ('preset = "quick"', ["preset", "'quick'"]),
        ('method = "gauss"', ["method", "'gauss-newton'"]),
        ("method = ", ["not TOML"]),
    ],
)
def test_a_wrong_file_is_one_line(text, words, tmp_path):
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(GavoError) as refused:
        load_settings(path)
    assert all(word in str(refused.value) for word in (str(path), *words)) and "\n" not in str(refused.value)


def test_a_name_without_its_part_is_told_with_it():
    for name, whole in (("points", "alignment.points"), ("population.4", "solver.population"), ("solvr.a", "solver")):
        with pytest.raises(GavoError, match=f"did you mean '{whole}'"):
            override(presets.preset("ga", "default"), {name: 3})


def test_somebody_elses_code_is_not_written(tmp_path):
    class Own(GeneticAlgorithm):
        """Its name would not be known to who reads it."""

    with pytest.raises(GavoError, match="cannot store a Own: not a solver of this package"):
        save_settings(tmp_path / "settings.toml", Settings(Own()))
    own = replace(presets.preset(), alignment=replace(presets.preset().alignment, loss=lambda s: s))
    with pytest.raises(GavoError, match="loss"):
        save_settings(tmp_path / "settings.toml", own)
    assert not (tmp_path / "settings.toml").exists()


def test_assignments_are_toml_or_words():
    assert assignments(["alignment.points=2400", "solver.spread = [1, 2.5]", "alignment.loss=huber", "a=none"]) == {
        "alignment.points": 2400,
        "solver.spread": [1, 2.5],
        "alignment.loss": "huber",
        "a": "none",
    }
    digits = "1" + 5000 * "0"
    assert assignments([f"a={digits}"]) == {"a": digits}, "no number that a setting could take"
    for wrong in ("alignment.points", "=3", "a="):
        with pytest.raises(GavoError, match="NAME=VALUE"):
            assignments([wrong])


def test_numbers_of_arrays_are_written_as_numbers(tmp_path):
    numbers: dict[str, Any] = {"mutants": np.float32(0.25), "patience": np.int64(5), "spread": (jnp.float32(0.5),) * 5}
    solver = GeneticAlgorithm(**numbers)
    save_settings(tmp_path / "s.toml", Settings(solver))
    again = load_settings(tmp_path / "s.toml").settings.solver
    assert again == GeneticAlgorithm(mutants=0.25, patience=5, spread=(0.5,) * 5)


def test_settings_out_of_range_are_not_written(tmp_path):
    with pytest.raises(GavoError, match=r"s\.toml: solver\.mutants: must be at most 1"):
        save_settings(tmp_path / "s.toml", Settings(GeneticAlgorithm(mutants=2.0)))
    assert not (tmp_path / "s.toml").exists()


@pytest.mark.parametrize(("method", "preset"), [("pso", "default"), (None, "nosuch")])
def test_what_could_not_be_read_again_is_not_written(tmp_path, method, preset):
    with pytest.raises(GavoError, match=r"pso is not that of a GeneticAlgorithm|nosuch"):
        save_settings(tmp_path / "s.toml", presets.preset("ga", "fast"), method, preset)
    assert not (tmp_path / "s.toml").exists()
