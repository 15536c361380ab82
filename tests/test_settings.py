"""What a caller may mean by settings."""

from dataclasses import replace

import pytest

import gavo_jax as gavo
from gavo_jax.settings import as_settings

NEWTON = gavo.GaussNewton()
ROBUST = gavo.AlignmentOptions(depth=False)


def test_nothing_is_the_default_preset():
    assert as_settings() == gavo.Settings() == gavo.preset("ga", "default")


def test_a_solver_stands_for_the_default_settings_with_it():
    assert as_settings(NEWTON) == as_settings(solver=NEWTON) == replace(gavo.Settings(), solver=NEWTON)
    assert as_settings(gavo.preset("pso", "fast"), NEWTON) == replace(gavo.preset("pso", "fast"), solver=NEWTON)


@pytest.mark.parametrize("wrong", ["ga", gavo.AlignmentOptions(), gavo.GaussNewton])
def test_anything_else_is_told(wrong):
    with pytest.raises(TypeError, match="neither Settings nor a solver"):
        as_settings(wrong)


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
