"""Whether a motion fits the run so far: what a camera can do, and how well frames matched until now.

A frame that doesn't belong to its timestamp can match its reference perfectly. Its motion gives it away: it starts and
stops like no camera's. And a match far worse than usual in the run is wrong, or its depth is, even if it would pass for
a pair by itself.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64

from gavo_jax.alignment.result import Alignment
from gavo_jax.objective.estimates import ExplainedShare
from gavo_jax.rigid_motions import length_and_angle
from gavo_jax.se3 import log
from gavo_jax.status import AlignmentStatus, as_findings, gravest
from gavo_jax.trajectory import inverse

REMEMBERED = 15
"""Number of pairs whose median is the usual value."""
MIN_REMEMBERED = 3
"""Pairs that have to be known before one can be unusual."""
MAX_ACCELERATION = (15.0, 28.0)
"""m/s² and rad/s². Over two frames of a hand-held camera the ground truth of the TUM clips reaches 3 and 21
(`benchmarks/acceleration.py`); a braking car reaches 10.
"""
ABRUPT, ABRUPT_TOLERANCE = 0.5, 0.004
"""Share of the possible change of the translation, plus errors in metres, above which a change is abrupt."""
MAX_SPEED = (5.0, 12.0)
"""m/s and rad/s: images of a faster camera are blurred."""
STAMP_JITTER = 0.02
"""Error in seconds of the time between two timestamps; a moving camera then seems faster or slower, on its path."""
UNKNOWN_SECONDS = 1.0
"""Seconds assumed for an unknown motion: after that long any motion is possible."""
TOLERANCE = (0.015, 0.01)
"""Errors of an estimate by itself, metres and radians."""
MAX_ERROR_RATIO = 6.0
"""Error over its usual value above which a pair is `HIGH_ERROR` (`benchmarks/conditions.py`)."""
MIN_USUAL_ERROR = 0.2
"""Smallest usual error, squared pixels, as that of a camera at rest is the sensor's noise alone."""
SCENE_DISTANCE = 1.5
"""Distance assumed for the scene, metres: it converts a translation to a shift of the image."""
SMALLEST_SHIFT = 0.005
"""Smallest usual shift of the image, radians, as at rest it would be the noise of the estimate."""
MIN_DEPTH_RATIO = 0.65
"""Explained share of depth, over its usual value, below which a pair is `DEPTH_MISMATCH`."""
MOST_HIDDEN = 1.5
"""Largest factor by which a motion above the usual lowers the depth that has to agree. With up to twelve frames dropped
from the TUM clips, the share stays at 0.54 of the usual one or more. With depth in other units it is 0.1 or less.
"""
MAX_DEPTH_SCALE_RATIO = 6.0
"""Scale of the depth residuals over its usual value above which a pair is `DEPTH_MISMATCH`: where all depths are
similar, wrong depth lies near the right one. Clean pairs reach 4.6, and 5.5 after five dropped frames; shifted, old,
permuted or upside-down depth mostly has 7 to 16.
"""
MUCH_DEPTH, SHOWN = 0.3, 0.25
"""Share of depth that has to disagree with a motion for depth itself to be wrong, and the part of it below which the
image's own disagreement has to stay. Of 255 first pairs of the TUM clips, up to ten frames apart, none is like that;
with depth upside down 74 of 85 are.
"""
LEAST_DEPTH_SCALE, STEADY_SHIFT = 0.022, 0.02
"""Scale of the depth residuals, 1/m, up to which nothing is said, and usual shift of the image, radians, below which
that limit grows. A camera at rest has much smaller residuals than one that starts to move.
"""


class Usual(NamedTuple):
    """Figures of the last good pairs; NaN where there are none yet."""

    errors: Float[Array, " n"]
    """E in squared pixels (`Exposure.error_per_pixel`), as E grows with the images' contrast and sharpness."""
    shifts: Float[Array, " n"]
    """How far the image moved, radians."""
    explained_depths: Float[Array, " n"]
    depth_scales: Float[Array, " n"]
    """Scales of the depth residuals, 1/m."""

    @classmethod
    def unknown(cls) -> "Usual":
        """The figures before the first pair."""
        nothing: Any = np.full(REMEMBERED, np.nan, np.float32)
        return cls(*(nothing for _ in cls._fields))

    def after(self, result: Alignment, error: Float[Array, ""]) -> "Usual":
        """Add one more pair and its error, squared pixels."""
        figures = (error, _shift(result), result.explained.depth, result.depth_scale)
        return Usual(*(jnp.append(old[1:], new) for old, new in zip(self, figures, strict=True)))


