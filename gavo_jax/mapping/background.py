"""A map that is made beside the tracking: a worker takes notice of the frames, in order, while others are aligned.

Tracking never looks at the map but where a frame has to be found in it, and then the map has seen all frames before. So
the result is that of a map made frame by frame, whatever the timing.
"""

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, ParamSpec, TypeVar

from gavo_jax.compilation.precision import in_32_bits
from gavo_jax.datasets.base import Frame, Sequence
from gavo_jax.mapping.mapper import Loops, Mapper
from gavo_jax.odometry.driver import Found, Moving, Step, seen_moving

P = ParamSpec("P")
R = TypeVar("R")

MOST_AHEAD = 16
"""Frames that the tracking may be ahead of the map, then it waits: that bounds memory, and what an end waits for."""


class BackgroundMapper:
    """A mapper that works in a thread of its own.

    What goes wrong there is raised by a later call.

    Args:
        mapper: The mapper that works there; nobody else may use it meanwhile.
    """

    def __init__(self, mapper: Mapper):
        self.mapper = mapper
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="mapper")
        self._ahead: deque[Future[Any]] = deque()

    def warm_up(self) -> float:
        """Compile what is needed, or load it; the seconds this took."""
        return self._after_all(self.mapper.warm_up)

    def watch(self, frame: Frame | None, step: Step | None) -> None:
        """Take notice of a frame, soon; see `Mapper.watch`."""
        self._wait_for(MOST_AHEAD - 1)
        self._ahead.append(self._worker.submit(in_32_bits(self.mapper.watch), frame, step))

    def find(self, frame: Frame, segment: int) -> Found | None:
        """Return where a frame was taken, by a map of all frames before; see `driver.Relocaliser`."""
        return self._after_all(self.mapper.find, frame, segment)

    def replay(
        self, sequence: Sequence, steps: list[Step], moving: Moving = seen_moving, is_drawn_on: bool = False
    ) -> None:
        """Take notice of what a run did before it was cut short; see `Mapper.replay`."""
        self._after_all(self.mapper.replay, sequence, steps, moving, is_drawn_on)

    def finish(self, steps: Iterable[Step] = ()) -> Loops:
        """The whole map; see `Mapper.finish`."""
        return self._after_all(self.mapper.finish, steps)

    def _after_all(self, work: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """What a function returns that the worker runs once the map has seen all frames."""
        self._wait_for(0)
        return self._worker.submit(in_32_bits(work), *args, **kwargs).result()

    def _wait_for(self, most: int) -> None:
        """Wait until the worker has no more than so many frames left."""
        while self._ahead and (len(self._ahead) > most or self._ahead[0].done()):
            self._ahead[0].result()
            self._ahead.popleft()
