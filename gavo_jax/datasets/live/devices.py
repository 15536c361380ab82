"""Live devices by name: the words that stand for a camera where a source is asked for."""

from collections.abc import Callable

from gavo_jax.datasets.live import realsense
from gavo_jax.datasets.live.frames import LiveDevice
from gavo_jax.errors import GavoError, shown

_devices: dict[str, Callable[[], LiveDevice]] = {realsense.NAME: realsense.RealSense}


def register_device(name: str, opened: Callable[[], LiveDevice]) -> None:
    """Give a device of one's own a name: `gavo run NAME` then tracks its frames as they come.

    Args:
        name: the word; one that is registered again gets the new device.
        opened: returns the device, ready to be read.

    Raises:
        GavoError: the name is no word, or nothing can be called.
    """
    if not (isinstance(name, str) and name):
        raise GavoError(f"live device: name: a word is needed, not {shown(name)}")
    if not callable(opened):
        raise GavoError(f"live device {name!r}: what opens it is needed, a function, not {shown(opened)}")
    _devices[name] = opened


def is_live(source: str) -> bool:
    """Whether a source is a device's name."""
    return source in _devices


def open_device(name: str) -> LiveDevice:
    """Open the device of a name.

    Raises:
        GavoError: there is none of that name, or it cannot be opened.
    """
    if name not in _devices:
        raise GavoError(f"unknown live device {name!r}: not one of {', '.join(_devices)}")
    return _devices[name]()
