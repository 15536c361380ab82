"""The program for a frame: its pyramid, its motion from the last frame and the keyframe at once, the next references.

One compiled program does all of it, and what it needs of earlier frames stays on the device.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from gavo_jax.alignment.judgement import Part
from gavo_jax.alignment.result import Alignment
from gavo_jax.alignment.search import Population, align_views
from gavo_jax.alignment.sway import Swaying, VelocityChange
from gavo_jax.alignment.visits import Exchanged, levels_of, prepare_target
from gavo_jax.camera import Camera
from gavo_jax.compilation.programs import CachedProgram
from gavo_jax.image.pyramid import LEVELS, Pyramid, PyramidLevel, build_pyramid, halve_inverse_depth
from gavo_jax.image.sampling import Target
from gavo_jax.image.synchronisation import synchronise_depth
from gavo_jax.image.warp import Points, warp
from gavo_jax.objective.estimates import Brightness
from gavo_jax.objective.points import Reference, make_references, move_reference, undo_rolling_shutter
from gavo_jax.odometry.exposure import Exposure, in_exposure, in_one_brightness
from gavo_jax.odometry.plausibility import UNKNOWN_SECONDS, Usual, judge_by_history
from gavo_jax.se3 import exp
from gavo_jax.settings import AlignmentOptions, OdometryOptions
from gavo_jax.solvers.base import Solver


class TrackerState(NamedTuple):
    """State that stays on the device from frame to frame."""

    previous: Reference
    keyframe: Reference
    """Points of earlier frames in the previous frame's camera; see `renew_keyframe`."""
    previous_image: Target
    """The previous frame, packed for sampling, as the symmetric error needs it."""
    motion: Float[Array, " 6"]
    """Twist of the last motion, from the frame before the previous one to the previous one."""
    guess: Float[Array, " 6"]
    """Twist expected of the next motion if it takes as long: the last one, unless something better is known."""
    instant_motion: Float[Array, " 6"]
    """Twist that the last motion would be, had the camera always moved as it did at the previous frame's own moment."""
    velocity_change: VelocityChange
    """How the velocity changes from frame to frame."""
    seconds: Float[Array, ""]
    """Duration of the last motion, seconds; `UNKNOWN_SECONDS` where it is unknown."""
    part: Part
    """The part of the image whose points take part in the next search."""
    exposure: Exposure
    """Exposure of the previous frame; the keyframe's points are adjusted to it."""
    usual: Usual


class Clock(NamedTuple):
    """Times of a new frame, as inputs of the program."""

    elapsed: Any
    """Time since the reference's colour image, seconds."""
    depth_delay: Any
    """Time from the new colour image to the new depth image, seconds."""
    index: Any
    """Index in the sequence; with the run's key it determines the frame's random numbers."""


@partial(jax.jit, static_argnames="finest")
def _synchronised(pyramid: Pyramid, camera: Camera, twist: Float[Array, " 6"], finest: int) -> Pyramid:
    """The pyramid with depth moved along a twist (colour moment to depth moment), from level `finest` upwards."""
    levels = list(pyramid)
    moved = synchronise_depth(pyramid[finest].inverse_depth, camera.level(finest), exp(twist))
    for level in range(finest, len(levels)):
        levels[level] = PyramidLevel(levels[level].grey, moved)
        if level + 1 < len(levels):
            moved = halve_inverse_depth(moved)
    return tuple(levels)


KEYFRAME_SHARES = 16
"""Number of shares that a keyframe's points are dealt into, each renewed on its own."""
LEFT = 0.5
"""Ratio of a share's points to those of a new share below which points lost to bodies count as out of view."""
KEYFRAME_SPREAD = 0.2
"""Width of the range over which the shares' thresholds for renewal are evenly spread."""


