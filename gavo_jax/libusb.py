"""Import of libraries that link to libusb; on systems that lack it, that of the package libusb-package is loaded."""

import ctypes
import importlib
import warnings
from typing import Any

from gavo_jax.errors import GavoError


def import_with_libusb(name: str) -> Any:
    """Import a library, if necessary with libusb-package's libusb; warnings of the import are suppressed.

    Raises:
        ImportError: it cannot be imported.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return importlib.import_module(name)
        except ImportError as error:
            if "libusb" not in str(error):
                raise
            _load_libusb(error)
            return importlib.import_module(name)


def import_open3d(extra: str) -> Any:
    """Import Open3D, which is part of one of this package's extras.

    Raises:
        GavoError: it cannot be imported.
    """
    try:
        return import_with_libusb("open3d")
    except (ImportError, OSError) as error:
        raise GavoError(f"Open3D cannot be imported ({error}): install 'gavo-jax[{extra}]'") from None


def _load_libusb(error: ImportError) -> None:
    """Load libusb-package's library for all later imports; raise `error` if there is none."""
    try:
        path = importlib.import_module("libusb_package").get_library_path()
        if path is None:
            raise error
        ctypes.CDLL(str(path), ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        raise error from None
