"""Whether a motion fits the run so far: what a camera can do, and how well its frames matched until now.

A frame that doesn't belong to its time stamp can match its reference perfectly. What gives it away is the motion: it
starts and stops as no camera does. And a match that is far worse than the run's usual one is wrong, or its depth is,
even where it would pass for a pair by itself.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gavo_jax.alignment.result import Alignment
from gavo_jax.objective.estimates import ExplainedShare
from gavo_jax.se3 import log
from gavo_jax.status import AlignmentStatus, as_findings, gravest

REMEMBERED = 15
"""Pairs whose median says what is usual."""
MIN_REMEMBERED = 3
"""Pairs that have to be known before one can be unusual."""
MAX_ACCELERATION = (15.0, 28.0)
"""m/s² and rad/s²: over two frames of a hand-held camera the truth of the TUM clips reaches 3 and 21
(`benchmarks/acceleration.py`); a car brakes by 10.
"""
MAX_SPEED = (5.0, 12.0)
"""m/s and rad/s: images of a faster camera are smeared."""
STAMP_JITTER = 0.02
"""Seconds that two stamps may be off against each other; a moving camera then seems faster or slower, on its way."""
UNKNOWN_SECONDS = 1.0
"""Seconds that stand for those of a motion that is not known: whatever comes next is possible after so many."""
TOLERANCE = (0.015, 0.01)
"""Metres and radians that an estimate may be off by itself."""
MAX_ERROR_RATIO = 6.0
"""E over its usual value, above which a pair is `HIGH_ERROR`; a motion larger than usual may have
as much larger an error."""
SCENE_DISTANCE = 1.5
"""Metres at which a translation moves the image as a rotation by so many radians does."""
SMALLEST_SHIFT = 0.005
"""Radians that the image moves by at least: the error of a camera at rest is the sensor's noise alone."""
MIN_DEPTH_RATIO = 0.65
"""Explained share of depth, over its usual value, below which a pair is `DEPTH_MISMATCH`."""
MOST_HIDDEN = 1.5
"""Largest factor by which a motion above the usual lets less depth agree. Where up to twelve frames are dropped from
the TUM clips, the share stays at 0.54 of the usual one and more; of a depth of other units it is 0.1 and less.
"""
MAX_DEPTH_SCALE_RATIO = 6.0
"""Scale of the depth residuals over its usual value, above which a pair is `DEPTH_MISMATCH`: in a scene of about one
depth a wrong one lies near the right one. Clean pairs reach 4.6, and 5.5 after five dropped frames; shifted, old,
permuted or upside-down depth mostly has 7 to 16.
"""
MUCH_DEPTH, SHOWN = 0.3, 0.25
"""Share of the depth that disagrees with a motion, from which on depth itself is wrong if the image disagrees with less
than this part of that. Of 255 first pairs of the TUM clips, up to ten frames apart, none is like that; with depth
upside down 74 of 85 are.
"""
LEAST_DEPTH_SCALE, STEADY_SHIFT = 0.022, 0.02
"""1/m, up to which nothing is said; more where the image usually moved by less than so many radians, as a camera at
rest has much less than one that starts to move.
"""


class Usual(NamedTuple):
    """Figures of the last good pairs; not-a-number where there were none yet."""

    errors: Float[Array, " n"]
    """E over the image's squared contrast, as it grows with the camera's gain."""
    shifts: Float[Array, " n"]
    """How far the image moved, radians."""
    explained_depths: Float[Array, " n"]
    depth_scales: Float[Array, " n"]
    """Scales of the depth residuals, 1/m."""

    @classmethod
    def unknown(cls) -> "Usual":
        """Before the first pair."""
        nothing: Any = np.full(REMEMBERED, np.nan, np.float32)
        return cls(*(nothing for _ in cls._fields))

    def after(self, result: Alignment, contrast: Float[Array, ""]) -> "Usual":
        """Add one more pair."""
        figures = (result.error / contrast**2, _shift(result), result.explained.depth, result.depth_scale)
        return Usual(*(jnp.append(old[1:], new) for old, new in zip(self, figures, strict=True)))


