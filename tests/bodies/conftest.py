"""What tests of bodies share."""

import importlib
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture
def clips(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The benchmark's, with a card put in."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    return importlib.import_module("moving_clips")
