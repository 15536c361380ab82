"""Facts about a source of frames: in full for `gavo inspect`, and in one line for every run."""

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame, FrameError, Sequence
from gavo_jax.datasets.depth_doubts import doubt_of_depth, fault_of_depth
from gavo_jax.datasets.depth_unit import name_of_unit
from gavo_jax.datasets.rectified import rectified_at
from gavo_jax.depth_edges import DepthEdges
from gavo_jax.frame_checks import MAX_INTERVAL_RATIO, MIN_INTERVAL_RATIO, History, Use, check_frame, some_of
from gavo_jax.status import AlignmentStatus

Facts = dict[str, Any]

MAX_REASONS = 5
"""Largest number of unreadable frames whose reason is listed."""


def summary(sequence: Sequence) -> str:
    """Describe a source in one line: its kind, number of frames, camera and that one's origin, and unit of depth.

    For a recording it names the topics of colour and depth; if the frame rate is a guess, it says so.
    """
    camera, source = sequence.camera, _source(sequence)
    guess = source["times_guessed"] and f" at {_times(np.asarray(sequence.timestamps))['rate_hz'] or 0:.4g} frames/s"
    rate = f"{guess} ({source['times_guessed']})" if guess else ""
    topics = f" of {' and '.join(source['topics'])}" if source["topics"] else ""
    return (
        f"{sequence.name}: {source['kind']}{topics}, {len(sequence)} frames of {camera.width}x{camera.height}{rate}; "
        f"camera fx {camera.fx:g} fy {camera.fy:g} cx {camera.cx:g} cy {camera.cy:g} ({source['camera_from']}); "
        f"depth in {unit_of(source)}"
    )


def unit_of(source: Facts) -> str:
    """Return the unit of depth in words, marked as a guess if nothing states it."""
    doubt = ", a guess: pass --depth-scale if it is another" if source["depth_unit_assumed"] else ""
    return f"{name_of_unit(source['depth_units_per_metre'])}{doubt}"


def left_out(sequence: Sequence) -> list[str]:
    """List what the source contains that yields no frame, and why, a line each."""
    return list(getattr(sequence, "left_out", ()))


def left_out_in_short(sequence: Sequence) -> str | None:
    """Summarise in a line how much of the source yields no frame; None if all of it does."""
    counts = ", ".join(line.partition(": ")[0] for line in left_out(sequence))
    return f"left out: {counts}" if counts else None


def inspect_sequence(sequence: Sequence, on_frame: Callable[[], None] = lambda: None) -> Facts:
    """Examine every frame and return the facts, ready for JSON; docs/sources.md explains their names.

    Args:
        sequence: at least two frames.
        on_frame: called after each frame.
    """
    stamps = np.asarray(sequence.timestamps)
    looked = _look(sequence, on_frame)
    return {
        "name": sequence.name,
        **_source(sequence),
        "frames": len(sequence),
        "frames_used": looked["used"],
        "frames_not_used": looked["not_used"],
        "frames_doubted": looked["doubted"],
        "why_not": looked["reasons"],
        "left_out": left_out(sequence),
        **_times(stamps),
        "delay_of_depth_ms": looked["delay"],
        "image": looked["image"],
        "depth": looked["depth"] | {"fault": fault_of_depth(sequence), "doubt": doubt_of_depth(sequence)},
        "camera": _camera(sequence.camera),
        "recorded_camera": _recorded(sequence),
        "ground_truth": _truth(sequence, stamps),
    }


def _source(sequence: Sequence) -> Facts:
    calibration, unit = getattr(sequence, "calibration", None), getattr(sequence, "depth_unit", None)
    return {
        "kind": getattr(sequence, "kind", type(sequence).__name__),
        "topics": list(getattr(sequence, "topics", ())),
        "times_guessed": getattr(sequence, "times_guessed", ""),
        "camera_from": getattr(calibration, "origin", "the sequence"),
        "depth_unit_assumed": getattr(sequence, "unit_is_assumed", False),
        "depth_units_per_metre": sequence.camera.depth_scale if unit is None else unit.file,
    }


