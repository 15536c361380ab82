"""The result of aligning a pair of frames."""

from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from gavo_jax.errors import GavoError
from gavo_jax.objective.estimates import Brightness, ExplainedShare
from gavo_jax.se3 import rigid
from gavo_jax.status import AlignmentStatus, bit

MAX_TRANSLATION_DEVIATION = 0.05
"""Metres: a larger standard deviation of a translation makes a pair `LOW_TEXTURE`."""
MAX_ROTATION_DEVIATION = 0.05
"""Radians: a larger standard deviation of a rotation makes a pair `LOW_TEXTURE`."""


class Alignment(NamedTuple):
    """The motion between two frames, with its covariance, status and statistics.

    A batch holds the same fields with a leading axis, and `status` as an integer array.
    """

    target_T_reference: Float[Array, "4 4"]
    """Maps points of the reference camera into the target camera, metres. On the host it is a NumPy array of float64
    with an orthonormal rotation."""
    xi: Float[Array, " 6"]
    """Logarithm (v, w) of the motion: metres, radians."""
    error: Float[Array, ""]
    """E at the finest level, squared grey levels."""
    overlap: Float[Array, ""]
    """Share of the reference's points that land inside the target."""
    covariance: Float[Array, "6 6"]
    """Covariance of δ in target_T_reference · exp(δ), δ = (v, w) in metres and radians; NaN where unknown."""
    status: Any
    """`AlignmentStatus`: the gravest finding of the search, including plausibility among the run's pairs. A later
    finding about the frame or the run becomes the status only if there was none before."""
    history: Float[Array, " iterations"]
    """Best error after every iteration of every level, coarsest first (errors of different levels are not
    comparable)."""
    findings: Any = 0
    """Every status that holds, except `OK`, as the bits of an integer; see `statuses`."""
    explained: ExplainedShare = ExplainedShare(np.float32(np.nan), np.float32(np.nan))  # pyright: ignore
    """Share of the grey and of the depth residuals that are not large."""
    depth_scale: Any = np.float32(np.nan)
    """Scale of the depth residuals, 1/m."""
    sway: Any = np.zeros(6, np.float32)
    """Twist of the points in the target camera at its timestamp, less ξ: metres and radians over the time between the
    frames; 0 unless a rolling shutter shows it. See `alignment.sway`."""
    brightness: Brightness = Brightness(np.float32(1.0), np.float32(0.0))  # pyright: ignore
    """Gain and bias (grey levels) that map each view's grey to the target's: for the reference and, in a sequence, the
    keyframe."""

    @property
    def statuses(self) -> tuple[AlignmentStatus, ...]:
        """Every status that holds, `status` first; only `OK` if there are no findings.

        Raises:
            GavoError: This is a batch.
        """
        if np.ndim(self.status):
            words = "jax.tree.map(lambda field: field[i], batch) is its pair i"
            raise GavoError(f"a batch of {np.shape(self.status)[0]} alignments has no single status: {words}")
        status = AlignmentStatus(int(self.status))
        others = (other for other in AlignmentStatus if int(self.findings) & bit(other) and other != status)
        return (status, *others)

    @property
    def undetermined(self) -> str:
        """Directions of motion that the images of a `LOW_TEXTURE` pair leave undetermined, in words; else empty.

        They are some of the six axes of ξ, in the reference camera, joined by "with" if only their mixture is
        undetermined. An axis is named if its share of the undetermined directions is large, or if its own deviation
        along them exceeds the tolerable one.
        """
        covariance = np.asarray(self.covariance, np.float64)
        if AlignmentStatus.LOW_TEXTURE not in self.statuses or not np.isfinite(covariance).all():
            return ""
        tolerable = np.repeat([MAX_TRANSLATION_DEVIATION, MAX_ROTATION_DEVIATION], 3)
        values, vectors = np.linalg.eigh(covariance / np.outer(tolerable, tolerable))
        is_open = values > min(1.0, values[-1])
        is_open[-1] = True
        share = np.sum(vectors[:, is_open] ** 2, axis=1)
        variance = np.sum(values[is_open] * vectors[:, is_open] ** 2, axis=1)
        is_main = (share > share.max() / 16) | (variance > 1)
        main = [axis for axis in np.argsort(-share, kind="stable") if is_main[axis]]
        words = (f"{('translation along', 'rotation about')[axis // 3]} {'xyz'[axis % 3]}" for axis in main)
        return (" with " if np.sum(is_open) == 1 else ", ").join(words)

    @property
    def frozen(self) -> Literal["", "image", "depth"]:
        """Which part of a `FROZEN` frame repeats the last one's; else empty.

        A frozen image is not aligned, so that there is no error then.
        """
        if AlignmentStatus.FROZEN not in self.statuses:
            return ""
        return "depth" if np.isfinite(self.error) else "image"

    @property
    def sentence(self) -> str:
        """The status of the result in a sentence or two."""
        status, left_open = self.statuses[0], self.undetermined
        words = status.sentence
        if status is AlignmentStatus.FROZEN:
            words = f"The {self.frozen} repeats the last one."
        if left_open and status is AlignmentStatus.LOW_TEXTURE:
            return f"{words[:-1]}, above all {left_open}."
        return f"{words} The images do not determine: {left_open}." if left_open else words


def on_host(alignment: Alignment) -> Alignment:
    """Return a result, or a batch of results, as NumPy arrays.

    Motions are made rigid in double precision; the status of a single result becomes an `AlignmentStatus`.
    """
    host = jax.device_get(alignment)
    status = host.status if np.ndim(host.status) else AlignmentStatus(int(host.status))
    return host._replace(target_T_reference=rigid(host.target_T_reference), status=status)


def with_finding(result: Alignment, status: AlignmentStatus) -> Alignment:
    """Return a result with one more finding, which becomes the status if there was none."""
    if status is AlignmentStatus.OK:
        return result
    first = status if result.status == AlignmentStatus.OK else result.status
    return result._replace(status=first, findings=int(result.findings) | bit(status))


def no_alignment(status: AlignmentStatus) -> Alignment:
    """Return the result of a pair that could not be aligned: identity motion, unknown covariance."""
    nothing: dict[str, Any] = {
        "target_T_reference": np.eye(4),
        "xi": np.zeros(6, np.float32),
        "error": np.float32(np.nan),
        "overlap": np.float32(0.0),
        "covariance": np.full((6, 6), np.nan, np.float32),
        "history": np.zeros(0, np.float32),
    }
    return Alignment(**nothing, status=status, findings=bit(status) if status else 0)
