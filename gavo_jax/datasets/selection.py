"""Which frames of which sequence, by name."""

from gavo_jax.camera import load_camera
from gavo_jax.datasets.base import Sequence
from gavo_jax.datasets.synthetic import SyntheticSequence
from gavo_jax.datasets.tum import TumSequence
from gavo_jax.errors import GavoError

SYNTHETIC = "synthetic"
SYNTHETIC_FRAMES = 40
"""Unless it is said how many: the drift over one second needs a little more than a second of them."""
MAX_SYNTHETIC_FRAMES = 1_000_000


def open_part(
    sequence: str, camera: str = "auto", start: int = 0, frames: int | None = None, stride: int = 1
) -> Sequence:
    """Return the chosen frames, checked as far as that is possible before a run.

    Args:
        sequence: A folder in TUM layout, or the word synthetic.
        camera: "auto", or what `load_camera` takes.
        start: First frame, from 0.
        frames: How many, at least 2; all that there are if left out.
        stride: Take every so-manieth frame, from 1.

    Raises:
        GavoError: what is wrong with the sequence or its camera; fewer than two frames.
    """
    stop = None if frames is None else start + (frames - 1) * stride + 1
    whole = _synthetic(camera, stop) if sequence == SYNTHETIC else TumSequence(sequence, camera)
    chosen = whole[start:stop:stride]
    if len(chosen) < 2:
        raise GavoError(
            f"{sequence}: {len(chosen)} of its {len(whole)} frames chosen by start, frames and stride: "
            "at least 2 are needed"
        )
    chosen.check()
    return chosen


def _synthetic(camera: str, stop: int | None) -> SyntheticSequence:
    frames = SYNTHETIC_FRAMES if stop is None else stop
    if frames > MAX_SYNTHETIC_FRAMES:
        raise GavoError(f"{SYNTHETIC}: has no more than {MAX_SYNTHETIC_FRAMES} frames, not {frames}")
    return SyntheticSequence(frames, camera=None if camera == "auto" else load_camera(camera))