def renew_keyframe(keyframe: Reference, newest: Reference, camera: Camera, overlap: Any) -> Reference:
    """Replace those points of a keyframe that are going out of view by the newest frame's.

    If a keyframe were replaced as a whole, all that follows would depend on which frame is the first below a threshold.
    Instead the points are dealt into shares, each with its own threshold, so that the shares soon come from different
    frames.

    Args:
        keyframe: Points of earlier frames in the newest frame's camera, [L, N].
        newest: The newest frame's points, likewise.
        camera: Camera of the last, finest level.
        overlap: Part of a share that is in view when it is replaced, on average over the shares.
    """
    places = np.arange(keyframe.grey.shape[-1])
    share = np.floor(KEYFRAME_SHARES * (places * (np.sqrt(1.25) - 0.5) % 1.0)).astype(int)  # each spans the image
    dealt = jax.nn.one_hot(share, KEYFRAME_SHARES)
    finest, newest_points = (jax.tree.map(lambda leaf: leaf[-1], view.points) for view in (keyframe, newest))
    inside = warp(finest, jnp.eye(4), camera).inside
    readings, newer = ((points.q > 0).astype(jnp.float32) @ dealt for points in (finest, newest_points))
    in_view = (inside @ dealt) / jnp.maximum(jnp.maximum(readings, LEFT * newer), 1.0)
    thresholds = overlap + KEYFRAME_SPREAD * np.linspace(-0.5, 0.5, KEYFRAME_SHARES)
    renewed = ((in_view < thresholds) | (readings == 0))[share]
    return jax.tree.map(lambda new, old: jnp.where(renewed, new, old), newest, keyframe)


class Moved(NamedTuple):
    """The motion of a frame, from which the next search starts; none for a first frame."""

    is_first: Bool[Array, ""]
    target_T_reference: Float[Array, "4 4"]
    motion: Float[Array, " 6"]
    """Twist ξ of the motion."""
    sway: Float[Array, " 6"]
    instant_motion: Float[Array, " 6"]
    """Twist that ξ would be, had the camera always moved as it did at the frame's own moment."""

    @classmethod
    def by(cls, result: Alignment, is_first: Bool[Array, ""]) -> "Moved":
        """Take the motion from a result."""
        motion, sway = jnp.where(is_first, 0.0, result.xi), jnp.where(is_first, 0.0, result.sway)
        return cls(is_first, jnp.where(is_first, jnp.eye(4), result.target_T_reference), motion, sway, motion + sway)


def as_exposed(camera: Camera, options: OdometryOptions) -> Camera:
    """The camera to compute with: its shutter is global where the options leave the rolling shutter out."""
    return camera if options.rolling_shutter else replace(camera, readout=0.0)


def readout_share(camera: Camera, elapsed: Any) -> Any:
    """Readout over the time between two frames; 0 where it is much longer than that, as timestamps may be off."""
    return camera.readout / elapsed * (camera.readout <= 1.5 * elapsed)


def _undo_rolling_shutter(
    newest: Reference, keyframe: Reference, moved: Moved, readout: Float[Array, ""]
) -> tuple[Reference, Reference]:
    """Undo the rolling shutter of both references by the motion that has been found.

    It is not undone for a first frame, whose motion is unknown.
    """
    as_exposed = newest.row_time
    newest = undo_rolling_shutter(newest, moved.instant_motion * readout)
    keyframe = undo_rolling_shutter(keyframe, moved.motion * readout)
    return newest._replace(row_time=jnp.where(moved.is_first, as_exposed, newest.row_time)), keyframe


def _velocity_change_after(state: TrackerState, moved: Moved, elapsed: Float[Array, ""]) -> VelocityChange:
    """Statistics of the velocity's changes after one more pair, which is `elapsed` seconds apart."""
    change = moved.motion / elapsed - state.motion / state.seconds
    was_second = ~jnp.any(state.motion != 0.0)  # the motion before is unknown
    velocity_change = state.velocity_change.after(moved.sway / elapsed, change)
    return velocity_change._replace(
        changes=jnp.where(was_second, state.velocity_change.changes, velocity_change.changes)
    )


def _usual_after(usual: Usual, result: Alignment, error: Float[Array, ""], is_first: Bool[Array, ""]) -> Usual:
    """The usual figures after one more result, with its error in squared pixels; a first frame adds none."""
    after = usual.after(result, error)
    return jax.tree.map(lambda new, old: jnp.where(is_first, old, new), after, usual)


