"""A folder has one writer, and the lock of a process that died holds nobody up."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from gavo_jax import locks
from gavo_jax.errors import GavoError, GavoWarning
from gavo_jax.locks import LOCK, hold

HOLDER = """import sys, time
from gavo_jax.locks import hold
with hold(sys.argv[1]):
    print("held", flush=True)
    sys.stdin.read()
"""


def start_holder(folder: Path) -> subprocess.Popen[str]:
    """A process that has the folder until its standard input closes."""
    command = [sys.executable, "-c", HOLDER, str(folder)]
    holder = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None and holder.stdout.readline() == "held\n"
    return holder


def test_the_second_process_is_refused_until_the_first_ends(tmp_path):
    with start_holder(tmp_path) as holder:
        with pytest.raises(GavoError, match=f"{tmp_path}: in use by another gavo .process {holder.pid} on "):
            with hold(tmp_path):
                pytest.fail("two have it")
        holder.communicate("")
    with hold(tmp_path), hold(tmp_path, "another.lock"):
        assert len(list(tmp_path.iterdir())) == 2
        with pytest.raises(GavoError, match="in use"), hold(tmp_path):
            pytest.fail("two have it")
    assert not list(tmp_path.iterdir())


def test_a_killed_process_holds_nobody_up(tmp_path):
    with start_holder(tmp_path) as holder:
        holder.send_signal(signal.SIGKILL)
    assert (tmp_path / LOCK).exists()
    with hold(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_it_ends_with_a_fault_too(tmp_path):
    with pytest.raises(KeyboardInterrupt), hold(tmp_path):
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


def test_who_comes_just_as_the_lock_is_removed_takes_the_new_one(tmp_path, monkeypatch):
    """Between opening the file and locking it, the one who had it removes it."""
    real, first = locks._lock, True

    def lock(path: Path, file: int) -> bool:
        nonlocal first
        if first:
            first = False
            path.unlink()
        return real(path, file)

    monkeypatch.setattr(locks, "_lock", lock)
    with hold(tmp_path):
        with pytest.raises(GavoError, match="in use"), hold(tmp_path):
            pytest.fail("two have it")


def test_what_is_planted_in_its_place_is_neither_followed_nor_waited_for(tmp_path):
    foreign = tmp_path / "foreign.txt"
    foreign.write_text("somebody else's")
    out = tmp_path / "out"
    out.mkdir()
    (out / LOCK).symlink_to(foreign)
    with pytest.raises(GavoError, match=LOCK), hold(out):
        pytest.fail("followed")
    assert foreign.read_text() == "somebody else's"
    for make in (os.mkfifo, Path.mkdir):
        (out / LOCK).unlink()
        make(out / LOCK)
        with pytest.raises(GavoError, match=LOCK), hold(out):
            pytest.fail("no file")


def test_a_folder_that_may_not_be_written_to_is_named_as_such(tmp_path, monkeypatch):
    """It was told "No such file": of the second try, to lock a file of another user's by reading."""
    start = os.open

    def unless_made(path, flags, mode=0o777):
        if flags & os.O_CREAT:
            raise PermissionError(errno.EACCES, "Permission denied")
        return start(path, flags, mode)

    monkeypatch.setattr(os, "open", unless_made)
    with pytest.raises(GavoError, match="cannot be written: Permission denied"), hold(tmp_path):
        pass


def test_a_file_system_without_locks_is_told(tmp_path, monkeypatch):
    def flock(*arguments: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", flock)
    with pytest.warns(GavoWarning, match="cannot be locked .No locks available."), hold(tmp_path):
        pass
