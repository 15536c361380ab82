"""Correction of a run's trajectory by its map."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int

from gavo_jax.mapping.keyframes import Keyframe
from gavo_jax.mapping.mapper import Loops, tied_segments
from gavo_jax.mapping.pose_graph import COUNTED
from gavo_jax.rigid_motions import interpolate
from gavo_jax.trajectory import Trajectory, inverse, stamp_name

IN_DOUBT = 100.0
"""Weight of a guessed motion over that of one that was found, where a correction changes along the trajectory."""


class Doubts(NamedTuple):
    """Which poses of a trajectory are no more than guesses."""

    guessed: Bool[np.ndarray, " n"]
    """Poses whose motion from the last one is a guess: lost, or taken to have gone on behind a body."""
    lost: Bool[np.ndarray, " n"]
    """Guessed poses of frames that were lost."""


def correct(odometry: Trajectory, loops: Loops, doubts: Doubts | None = None) -> Trajectory:
    """Correct a trajectory of the odometry as its keyframes were corrected.

    Between two keyframes the correction blends from one's to the other's, along the screw between the poses that they
    give. Where motions in between are guesses, nearly all of the change is put there. Segments that a loop joins become
    one.

    Args:
        odometry: The trajectory of the odometry.
        loops: The map, with its corrected keyframes.
        doubts: Which poses are guesses. Lost poses are interpolated between their neighbours if these are of one
            segment.
    """
    placed = _placed(loops.keyframes, odometry)
    if not placed:
        return odometry
    keyframes, places = zip(*placed, strict=True)
    passed = _passed(odometry.timestamps, doubts)
    at_keyframes = passed[list(places)]
    corrections = [keyframe.world_T_camera @ inverse(keyframe.world_T_odometry) for keyframe in keyframes]
    poses = np.empty_like(odometry.world_T_camera)
    for i, pose in enumerate(odometry.world_T_camera):
        after = int(np.searchsorted(places, i, side="right"))
        before = max(after - 1, 0)
        if 0 < after < len(places) and keyframes[before].segment == keyframes[after].segment:
            share = (passed[i] - at_keyframes[before]) / (at_keyframes[after] - at_keyframes[before])
            poses[i] = interpolate(corrections[before] @ pose, corrections[after] @ pose, float(share))
        else:
            nearest = after if _begins(keyframes, after, odometry.segments[i]) else before
            poses[i] = corrections[nearest] @ pose
    corrected = Trajectory(odometry.timestamps, poses, joined(odometry.segments, loops))
    return corrected if doubts is None else bridged(corrected, doubts.lost)


def _placed(keyframes: list[Keyframe], odometry: Trajectory) -> list[tuple[Keyframe, int]]:
    """Keyframes with their indices among the poses.

    Both are in the order in which the frames came. That need not be the order of their timestamps, as a clock may have
    been set back. The map may be ahead of a run that was interrupted.
    """
    places_of: dict[str, list[int]] = {}
    for i, stamp in enumerate(odometry.timestamps.tolist()):
        places_of.setdefault(stamp_name(stamp), []).append(i)
    placed, start = [], 0
    for keyframe in keyframes:
        places = [i for i in places_of.get(stamp_name(keyframe.timestamp), ()) if i >= start]
        if places:  # a timestamp may recur in another segment
            place = next((i for i in places if odometry.segments[i] == keyframe.segment), places[0])
            placed.append((keyframe, place))
            start = place + 1
    return placed


def _passed(stamps: Float64[np.ndarray, " n"], doubts: Doubts | None) -> Float64[np.ndarray, " n"]:
    """Seconds since the first pose; guessed motions count more. Where a clock was set back, the usual time passes."""
    between = np.diff(stamps)
    grows = between > 0
    usual = np.median(between[grows]) if np.any(grows) else 1.0
    weights = 1.0 if doubts is None else np.where(doubts.guessed[1:], IN_DOUBT, 1.0)
    return np.concatenate([[0.0], np.cumsum(weights * np.where(grows, between, usual))])


def bridged(trajectory: Trajectory, lost: Bool[np.ndarray, " n"]) -> Trajectory:
    """Interpolate the poses that were lost between two others of the same segment."""
    known = np.flatnonzero(~lost)
    poses, segments = trajectory.world_T_camera.copy(), trajectory.segments
    passed = _passed(trajectory.timestamps, None)
    for start, end in zip(known, known[1:], strict=False):
        for i in range(start + 1, end):
            if segments[start] == segments[i] == segments[end]:
                share = (passed[i] - passed[start]) / (passed[end] - passed[start])
                poses[i] = interpolate(poses[start], poses[end], float(share))
    return Trajectory(trajectory.timestamps, poses, segments)


def _begins(keyframes: Sequence[Keyframe], number: int, segment: int) -> bool:
    """Whether a frame before a keyframe belongs to that keyframe rather than to the one before."""
    return number < len(keyframes) and keyframes[number].segment == segment


def joined(segments: Int[np.ndarray, " n"], loops: Loops) -> Int[np.ndarray, " n"]:
    """Segments of poses, where those that loops join get the number of the first of them."""
    weighted = zip(loops.edges, loops.solution.weights, strict=True)
    first = tied_segments(loops.keyframes, (edge for edge, weight in weighted if weight > COUNTED))
    return np.array([first.get(int(segment), int(segment)) for segment in segments])


def loop_figures(loops: Loops) -> dict[str, int | float]:
    """Entries of metrics.json about the map."""
    counted = int(np.sum(loops.solution.weights > COUNTED))
    return {
        "keyframes": len(loops.keyframes),
        "loops": counted,
        "loops_refused": len(loops.edges) - counted,
        "odometry_covariance_scale": loops.solution.scale,
    }
