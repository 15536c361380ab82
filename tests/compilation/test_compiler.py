"""Which JAX is allowed, and that no program of another processor is loaded."""

import os
import subprocess
import sys
import warnings
from importlib.metadata import version
from pathlib import Path

import pytest
from jax._src import compilation_cache

from gavo_jax.compilation import compiler
from gavo_jax.compilation.compiler import CompilerWarning, prepare_process, processor_digest, unfit_compiler


@pytest.fixture
def installed(monkeypatch):
    """Have a package look installed in another version."""

    def pretend(package: str, other: str) -> None:
        monkeypatch.setattr(compiler, "version", lambda name: other if name == package else version(name))

    return pretend


@pytest.mark.parametrize("package", ["jax", "jaxlib"])
@pytest.mark.parametrize("other", ["0.7.0", "0.8.1", "0.10.2", "0.11.0"])
def test_a_version_that_computes_wrong_numbers_is_told(installed, package, other):
    installed(package, other)
    told = unfit_compiler.__wrapped__()
    assert told is not None and "\n" not in told
    assert told.startswith(f"{package} {other} ") and "!=0.10.2" in told


@pytest.mark.parametrize("other", ["0.8.2", "0.10.1", "0.11.1", "0.12.0.1", "0.13.0.dev20270101"])
def test_other_versions_are_allowed(installed, other):
    installed("jaxlib", other)
    assert unfit_compiler.__wrapped__() is None


def test_this_one_is_allowed():
    assert unfit_compiler() is None


@pytest.mark.parametrize(
    ("words", "name", "is_warned"),
    [
        (["python", "program.py"], "program.py", True),
        (["python", "-m", "tool.run"], "-m", True),  # its package imports this one: argv is not the module's yet
        (["python", "-m", "gavo_jax", "doctor"], "-m", False),
        (["python", "/usr/bin/gavo", "doctor"], "/usr/bin/gavo", False),
    ],
)
def test_every_program_but_the_command_is_warned_of_wrong_numbers(monkeypatch, words, name, is_warned):
    monkeypatch.setattr(compiler, "unfit_compiler", lambda: "jax 0.11.0 may compute wrong numbers")
    monkeypatch.setattr(sys, "orig_argv", words)
    monkeypatch.setattr(sys, "argv", [name])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        prepare_process()
    assert [warning.category for warning in told] == [CompilerWarning] * is_warned


def test_two_processors_have_two_names(monkeypatch):
    own = processor_digest()
    assert own == processor_digest.__wrapped__()
    monkeypatch.setattr(compiler, "_cpuinfo", lambda: {"model name": "Another", "flags": "fpu sse2"})
    assert processor_digest.__wrapped__() != own


PROGRAM = """
import gavo_jax, jax, jax.numpy as jnp
gavo_jax.enable_compilation_cache()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
hits = []
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event.endswith("/cache_hits")))
print(float(jax.jit(lambda x: jnp.sin(x).sum())(jnp.ones(100))), sum(hits) > 0)
"""


def compile_in_another_process(folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Compile something with the cache in a folder; prints the result and whether it was loaded."""
    left_out = ("JAX_COMPILATION_CACHE_DIR", "TF_CPP_MIN_LOG_LEVEL")
    own = {name: value for name, value in os.environ.items() if name not in left_out}
    environment = {**own, "GAVO_CACHE_DIR": str(folder), **variables}
    command = [sys.executable, "-c", PROGRAM]
    return subprocess.run(command, capture_output=True, text=True, check=True, env=environment)


def mark(entry: Path) -> bool:
    """Have a kept program look compiled for an instruction that no machine has; whether there was one to rename."""
    content = compilation_cache.decompress_executable(entry.read_bytes())
    entry.write_bytes(compilation_cache.compress_executable(content.replace(b"+cmov", b"+cmox")))
    return b"+cmov" in content


def test_programs_are_kept_by_processor_and_their_loading_is_silent(tmp_path):
    first = compile_in_another_process(tmp_path)
    kept = tmp_path / "jax" / processor_digest()
    entries = list(kept.glob("*-cache"))
    assert first.stdout.endswith("False\n") and entries
    # XLA takes settings of its own for instructions that the machine lacks, and says so whenever it loads a program
    marked = [mark(entry) for entry in entries]
    second = compile_in_another_process(tmp_path)
    assert second.stdout.endswith("True\n") and second.stdout.split()[0] == first.stdout.split()[0]
    assert "cpu_aot_loader" not in second.stderr and "SIGILL" not in second.stderr
    if any(marked):
        assert "cpu_aot_loader" in compile_in_another_process(tmp_path, TF_CPP_MIN_LOG_LEVEL="0").stderr
    kept.rename(tmp_path / "jax" / "0123456789abcdef")
    assert compile_in_another_process(tmp_path).stdout.endswith("False\n")
