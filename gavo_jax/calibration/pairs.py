"""How well consecutive frames agree under assumed camera parameters: each pair's residuals at its best motion.

The parameters are inputs of one compiled program, so that a search over them recompiles nothing.
"""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Integer

from gavo_jax.alignment.fitting import fit_objective
from gavo_jax.alignment.search import align_views
from gavo_jax.alignment.visits import levels_of, prepare_target, stack_levels
from gavo_jax.camera import Camera, to_pixels, to_ray
from gavo_jax.datasets.base import Frame
from gavo_jax.image.pyramid import PyramidLevel, build_pyramid, halve_grey, halve_inverse_depth
from gavo_jax.image.sampling import Target
from gavo_jax.image.warp import Points, moved
from gavo_jax.objective.estimates import measured_scales
from gavo_jax.objective.points import Reference, make_references, undo_rolling_shutter
from gavo_jax.presets import HALF_SIZE_OBJECTIVE
from gavo_jax.se3 import exp, log, rigid_inverse
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.status import AlignmentStatus

SOLVER = GaussNewton(iterations=(6, 6, 8, 8, 0))
"""Solver of a pair, with `HALF_SIZE_OBJECTIVE`. A keyframe as another view would carry assumptions about the camera
from pair to pair."""


class Unknowns(NamedTuple):
    """Parameters of a camera that can be estimated."""

    readout: Any
    """Seconds from the first row to the last."""
    delay: Any
    """Seconds that depth was taken after its stamp, or after the colour image's if it has none."""
    fx: Any
    fy: Any
    cx: Any
    cy: Any
    vignetting: Any
    """Vignetting beyond what the frames were rectified by: a of (1 + a r²)⁻², which is 1 for an ideal lens."""

    @classmethod
    def of(cls, camera: Camera) -> "Unknowns":
        """Return a camera's own parameters."""
        return cls(camera.readout, 0.0, camera.fx, camera.fy, camera.cx, camera.cy, 0.0)

    def on(self, camera: Camera) -> Camera:
        """Return a camera with these parameters."""
        return replace(camera, fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy, readout=self.readout)


class Stretch(NamedTuple):
    """Consecutive frames of a recording, at half their size."""

    grey: Float[Array, "f h w"]
    inverse_depth: Float[Array, "f h w"]
    stamps: Float[Array, " f"]
    """Stamps of colour, seconds after the first one, with jitter removed; see `evened`."""
    delays: Float[Array, " f"]
    """Delays of depth after colour by the stamps, seconds."""

    @classmethod
    def of(cls, frames: Iterable[Frame], camera: Camera) -> "Stretch":
        """Stack frames on the device."""
        levels, stamps, depth_stamps = [], [], []
        for frame in frames:
            levels.append(_half(frame.grey, frame.depth, camera.depth_scale))
            stamps.append(frame.timestamp)
            depth_stamps.append(frame.timestamp + frame.depth_delay)
        grey, inverse_depth = (jnp.stack(images) for images in zip(*levels, strict=True))
        start = stamps[0]
        colour, depth = evened(np.array(stamps) - start), evened(np.array(depth_stamps) - start)
        return cls(grey, inverse_depth, jnp.asarray(colour, jnp.float32), jnp.asarray(depth - colour, jnp.float32))

    def some(self, frames: Integer[np.ndarray, " n"]) -> "Stretch":
        """Return a stretch of only some of the frames."""
        return Stretch(*(leaf[frames] for leaf in self))


MOST_JITTER = 0.3
"""Largest deviation from an even clock that is removed as jitter, as a share of the interval between frames."""


def evened(stamps: Float[np.ndarray, " f"]) -> Float[np.ndarray, " f"]:
    """Remove the jitter of stamps that follow an even clock; frames may be missing.

    A camera exposes at regular intervals, but a stamp says when an image arrived. A jitter of milliseconds, with 33
    between frames, would make the speed jump by a tenth from frame to frame, which would hide the true acceleration.
    """
    intervals = np.diff(stamps)
    usual = np.median(intervals)
    if not usual > 0:  # most of them repeat
        return stamps
    ticks = np.concatenate([[0.0], np.cumsum(np.round(intervals / usual))])
    interval, start = np.polyfit(ticks, stamps, 1)
    even = start + interval * ticks
    fits = len(np.unique(ticks)) == len(ticks) and np.abs(stamps - even).max() < MOST_JITTER * interval
    return even if fits else stamps


@jax.jit
def _half(grey: Array, depth: Array, depth_scale: Array | float) -> PyramidLevel:
    return build_pyramid(grey, depth, depth_scale, 2)[1]


