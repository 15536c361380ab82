"""Which frames of which source, by name."""

from dataclasses import replace

from gavo_jax.camera_files.calibration import load_camera
from gavo_jax.datasets.base import Sequence
from gavo_jax.datasets.depth_unit import fault_of_scale, lack_of_depth
from gavo_jax.datasets.files import Reading
from gavo_jax.datasets.registry import open_source
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError

SYNTHETIC = "synthetic"
SYNTHETIC_FRAMES = 40
"""Unless it is said how many: the drift over one second needs a little more than a second of them."""


def open_part(
    source: str,
    camera: str = "auto",
    start: int = 0,
    frames: int | None = None,
    stride: int = 1,
    reading: Reading | None = None,
    force: bool = False,
    moving: int = 0,
) -> Sequence:
    """Return the chosen frames, checked as far as that is possible before a run.

    Args:
        source: A folder or file that `open_source` knows, or the word synthetic.
        camera: "auto", or what `load_camera` takes.
        start: First frame, from 0.
        frames: How many, at least 2; all that there are if left out.
        stride: Take every so-manieth frame, from 1.
        reading: What else is to be known of the source; its own camera does not count.
        force: Whether depth that looks as if its scale were wrong is taken all the same.
        moving: How many bodies move through the synthetic room.

    Raises:
        GavoError: what is wrong with the source or its camera; fewer than two frames; a depth scale that is wrong by 5
            or 1000, as the first frames look.
    """
    reading = reading or Reading()
    if source == SYNTHETIC and (given := reading.given()):
        raise GavoError(f"{given[0]}: is not of the {SYNTHETIC} room")
    stop = None if frames is None else start + (frames - 1) * stride + 1
    reading = replace(reading, camera=camera)
    whole = _synthetic(camera, stop, moving, reading.color) if source == SYNTHETIC else open_source(source, reading)
    chosen = whole[start:stop:stride]
    if len(chosen) < 2:
        left_out = "".join(f"; {line}" for line in getattr(whole, "left_out", ()))
        raise GavoError(
            f"{source}: {len(chosen)} of its {len(whole)} frames chosen by start, frames and stride: "
            f"at least 2 are needed{left_out}"
        )
    chosen.check()
    if source != SYNTHETIC and not force and (fault := lack_of_depth(chosen) or fault_of_scale(chosen)):
        raise GavoError(f"{source}: {fault}, or go on with --force")
    return chosen


def _synthetic(camera: str, stop: int | None, moving: int, color: bool) -> SyntheticSequence:
    frames = SYNTHETIC_FRAMES if stop is None else stop
    named = None if camera == "auto" else load_camera(camera)
    return SyntheticSequence(frames, camera=named, bodies=moving, color=color)
