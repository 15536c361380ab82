"""Names of files and sequences are other people's words: whatever they are, they do not command the terminal."""

import errno
import io
import os
import pty
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from command import runner

from gavo_jax.cli import main

EVIL = "cl\x1b]0;gotcha\x07\x1b[31m\x9bip [b] {task} %s $\\frac$\n"


@pytest.fixture
def gavo(capsys, monkeypatch, tmp_path, forty_frames):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(forty_frames, tmp_path / EVIL)
    (Path(EVIL) / "camera.toml").rename("camera.toml")
    return runner(capsys)


EXPERIMENT = """
[[sequences]]
path = "cl*"
camera = "camera.toml"
[[methods]]
name = "opencv-rgb"
[[methods]]
name = "opencv-rgbd"
"""
RUN = ("run", EVIL, "--camera", "camera.toml", "--method", "gauss-newton", "--frames", "34", "--output", "run" + EVIL)
COMMANDS = {
    "run": (0, RUN),
    "nothing to resume": (0, (*RUN, "--resume")),
    "evaluate": (0, ("evaluate", f"{EVIL}/groundtruth.txt", f"{EVIL}/groundtruth.txt")),
    "compare": (
        0,
        ("compare", EVIL, "--camera", "camera.toml", "--methods", "opencv-rgb", "--output", "compare" + EVIL),
    ),
    "experiment": (0, ("experiment", "e.toml", "--output", "table" + EVIL)),
    "markdown": (0, ("experiment", "report", "table" + EVIL, "--markdown")),
    "unknown method": (2, ("run", "--method", EVIL)),
    "unknown option": (2, ("run", EVIL, f"--{EVIL}")),
    "no number": (2, ("run", "--frames", EVIL)),
    "no camera": (2, ("run", EVIL, "--camera", EVIL)),
    "no file": (2, ("evaluate", EVIL + "x", EVIL)),
    "setting": (2, ("run", "--set", EVIL)),
    "download": (2, ("download", EVIL)),
    "no settings": (2, ("run", "--settings", EVIL)),
    "tune": (2, ("tune", EVIL)),
}


def test_no_name_commands_the_terminal(gavo):
    Path("e.toml").write_text(EXPERIMENT)
    for name, (status, words) in COMMANDS.items():
        done = gavo(*words)
        assert done.status == status, (name, done.err)
        for line in (done.out + done.err).splitlines():
            assert line.isprintable(), (name, line)
        assert status == 0 or done.err.count("\n") == 1, (name, done.err)


@pytest.mark.skipif(os.name != "posix", reason="makes a terminal")
def test_on_a_terminal_too(gavo, tmp_path):
    """Where colours and bars are drawn: these are the only commands."""
    for words, status in ((RUN, 0), (("download", EVIL, "--to", "data"), 2)):
        mine, its = pty.openpty()
        process = subprocess.Popen([sys.executable, "-m", "gavo_jax", *words], stdout=its, stderr=its, stdin=its)
        os.close(its)
        printed = b""
        try:
            while data := os.read(mine, 65536):
                printed += data
        except OSError:  # the other end is closed
            pass
        assert process.wait() == status, printed
        assert b"gotcha" in printed and b"Traceback" not in printed
        for evil in (b"\x1b]", b"\x07", b"\x1b[31m\xc2\x9b", b"\xc2\x9b"):
            assert evil not in printed


@pytest.mark.parametrize("encoding", ["latin-1", "ascii", "cp1252", "utf-16"])
@pytest.mark.parametrize("words", ["--help", "run --help", "experiment --help", "evaluate nöwhere nöwhere"])
def test_any_encoding_of_the_screen(monkeypatch, encoding, words):
    """Streams as Python opens them for a screen of that encoding."""
    streams = {name: io.TextIOWrapper(io.BytesIO(), encoding=encoding) for name in ("stdout", "stderr")}
    for name, stream in streams.items():
        monkeypatch.setattr(sys, name, stream)
    status = main(words.split())
    assert status == (0 if "--help" in words else 2)
    printed = {}
    for name, stream in streams.items():
        stream.flush()
        printed[name] = stream.buffer.getvalue().decode(encoding)
    assert printed["stdout" if "--help" in words else "stderr"].strip()


def test_a_warning_is_a_line_also_where_warnings_are_errors(tmp_path: Path, capsys: Any) -> None:
    """As with PYTHONWARNINGS=error, or in this test: it ended in a traceback."""
    rows = [f"{i / 10} 0 0 0 0 0 0 1" for i in range(30)]
    for name, more in (("a.txt", ["9 nan 0 0 0 0 0 1"]), ("b.txt", [])):
        (tmp_path / name).write_text("\n".join(rows + more))
    assert main(["evaluate", str(tmp_path / "a.txt"), str(tmp_path / "b.txt")]) == 0
    assert "gavo: warning: " in (told := capsys.readouterr().err) and "1 of 31 rows left out" in told, told


def test_a_folder_that_is_closed_to_this_user_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    """`Path.is_dir` raises what no other question about a file does."""

    def refuse(self: Path) -> bool:
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    monkeypatch.setattr(Path, "is_dir", refuse)
    assert main(["view", "closed"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
