"""Fixtures and settings shared by all tests."""

import gc
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

# JAX reads this when it is imported, so it comes first
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # as the package sets it where it is the first to import JAX

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # of what a shell starts in the background; tests send it
    signal.signal(signal.SIGINT, signal.default_int_handler)

# XLA's older way to write out a program, and fewer of LLVM's passes over it, take a third of the time, and the program
# takes almost half as long again to run: the right choice where most time goes into compilation. `XLA_FLAGS= python -m
# pytest` tests what users run.
SOONER_COMPILED = (
    "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=1 --xla_cpu_prefer_vector_width=128"
    " --xla_backend_extra_options=xla_cpu_optimize_for_size"
)
if "XLA_FLAGS" not in os.environ and "PYTEST_XDIST_WORKER" not in os.environ:
    tried = {**os.environ, "XLA_FLAGS": SOONER_COMPILED}
    is_known = subprocess.run([sys.executable, "-c", "import jax; jax.devices()"], env=tried, capture_output=True)
    os.environ["XLA_FLAGS"] = SOONER_COMPILED if is_known.returncode == 0 else ""

import jax  # noqa: E402
import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

from gavo_jax.compilation.compiler import processor_digest  # noqa: E402
from gavo_jax.compilation.programs import keep_programs_in  # noqa: E402

# programs of the tests, and of the commands that they start, are kept between runs
KEPT = Path.home() / ".cache" / "gavo-jax"
os.environ.setdefault("GAVO_CACHE_DIR", str(KEPT / "test"))
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(KEPT / "test-jax" / processor_digest()))
jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
TRACED = Path(os.environ["GAVO_CACHE_DIR"]) / "traced"

LONGEST = (
    "bodies/test_rival.py",
    "cli/test_cli.py",
    "alignment/test_search.py",
    "test_benchmarks.py",
    "cli/test_contract.py",
    "output/test_resume.py",
    "experiments/test_together.py",
    "alignment/test_review.py",
    "alignment/test_pairs.py",
    "bodies/test_aligner.py",
    "test_examples.py",
    "compilation/test_precision.py",
    "calibration/test_calibration.py",
    "experiments/test_sharding.py",
    "selfcheck/test_selfcheck.py",
    "cli/test_shared_folders.py",
    "cli/test_sources.py",
    "datasets/test_forms.py",
    "odometry/test_tracking.py",
    "objective/test_error.py",
    "alignment/test_sway.py",
    "bodies/test_consensus.py",
    "solvers/test_solve.py",
)
"""Files that take longest, in the order in which they begin: one that began last would keep a process waiting. Those
that need the same large program begin at different times, as both processes would compile it: the rival and the
aligner, single pairs and their review.
"""

MOST_MAPS = 20_000
"""Maps of memory: a process has 65,530 by default, and each compiled program holds some."""

# what tracing makes by the hundred thousand stays: to look through it again and again takes a fifth of the time
gc.set_threshold(100_000, 20, 100)

settings.register_profile("gavo", deadline=None, derandomize=True)
settings.load_profile("gavo")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first; all else stays in order."""
    places = {Path(__file__).parent / name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path, len(LONGEST)))


@pytest.fixture(scope="module", autouse=True)
def _programs_are_shared() -> Iterator[None]:
    """Have modules use the same programs, as long as a process can hold them all."""
    keep_programs_in(TRACED)
    yield
    if maps_of_memory() > MOST_MAPS:
        jax.clear_caches()
        keep_programs_in(None)


def maps_of_memory() -> int:
    """How many this process has; 0 where the system does not say."""
    try:
        return Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return 0


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """`gavo run` draws no figures: they take longer than a short run, and are made of what its files say."""
    from gavo_jax.cli import run

    for name in ("draw", "draw_search"):
        monkeypatch.setattr(run, name, lambda *_: None)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Return the folder of real TUM clips (fr1_xyz, fr1_desk, fr1_rpy).

    Skips where GAVO_DATA does not name one; fails instead with GAVO_REQUIRE_DATA=1.
    """
    folder = os.environ.get("GAVO_DATA")
    if folder and Path(folder).is_dir():
        return Path(folder)
    reason = f"GAVO_DATA is no folder: {folder}" if folder else "GAVO_DATA is not set: it names the real TUM clips"
    if os.environ.get("GAVO_REQUIRE_DATA"):
        pytest.fail(reason)
    pytest.skip(reason)


@pytest.fixture(scope="session")
def open3d() -> ModuleType:
    """Return the library that maps need. Skips where it cannot be imported."""
    from gavo_jax.errors import GavoError
    from gavo_jax.libusb import import_open3d

    try:
        return import_open3d("map")
    except GavoError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def forty_frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A TUM folder of 160×120 pixels, which takes a second and a half to render: to be copied, no test changes it."""
    from small import CAMERA

    from gavo_jax.datasets.layouts.tum_writing import write_tum
    from gavo_jax.datasets.rendered.synthetic import SyntheticSequence

    folder = tmp_path_factory.mktemp("forty") / "clip"
    write_tum(SyntheticSequence(frames=40, camera=CAMERA), folder)
    return folder
