"""The camera's way since the reference, where frames that were found did not become it: their depth was missing, say.

The motion to be expected grows with every frame that the reference is held. That it goes on as before the reference is
soon far off; where it was last seen tells more.
"""

from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Float64

REMEMBERED = 2
"""Frames, of which the last velocity is made."""


class Fix(NamedTuple):
    """Where the camera was found."""

    seconds: float
    """Seconds since the reference."""
    xi: tuple[float, ...]
    """Twist of target_T_reference, metres and radians."""


class Way(NamedTuple):
    """Where the camera was found since the reference, the last frames."""

    fixes: tuple[Fix, ...] = ()

    def after(self, seconds: float, xi: Float64[np.ndarray, " 6"]) -> Self:
        """Add one more frame; of one before the reference, after which a clock was set back, nothing is foretold."""
        if not seconds > 0:
            return self._replace(fixes=())
        return self._replace(fixes=(*self.fixes, Fix(seconds, tuple(map(float, xi))))[-REMEMBERED:])

    def at(self, seconds: float) -> Float64[np.ndarray, " 6"] | None:
        """The twist to be expected so many seconds after the reference, at the last velocity; None at the first frame,
        or at a time before the last one.
        """
        if not self.fixes or seconds <= self.fixes[-1].seconds:
            return None
        before, last = (Fix(0.0, (0.0,) * 6), *self.fixes)[-2:]
        velocity = (np.array(last.xi) - before.xi) / max(last.seconds - before.seconds, 1e-3)
        return np.array(last.xi) + (seconds - last.seconds) * velocity
