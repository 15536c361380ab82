"""Whether the motions found explain how depth changes.

Depth that becomes wrong differs from that of earlier frames (`plausibility`). Depth that was wrong from the first frame
on does not: it may be mirrored, of another camera, of other moments, or no depth at all. But it does not change as the
image's motions say. They explain its change hardly better than a camera at rest would.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from gavo_jax.camera import Camera, in_image, inverse_depth, to_pixels, to_ray
from gavo_jax.datasets.base import Frame
from gavo_jax.frame_checks import is_one_number
from gavo_jax.rigid_motions import exp, log
from gavo_jax.trajectory import inverse

COLUMNS = 60
"""Points across an image, on a regular grid: high-contrast points would lie on the edges of objects."""
SMALLEST_CHANGE = 0.01
"""Difference between motion and rest, 1/m, above which a point is informative: three times the noise of a
structured-light sensor.
"""
CHANGED = 0.25
"""Share of all points that is used: those at which motion and rest differ most."""
LEAST_POINTS = 50
"""Fewest points needed for a figure."""
EDGE = 0.05
"""Difference between neighbouring pixels, 1/m, above which they show different objects."""
REMEMBERED, MIN_REMEMBERED = 15, 8
"""Number of last pairs whose median counts, and the fewest that suffice."""
MOST_LEFT = 0.7
"""Largest part of the change of depth that the motions may leave unexplained; 1 is no better than rest. Clean clips
reach 0.24, and 0.42 with a body over 40 % of the image.
"""
MOST_WITHOUT_BODIES = 0.5
"""Part that is left without bodies over the one with them, below which bodies are why depth seemed wrong."""
MOTIONS = 4
"""Number of last motions that are remembered: those of 0.1 s at 30 frames per second, the longest delay of depth."""
RIGHT_BEFORE = 5
"""Surplus of pairs whose change of depth was explained, counted from the first remembered one, that shows that depth
was right until then.
"""
LEAST_EXPLAINED = 0.95
"""Share of small grey residuals above which depth of a single value is accepted as a wall straight ahead: a translation
along it explains the image. Rooms whose depth was set to one value have 0.93 and less.
"""


class DepthChange(NamedTuple):
    """What is known of the reference's depth, and of how depth changed over the last pairs."""

    inverse: Float64[np.ndarray, "rows columns"]
    """Inverse depth of the reference on a grid, 1/m; 0 without a reading."""
    delay: float
    """Time from the reference's colour image to its depth image, seconds."""
    before: tuple[tuple[float, ...], ...] = ()
    """The last motions up to the reference, latest last: the seconds of each, and its velocity, a twist per second."""
    since: tuple[float, ...] = ()
    """The last motion found from the reference on, likewise; empty if there is none yet."""
    left: tuple[float, ...] = ()
    """Error of depth that the motion leaves over that which rest would leave, for each of the last pairs."""

    @property
    def usually_left(self) -> float:
        """Lower median of `left`, as half of the pairs may show a body; NaN if there are too few."""
        return float(np.quantile(self.left, 0.5, method="lower")) if len(self.left) >= MIN_REMEMBERED else np.nan

    @property
    def is_unexplained(self) -> bool:
        """Whether the motions explain the change of depth hardly better than rest."""
        return self.usually_left > MOST_LEFT

    def pairs_covered(self, pairs: int) -> int:
        """Return how many of the last `pairs` pairs the figures speak against.

        These are all pairs until the first was forgotten, but for those before depth became wrong.
        """
        covered = len(self.left) if len(self.left) == REMEMBERED else pairs
        more_explained = np.cumsum(np.where(np.array(self.left) > MOST_LEFT, -1, 1))
        was_right = more_explained.size > 0 and more_explained.max() >= RIGHT_BEFORE
        return covered - (int(np.argmax(more_explained)) + 1 if was_right else 0)

    def after(
        self,
        frame: Frame,
        at_rest: Frame,
        elapsed: float,
        target_T_reference: Any,
        explained: float,
        camera: Camera,
    ) -> "DepthChange":
        """Add one more pair, of the same reference.

        Earlier figures above `MOST_LEFT` are forgotten if bodies make the difference in this pair: before they were
        found, they caused these figures. Near bodies in a far room are all of the depth that changes.

        Args:
            frame: The target.
            at_rest: The same frame without what moves on its own; the same object if nothing does.
            elapsed: Time between the two images, seconds.
            target_T_reference: Motion between the two images.
            explained: Share of the grey residuals that are not large.
            camera: Camera of both frames.
        """
        twist = log(np.asarray(target_T_reference, np.float64)) / elapsed
        left = self._left_in(at_rest, elapsed, twist, explained, camera)
        figures = (*self.left, left)[-REMEMBERED:] if np.isfinite(left) else self.left
        if at_rest is not frame and max(figures, default=0.0) > MOST_LEFT:
            with_bodies = self._left_in(frame, elapsed, twist, explained, camera)
            if left < min(MOST_LEFT, MOST_WITHOUT_BODIES * with_bodies):
                figures = tuple(figure for figure in figures if figure <= MOST_LEFT)
        return self._replace(since=(elapsed, *twist.tolist()), left=figures)

    def _left_in(
        self, frame: Frame, elapsed: float, twist: Float64[np.ndarray, "6"], explained: float, camera: Camera
    ) -> float:
        """Part of the change of depth that a motion leaves; NaN if too little changes.

        Depth of a single value in both frames fits a wall along which the camera translates. Rotations are then found
        as translations, and depth agrees. So the image has to fit a wall as well.
        """
        earlier = self.before or ((elapsed, *twist.tolist()),)

        def moved_by(seconds: float) -> Float64[np.ndarray, "4 4"]:
            """Return the motion from the reference's image on, or back to an earlier time."""
            return exp(seconds * twist) if seconds > 0 else gone_back(-seconds, earlier)

        motion = moved_by(elapsed + frame.depth_delay) @ inverse(moved_by(self.delay))
        left = left_unexplained(self.inverse, np.asarray(frame.depth), motion, camera)
        if not np.isfinite(left) and explained < LEAST_EXPLAINED:
            left = 1.0 if _is_one_number(self.inverse) and _is_one_number(depth_on_grid(frame, camera)) else left
        return left

    def seen_from(self, frame: Frame, camera: Camera) -> "DepthChange":
        """Continue with another reference."""
        before = (*self.before, self.since)[-MOTIONS:] if self.since else self.before
        return DepthChange(depth_on_grid(frame, camera), frame.depth_delay, before, left=self.left)


