"""The compiler and the processor that it compiles for: is the one fit to use, and which is the other.

`pyproject.toml` leaves out the versions of JAX that are known to compute wrong numbers, and names the reports. A
version can still come in behind its back (`pip install --no-deps`, a frozen environment), so a process asks here.

Nothing here imports JAX: some of it has to happen before.
"""

import hashlib
import os
import platform
import subprocess
import sys
import warnings
from functools import cache
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

from packaging.requirements import Requirement

from gavo_jax.early import is_command

COMPILERS = ("jax", "jaxlib")
"""Packages that decide what numbers a compiled program gives."""


class CompilerWarning(UserWarning):
    """The installed JAX is one that this package rules out."""


@cache
def unfit_compiler() -> str | None:
    """One line about a JAX whose version this package rules out; None where there is nothing to say."""
    try:
        requirements = [Requirement(line) for line in requires("gavo-jax") or []]
    except PackageNotFoundError:  # not installed, so nothing says what it allows
        return None
    ours = [requirement for requirement in requirements if requirement.name in COMPILERS and not requirement.marker]
    unfit = [r.name for r in ours if not r.specifier.contains(version(r.name), prereleases=True)]
    if not unfit:
        return None
    found = ", ".join(f"{name} {version(name)}" for name in unfit)
    wanted = " ".join(f"'{requirement}'" for requirement in ours)
    return f"{found} may compute wrong numbers and is ruled out: pip install {wanted}"


def prepare_process() -> None:
    """What has to happen before JAX is imported.

    XLA says, for every program that is loaded on some processors, that it was compiled for another one: it takes
    settings such as `prefer-no-gather` for instructions (jax-ml/jax#38445). Programs of other processors are kept
    apart (`processor_digest`), so its lines tell nothing and are not shown; faults come as exceptions all the same.
    """
    if "jax" not in sys.modules:
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    if not is_command() and (fault := unfit_compiler()):  # the command says it itself, as bad input
        warnings.warn(fault, CompilerWarning, stacklevel=3)


def processor() -> str:
    """The processor's name, for people."""
    return _cpuinfo().get("model name") or platform.processor() or platform.machine()


@cache
def processor_digest() -> str:
    """A name for this kind of processor: the same for two machines only if they have the same instructions."""
    described = _cpuinfo()
    told = [described.get(key, "") for key in ("vendor_id", "cpu family", "model", "model name", "flags", "Features")]
    if sys.platform == "darwin":
        told += [_output("sysctl", "-n", "machdep.cpu.brand_string"), _output("sysctl", "hw.optional")]
    told += [platform.machine(), platform.processor()]
    return hashlib.sha256("\n".join(told).encode()).hexdigest()[:16]


@cache
def _cpuinfo() -> dict[str, str]:
    """What Linux says of the first core; empty elsewhere."""
    try:
        first, _, _ = Path("/proc/cpuinfo").read_text(encoding="utf-8").partition("\n\n")
    except OSError:
        return {}
    rows = (line.partition(":") for line in first.splitlines())
    return {name.strip(): value.strip() for name, _, value in rows}


def _output(*command: str) -> str:
    try:
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=5).stdout
    except (OSError, subprocess.TimeoutExpired):
        return ""
