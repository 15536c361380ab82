"""The command against the contract that its users hold it to, by their own script."""

import contextlib
import io
import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from gavo_jax.cli import main

AS_INSTALLED = "files_and_keys"
"""The part that starts the installed command, with XLA's own settings as users do, not those that compile sooner."""
PARTS = (AS_INSTALLED, "one_pair", "evaluate", "bad_input")


@pytest.fixture
def script(data_dir) -> Path:
    script = data_dir.parent / "tools" / "check-contract"
    if not script.is_file():
        pytest.skip("no tools/check-contract beside the folder of real clips")
    return script


def test_every_part_is_checked(script):
    assert tuple(re.findall(r"^def (\w+)\(work\)", script.read_text(), re.MULTILINE)) == PARTS


def test_the_installed_command(script):
    gavo = shutil.which("gavo", path=str(Path(sys.executable).parent))
    assert gavo is not None, "the package is not installed: no command `gavo` beside this Python"
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    command = [sys.executable, script, "--gavo", gavo, "--only", AS_INSTALLED]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0 and done.stdout.rstrip().endswith("all hold"), done.stdout + done.stderr


@pytest.mark.parametrize("part", [part for part in PARTS if part != AS_INSTALLED])
def test_contract(script, part, capsys, monkeypatch):
    """In this process, where the script would start the command anew for every check."""
    start = subprocess.run

    def run(command: list[str], **options: Any) -> Any:
        if command[0] != "gavo":
            return start(command, **options)
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = main(command[1:])
        return subprocess.CompletedProcess(command, status, out.getvalue(), err.getvalue())

    monkeypatch.setattr(subprocess, "run", run)
    monkeypatch.setattr(sys, "argv", [str(script), "--gavo", "gavo", "--only", part])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    printed = capsys.readouterr().out
    assert not ended.value.code and printed.rstrip().endswith("all hold") and "ok    " in printed, printed
