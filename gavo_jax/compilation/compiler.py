"""Check of the compiler's version, and identification of the processor that it compiles for.

`pyproject.toml` excludes the versions of JAX that are known to compute wrong numbers, and names the reports. Such a
version can still get installed (`pip install --no-deps`, a frozen environment), so each process checks here.

Nothing here imports JAX, as some of it must happen before that.
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
"""Packages that determine the numbers that a compiled program computes."""


class CompilerWarning(UserWarning):
    """The installed JAX is a version that this package excludes."""


@cache
def unfit_compiler() -> str | None:
    """Return a line about an installed JAX whose version this package excludes; None if it is fine."""
    try:
        requirements = [Requirement(line) for line in requires("gavo-jax") or []]
    except PackageNotFoundError:  # not installed, so its requirements are unknown
        return None
    ours = [requirement for requirement in requirements if requirement.name in COMPILERS and not requirement.marker]
    unfit = [r.name for r in ours if not r.specifier.contains(version(r.name), prereleases=True)]
    if not unfit:
        return None
    found = ", ".join(f"{name} {version(name)}" for name in unfit)
    wanted = " ".join(f"'{requirement}'" for requirement in ours)
    return f"{found} may compute wrong numbers and is ruled out: pip install {wanted}"


def prepare_process() -> None:
    """Set up the process before JAX is imported.

    On some processors XLA reports, for every program that is loaded, that it was compiled for another one: it takes
    settings such as `prefer-no-gather` for instructions (jax-ml/jax#38445). Programs of other processors are kept apart
    (`processor_digest`), so these lines are meaningless and suppressed; errors still come as exceptions.
    """
    if "jax" not in sys.modules:
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    if not is_command() and (fault := unfit_compiler()):  # the command reports it itself, as bad input
        warnings.warn(fault, CompilerWarning, stacklevel=3)


def processor() -> str:
    """Return the processor's human-readable name."""
    return _cpuinfo().get("model name") or platform.processor() or platform.machine()


@cache
def processor_digest() -> str:
    """Return a name for this kind of processor: equal on two machines only if they have the same instructions."""
    described = _cpuinfo()
    told = [described.get(key, "") for key in ("vendor_id", "cpu family", "model", "model name", "flags", "Features")]
    if sys.platform == "darwin":
        told += [_output("sysctl", "-n", "machdep.cpu.brand_string"), _output("sysctl", "hw.optional")]
    told += [platform.machine(), platform.processor()]
    return hashlib.sha256("\n".join(told).encode()).hexdigest()[:16]


@cache
def _cpuinfo() -> dict[str, str]:
    """Return Linux's description of the first core; empty on other systems."""
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