def judge_by_history(
    result: Alignment,
    usual: Usual,
    error: Float[Array, ""],
    predicted: Float[Array, " 6"],
    elapsed: Float[Array, ""],
    last_elapsed: Float[Array, ""],
) -> Alignment:
    """Add to a result's findings what the run so far says against it.

    Args:
        result: Result of the new frame.
        usual: Figures of the pairs before.
        error: Error of the result, squared pixels.
        predicted: Twist of the motion if the camera had kept its velocity.
        elapsed: Time since the reference, seconds.
        last_elapsed: Duration of the last motion, seconds; `UNKNOWN_SECONDS` where there was none.
    """
    motion = result.target_T_reference
    change = _change(log(motion), predicted, STAMP_JITTER / elapsed)
    possible = possible_change(elapsed, last_elapsed)
    reachable = jnp.array(MAX_SPEED) * elapsed
    tolerance = jnp.array(TOLERANCE)
    implausible = jnp.any(change > possible + tolerance) | jnp.any(_lengths(log(motion)) > reachable + tolerance)
    usual_shift = jnp.maximum(_usual(usual.shifts), SMALLEST_SHIFT)
    larger = jnp.maximum(_shift(result) / usual_shift, 1.0)
    explained_depth = result.explained.depth * jnp.minimum(larger, MOST_HIDDEN)
    least_scale = LEAST_DEPTH_SCALE * jnp.sqrt(jnp.maximum(STEADY_SHIFT / usual_shift, 1.0))
    most_scale = jnp.maximum(MAX_DEPTH_SCALE_RATIO * _usual(usual.depth_scales), least_scale)
    mismatch = explained_depth < MIN_DEPTH_RATIO * _usual(usual.explained_depths)
    mismatch |= (result.depth_scale > most_scale) | depth_alone_disagrees(result.explained)
    findings = result.findings | as_findings(
        {
            AlignmentStatus.IMPLAUSIBLE_MOTION: implausible,
            AlignmentStatus.HIGH_ERROR: error > MAX_ERROR_RATIO * jnp.maximum(_usual(usual.errors), MIN_USUAL_ERROR),
            AlignmentStatus.DEPTH_MISMATCH: mismatch,
        }
    )
    return result._replace(findings=findings, status=gravest(findings))


def depth_alone_disagrees(explained: ExplainedShare) -> Bool[Array, ""]:
    """Whether depth contradicts a motion and the image does not: what moves, or occludes the scene, shows in both."""
    unlike = 1.0 - explained.depth
    return (unlike > MUCH_DEPTH) & (1.0 - explained.grey < SHOWN * unlike)


def possible_change(elapsed: Any, last_elapsed: Any) -> Any:
    """How far a camera's translation and rotation can be from the prediction, metres and radians."""
    return np.array(MAX_ACCELERATION, np.float32) * elapsed * 0.5 * (elapsed + last_elapsed)


def is_abrupt(
    motion: Float64[np.ndarray, "4 4"], predicted: Float64[np.ndarray, "4 4"], elapsed: float, last_elapsed: float
) -> bool:
    """Whether a motion's translation is further from the prediction than a hand accelerates a camera."""
    change, _ = length_and_angle(inverse(motion) @ predicted)
    return bool(change > ABRUPT * possible_change(elapsed, last_elapsed)[0] + ABRUPT_TOLERANCE)


def image_shift(translation: Any, rotation: Any) -> Any:
    """About how far a motion of this length and angle moves the image, radians."""
    return rotation + translation / SCENE_DISTANCE


def _change(twist: Float[Array, " 6"], predicted: Float[Array, " 6"], share: Float[Array, ""]) -> Float[Array, " 2"]:
    """How far translation and rotation are from the prediction, whose duration may be off by a share of it.

    The prediction is never reversed.
    """
    moved, expected = twist.reshape(2, 3), predicted.reshape(2, 3)
    along = jnp.sum(moved * expected, axis=1) / jnp.maximum(jnp.sum(expected**2, axis=1), 1e-12)
    stretched = jnp.clip(along, jnp.maximum(1.0 - share, 0.0), 1.0 + share)[:, None] * expected
    return jnp.linalg.norm(moved - stretched, axis=1)


def _shift(result: Alignment) -> Float[Array, ""]:
    """About how far a result's motion moves the image, radians."""
    return image_shift(*_lengths(log(result.target_T_reference)))


def _lengths(twist: Float[Array, " 6"]) -> Float[Array, " 2"]:
    """Return the lengths of the translation and of the rotation, metres and radians."""
    return jnp.linalg.norm(twist.reshape(2, 3), axis=1)


def _usual(values: Float[Array, " n"]) -> Float[Array, ""]:
    """Median of the remembered values; NaN, for which every comparison is false, where there are too few."""
    return jnp.where(jnp.sum(jnp.isfinite(values)) >= MIN_REMEMBERED, jnp.nanmedian(values), jnp.nan)
