"""The camera's way since the reference, over frames that did not become it, for lack of depth for example.

The expected motion grows with every frame for which the reference is held. Continuing the motion from before the
reference is soon far off; where the camera was last found tells more.
"""

from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Float64

from gavo_jax.frame_checks import History, credible_time

REMEMBERED = 2
"""Number of frames that the last velocity is computed from."""


class Fix(NamedTuple):
    """Where the camera was found at one time."""

    seconds: float
    """Seconds since the reference."""
    xi: tuple[float, ...]
    """Twist of target_T_reference, metres and radians."""


class Way(NamedTuple):
    """Where the camera was last found since the reference."""

    fixes: tuple[Fix, ...] = ()

    def after(self, seconds: float, xi: Float64[np.ndarray, " 6"]) -> Self:
        """Add one more frame; one from before the reference, after a clock was set back, clears the way."""
        if not seconds > 0:
            return self._replace(fixes=())
        return self._replace(fixes=(*self.fixes, Fix(seconds, tuple(map(float, xi))))[-REMEMBERED:])

    def at(self, seconds: float, history: History) -> Float64[np.ndarray, " 6"] | None:
        """The twist to be expected `seconds` after the reference, at the last velocity.

        This is None if no frame was found yet, or at a time that is not after the last one. The history tells which
        times between two frames are credible.
        """
        if not self.fixes or seconds <= self.fixes[-1].seconds:
            return None
        before, last = (Fix(0.0, (0.0,) * 6), *self.fixes)[-2:]
        velocity = (np.array(last.xi) - before.xi) / credible_time(last.seconds - before.seconds, history)
        return np.array(last.xi) + (seconds - last.seconds) * velocity
