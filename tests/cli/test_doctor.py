"""`gavo doctor`: what it prints and when it says that something is off; other subcommands beside a ruled-out JAX."""

import os
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path

import jax
import numpy as np
import pytest
from command import Done, runner

from gavo_jax import presets
from gavo_jax.compilation import compiler
from gavo_jax.datasets import registry
from gavo_jax.selfcheck import checks
from gavo_jax.version import __version__

RULED_OUT = "jax 0.0.1 may compute wrong numbers and is ruled out: pip install 'jax>=0.8.2'"


@pytest.fixture
def gavo(capsys, monkeypatch, tmp_path):
    """Run the command with a cache folder of its own, a fit compiler and two cheap checks."""
    monkeypatch.setenv("GAVO_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(compiler, "unfit_compiler", lambda: None)
    cheap = {name: checks.CHECKS[name]._replace(sizes=(300,)) for name in ("inverse", "warp")}
    monkeypatch.setattr(checks, "CHECKS", cheap)
    monkeypatch.setattr(checks, "scoring_nanoseconds", lambda: 12.34)
    return runner(capsys)


def test_doctor_tells_what_an_issue_report_needs(gavo, tmp_path):
    done = gavo("doctor")
    assert done.status == 0, done
    lines = dict(line.split(": ", 1) for line in done.out.splitlines() if ": " in line)
    assert lines["gavo-jax"] == __version__
    assert lines["jax"] == jax.__version__ and lines["numpy"] == np.__version__
    assert {"jaxlib", "opencv-python-headless", "python", "system", "devices"} <= set(lines)
    assert "cpu cpu" not in lines["devices"] and lines["devices"]
    assert f"{os.cpu_count()} cores" in lines["processor"] and compiler.processor() in lines["processor"]
    assert lines["cache"].startswith(str(tmp_path / "cache")) and lines["cache"].endswith("writable")
    assert {f"extra {name}" for name in ("plot", "viewer", "download", "ray", "tune", "peers", "cuda")} <= set(lines)
    assert "extra test" not in lines
    assert done.out.count("check ok: ") == 2 and "inverse of 300 motions: off by " in done.out
    assert lines["speed"].startswith("12.3 ns per pixel and candidate")
    assert done.out.endswith("all is well\n") and not done.err
    assert max(map(len, done.out.splitlines())) < 160


def test_doctor_counts_the_programs_that_are_kept(gavo, tmp_path, monkeypatch):
    folder = tmp_path / "cache" / "jax" / "processor"
    folder.mkdir(parents=True)
    for name in ("a-cache", "a-atime", "b-cache"):
        (folder / name).write_bytes(bytes(2**20))
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert "cache: ~/cache, 2 programs, 2.0 MiB" in gavo("doctor").out


def test_doctor_tells_a_wrong_number(gavo, monkeypatch):
    right = checks.rigid_inverse
    monkeypatch.setattr(checks, "rigid_inverse", lambda motions: right(motions).at[200:].multiply(1.01))
    done = gavo("doctor")
    assert done.status == 1 and "check WRONG: inverse of 300 motions: off by " in done.out
    assert "check ok: warp of 300 points" in done.out
    assert done.out.endswith("problems found: inverse of 300 motions\n")


def test_doctor_tells_packages_that_cannot_be_loaded(gavo, monkeypatch):
    entries = {
        module.PLUGINS: [EntryPoint("broken", "no_such_package:KIND", module.PLUGINS)] for module in (presets, registry)
    }
    for module in (presets, registry):
        monkeypatch.setattr(module, "entry_points", lambda group: entries[group])
        monkeypatch.setattr(module, "faulty_plugins", cache(module.faulty_plugins.__wrapped__))
    done = gavo("doctor")
    for what in ("method", "dataset"):
        assert f"plugin: WRONG: {what} 'broken' of no_such_package:KIND: cannot be loaded: No module" in done.out
    assert done.status == 1 and not done.err
    assert done.out.endswith("problems found: packages that bring methods or datasets\n")


def test_doctor_tells_a_compiler_that_is_ruled_out(gavo, monkeypatch):
    monkeypatch.setattr(compiler, "unfit_compiler", lambda: RULED_OUT)
    done = gavo("doctor")
    assert done.status == 1 and f"compiler: WRONG: {RULED_OUT}\n" in done.out and not done.err
    assert done.out.endswith("problems found: the version of JAX\n")


@pytest.mark.filterwarnings("ignore:.*no programs are kept:gavo_jax.GavoWarning")
def test_doctor_tells_a_cache_that_keeps_nothing(gavo, tmp_path, monkeypatch):
    file = tmp_path / "file"
    file.touch()
    monkeypatch.setenv("GAVO_CACHE_DIR", str(file / "cache"))
    done = gavo("doctor")
    assert done.status == 1 and "NOT writable" in done.out
    assert done.out.endswith("problems found: the cache folder\n")


@pytest.mark.parametrize(
    "arguments", [("run",), ("compare",), ("view", "x"), ("align", *"abcd"), ("evaluate", "a", "b"), ("tune", "x")]
)
def test_no_other_subcommand_runs_on_a_compiler_that_is_ruled_out(gavo, monkeypatch, arguments):
    monkeypatch.setattr(compiler, "unfit_compiler", lambda: RULED_OUT)
    assert gavo(*arguments) == Done(2, "", f"gavo: {RULED_OUT}\n")


def test_help_and_version_do(gavo, monkeypatch):
    monkeypatch.setattr(compiler, "unfit_compiler", lambda: RULED_OUT)
    assert gavo("--version").status == 0 and "doctor" in gavo("--help").out
    assert gavo("doctor", "--help").status == 0
    refused = gavo("doctor", "--nonsense")
    assert refused.status == 2 and "gavo doctor --help" in refused.err
