"""Ctrl-C at any moment: one line and status 130."""

import gc
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from gavo_jax.interrupts import interruptible, postponed, raised

pytestmark = pytest.mark.skipif(os.name != "posix", reason="sends signals")


def send() -> None:
    signal.raise_signal(signal.SIGINT)


def test_it_is_raised_once_more_where_python_drops_it(capsys):
    """A callback of the garbage collector, as JAX has one, drops what is raised in it."""

    def callback(phase: str, info: object) -> None:
        if phase == "start" and not sent:
            sent.append(True)
            send()

    sent: list[bool] = []
    gc.callbacks.append(callback)
    try:
        with raised(), pytest.raises(KeyboardInterrupt):
            gc.collect()
            assert sent
            time.sleep(5.0)
    finally:
        gc.callbacks.remove(callback)
    assert not capsys.readouterr().err


def test_what_else_is_dropped_is_told_as_ever(capsys, monkeypatch):
    told: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda dropped: told.append(dropped.exc_type))

    class Faulty:
        def __del__(self) -> None:
            raise RuntimeError("dropped")

    with raised():
        Faulty()
    assert told == [RuntimeError]


def test_what_belongs_together_is_done_before_it_is_raised():
    done: list[int] = []
    with raised(), pytest.raises(KeyboardInterrupt):
        with postponed():
            send()
            done.append(1)
        done.append(2)
    assert done == [1]
    with raised():
        with postponed():
            done.append(3)
        with pytest.raises(KeyboardInterrupt):
            send()
    with postponed():  # elsewhere nothing is changed
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_long_work_of_compiled_code_is_not_waited_for():
    going = threading.Event()

    def work() -> None:
        going.wait(20.0)

    threading.Timer(0.2, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
    start = time.monotonic()
    with raised(), pytest.raises(KeyboardInterrupt):
        interruptible(work)
    assert time.monotonic() - start < 10.0
    going.set()


def test_work_returns_and_raises_as_a_call_does():
    def fail() -> None:
        raise KeyError("x")

    assert interruptible(lambda: 3) == 3
    with raised():
        assert interruptible(lambda: threading.current_thread() is threading.main_thread()) is False
        with pytest.raises(KeyError, match="x"):
            interruptible(fail)


def test_a_program_that_has_a_handler_of_its_own_keeps_it():
    def own(number: int, frame: object) -> None:
        raise ZeroDivisionError

    for handler in (own, signal.SIG_IGN):
        before = signal.signal(signal.SIGINT, handler)
        try:
            with raised():
                assert signal.getsignal(signal.SIGINT) is handler
        finally:
            signal.signal(signal.SIGINT, before)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize(("module", "is_ours"), [("gavo_jax", True), ("other", False)])
def test_only_the_command_is_ended_while_it_imports(tmp_path, module, is_ours):
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "__init__.py").write_text(
        "import signal, gavo_jax\nassert signal.getsignal(signal.SIGINT) is signal.default_int_handler\n"
    )
    (tmp_path / "other" / "__main__.py").write_text("print('as ever')")
    if is_ours:
        code = "import sys, runpy; sys.argv = ['-m']; sys.orig_argv = ['python', '-m', 'gavo_jax']\n"
        code += "import gavo_jax, signal; print(signal.getsignal(signal.SIGINT).__name__)"
        command = [sys.executable, "-c", code]
    else:
        command = [sys.executable, "-m", module]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout == ("end\n" if is_ours else "as ever\n"), done.stderr


def interrupted(arguments: list[str], folder: Path, after: float) -> tuple[int, str]:
    """Status and standard error of a command that Ctrl-C meets so many seconds after its first module is there."""
    code = (
        "import sys; sys.argv[0] = 'gavo'\n"
        "import threading, os, signal\n"
        f"timer = threading.Timer({after}, lambda: os.kill(os.getpid(), signal.SIGINT)); timer.daemon = True\n"
        "timer.start()\n"
        "from gavo_jax.cli import main\n"
        "sys.exit(main())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=folder, capture_output=True, text=True, check=False, timeout=100
    )
    return done.returncode, done.stderr


@pytest.mark.parametrize("after", np.linspace(0.02, 2.0, 6).round(2).tolist())
def test_at_any_moment(tmp_path, after):
    arguments = ["run", "--frames", "40", "--method", "gauss-newton", "--output", "out"]
    status, error = interrupted(arguments, tmp_path, after)
    assert status == 130 and error.count("\n") == 1 and "interrupted" in error, error
    assert not (tmp_path / "out" / ".gavo.lock").exists()


@pytest.mark.slow
@pytest.mark.parametrize("arguments", ["run", "compare --methods gauss-newton", "run --viewer save"])
def test_at_many_moments_with_nothing_compiled(tmp_path, monkeypatch, arguments):
    monkeypatch.delenv("GAVO_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null/none")  # a warning would be of one that GAVO_CACHE_DIR names
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    for after in np.arange(0.1, 12.0, 0.7):
        words = [*arguments.split(), "--frames", "30", "--output", "out"]
        status, error = interrupted(words, tmp_path, float(after))
        assert status == 130 and error.count("\n") == 1 and "interrupted" in error, (after, error)
