"""Where compiled programs are kept between runs, so that only the first command on a machine waits for them."""

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


def enable_compilation_cache() -> None:
    """Keep traced programs in `cache_folder()`, and have JAX keep compiled ones there, unless
    `JAX_COMPILATION_CACHE_DIR` says where. Each kind of processor has a folder of its own: JAX would load what another
    one compiled, and could run into instructions that this one lacks.

    An entry that cannot be read or written (torn by a kill, a full disk) costs a compilation and no word.
    """
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry")
    folder = cache_folder()
    keep_programs_in(folder and folder / "traced")
    if os.environ.get("JAX_COMPILATION_CACHE_DIR") or folder is None:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder / "jax" / processor_digest()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
