"""Choice of the stretches of a recording in which its camera moves most."""

import numpy as np

from gavo_jax.datasets.base import Frame, FrameError, Sequence
from gavo_jax.datasets.rectified import rectified
from gavo_jax.errors import GavoError
from gavo_jax.frame_checks import MIN_INTERVAL_RATIO

WINDOW = 45
"""Number of frames of a stretch, a second and a half; enough for several turns back and forth."""
WINDOWS = 2
"""Number of stretches, those with the most motion."""
LEAST_FRAMES = 12
MOST_SEARCHED = 3000
"""Number of frames that are searched for stretches."""


def stretches_of_motion(sequence: Sequence) -> list[list[Frame]]:
    """Return the stretches with the most motion, each of consecutive readable frames.

    Raises:
        GavoError: none has enough frames.
    """
    needed = f"{LEAST_FRAMES} readable frames in a row, none too soon after the last for the recording's rate"
    too_few = GavoError(f"{sequence.name}: needs at least {needed}")
    if len(sequence) < LEAST_FRAMES:
        raise too_few
    count = min(len(sequence), MOST_SEARCHED)
    length = min(WINDOW, count)
    changes = _changes(sequence, count)
    sums = np.convolve(changes, np.ones(length - 1), "valid")
    chosen: list[int] = []
    for start in np.argsort(-sums, kind="stable"):
        if all(abs(int(start) - other) >= length for other in chosen):
            chosen.append(int(start))
        if len(chosen) == WINDOWS:
            break
    runs = [_readable(sequence, start, length) for start in chosen]
    runs = [run for run in runs if len(run) >= LEAST_FRAMES]
    if not runs:
        raise too_few
    return runs


def _changes(sequence: Sequence, count: int) -> np.ndarray:
    """Difference of each image from the one before, relative to its contrast; 0 where one cannot be read."""
    if count <= WINDOW:
        return np.zeros(max(count - 1, 0))
    changes, before, camera = np.zeros(count - 1), None, sequence.camera.rectified()
    for index in range(count):
        try:
            grey = np.asarray(rectified(sequence[index], camera).grey)[::8, ::8].astype(np.float32)
        except FrameError:
            before = None
            continue
        if before is not None:
            changes[index - 1] = np.mean(np.abs(grey - before)) / max(float(grey.std()), 1.0)
        before = grey
    return changes


def _readable(sequence: Sequence, start: int, length: int) -> list[Frame]:
    """Return the longest run of readable frames with increasing, credible stamps.

    Where a frame comes too soon after the last, one of both stamps is wrong, and so is the speed between them.
    """
    runs: list[list[Frame]] = [[]]
    camera = sequence.camera.rectified()
    shortest = MIN_INTERVAL_RATIO * float(np.median(np.diff(sequence.timestamps)))
    for index in range(start, start + length):
        try:
            frame = rectified(sequence[index], camera).copied()
        except FrameError:
            runs.append([])
            continue
        if runs[-1] and not frame.timestamp - runs[-1][-1].timestamp > max(shortest, 0.0):
            runs[-1].pop()
            runs.append([])
        runs[-1].append(frame)
    return max(runs, key=len)
