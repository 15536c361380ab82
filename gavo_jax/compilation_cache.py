"""Where compiled programs are kept between processes, so that only the first one on a machine waits for them."""

import os
import warnings
from pathlib import Path

import jax

from gavo_jax.compiler import processor_digest
from gavo_jax.program_cache import keep_programs_in


def cache_folder() -> Path | None:
    """Return `GAVO_CACHE_DIR`, else the user's cache folder for this package; None where there is no home."""
    if named := os.environ.get("GAVO_CACHE_DIR"):
        return Path(named)
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gavo-jax"
    except RuntimeError:
        return None


def enable_compilation_cache(folder: str | Path | None = None) -> None:
    """Keep programs between processes: traced ones, and compiled ones by JAX.

    The command `gavo` does so by itself; a program of one's own calls this once, before the first alignment. JAX's
    configuration is the process's, so compiled programs of other packages are kept too. Each kind of processor has a
    folder of its own: JAX would load what another one compiled, and could run into instructions that this one lacks.

    An entry that cannot be read or written (torn by a kill, a full disk) costs a compilation and no word.

    Args:
        folder: Where; by default `GAVO_CACHE_DIR`, else the user's cache folder for this package. JAX keeps its part
            where `JAX_COMPILATION_CACHE_DIR` says, if that is set.
    """
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry")
    folder = cache_folder() if folder is None else Path(folder)
    keep_programs_in(folder and folder / "traced")
    if os.environ.get("JAX_COMPILATION_CACHE_DIR") or folder is None:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder / "jax" / processor_digest()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
