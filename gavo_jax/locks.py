"""A lock that lets one process at a time write to a folder.

It is the operating system's lock on a file in the folder. It ends with its process, however that ends, so staleness is
never guessed from age or process id. Over NFS other hosts respect it, too.
"""

import contextlib
import os
import platform
import stat
import warnings
from collections.abc import Iterator
from pathlib import Path

from gavo_jax.errors import GavoError, GavoWarning

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LOCK = ".gavo.lock"
"""Name of the locked file. A killed process leaves the file behind, which then blocks nobody."""
MAX_HOLDER = 200


@contextlib.contextmanager
def hold(folder: str | Path, name: str = LOCK) -> Iterator[None]:
    """Hold the lock of a folder while the block runs.

    Args:
        folder: An existing folder. If its file system has no locks, a warning says so and the block runs unlocked.
        name: Name of the locked file; locks of different names are independent.

    Raises:
        GavoError: another process (or another block of this one) holds the folder, or the file cannot be made.
    """
    path = Path(folder) / name
    try:
        held = _take(path)
    except OSError as error:
        raise GavoError(f"{path}: cannot be written: {error.strerror or error}") from None
    if held is None:
        raise GavoError(
            f"{folder}: in use by another gavo{_holder(path)}: wait until it ends, or choose another folder"
        )
    try:
        yield
    finally:
        if _is_still(path, held):
            with contextlib.suppress(OSError):
                path.unlink()
        os.close(held)


def _take(path: Path) -> int | None:
    """Return the descriptor of the locked file; None if it is locked elsewhere."""
    while True:
        file = _open(path)
        try:
            if not _lock(path, file):
                os.close(file)
                return None
            if _is_still(path, file):
                break
        except BaseException:
            os.close(file)
            raise
        os.close(file)  # its last holder has just removed it
    with contextlib.suppress(OSError):  # for information only: a full disk does not matter
        os.ftruncate(file, 0)
        os.pwrite(file, f"process {os.getpid()} on {platform.node()}".encode(), 0)
    return file


def _open(path: Path) -> int:
    """Open the file, creating it if missing; links are not followed."""
    careful = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | careful, 0o644)
    except PermissionError as refused:  # left by another user's killed process: reading is enough to lock it
        try:
            file = os.open(path, os.O_RDONLY | careful)
        except FileNotFoundError:  # a folder that may not be written to
            raise refused from None
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise OSError("not a file")
    return file


def _lock(path: Path, file: int) -> bool:
    if fcntl is None:
        warnings.warn(f"{path.parent}: not locked on this system: let nothing else write to it", GavoWarning, 5)
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except OSError as error:
        reason = error.strerror or error
        warnings.warn(f"{path.parent}: cannot be locked ({reason}): let nothing else write to it", GavoWarning, 5)
    return True


def _is_still(path: Path, file: int) -> bool:
    """Whether the open file is still the one at its path."""
    try:
        return os.path.samestat(os.lstat(path), os.fstat(file))
    except FileNotFoundError:
        return False


def _holder(path: Path) -> str:
    """Return the holder that the lock file names, in brackets."""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            words = file.read(MAX_HOLDER).strip()
    except OSError:
        return ""
    return f" ({words})" if words else ""
