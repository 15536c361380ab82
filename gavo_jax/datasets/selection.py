"""Selection of a source by name, and of a range of its frames."""

from dataclasses import replace

from gavo_jax.camera_files.calibration import load_camera
from gavo_jax.datasets.base import Sequence
from gavo_jax.datasets.depth_doubts import fault_of_depth
from gavo_jax.datasets.depth_unit import lack_of_depth
from gavo_jax.datasets.files import Reading
from gavo_jax.datasets.registry import open_source
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError

SYNTHETIC = "synthetic"
SYNTHETIC_FRAMES = 40
"""Default number of synthetic frames: drift over one second needs slightly more than a second of frames."""


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
    """Return the chosen frames, checked as far as possible before a run.

    Args:
        source: A folder or file that `open_source` knows, or the word synthetic.
        camera: "auto", or what `load_camera` takes.
        start: First frame, from 0.
        frames: Number of frames, at least 2; all of them if None.
        stride: Take every `stride`-th frame, from 1.
        reading: Further options for reading the source; its `camera` is ignored.
        force: Whether to accept depth that is missing, or whose scale looks wrong.
        moving: Number of bodies that move through the synthetic room.

    Raises:
        GavoError: the source or its camera is faulty; fewer than two frames are chosen; no depth in the frames that are
            sampled, or a depth scale that looks wrong (by 5 or 1000, say).
    """
    reading = reading or Reading()
    if source == SYNTHETIC and (given := reading.given()):
        raise GavoError(f"{given[0]}: does not apply to the {SYNTHETIC} room")
    stop = None if frames is None else start + (frames - 1) * stride + 1
    reading = replace(reading, camera=camera)
    whole = _synthetic(camera, stop, moving, reading.color) if source == SYNTHETIC else open_source(source, reading)
    chosen = whole[start:stop:stride]
    if len(chosen) < 2:
        left_out = "".join(f"; {line}" for line in getattr(whole, "left_out", ()))
        raise GavoError(
            f"{source}: start, frames and stride select {len(chosen)} of its {len(whole)} frames: "
            f"at least 2 are required{left_out}"
        )
    chosen.check()
    if source != SYNTHETIC and not force and (fault := lack_of_depth(chosen) or fault_of_depth(chosen)):
        raise GavoError(f"{source}: {fault}, or continue with --force")
    return chosen


def _synthetic(camera: str, stop: int | None, moving: int, color: bool) -> SyntheticSequence:
    frames = SYNTHETIC_FRAMES if stop is None else stop
    named = None if camera == "auto" else load_camera(camera)
    return SyntheticSequence(frames, camera=named, bodies=moving, color=color)
