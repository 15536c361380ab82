"""A sequence streamed through the driver, frame by frame; a thread decodes the next frame meanwhile."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from gavo_jax.datasets.base import Frame, FrameError, Sequence, require_sequence
from gavo_jax.datasets.rectified import rectified_at
from gavo_jax.errors import GavoError
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.settings import Settings
from gavo_jax.solvers.base import Solver


def unwatched(frame: Frame | None, step: Step | None) -> None:
    """Ignore a frame and its step."""


def track(
    sequence: Sequence,
    settings: Settings | Solver | None = None,
    *,
    seed: int = 0,
    odometry: Odometry | None = None,
    watch: Callable[[Frame | None, Step | None], None] = unwatched,
) -> Iterator[Step]:
    """Stream a sequence: yield a step for every frame after the first, as it is done.

    The next frame is decoded in a thread while one is aligned; memory does not grow with the sequence. A frame that
    cannot be read makes a lost step. With `on_lost="stop"` the stream ends after the first lost step.

    Args:
        sequence: The frames.
        settings: See `Odometry`.
        seed: See `Odometry`.
        odometry: A driver to use instead of a new one; if it has seen frames already it goes on with the next one.
        watch: Called with every `Odometry.frame` and its step, which is None for the first frame.

    Raises:
        GavoError: The input is no sequence or yields something that is no frame, or `odometry` is no driver, or one of
            another camera (its readout may differ), or has seen more frames than there are.
        FrameError: The first frame cannot be read.
    """
    require_sequence(sequence)
    if odometry is None:
        odometry = Odometry(sequence.camera, settings, seed=seed)
    elif not isinstance(odometry, Odometry):
        raise GavoError(f"expected an Odometry, got {type(odometry).__name__}: gavo.Odometry(camera, settings)")
    elif replace(sequence.camera.rectified(), readout=odometry.camera.readout) != odometry.camera:
        raise GavoError("the driver's camera is not that of the sequence: gavo.Odometry(sequence.camera, settings)")

    first = odometry.progress.last_index + 1
    if first > len(sequence):
        raise GavoError(
            f"the driver has seen {first} frames and goes on with the next one, but there are {len(sequence)}"
        )
    for index, frame in enumerate(decoded(sequence, first), start=first):
        step = odometry.register(frame, float(sequence.timestamps[index]))
        watch(odometry.frame, step)
        if step is not None:
            yield step
            if step.lost and odometry.settings.odometry.on_lost == "stop":
                return


def decoded(sequence: Sequence, first: int = 0) -> Iterator[Frame | FrameError]:
    """Yield frames at the sequence's timestamps, or errors in their place; a thread decodes the next one meanwhile."""

    def read(index: int) -> Frame | FrameError:
        try:
            return rectified_at(sequence, index).copied()
        except FrameError as error:
            return error

    if first >= len(sequence):
        return
    with ThreadPoolExecutor(max_workers=1) as decoder:
        coming = decoder.submit(read, first)
        for index in range(first, len(sequence)):
            frame = coming.result()
            if index + 1 < len(sequence):
                coming = decoder.submit(read, index + 1)
            yield frame