class Kinematics(NamedTuple):
    """The camera's motion at the frames' timestamps: twists of the points in it, per second."""

    velocity: Float[Array, "f 6"]
    acceleration: Float[Array, "f 6"]
    between: Float[Array, "f 6"]
    """Mean velocity from a frame to the next; the last row is not used."""
    guesses: Float[Array, "f 4 4"]
    """target_T_reference from a frame to the next, to start from."""

    @classmethod
    def unknown(cls, frames: int) -> "Kinematics":
        """Return the kinematics of a camera at rest."""
        zero = jnp.zeros((frames, 6))
        return cls(zero, zero, zero, jnp.tile(jnp.eye(4), (frames, 1, 1)))

    @classmethod
    def of(cls, stamps: np.ndarray, matched: "Matched") -> "Kinematics":
        """Derive kinematics from the motions between frames: fourth-order central differences, second near the ends."""
        seconds = np.diff(stamps)[:, None]
        between = np.nan_to_num(np.asarray(matched.xi)) / seconds
        velocity = np.concatenate([between[:1], (between[1:] + between[:-1]) / 2, between[-1:]])
        if len(between) > 3:
            velocity[2:-2] = (7 * (between[1:-2] + between[2:-1]) - between[:-3] - between[3:]) / 12
        acceleration = np.zeros_like(velocity)
        acceleration[1:-1] = (between[1:] - between[:-1]) / ((seconds[1:] + seconds[:-1]) / 2)
        return cls(
            jnp.asarray(velocity, jnp.float32),
            jnp.asarray(acceleration, jnp.float32),
            jnp.asarray(np.concatenate([between, between[-1:]]), jnp.float32),
            jnp.concatenate([matched.target_T_reference, jnp.eye(4)[None]]),
        )

    def some(self, frames: Integer[np.ndarray, " n"], stamps: np.ndarray) -> "Kinematics":
        """Return the kinematics of some frames: at their timestamps, and composed from one to the next."""
        steps, guesses = np.asarray(self.guesses, np.float64), np.tile(np.eye(4), (len(frames), 1, 1))
        for place, (first, last) in enumerate(pairwise(frames)):
            for step in steps[first:last]:
                guesses[place] = step @ guesses[place]
        seconds = np.append(np.diff(stamps[frames]), 1.0)[:, None]
        between = np.asarray(jax.vmap(log)(jnp.asarray(guesses, jnp.float32))) / seconds
        return Kinematics(
            self.velocity[frames],
            self.acceleration[frames],
            jnp.asarray(between, jnp.float32),
            jnp.asarray(guesses, jnp.float32),
        )


class Matched(NamedTuple):
    """Best motion of each pair of consecutive frames, with the residuals that it leaves."""

    grey: Float[Array, " pairs"]
    """Logarithm of the grey residuals' scale."""
    depth: Float[Array, " pairs"]
    """Logarithm of the depth residuals' scale."""
    xi: Float[Array, "pairs 6"]
    target_T_reference: Float[Array, "pairs 4 4"]
    usable: Float[Array, " pairs"]


@partial(jax.jit, static_argnames="camera")
def match_pairs(stretch: Stretch, kinematics: Kinematics, unknowns: Unknowns, *, camera: Camera) -> Matched:
    """Align each frame of a stretch with the one before it by Gauss-Newton, under assumed camera parameters.

    Args:
        stretch: Frames.
        kinematics: The camera's motion, for the effects of shutter and delay.
        unknowns: Assumed parameters.
        camera: Camera of the full images; only its size matters.
    """
    seen = unknowns.on(camera).level(1)
    levels = levels_of(seen, SOLVER, HALF_SIZE_OBJECTIVE)

    x, y = to_ray(seen, jnp.arange(seen.width), jnp.arange(seen.height)[:, None])
    gain = (1.0 + unknowns.vignetting * (x**2 + y**2)) ** 2
    gain /= jnp.mean(gain)  # else residuals would become larger with it

    def prepare(frame: Array) -> tuple[Reference, Target]:
        late = stretch.delays[frame] + unknowns.delay
        twist = late * kinematics.velocity[frame] + 0.5 * late**2 * kinematics.acceleration[frame]
        depth = depth_moved(smoothed_depth(stretch.inverse_depth[frame]), seen, exp(twist))
        pyramid = [PyramidLevel(stretch.grey[frame] * gain, depth)]
        for _ in levels.numbers[1:]:
            pyramid.append(PyramidLevel(halve_grey(pyramid[-1].grey), halve_inverse_depth(pyramid[-1].inverse_depth)))
        return make_references(tuple(pyramid), seen, levels), prepare_target(tuple(pyramid), levels)

    references, targets = jax.lax.map(prepare, jnp.arange(stretch.stamps.shape[0]))

    def pair(first: Array) -> Matched:
        reference, target = (
            jax.tree.map(lambda leaf: leaf[first], references),
            jax.tree.map(lambda leaf: leaf[first + 1], targets),
        )
        # the target's rows are assumed to move at the mean velocity, so what the camera really gained in speed between
        # the two frames is subtracted from the reference's velocity
        gained = kinematics.velocity[first + 1] - kinematics.velocity[first]
        reference = undo_rolling_shutter(reference, (kinematics.between[first] - gained) * unknowns.readout)
        share = unknowns.readout / (stretch.stamps[first + 1] - stretch.stamps[first])
        key, guess = jax.random.key(0), kinematics.guesses[first][None]
        found, _ = align_views(
            (reference,), target, seen, levels, SOLVER, HALF_SIZE_OBJECTIVE, key, guess, readout=share
        )
        visits = stack_levels((reference,), seen, levels, HALF_SIZE_OBJECTIVE, None, share)
        finest = jax.tree.map(lambda leaf: leaf[-1], visits)
        objective, _ = fit_objective(finest, target, HALF_SIZE_OBJECTIVE, found.target_T_reference)
        # far depth's is below the bound that searches keep to
        grey, depth = measured_scales(objective.residuals(found.target_T_reference))
        usable = (found.status == int(AlignmentStatus.OK)).astype(jnp.float32)
        return Matched(jnp.log(grey), jnp.log(depth), found.xi, found.target_T_reference, usable)

    return jax.lax.map(pair, jnp.arange(stretch.stamps.shape[0] - 1))


