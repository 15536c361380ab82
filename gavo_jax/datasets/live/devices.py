"""Registry of live devices: the names that can be given in place of a recorded source."""

from collections.abc import Callable

from gavo_jax.datasets.live import realsense
from gavo_jax.datasets.live.frames import LiveDevice
from gavo_jax.errors import GavoError, shown

_devices: dict[str, Callable[[], LiveDevice]] = {realsense.NAME: realsense.RealSense}


def register_device(name: str, opened: Callable[[], LiveDevice]) -> None:
    """Register a custom device by name: `gavo run NAME` then tracks its frames live.

    Args:
        name: name of the device; registering it again replaces the device.
        opened: function that opens the device and returns it, ready to be read.

    Raises:
        GavoError: the name is empty or no text, or `opened` cannot be called.
    """
    if not (isinstance(name, str) and name):
        raise GavoError(f"live device: name: expected a word, got {shown(name)}")
    if not callable(opened):
        raise GavoError(f"live device {name!r}: expected a function that opens it, got {shown(opened)}")
    _devices[name] = opened


def is_live(source: str) -> bool:
    """Whether a source is the name of a live device."""
    return source in _devices


def open_device(name: str) -> LiveDevice:
    """Open a device by name.

    Raises:
        GavoError: there is none of that name, or it cannot be opened.
    """
    if name not in _devices:
        raise GavoError(f"unknown live device {name!r}: not one of {', '.join(_devices)}")
    return _devices[name]()