def gone_back(seconds: float, motions: tuple[tuple[float, ...], ...]) -> Float64[np.ndarray, "4 4"]:
    """The motion from now back to an earlier time, along the last motions; the first of them goes on before it."""
    result = np.eye(4)
    for number, (duration, *velocity) in reversed(list(enumerate(motions))):
        here = seconds if number == 0 else min(seconds, duration)
        result = exp(-here * np.array(velocity)) @ result
        seconds -= here
    return result


def depth_on_grid(frame: Frame, camera: Camera) -> Float64[np.ndarray, "rows columns"]:
    """Inverse depth of a frame on the grid, 1/m; 0 without a reading."""
    rows, columns = _grid(camera)
    return inverse_depth(np.asarray(frame.depth)[rows, columns], camera)


def left_unexplained(
    reference: Float64[np.ndarray, "rows columns"], depth: np.ndarray, target_T_reference: np.ndarray, camera: Camera
) -> float:
    """Median error of inverse depth under a motion over that at rest, at the points where the two differ most.

    Args:
        reference: Inverse depth of the reference on the grid, 1/m.
        depth: Raw depth of the target, [H, W].
        target_T_reference: Motion between the moments of both depth images.
        camera: Camera of both frames.

    Returns:
        0 where the motion explains all, 1 where rest explains as much; NaN where too little changes.
    """
    row, column = _grid(camera)
    x, y = to_ray(camera, column, row)
    rotation, translation = target_T_reference[:3, :3], target_T_reference[:3, 3]
    there = np.stack(np.broadcast_arrays(x, y, 1.0)).reshape(3, -1)
    q = reference.ravel()
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = rotation @ there + q * translation[:, None]
        u, v = to_pixels(camera, moved[0], moved[1], 1 / moved[2])
        inside = (q > 0) & (moved[2] > 0) & in_image(camera, u, v)
    seen = _sampled(depth, np.where(inside, u, 0), np.where(inside, v, 0), camera)
    unmoved = inverse_depth(depth[row, column].ravel(), camera)
    inside &= (seen > 0) & (unmoved > 0)
    if np.count_nonzero(inside) < LEAST_POINTS:
        return np.nan
    at_motion = (seen - q / np.where(inside, moved[2], 1.0))[inside]
    at_rest = (unmoved - q)[inside]
    apart = np.abs(at_motion - at_rest)
    telling = apart > max(SMALLEST_CHANGE, float(np.quantile(apart, 1.0 - CHANGED)))
    if np.count_nonzero(telling) < LEAST_POINTS:
        return np.nan
    return float(np.median(np.abs(at_motion[telling])) / max(np.median(np.abs(at_rest[telling])), 1e-9))


def _is_one_number(inverse: Float64[np.ndarray, "rows columns"]) -> bool:
    """Whether all readings on the grid are one number."""
    readings = inverse[inverse > 0]
    return readings.size >= LEAST_POINTS and is_one_number(readings)


def _grid(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Rows [R, 1] and columns [1, C] of the grid."""
    step = max(camera.width // COLUMNS, 1)
    row, column = np.ogrid[step // 2 : camera.height : step, step // 2 : camera.width : step]
    return row, column


def _sampled(depth: np.ndarray, u: np.ndarray, v: np.ndarray, camera: Camera) -> np.ndarray:
    """Inverse depth between pixels, 1/m; 0 where one of the four neighbours has no reading, or an edge lies between."""
    left, above = np.minimum(u.astype(int), camera.width - 2), np.minimum(v.astype(int), camera.height - 2)
    down_by, along_by = np.array([[0], [0], [1], [1]]), np.array([[0], [1], [0], [1]])
    around = inverse_depth(depth[above + down_by, left + along_by], camera)
    along, down = u - left, v - above
    weights = np.stack([(1 - down) * (1 - along), (1 - down) * along, down * (1 - along), down * along])
    is_smooth = np.all(around > 0, axis=0) & (np.ptp(around, axis=0) < EDGE)
    return np.where(is_smooth, np.sum(weights * around, axis=0), 0.0)