@partial(CachedProgram, static=("record",), returns=(TrackerState, Reference, Points, Target, Alignment, Population))
def track_frame(
    state: TrackerState,
    grey: Array,
    depth: Array,
    clock: Clock,
    key: PRNGKeyArray,
    camera: Camera,
    solver: Solver,
    alignment: AlignmentOptions,
    options: OdometryOptions,
    *,
    record: bool,
) -> tuple[TrackerState, Alignment, Population | None]:
    """Process one frame: pyramid, alignment with the references, and the state for the next frame; `key` is the run's.

    Before the first frame the state holds no readings. That frame becomes both references, and its rolling shutter is
    not undone, as its motion is unknown. The same program serves it, as another one would have to be compiled too.
    """
    raw = build_pyramid(grey, depth, camera.depth_scale, LEVELS)
    exposure = Exposure.of(raw)
    since = clock.elapsed / state.seconds
    predicted, guess = state.motion * since, state.guess * since
    levels = levels_of(camera, solver, alignment)
    finest = levels.numbers[-1]
    delay = clock.depth_delay / clock.elapsed
    target = _synchronised(raw, camera, delay * guess, finest) if options.synchronise else raw
    packed = prepare_target(target, levels)
    readout = readout_share(camera, clock.elapsed) if options.rolling_shutter else None
    previous, keyframe = (in_exposure(view, state.exposure, exposure) for view in (state.previous, state.keyframe))
    exchanged = None
    if alignment.symmetric:
        exchanged = Exchanged(make_references(target, camera, levels), state.previous_image)
    result, populations = align_views(
        (previous, keyframe) if options.reference == "keyframe" else (previous,),
        packed,
        camera,
        levels,
        solver,
        alignment,
        jax.random.fold_in(key, clock.index),
        jnp.stack([exp(guess), jnp.eye(4)]) if options.prior else jnp.eye(4)[None],
        record=record,
        exchanged=exchanged,
        readout=readout,
        swaying=Swaying(clock.elapsed, state.velocity_change) if options.sway else None,
        part=state.part,
    )
    error = result.error / exposure.error_per_pixel(state.exposure)
    result = judge_by_history(result, state.usual, error, predicted, clock.elapsed, state.seconds)
    moved = Moved.by(result, is_first=~jnp.any(state.previous.points.q > 0))
    if options.synchronise:
        target = _synchronised(raw, camera, delay * moved.instant_motion, finest)
    newest = make_references(target, camera, levels)
    if readout is not None:
        newest, keyframe = _undo_rolling_shutter(newest, keyframe, moved, readout)
    keyframe, renewing = move_reference(keyframe, moved.target_T_reference), newest
    if options.reference == "keyframe":
        gain, bias = (found[-1] for found in result.brightness)
        seen = Brightness(jnp.where(moved.is_first, 1.0, gain), jnp.where(moved.is_first, 0.0, bias))
        keyframe, renewing = in_one_brightness(keyframe, newest, seen)
    after_it = TrackerState(
        previous=newest,
        keyframe=renew_keyframe(keyframe, renewing, camera.level(finest), options.keyframe_overlap),
        previous_image=packed,
        motion=moved.motion,
        guess=moved.motion,
        instant_motion=moved.instant_motion,
        velocity_change=_velocity_change_after(state, moved, clock.elapsed),
        seconds=clock.elapsed,
        part=Part.whole(),
        exposure=exposure,
        usual=_usual_after(state.usual, result, error, moved.is_first),
    )
    return after_it, result, populations


@jax.jit
def first_state(grey: Array, depth: Array, camera: Camera, solver: Solver, alignment: AlignmentOptions) -> TrackerState:
    """State after the first frame, by a separate program."""
    pyramid = build_pyramid(grey, depth, camera.depth_scale, LEVELS)
    levels = levels_of(camera, solver, alignment)
    reference, packed = make_references(pyramid, camera, levels), prepare_target(pyramid, levels)
    return TrackerState(
        previous=reference,
        keyframe=reference,
        previous_image=packed,
        motion=jnp.zeros(6),
        guess=jnp.zeros(6),
        instant_motion=jnp.zeros(6),
        velocity_change=VelocityChange.unknown(),
        seconds=jnp.float32(UNKNOWN_SECONDS),
        part=Part.whole(),
        exposure=Exposure.of(pyramid),
        usual=Usual.unknown(),
    )


def blank_state(camera: Camera, solver: Solver, alignment: AlignmentOptions) -> TrackerState:
    """The state before the first frame: blank, in the shapes and types of every state."""
    levels = levels_of(camera, solver, alignment)
    row: Any = np.zeros((len(levels.numbers), levels.most_points), np.float32)
    words: Any = np.zeros((levels.layout.height, levels.layout.width), np.uint32)
    reference = Reference(Points(row, row, row), *[row] * 8)
    zero: Any = np.float32(0.0)
    still: Any = np.zeros(6, np.float32)
    return TrackerState(
        previous=reference,
        keyframe=reference,
        previous_image=Target(words, words),
        motion=still,
        guess=still,
        instant_motion=still,
        velocity_change=VelocityChange.unknown(),
        seconds=np.float32(UNKNOWN_SECONDS),  # pyright: ignore[reportArgumentType]
        part=Part(np.float32(1.0), np.array(False)),  # pyright: ignore[reportArgumentType]
        exposure=Exposure(zero, zero, zero),
        usual=Usual.unknown(),
    )