def judge_by_history(
    result: Alignment,
    usual: Usual,
    contrast: Float[Array, ""],
    predicted: Float[Array, " 6"],
    elapsed: Float[Array, ""],
    last_elapsed: Float[Array, ""],
) -> Alignment:
    """The result with what the run so far says against it among its findings.

    Args:
        result: Of the new frame.
        usual: Of the pairs before.
        contrast: Of the new image, grey levels.
        predicted: Twist of the motion if the camera had gone on as before.
        elapsed: Since the reference, seconds.
        last_elapsed: The time that the motion before took; `UNKNOWN_SECONDS` where there was none.
    """
    motion = result.target_T_reference
    change = _change(log(motion), predicted, STAMP_JITTER / elapsed)
    possible = possible_change(elapsed, last_elapsed)
    reachable = jnp.array(MAX_SPEED) * elapsed
    tolerance = jnp.array(TOLERANCE)
    implausible = jnp.any(change > possible + tolerance) | jnp.any(_lengths(log(motion)) > reachable + tolerance)
    usual_shift = jnp.maximum(_usual(usual.shifts), SMALLEST_SHIFT)
    larger = jnp.maximum(_shift(result) / usual_shift, 1.0)
    error = result.error / contrast**2 / larger
    explained_depth = result.explained.depth * jnp.minimum(larger, MOST_HIDDEN)
    least_scale = LEAST_DEPTH_SCALE * jnp.sqrt(jnp.maximum(STEADY_SHIFT / usual_shift, 1.0))
    most_scale = jnp.maximum(MAX_DEPTH_SCALE_RATIO * _usual(usual.depth_scales), least_scale)
    mismatch = explained_depth < MIN_DEPTH_RATIO * _usual(usual.explained_depths)
    mismatch |= (result.depth_scale > most_scale) | depth_alone_disagrees(result.explained)
    findings = result.findings | as_findings(
        {
            AlignmentStatus.IMPLAUSIBLE_MOTION: implausible,
            AlignmentStatus.HIGH_ERROR: error > MAX_ERROR_RATIO * _usual(usual.errors),
            AlignmentStatus.DEPTH_MISMATCH: mismatch,
        }
    )
    return result._replace(findings=findings, status=gravest(findings))


def depth_alone_disagrees(explained: ExplainedShare) -> Bool[Array, ""]:
    """Whether depth speaks against a motion and the image does not: what moves, or hides the scene, shows in both."""
    unlike = 1.0 - explained.depth
    return (unlike > MUCH_DEPTH) & (1.0 - explained.grey < SHOWN * unlike)


def possible_change(elapsed: Any, last_elapsed: Any) -> Any:
    """How far a camera's translation and rotation can be from what was predicted, metres and radians."""
    return np.array(MAX_ACCELERATION, np.float32) * elapsed * 0.5 * (elapsed + last_elapsed)


def image_shift(translation: Any, rotation: Any) -> Any:
    """How far a motion of this length and angle moves the image, about, in radians."""
    return rotation + translation / SCENE_DISTANCE


def _change(twist: Float[Array, " 6"], predicted: Float[Array, " 6"], share: Float[Array, ""]) -> Float[Array, " 2"]:
    """How far translation and rotation are from what was predicted, which may take that share more or less of time.

    It is never turned round.
    """
    moved, expected = twist.reshape(2, 3), predicted.reshape(2, 3)
    along = jnp.sum(moved * expected, axis=1) / jnp.maximum(jnp.sum(expected**2, axis=1), 1e-12)
    stretched = jnp.clip(along, jnp.maximum(1.0 - share, 0.0), 1.0 + share)[:, None] * expected
    return jnp.linalg.norm(moved - stretched, axis=1)


def _shift(result: Alignment) -> Float[Array, ""]:
    """How far a motion moves the image, about, in radians."""
    return image_shift(*_lengths(log(result.target_T_reference)))


def _lengths(twist: Float[Array, " 6"]) -> Float[Array, " 2"]:
    """Return the lengths of the translation and of the rotation, metres and radians."""
    return jnp.linalg.norm(twist.reshape(2, 3), axis=1)


def _usual(values: Float[Array, " n"]) -> Float[Array, ""]:
    """Median of what is remembered; not-a-number, of which no comparison holds, where that is too little."""
    return jnp.where(jnp.sum(jnp.isfinite(values)) >= MIN_REMEMBERED, jnp.nanmedian(values), jnp.nan)
