"""What is kept is run as it is found: so only in a folder that nobody else can write to."""

import os
import stat
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
from small import CAMERA

from gavo_jax.compilation import programs
from gavo_jax.compilation.cache import cache_folder, enable_compilation_cache, why_not_private
from gavo_jax.compilation.programs import keep_programs_in
from gavo_jax.datasets.layouts.tum_writing import write_tum
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoWarning

NOBODY = 65534

pytestmark = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="owners and modes of files mean nothing here")
as_root = pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() != 0, reason="gives files away: needs root")


@pytest.fixture(autouse=True)
def own_settings(monkeypatch) -> Iterator[None]:
    """Leave the process's caches as they were."""
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    kept = {name: jax.config.values[name] for name in CONFIGURED}
    yield
    for name, value in kept.items():
        jax.config.update(name, value)
    keep_programs_in(None)


SOON_COMPILED = ("solver.iterations=[0,0,0,0,20]", "alignment.loss=l2", "alignment.last_step=false") + tuple(
    f"alignment.{part}=false" for part in ("robust_scale", "brightness", "depth")
)
CONFIGURED = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")


def give_away(path: Path) -> None:
    os.chown(path, NOBODY, NOBODY)


OPEN = {
    "to all": lambda folder: folder.chmod(0o777),
    "to the group": lambda folder: folder.chmod(0o770),
    "sticky": lambda folder: folder.chmod(0o1777),
    "part of it": lambda folder: ((folder / "traced").mkdir(), (folder / "traced").chmod(0o777)),
    "the folder above": lambda folder: folder.parent.chmod(0o777),
    "a file in it": lambda folder: (
        (folder / "traced").mkdir(),
        (folder / "traced" / "program").touch(),
        (folder / "traced" / "program").chmod(0o666),
    ),
}
GIVEN = {
    "itself": lambda folder: give_away(folder),
    "part of it": lambda folder: ((folder / "jax").mkdir(), give_away(folder / "jax")),
    "a file in it": lambda folder: (
        (folder / "traced").mkdir(),
        (folder / "traced" / "program").touch(),
        give_away(folder / "traced" / "program"),
    ),
}
CASES = [pytest.param(make, id=f"open: {name}") for name, make in OPEN.items()]
CASES += [pytest.param(make, id=f"another's: {name}", marks=as_root) for name, make in GIVEN.items()]


@pytest.mark.parametrize("make", CASES)
def test_where_others_can_write_nothing_is_kept_and_one_warning_says_so(tmp_path, make):
    folder = tmp_path / "above" / "cache"
    folder.mkdir(parents=True)
    make(folder)
    before = jax.config.values["jax_compilation_cache_dir"]
    with pytest.warns(GavoWarning) as said:
        enable_compilation_cache(folder)
    assert len(said) == 1 and str(folder) in str(said[0].message) and "so none is kept" in str(said[0].message)
    assert programs._folder is None and jax.config.values["jax_compilation_cache_dir"] == before


@pytest.mark.parametrize("mask", [0o000, 0o002, 0o022])
def test_a_folder_of_ones_own_is_private_whatever_the_mask(tmp_path, mask):
    previous = os.umask(mask)
    try:
        for _ in range(2):
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                enable_compilation_cache(tmp_path / "cache")
            assert programs._folder == tmp_path / "cache" / "traced"
            (tmp_path / "cache" / "traced" / "program").touch()
    finally:
        os.umask(previous)
    assert stat.S_IMODE((tmp_path / "cache").stat().st_mode) == 0o700
    assert Path(jax.config.values["jax_compilation_cache_dir"]).parent == tmp_path / "cache" / "jax"


def test_a_link_to_ones_own_folder_will_do(tmp_path):
    (tmp_path / "real").mkdir(0o700)
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert why_not_private(tmp_path / "link") is None
    (tmp_path / "real").chmod(0o777)
    assert why_not_private(tmp_path / "link") == "others can write to it"


def test_a_folder_in_ones_home_needs_no_shell(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("GAVO_CACHE_DIR", "~/kept")
    assert cache_folder() == tmp_path / "kept"


@pytest.mark.parametrize("end", ["", "cache"])
@pytest.mark.parametrize("named", ["as an argument", "by GAVO_CACHE_DIR", "as the user's own"])
def test_only_a_folder_that_was_asked_for_is_missed(tmp_path, monkeypatch, named, end):
    """Whoever named one waited for every compilation without a word of why."""
    (tmp_path / "file").touch()
    folder = tmp_path / "file" / end
    monkeypatch.delenv("GAVO_CACHE_DIR", raising=False)
    if named == "by GAVO_CACHE_DIR":
        monkeypatch.setenv("GAVO_CACHE_DIR", str(folder))
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        enable_compilation_cache(folder if named == "as an argument" else None)
    assert programs._folder is None
    if named == "as the user's own":
        assert not said
    else:
        assert len(said) == 1 and said[0].category is GavoWarning
        assert str(said[0].message).startswith(f"{folder}: cannot be used (Not a directory): no programs are kept")


def test_a_home_that_is_not_there_is_missed(monkeypatch):
    monkeypatch.setenv("GAVO_CACHE_DIR", "~nobody-of-this-name/kept")
    with pytest.warns(GavoWarning, match="no such home folder: no programs are kept"):
        enable_compilation_cache()


def test_the_command_goes_on_with_one_line(tmp_path):
    cache = tmp_path / "cache"
    cache.mkdir()
    cache.chmod(0o777)
    write_tum(SyntheticSequence(2, camera=CAMERA), tmp_path / "clip")
    environment = {**os.environ, "GAVO_CACHE_DIR": str(cache)}
    environment.pop("TF_CPP_MIN_LOG_LEVEL", None)  # set by JAX in this process
    images = [str(path) for part in ("rgb", "depth") for path in sorted((tmp_path / "clip" / part).iterdir())]
    command = [sys.executable, "-m", "gavo_jax", "align", *images[::2], *images[1::2], "--method", "gauss-newton"]
    command += ["--camera", "clip/camera.toml"]
    command += [f"--set={setting}" for setting in SOON_COMPILED]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("\n") == 1 and done.stderr.startswith(f"gavo: warning: {cache}: others can write to it")
    assert not list(cache.iterdir())
