"""`gavo doctor`: prints what a support request needs, and checks that JAX computes correct numbers."""

import os
import platform
import tempfile
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, metadata, requires, version
from pathlib import Path

import jax
from packaging.requirements import Requirement

from gavo_jax import presets
from gavo_jax.cli.options import Doctor
from gavo_jax.cli.readiness import be_ready
from gavo_jax.compilation import compiler
from gavo_jax.compilation.cache import cache_folder, why_not_private
from gavo_jax.datasets import registry
from gavo_jax.interrupts import interruptible
from gavo_jax.output.screen import say
from gavo_jax.selfcheck import checks
from gavo_jax.version import __version__

CHECK_FAILED = 1
"""Exit status if a check fails."""
NOT_INSTALLED = "not installed"
PACKAGES = ("jax", "jaxlib", "numpy", "opencv-python-headless")


def doctor(command: Doctor) -> int:
    """Print versions, machine, cache, extras, faulty plugins, checks and speed; 0 if all is well."""
    del command
    faults = []
    say(f"gavo-jax: {__version__}")
    for name in PACKAGES:
        say(f"{name}: {_version(name) or NOT_INSTALLED}")
    say(f"python: {platform.python_version()} ({platform.python_implementation()})")
    say(f"system: {platform.platform()}")
    say(f"processor: {compiler.processor()}, {os.cpu_count()} cores, {_usable_cores()} of them for this process")
    be_ready()
    say(f"devices: {', '.join(_device(device.platform, device.device_kind) for device in jax.devices())}")
    fault = compiler.unfit_compiler()
    if fault:
        say(f"compiler: WRONG: {fault}")
        faults.append("the version of JAX")
    described, is_writable = _cache()
    say(f"cache: {described}")
    if elsewhere := os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        say(f"cache of compiled programs: {_without_home(Path(elsewhere))}")
    if not is_writable:
        faults.append("the cache folder")
    for line in _extras():
        say(f"extra {line}")
    plugins = (*presets.faulty_plugins().values(), *registry.faulty_plugins())
    for line in plugins:
        say(f"plugin: WRONG: {line}")
    if plugins:
        faults.append("packages that bring methods or datasets")
    faults += interruptible(_print_checks)
    say("all is well" if not faults else f"problems found: {', '.join(faults)}")
    return CHECK_FAILED if faults else 0


def _print_checks() -> list[str]:
    """Run the checks, print them and the speed, and return the names of failed checks."""
    wrong = []
    for outcome in checks.full_size():
        verdict = "ok" if outcome.is_right else "WRONG"
        say(f"check {verdict}: {outcome.name}: off by {outcome.deviation:.1e}, at most {outcome.tolerance:.0e}")
        if not outcome.is_right:
            wrong.append(outcome.name)
    recorded = ", ".join(f"{time} on an {name}" for name, time in checks.RECORDED_NANOSECONDS.items())
    say(f"speed: {checks.scoring_nanoseconds():.1f} ns per pixel and candidate (2 cores have taken {recorded})")
    return wrong


def _device(platform_name: str, kind: str) -> str:
    """Describe a device; for a CPU the kind only repeats the platform."""
    return kind if kind.lower() == platform_name.lower() else f"{platform_name} {kind}"


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _usable_cores() -> int | None:
    """Return the number of cores this process may use, or of all cores if the system doesn't say."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def _cache() -> tuple[str, bool]:
    """Describe the cache folder, and return whether compiled programs can be kept there."""
    folder = cache_folder()
    if folder is None:
        return "none: no home folder, and GAVO_CACHE_DIR is not set", False
    try:
        if fault := why_not_private(folder):
            return f"{_without_home(folder)}, NOT private, so NOT in use: {fault}", False
    except OSError as error:
        return f"{_without_home(folder)}, NOT writable: {error.strerror}", False
    sizes = [_size(path) for path in folder.rglob("*") if path.is_file() and not path.name.endswith("-atime")]
    words = f"{_without_home(folder)}, {len(sizes)} programs, {sum(sizes) / 2**20:.1f} MiB"
    try:
        with tempfile.NamedTemporaryFile(dir=folder):
            return f"{words}, writable", True
    except OSError as error:
        return f"{words}, NOT writable: {error.strerror}", False


def _size(path: Path) -> int:
    """Return a file's size in bytes, or 0 if another process has just removed it."""
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _without_home(path: Path) -> str:
    """Return the path with `~` for the home folder, to hide the user's name."""
    try:
        return f"~/{path.absolute().relative_to(Path.home())}"
    except (RuntimeError, ValueError):
        return str(path)


def _extras() -> Iterator[str]:
    """Yield a line for each optional extra: its packages and their versions."""
    try:
        extras = metadata("gavo-jax").get_all("Provides-Extra") or []
        requirements = [Requirement(line) for line in requires("gavo-jax") or []]
    except PackageNotFoundError:
        return
    for extra in extras:
        if extra == "test":
            continue
        needed = [r for r in requirements if r.marker and r.marker.evaluate({"extra": extra})]
        names = [name for requirement in needed for name in _packages(requirement)]
        yield f"{extra}: {', '.join(f'{name} {_version(name) or NOT_INSTALLED}' for name in names)}"


def _packages(requirement: Requirement) -> list[str]:
    """Return a requirement's package, or for extras such as jax[cuda12] the plugin packages they add."""
    return [f"{requirement.name}-{extra}-plugin" for extra in requirement.extras] or [requirement.name]
