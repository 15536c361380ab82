"""The folder that keeps compiled programs between processes, so that only a machine's first process waits for them."""

import os
import stat
import warnings
from contextlib import suppress
from pathlib import Path

import jax

from gavo_jax.compilation.compiler import processor_digest
from gavo_jax.compilation.programs import keep_programs_in
from gavo_jax.errors import GavoWarning, as_path

OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def cache_folder() -> Path | None:
    """Return `GAVO_CACHE_DIR`, else the user's cache folder for this package; None if there is no home folder."""
    try:
        if named := os.environ.get("GAVO_CACHE_DIR"):
            return Path(named).expanduser()  # no shell expands it in environment files
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gavo-jax"
    except RuntimeError:
        return None


def why_not_private(folder: Path) -> str | None:
    """Create a private folder if it is missing, and return how others could write to it.

    Returns:
        Words that continue the folder's name; None if nobody else can write to it.

    Raises:
        OSError: it cannot be created or examined.
    """
    for missing in reversed([path for path in (folder, *folder.parents) if not path.exists()]):
        missing.mkdir(mode=0o700, exist_ok=True)
    if not hasattr(os, "geteuid"):  # Windows: a user's folders are closed to others, and modes say nothing
        return None
    top = folder.stat()
    if top.st_uid != os.geteuid():
        return "belongs to another user"
    if top.st_mode & OTHERS_WRITE:
        return "others can write to it"
    for parent in folder.resolve().parents:
        mode = parent.stat().st_mode
        if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
            return f"others can put something else in its place, as they can write to {parent}"
    within_reach = (stat.S_IWGRP if top.st_mode & stat.S_IXGRP else 0) | (
        stat.S_IWOTH if top.st_mode & stat.S_IXOTH else 0
    )
    with os.scandir(folder) as entries:
        for entry in entries:
            with suppress(FileNotFoundError):
                status = entry.stat(follow_symlinks=False)
                if status.st_uid != os.geteuid() or status.st_mode & within_reach and not entry.is_symlink():
                    return f"others could write {entry.name} in it"
    return None


def enable_compilation_cache(folder: str | Path | None = None) -> None:
    """Keep programs between processes: traced ones, and those compiled by JAX.

    The command `gavo` does so by itself; other programs call this once, before the first alignment. JAX's configuration
    is global to the process, so compiled programs of other packages are kept too. Each kind of processor has its own
    folder: JAX would load what another one compiled, and could meet instructions that this one lacks.

    A kept program is run as it is found, so the folder must be private. If it belongs to another user, or others can
    write to it, a `GavoWarning` says so and nothing is kept. The same holds for a folder that is named here or by
    `GAVO_CACHE_DIR` and cannot be used; the user's own one may be missing. An entry that cannot be read or written
    (truncated by a kill, a full disk) silently costs a compilation.

    Args:
        folder: The folder; by default `GAVO_CACHE_DIR`, else the user's cache folder for this package. If
            `JAX_COMPILATION_CACHE_DIR` is set, JAX keeps its part there, and whoever sets it decides who may write.
    """
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry")
    is_named = folder is not None or bool(os.environ.get("GAVO_CACHE_DIR"))
    folder = cache_folder() if folder is None else as_path(folder)
    if folder is None and is_named:
        _warn(f"{os.environ['GAVO_CACHE_DIR']}: there is no such home folder: no programs are kept")
    keeps_compiled = not os.environ.get("JAX_COMPILATION_CACHE_DIR")
    parts = ["", "traced", "jax", f"jax/{processor_digest()}"][: 4 if keeps_compiled else 2]
    if folder is None or not all(_is_private(folder / part, is_named) for part in parts):
        keep_programs_in(None)
        return
    keep_programs_in(folder / "traced")
    if keeps_compiled:
        compiled = folder / parts[-1]
        jax.config.update("jax_compilation_cache_dir", str(compiled))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def _is_private(folder: Path, is_named: bool) -> bool:
    """Whether programs may be kept in a folder; a warning says why not if others could write to it, or if it is one
    that was asked for.
    """
    try:
        fault = why_not_private(folder)
    except OSError as error:
        if is_named:
            _warn(f"{folder}: cannot be used ({error.strerror or error}): no programs are kept")
        return False
    if fault:
        _warn(f"{folder}: {fault}, and programs kept there are run, so none is kept; remove it, or close it to others")
    return fault is None


def _warn(words: str) -> None:
    warnings.warn(words, GavoWarning, stacklevel=5)
