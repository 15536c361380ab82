"""A mapper in the background: a worker thread watches the frames, in order, while later ones are aligned.

Tracking looks at the map only to find a frame in it, and waits until the map has seen all frames before that one. So
the result is that of a map made frame by frame, whatever the timing.
"""

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, ParamSpec, TypeVar

from gavo_jax.camera import Camera
from gavo_jax.compilation.precision import in_32_bits
from gavo_jax.datasets.base import Frame, Sequence
from gavo_jax.mapping.mapper import Loops, Mapper
from gavo_jax.odometry.driver import Found, Moving, Step, seen_moving
from gavo_jax.odometry.tracking import as_exposed
from gavo_jax.settings import OdometryOptions

P = ParamSpec("P")
R = TypeVar("R")

MOST_AHEAD = 16
"""Frames that tracking may be ahead of the map before it waits: this bounds memory, and the wait at the end."""


class BackgroundMapper:
    """A mapper that works in a thread of its own; its errors are raised by a later call.

    Args:
        mapper: The mapper that works there; nobody else may use it meanwhile.
    """

    def __init__(self, mapper: Mapper):
        self.mapper = mapper
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="mapper")
        self._ahead: deque[Future[Any]] = deque()

    def warm_up(self) -> float:
        """Compile what is needed, or load it; return the seconds this took."""
        return self._after_all(self.mapper.warm_up)

    def watch(self, frame: Frame | None, step: Step | None) -> None:
        """Queue a frame for the mapper; see `Mapper.watch`."""
        self._wait_for(MOST_AHEAD - 1)
        self._ahead.append(self._worker.submit(in_32_bits(self.mapper.watch), frame, step))

    def find(self, frame: Frame, segment: int) -> Found | None:
        """Return where a frame was taken, by a map of all earlier frames; see `driver.Relocaliser`."""
        return self._after_all(self.mapper.find, frame, segment)

    def replay(
        self, sequence: Sequence, steps: list[Step], moving: Moving = seen_moving, is_drawn_on: bool = False
    ) -> None:
        """Rebuild the map of a run that was cut short; see `Mapper.replay`."""
        self._after_all(self.mapper.replay, sequence, steps, moving, is_drawn_on)

    def finish(self, steps: Iterable[Step] = ()) -> Loops:
        """Finish the map; see `Mapper.finish`."""
        return self._after_all(self.mapper.finish, steps)

    def _after_all(self, work: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """Run a function in the worker once the map has seen all frames, and return its result."""
        self._wait_for(0)
        return self._worker.submit(in_32_bits(work), *args, **kwargs).result()

    def _wait_for(self, most: int) -> None:
        """Wait until the worker has at most that many frames left."""
        while self._ahead and (len(self._ahead) > most or self._ahead[0].done()):
            self._ahead[0].result()
            self._ahead.popleft()


def mapper_of(camera: Camera, options: OdometryOptions) -> BackgroundMapper | None:
    """Return the mapper of a run with loops, which allows for shutter and depth delay if the odometry does; else None.

    Args:
        camera: Camera of the frames, without distortion.
        options: The run's.

    Raises:
        GavoError: GTSAM is not installed.
    """
    if not options.loops:
        return None
    return BackgroundMapper(Mapper(as_exposed(camera, options), synchronise=options.synchronise))
