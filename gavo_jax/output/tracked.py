"""Tracks a sequence with progress display, interruptible by Ctrl-C."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from gavo_jax.compilation.waits import Stopwatch, told_of_waits
from gavo_jax.datasets.base import Frame, Sequence
from gavo_jax.errors import print_message
from gavo_jax.interrupts import interruptible, postponed
from gavo_jax.mapping.background import BackgroundMapper
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.run import RunOutcome, finish_run
from gavo_jax.odometry.stream import track
from gavo_jax.output.screen import pair_progress
from gavo_jax.viewer.base import NO_VIEWER, Viewer


class Tracked(NamedTuple):
    """Result of tracking a sequence, possibly only up to an interruption."""

    steps: list[Step]
    """Steps in the order of the frames, without bodies: their masks would fill the memory."""
    interrupted: bool
    seconds: float
    """Wall time of the tracking, decoding included, compilation excluded."""
    compile_seconds: float

    def outcome(self, sequence: Sequence) -> RunOutcome:
        """Finish a run that was tracked from the sequence's first frame on; see `finish_run`."""
        first, truth = float(sequence.timestamps[0]), sequence.ground_truth
        return finish_run(first, self.steps, truth, None, self.seconds, self.compile_seconds)


def track_visibly(
    label: str,
    sequence: Sequence,
    odometry: Odometry,
    on_step: Callable[[Step], None] | None = None,
    viewer: Viewer = NO_VIEWER,
    mapper: BackgroundMapper | None = None,
) -> Tracked:
    """Compile, then track the frames that the driver has not seen yet, with a progress bar and a viewer.

    Raises:
        KeyboardInterrupt: The user stopped it before a pair was done.
    """
    pairs, done = len(sequence) - 1, max(odometry.progress.last_index, 0)
    steps: list[Step] = []
    interrupted = False

    def watch(frame: Frame | None, step: Step | None) -> None:
        if mapper is not None:
            mapper.watch(frame, step)
        viewer.watch(frame, step, odometry.candidates)

    with pair_progress(label, pairs, done) as bar:
        compile_seconds = interruptible(odometry.warm_up)
        if mapper is not None:
            compile_seconds += interruptible(mapper.warm_up)
        stopwatch = Stopwatch()
        try:
            with told_of_waits(bar.compiling):
                for step in track(sequence, odometry=odometry, watch=watch):
                    with postponed():  # or the count of steps and what is written of them would differ
                        if on_step is not None:
                            on_step(step)
                        steps.append(replace(step, bodies=()))
                    bar.advance()
        except KeyboardInterrupt:
            if not steps:
                raise
            interrupted = True
        seconds, compile_seconds = stopwatch.seconds, compile_seconds + stopwatch.waited
    if interrupted:
        print_message(f"{label}: interrupted after {done + len(steps)} of {pairs} pairs")
    return Tracked(steps, interrupted, seconds, compile_seconds)
