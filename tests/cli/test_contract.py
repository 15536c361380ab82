"""The installed command against the contract that its users hold it to, by their own script."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest


def test_contract(data_dir):
    script = data_dir.parent / "tools" / "check-contract"
    if not script.is_file():
        pytest.skip("no tools/check-contract beside the folder of real clips")
    gavo = shutil.which("gavo", path=str(Path(sys.executable).parent))
    assert gavo is not None, "the package is not installed: no command `gavo` beside this Python"
    as_installed = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    command = [sys.executable, script, "--gavo", gavo]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=as_installed)
    assert done.returncode == 0 and done.stdout.rstrip().endswith("all hold"), done.stdout + done.stderr