def _look(sequence: Sequence, on_frame: Callable[[], None]) -> Facts:
    """Decode every frame and check it as a run would, before anything is aligned."""
    history, statuses, reasons, delays, ranges, coverages = History(), Counter(), [], [], [], []
    used, contrast, doubted, edges = 0, [], Counter(), DepthEdges.none()
    for index, timestamp in enumerate(sequence.timestamps):
        try:
            frame: Frame | FrameError = rectified_at(sequence, index)
        except FrameError as error:
            frame = error
            reasons.append(str(error))
        finding, history = check_frame(frame, float(timestamp), sequence.camera, history)
        if finding.use is Use.NOTHING:
            statuses[str(finding.status)] += 1
        else:
            used += 1
            if finding.status is not AlignmentStatus.OK:
                doubted[str(finding.status)] += 1
        if isinstance(frame, Frame):
            edges = edges.after(frame, sequence.camera)
            some = some_of(frame.depth)
            readings = some[some > 0] / sequence.camera.depth_scale
            coverages.append(readings.size / some.size)
            contrast.append((float(frame.grey.mean()), float(frame.grey.std())))
            if readings.size:
                ranges.append(np.percentile(readings, [1, 50, 99]))
            if frame.depth_timestamp is not None:
                delays.append(1e3 * (frame.depth_timestamp - frame.timestamp))
        on_frame()
    low, median, high = np.median(ranges, axis=0).tolist() if ranges else (None, None, None)
    mean, deviation = np.mean(contrast, axis=0).tolist() if contrast else (None, None)
    return {
        "used": used,
        "not_used": dict(statuses),
        "doubted": dict(doubted),
        "reasons": reasons[:MAX_REASONS],
        "delay": _spread(delays),
        "image": {"mean": mean, "standard_deviation": deviation},
        "depth": {
            "near_m": low,
            "median_m": median,
            "far_m": high,
            "coverage": float(np.mean(coverages)) if coverages else None,
            "lies": edges.fault or None,
        },
    }


def _spread(values: list[float]) -> dict[str, float] | None:
    if not values:
        return None
    return {"median": float(np.median(values)), "least": min(values), "most": max(values)}


def _times(stamps: np.ndarray) -> Facts:
    intervals = np.diff(stamps)
    interval = float(np.median(intervals)) if intervals.size else 0.0
    gaps = intervals[intervals > MAX_INTERVAL_RATIO * interval] if interval > 0 else intervals[:0]
    return {
        "first_timestamp": float(stamps[0]),
        "duration_s": float(stamps[-1] - stamps[0]),
        "rate_hz": 1 / interval if interval > 0 else None,
        "gaps": len(gaps),
        "longest_gap_s": float(gaps.max(initial=0.0)),
        "too_soon": int(np.count_nonzero(intervals < MIN_INTERVAL_RATIO * interval)),
    }


def _camera(camera: Camera) -> Facts:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(camera).items()}


def _recorded(sequence: Sequence) -> Facts | None:
    """Return the cameras before rectification, if the sequence gives them."""
    calibration = getattr(sequence, "calibration", None)
    if calibration is None:
        return None
    facts: Facts = {"color": _camera(calibration.color)}
    if calibration.depth is not None:
        facts |= {"depth": _camera(calibration.depth), "colour_T_depth": calibration.color_T_depth.tolist()}
    return facts


def _truth(sequence: Sequence, stamps: np.ndarray) -> Facts | None:
    truth = sequence.ground_truth
    if truth is None:
        return None
    _, valid = truth.interpolate(stamps)
    steps = np.diff(truth.world_T_camera[:, :3, 3], axis=0)
    return {
        "poses": len(truth),
        "duration_s": float(np.ptp(truth.timestamps)),
        "path_m": float(np.linalg.norm(steps, axis=1).sum()),
        "frames_covered": int(np.count_nonzero(valid)),
    }
