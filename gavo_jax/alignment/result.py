"""The result of aligning a pair of frames."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from gavo_jax.se3 import rigid
from gavo_jax.status import AlignmentStatus


class Alignment(NamedTuple):
    """The motion between two frames, with what is known about it.

    A batch holds the same fields with a leading axis, and `status` as an integer array.
    """

    target_T_reference: Float[Array, "4 4"]
    """Maps points of the reference camera into the target camera, metres. On the host it is a NumPy array of float64
    with an orthonormal rotation."""
    xi: Float[Array, " 6"]
    """Its logarithm (v, w): metres, radians."""
    error: Float[Array, ""]
    """E at the finest level, squared grey levels."""
    overlap: Float[Array, ""]
    """Share of the reference's points that land inside the target."""
    covariance: Float[Array, "6 6"]
    """Covariance of δ in target_T_reference · exp(δ), δ = (v, w) in metres and radians."""
    status: Any
    """`AlignmentStatus`."""
    history: Float[Array, " iterations"]
    """Best error after every iteration of every level, coarsest first (the levels' errors are not comparable)."""

    @property
    def undetermined(self) -> str:
        """Of a pair that is `LOW_TEXTURE` the direction of motion that the images constrain least, in the axes of the
        reference camera: one or two of ξ's six, as words. Else empty.
        """
        covariance = np.asarray(self.covariance, np.float64)
        if self.status != AlignmentStatus.LOW_TEXTURE or not np.isfinite(covariance).all():
            return ""
        tolerable = np.repeat([MAX_TRANSLATION_DEVIATION, MAX_ROTATION_DEVIATION], 3)
        _, vectors = np.linalg.eigh(covariance / np.outer(tolerable, tolerable))
        share = vectors[:, -1] ** 2
        main = [axis for axis in np.argsort(-share)[:2] if share[axis] > share.max() / 4]
        return " with ".join(f"{('translation along', 'rotation about')[axis // 3]} {'xyz'[axis % 3]}" for axis in main)

    @property
    def sentence(self) -> str:
        """What is known of the result, in one sentence for people."""
        words = self.status.sentence
        return f"{words[:-1]}, above all {self.undetermined}." if self.undetermined else words


MAX_TRANSLATION_DEVIATION = 0.05
"""Metres: a larger standard deviation of a translation makes a pair `LOW_TEXTURE`."""
MAX_ROTATION_DEVIATION = 0.05
"""Radians, likewise for the rotation."""


def on_host(alignment: Alignment) -> Alignment:
    """The same result, or batch of results, as NumPy arrays: motions rigid in double precision, and the status of a
    single result an `AlignmentStatus`.
    """
    host = jax.device_get(alignment)
    status = host.status if np.ndim(host.status) else AlignmentStatus(int(host.status))
    return host._replace(target_T_reference=rigid(host.target_T_reference), status=status)


def no_alignment(status: AlignmentStatus) -> Alignment:
    """The result of a pair that could not be aligned at all: no motion, nothing known."""
    nothing: dict[str, Any] = {
        "target_T_reference": np.eye(4),
        "xi": np.zeros(6, np.float32),
        "error": np.float32(np.nan),
        "overlap": np.float32(0.0),
        "covariance": np.full((6, 6), np.nan, np.float32),
        "history": np.zeros(0, np.float32),
    }
    return Alignment(**nothing, status=status)
