"""What a caller may mean by settings."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gavo_jax as gavo
from gavo_jax.settings import as_settings
from gavo_jax.settings_check import as_seed

NEWTON = gavo.GaussNewton()
ROBUST = gavo.AlignmentOptions(depth=False)


def test_nothing_is_the_default_preset():
    assert as_settings() == gavo.Settings() == gavo.preset("ga", "default")


def test_a_solver_stands_for_the_default_settings_with_it():
    assert as_settings(NEWTON) == as_settings(solver=NEWTON) == replace(gavo.Settings(), solver=NEWTON)
    assert as_settings(gavo.preset("pso", "fast"), NEWTON) == replace(gavo.preset("pso", "fast"), solver=NEWTON)


def test_the_name_of_a_method_is_told_what_gives_its_settings():
    with pytest.raises(TypeError, match=r"neither Settings nor a solver: str: gavo.preset\(METHOD, PRESET\) gives"):
        as_settings("fast")  # pyright: ignore[reportArgumentType]


def test_settings_of_a_file_stand_for_themselves(tmp_path):
    """What `load_settings` returns was refused, without a word on its part that holds them."""
    (tmp_path / "s.toml").write_text('method = "pso"\npreset = "fast"\n')
    assert as_settings(gavo.load_settings(tmp_path / "s.toml")) == gavo.preset("pso", "fast")  # pyright: ignore


@pytest.mark.parametrize("wrong", ["ga", gavo.AlignmentOptions(), gavo.GaussNewton])
def test_anything_else_is_told(wrong):
    with pytest.raises(TypeError, match="neither Settings nor a solver"):
        as_settings(wrong)


def test_a_solver_that_is_no_pytree_is_told():
    """It ended in an AttributeError of the compiler's cache."""

    class Own(gavo.GaussNewton):
        pass

    with pytest.raises(
        gavo.GavoError, match=r"solver: Own is not a pytree: decorate it with @jax\.tree_util\.register"
    ):
        as_settings(Own())


def test_parts_one_by_one_still_work_and_warn():
    with pytest.warns(DeprecationWarning, match="parts of the settings"):
        found = as_settings(None, NEWTON, alignment=ROBUST, odometry=None)
    assert found == gavo.Settings(NEWTON, ROBUST)


@pytest.mark.parametrize(("old", "new"), [("get_preset", "preset"), ("Preset", "Settings")])
def test_old_names_still_work_and_warn(old, new):
    with pytest.warns(DeprecationWarning, match=f"gavo_jax.{new}"):
        assert getattr(gavo, old) is getattr(gavo, new)
    with pytest.raises(AttributeError):
        gavo.no_such_name  # noqa: B018


@pytest.mark.parametrize(
    "part, name, value, words",
    [
        ("solver", "population", -1, "solver.population: must be at least 4, not -1"),
        ("solver", "population", (0, 16, 16, 16, 2), "solver.population, level 4: must be at least 4, not 2"),
        ("solver", "iterations", 10, "solver.iterations: must be a list of 5 whole numbers, not 10"),
        ("solver", "iterations", [0, 0, 0, 0, 3], "use a tuple"),
        ("solver", "iterations", (0,) * 5, "solver.iterations: every level has 0"),
        ("solver", "iterations", (-1, 0, 0, 6, 8), "solver.iterations: must be at least 0, not -1"),
        ("solver", "patience", 0, "solver.patience: must be at least 1, not 0"),
        ("solver", "mutants", 1.5, "solver.mutants: must be at most 1, not 1.5"),
        ("solver", "mutation_rate", None, "solver.mutation_rate: must be a number, not None"),
        ("alignment", "points", 0, "alignment.points: must be at least 1, not 0"),
        ("alignment", "points", "many", "alignment.points: must be a whole number, none or a list of 5 whole numbers"),
        ("alignment", "depth", 1, "alignment.depth: must be true or false, not 1"),
        ("alignment", "loss", "huber", "alignment.loss: must be a function, not 'huber'"),
        ("alignment", "bounds", (0.1, 0.2, 0.3), "alignment.bounds: must be a list of 2 numbers"),
        ("alignment", "min_overlap", float("nan"), "alignment.min_overlap: must be a number, not nan"),
        (
            "odometry",
            "bodies",
            np.array(["off", "mask"]),
            "odometry.bodies: must be one of off, mask, track, not array",
        ),
        ("odometry", "bodies", True, "odometry.bodies: must be one of off, mask, track, not True"),
    ],
)
def test_values_by_hand_are_checked_where_they_are_used(part, name, value, words):
    settings = gavo.Settings()
    changed = replace(settings, **{part: replace(getattr(settings, part), **{name: value})})
    with pytest.raises(gavo.GavoError, match=re.escape(words)):
        as_settings(changed)


@pytest.mark.parametrize("part", ["solver", "alignment", "odometry"])
def test_a_part_of_another_kind_is_told(part):
    with pytest.raises(gavo.GavoError, match=f"settings: {part}: must be of type"):
        as_settings(replace(gavo.Settings(), **{part: gavo.Settings()}))


def test_numbers_of_arrays_and_what_is_traced_are_numbers():
    def same(rate):
        solver = gavo.GeneticAlgorithm(population=16, mutation_rate=rate)
        return as_settings(solver).solver is solver

    assert all(same(rate) for rate in (np.float32(0.2), jnp.float32(0.2), 1))
    assert jax.jit(lambda rate: rate * same(rate))(0.2) == jnp.float32(0.2)


def test_a_seed_is_a_whole_number_that_keys_take():
    """Of a larger one JAX took the last 32 bits: 2**32 was seed 0. Others ended in words of arrays."""
    assert [as_seed(seed) for seed in (0, np.int64(3), jnp.int32(4), 2**32 - 1)] == [0, 3, 4, 2**32 - 1]
    for wrong in ("1", 1.5, None, -1, 2**32, 2**70, float("nan"), np.array([1, 2]), jax.random.key(3)):
        with pytest.raises(gavo.GavoError, match="seed: must be a whole number from 0 to 4294967295, not"):
            as_seed(wrong)
