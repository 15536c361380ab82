"""From options to frames: which sequence, which of its frames, by which camera."""

from gavo_jax.camera import load_camera
from gavo_jax.cli.options import Source
from gavo_jax.datasets.base import Sequence
from gavo_jax.datasets.synthetic import SyntheticSequence
from gavo_jax.datasets.tum import TumSequence
from gavo_jax.errors import GavoError

SYNTHETIC = "synthetic"
SYNTHETIC_FRAMES = 40
"""Unless `--frames` says how many: the drift over one second needs a little more than a second of them."""
MAX_SYNTHETIC_FRAMES = 1_000_000
MAX_SEED = 2**32 - 1


def open_sequence(source: Source) -> Sequence:
    """Return the chosen frames, checked as far as that is possible before a run.

    Raises:
        GavoError: what is wrong with the options, the sequence or its camera; fewer than two frames.
    """
    _check_at_least("--start", source.start, 0)
    _check_at_least("--stride", source.stride, 1)
    if source.frames is not None:
        _check_at_least("--frames", source.frames, 2)
    stop = None if source.frames is None else source.start + (source.frames - 1) * source.stride + 1
    whole = _synthetic(source, stop) if source.sequence == SYNTHETIC else TumSequence(source.sequence, source.camera)
    chosen = whole[source.start : stop : source.stride]
    if len(chosen) < 2:
        raise GavoError(
            f"{source.sequence}: {len(chosen)} of its {len(whole)} frames chosen by --start, --frames and --stride: "
            "at least 2 are needed"
        )
    chosen.check()
    return chosen


def check_seed(seed: int) -> None:
    """Raise GavoError for a seed that JAX's keys do not take."""
    if not 0 <= seed <= MAX_SEED:
        raise GavoError(f"--seed: must be from 0 to {MAX_SEED}, not {seed}")


def _synthetic(source: Source, stop: int | None) -> SyntheticSequence:
    frames = SYNTHETIC_FRAMES if stop is None else stop
    if frames > MAX_SYNTHETIC_FRAMES:
        raise GavoError(f"{SYNTHETIC}: has no more than {MAX_SYNTHETIC_FRAMES} frames, not {frames}")
    return SyntheticSequence(frames, camera=None if source.camera == "auto" else load_camera(source.camera))


def _check_at_least(option: str, value: int, least: int) -> None:
    if value < least:
        raise GavoError(f"{option}: must be at least {least}, not {value}")
