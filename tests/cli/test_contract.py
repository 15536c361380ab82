"""The installed command against the contract that its users hold it to, by their own script."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

AS_INSTALLED = "files_and_keys"
"""The part that runs with XLA's own settings, as users do, and not with those by which the tests compile sooner."""
PARTS = (AS_INSTALLED, "one_pair", "evaluate", "bad_input")


@pytest.fixture
def script(data_dir) -> Path:
    script = data_dir.parent / "tools" / "check-contract"
    if not script.is_file():
        pytest.skip("no tools/check-contract beside the folder of real clips")
    return script


def test_every_part_is_checked(script):
    assert tuple(re.findall(r"^def (\w+)\(work\)", script.read_text(), re.MULTILINE)) == PARTS


@pytest.mark.parametrize("part", PARTS)
def test_contract(script, part):
    gavo = shutil.which("gavo", path=str(Path(sys.executable).parent))
    assert gavo is not None, "the package is not installed: no command `gavo` beside this Python"
    left_out = "XLA_FLAGS" if part == AS_INSTALLED else None
    environment = {name: value for name, value in os.environ.items() if name != left_out}
    command = [sys.executable, script, "--gavo", gavo, "--only", part]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0 and done.stdout.rstrip().endswith("all hold"), done.stdout + done.stderr
