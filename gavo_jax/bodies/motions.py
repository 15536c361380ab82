"""Which bodies a frame shows, and how each has moved: the camera's search on each body's own points."""

from typing import Any

import numpy as np
from jaxtyping import Float64, Integer

from gavo_jax.alignment.result import Alignment
from gavo_jax.alignment.sway import VelocityChange
from gavo_jax.bodies.belief import Belief
from gavo_jax.bodies.identity import BodyTracks, associate
from gavo_jax.bodies.records import Seen
from gavo_jax.bodies.scene import AwareState, MotionSegmenter
from gavo_jax.camera import to_ray
from gavo_jax.datasets.base import Frame
from gavo_jax.objective.points import Reference, apply_rolling_shutter
from gavo_jax.odometry.aligners import Aligner
from gavo_jax.odometry.plausibility import UNKNOWN_SECONDS, Usual
from gavo_jax.odometry.tracking import Clock, TrackerState, readout_share
from gavo_jax.status import AlignmentStatus


def find_motions(
    search: Aligner | None,
    segmenter: MotionSegmenter,
    state: AwareState,
    frame: Frame,
    clock: Clock,
    found: Integer[np.ndarray, "h w"],
    belief: Belief,
    inverse_depth: Float64[np.ndarray, "h w"],
) -> tuple[BodyTracks, tuple[Seen, ...]]:
    """The numbered bodies of a new frame, with their motions where these are asked for.

    Args:
        search: Finds a body's motion from its own points; None where only masks are asked for.
        segmenter: Segmenter of the frames.
        state: State before the frame.
        frame: The new frame.
        clock: When it was taken.
        found: Parts of the new frame that are bodies.
        belief: Belief about its pixels.
        inverse_depth: Inverse depth of its pixels, 1/m; 0 where there is no reading.
    """
    before = BodyTracks(*map(np.asarray, state.scene.tracks))
    tracks = associate(found, before)
    moving = np.asarray(belief.moving)
    seen = []
    for place, (number, age) in enumerate(zip(tracks.numbers, tracks.ages, strict=True)):
        part = (tracks.labels == number) & (found > 0)
        if number == 0 or age > 0 or not np.any(part):
            continue
        alignment = None
        if search is not None and np.any(before.numbers[before.ages == 0] == number):  # else its label is elsewhere
            alignment = _align(search, segmenter, state, frame, clock, before, int(number))
            is_known = alignment.status == AlignmentStatus.OK
            tracks.motions[place] = alignment.xi if is_known else 0.0
            tracks.seconds[place] = clock.elapsed if is_known else UNKNOWN_SECONDS
        field = np.where(part, np.maximum(moving, 1e-3), np.minimum(moving, -1e-3)).astype(np.float32)
        centroid = _centroid(part, inverse_depth, segmenter)
        seen.append(Seen(int(number), field, float(np.mean(part)), centroid, alignment))
    return tracks, tuple(seen)


def _align(
    search: Aligner,
    segmenter: MotionSegmenter,
    state: AwareState,
    frame: Frame,
    clock: Clock,
    before: BodyTracks,
    number: int,
) -> Alignment:
    """Motion of a body in the camera, from a search on its own points in the last frame."""
    place = int(np.flatnonzero(before.numbers == number)[0])
    whole = state.whole
    if np.any(state.tracker.instant_motion):
        whole = _with_rolling_shutter(whole, state.tracker, segmenter)
    motion: Any = np.float32(before.motions[place])
    tracker = state.tracker._replace(
        previous=whole,
        keyframe=whole,
        motion=motion,
        guess=motion,
        velocity_change=VelocityChange.unknown(),
        seconds=np.float32(before.seconds[place]),
        usual=Usual.unknown(),
        part=state.tracker.part._replace(is_body=np.array(True)),  # pyright: ignore[reportArgumentType]
    )
    return search.align(segmenter.without(tracker, before.labels != number), frame, clock).result


def _with_rolling_shutter(whole: Reference, tracker: TrackerState, segmenter: MotionSegmenter) -> Reference:
    """Move a frame's points back to where their rows saw them: only the camera's motion undid the shutter."""
    twist = tracker.instant_motion * readout_share(segmenter.full, tracker.seconds)
    return apply_rolling_shutter(whole, twist, segmenter.planes)


def _centroid(
    part: np.ndarray, inverse_depth: Float64[np.ndarray, "h w"], segmenter: MotionSegmenter
) -> Float64[np.ndarray, " 3"]:
    """Centroid, in the camera, of the points that a mask's pixels show; NaN without any reading."""
    v, u = np.nonzero(part & (inverse_depth > 0))
    if len(u) == 0:
        return np.full(3, np.nan)
    x, y = to_ray(segmenter.camera, u, v)
    return np.mean(np.stack([x, y, np.ones_like(x)]) / inverse_depth[v, u], axis=1)
