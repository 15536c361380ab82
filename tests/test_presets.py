"""Names of methods: ours, and those of others."""

from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint
from typing import Any

import jax
import numpy as np
import pytest

from gavo_jax import presets
from gavo_jax.camera import Camera
from gavo_jax.errors import GavoError
from gavo_jax.image.pyramid import LEVELS
from gavo_jax.settings import Settings
from gavo_jax.settings_file import load_settings, save_settings
from gavo_jax.solvers.gauss_newton import GaussNewton

QUICK = GaussNewton(iterations=(0, 0, 0, 0, 5))


@pytest.fixture(autouse=True)
def _nothing_is_registered(monkeypatch):
    monkeypatch.setattr(presets, "_registered", {})
    presets.faulty_plugins.cache_clear()
    yield
    presets.faulty_plugins.cache_clear()


def test_a_registered_method_has_a_name_and_one_preset():
    presets.register("quick", QUICK)
    assert presets.methods() == (*presets.METHODS, "quick")
    assert presets.preset("quick") == Settings(QUICK)
    with pytest.raises(GavoError, match="no preset 'fast'"):
        presets.preset("quick", "fast")


def test_settings_know_the_names_they_go_by():
    named = [(method, name) for method in presets.METHODS for name in presets.PRESETS]
    assert [presets.names_of(presets.preset(*names)) for names in named] == named
    assert presets.names_of(Settings(QUICK)) == ("gauss-newton", None)
    presets.register("quick", QUICK)
    assert presets.names_of(Settings(QUICK)) == ("quick", "default")
    fast = presets.preset("ga", "fast")
    weights = replace(fast, alignment=replace(fast.alignment, depth_weight=np.full(5, 0.1, np.float32)))
    assert presets.names_of(weights) == ("ga", None)


@pytest.mark.parametrize("name", ["ga", "", "Quick", "a b", "--help"])
def test_names_that_cannot_be(name):
    with pytest.raises(GavoError, match="cannot be the name"):
        presets.register(name, QUICK)


def test_an_installed_package_brings_a_method(monkeypatch):
    entry = EntryPoint("quick", "tests_of_presets:QUICK", presets.PLUGINS)
    monkeypatch.setattr(presets, "entry_points", lambda group: [entry] if group == presets.PLUGINS else [])
    monkeypatch.setattr(EntryPoint, "load", lambda self: QUICK)
    assert presets.preset("quick").solver == QUICK


def test_a_broken_package_is_one_line_and_only_where_it_is_asked_for(monkeypatch, tmp_path):
    entries = [EntryPoint(name, "no_such_package:SOLVER", presets.PLUGINS) for name in ("broken", "ga")]
    monkeypatch.setattr(presets, "entry_points", lambda group: entries)
    with pytest.raises(GavoError, match="'broken' of no_such_package:SOLVER: cannot be loaded: No module named"):
        presets.preset("broken")
    assert presets.methods() == (*presets.METHODS, "broken")
    assert presets.names_of(presets.preset("ga", "fast")) == ("ga", "fast")
    save_settings(tmp_path / "own.toml", presets.preset("ga"))
    assert load_settings(tmp_path / "own.toml").method == "ga"


def test_a_method_that_cannot_be_loaded_is_no_suggestion(monkeypatch, tmp_path):
    monkeypatch.setattr(presets, "entry_points", lambda group: [EntryPoint("gapp", "no_such_package:S", group)])
    (tmp_path / "own.toml").write_text('method = "gap"\n')
    with pytest.raises(GavoError, match=r"unknown name 'gap'; did you mean 'ga'\?"):
        load_settings(tmp_path / "own.toml")
    with pytest.raises(GavoError, match=r"not one of ga, pso, gauss-newton, adam$"):
        presets.preset("gap")
    (tmp_path / "own.toml").write_text('method = "gapp"\n')
    with pytest.raises(GavoError, match="cannot be loaded"):
        load_settings(tmp_path / "own.toml")


def test_a_method_that_is_registered_goes_before_a_broken_package_of_its_name(monkeypatch, tmp_path):
    """Then it is what the name stands for, and settings of it can be kept."""
    monkeypatch.setattr(presets, "entry_points", lambda group: [EntryPoint("quick", "no_such_package:S", group)])

    @jax.tree_util.register_dataclass
    @dataclass(frozen=True)
    class Own(GaussNewton):
        """Its type tells whose it is."""

    presets.register("quick", Own(iterations=(0, 0, 0, 0, 5)))
    save_settings(tmp_path / "own.toml", presets.preset("quick"))
    assert 'method = "quick"' in (tmp_path / "own.toml").read_text()
    assert load_settings(tmp_path / "own.toml").settings == presets.preset("quick")


def test_unknown_names_are_refused():
    with pytest.raises(GavoError, match="not one of ga, pso, gauss-newton, adam"):
        presets.preset("genetic")
    with pytest.raises(GavoError, match="not one of default"):
        presets.preset("ga", "quick")


@pytest.mark.parametrize("name", [None, [], np.eye(4), presets.preset("ga")])
def test_what_is_no_name_is_refused(name: Any) -> None:
    with pytest.raises(GavoError, match="unknown method"):
        presets.preset(name)
    with pytest.raises(GavoError, match="unknown preset"):
        presets.preset("ga", name)
    with pytest.raises(GavoError, match="unknown camera"):
        Camera.preset(name)


def test_every_preset_has_a_solver_for_all_levels():
    for method in presets.METHODS:
        for name in presets.PRESETS:
            settings = presets.preset(method, name)
            assert len(settings.solver.iterations) == len(settings.alignment.islands) == LEVELS
            assert settings.solver.levels[0] == 4
    assert presets.preset("ga", "paper").solver.levels[-1] == 0
    for bad in (("simplex", "default"), ("ga", "best")):
        with pytest.raises(GavoError, match="unknown"):
            presets.preset(*bad)


@pytest.mark.parametrize(("name", "settings"), [("mine", None), (3, GaussNewton())])
def test_nothing_is_no_method(name, settings):
    with pytest.raises(GavoError, match="settings or a solver|cannot be the name"):
        presets.register(name, settings)
    assert name not in presets.methods()