ONE_SURFACE = 0.03
"""Largest relative difference of the inverse depths around a pixel that are averaged."""


def smoothed_depth(inverse_depth: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """Average depth over 3 x 3 pixels by binomial weights; 0 where they are not all of one surface."""
    height, width = inverse_depth.shape
    padded = jnp.pad(inverse_depth, 1)
    around = [padded[down : down + height, across : across + width] for down in range(3) for across in range(3)]
    weights = [down * across / 16 for down in (1, 2, 1) for across in (1, 2, 1)]
    nearest, farthest = jnp.max(jnp.stack(around), axis=0), jnp.min(jnp.stack(around), axis=0)
    mean = sum(weight * each for weight, each in zip(weights, around, strict=True))
    return jnp.where(farthest > nearest * (1.0 - ONE_SURFACE), mean, 0.0)


def depth_moved(
    inverse_depth: Float[Array, "h w"], camera: Camera, depth_T_colour: Float[Array, "4 4"]
) -> Float[Array, "h w"]:
    """Warp depth as `synchronise_depth` does, but with interpolation, by a cubic B-spline.

    Looking up the nearest pixel would not respond to moves of less than half a pixel, and here small changes matter.
    Interpolation must not smooth noise more at half a pixel than at none: depth would seem to agree worst if it is not
    moved. After `smoothed_depth` this spline smooths by the same within 1 %; linear interpolation halves white noise.

    Args:
        inverse_depth: 1/m, 0 = no reading, seen from the camera's pose when depth was read.
        camera: camera of the image.
        depth_T_colour: maps points of the camera at the colour image's timestamp into that at the depth image's.
    """
    height, width = inverse_depth.shape
    x, y = to_ray(camera, jnp.arange(width), jnp.arange(height)[:, None])
    x, y, z = moved(Points(x, y, inverse_depth), depth_T_colour)
    u, v = to_pixels(camera, x, y, 1.0 / jnp.maximum(z, 1e-3))
    inside = (z > 1e-3) & (inverse_depth > 0) & (u >= 1) & (u < width - 2) & (v >= 1) & (v < height - 2)
    column, row = (jnp.where(inside, jnp.floor(at), 1).astype(jnp.int32) for at in (u, v))
    flat, place = inverse_depth.reshape(-1), row * width + column
    across, down = _spline(u - column), _spline(v - row)
    nearest, farthest, read = jnp.zeros_like(z), jnp.full_like(z, jnp.inf), jnp.zeros_like(z)
    for below in range(4):
        for right in range(4):
            depth = flat.at[place + (below - 1) * width + right - 1].get(mode="promise_in_bounds")
            nearest, farthest = jnp.maximum(nearest, depth), jnp.minimum(farthest, depth)
            read += down[below] * across[right] * depth
    smooth = inside & (farthest > nearest * (1.0 - ONE_SURFACE))
    read = jnp.where(smooth, read, 0.0)
    _, _, back = moved(Points(*to_ray(camera, u, v), read), rigid_inverse(depth_T_colour))
    return jnp.where(smooth & (back > 1e-3), read / back, 0.0)


def _spline(place: Float[Array, "h w"]) -> tuple[Array, Array, Array, Array]:
    """Weights of a cubic B-spline at the four pixels around a place, given from 0 to 1 between the middle two."""
    left = 1.0 - place
    outer = left**3 / 6, place**3 / 6
    inner = 2 / 3 - place**2 + place**3 / 2, 2 / 3 - left**2 + left**3 / 2
    return outer[0], inner[0], inner[1], outer[1]
