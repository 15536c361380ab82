"""Gain from a map of keyframes: error with and without loop closures, false loops, and relocalisation after a loss.

Prints up to four tables:

- `clips`: absolute error and drift of each clip before and after loop closure;
- `false`: absolute error with false loops planted in the first clip's pose graph;
- `synthetic`: error at the end of a rendered walk that returns to its start, with exact ground truth;
- `covered`: relocalisation after ten frames with a covered lens, in another part of the mapped scene (right within 5 cm
  and 3 degrees), or in a scene that is not in the map.

A fifth one, `long`, is printed only on request: 2,000 frames of rounds through a rendered room, 320 x 240, with the
lens covered for a second in each round. For every 250 frames it has the processor time of tracking and of the map per
uncovered frame, the map's longest time for one frame, resident memory, and keyframes. Here the map works after each
frame, not in parallel with tracking, so that the two can be timed separately.

    python benchmarks/loops.py
    python benchmarks/loops.py --clips fr1_desk_loop --parts clips,false
    python benchmarks/loops.py --parts covered --map-of fr1_desk_loop --tried fr1_desk
    python benchmarks/loops.py --parts long

On 2 cores the defaults take about 10 minutes.
"""

import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import common
import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame, Sequence
from gavo_jax.datasets.registry import open_source
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.evaluation import absolute_trajectory_error
from gavo_jax.mapping.correction import correct
from gavo_jax.mapping.mapper import Loops, Mapper
from gavo_jax.mapping.pose_graph import COUNTED, optimise
from gavo_jax.mapping.verification import Edge
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.metrics import ABSOLUTE_ERROR, DRIFT, FRAMES_PER_SECOND, ROTATION_DRIFT
from gavo_jax.odometry.run import run_odometry, trajectory_of
from gavo_jax.odometry.stream import track
from gavo_jax.output.screen import number
from gavo_jax.rigid_motions import exp, length_and_angle
from gavo_jax.settings import Settings
from gavo_jax.trajectory import Trajectory, inverse

PARTS = "clips,false,synthetic,covered"
COVERED, SOUGHT = 10, 5
"""Frames for which the lens is covered, and within which it must then be relocalised."""
NEAR = (0.05, np.radians(3.0))
"""Metres and radians within which a place is right."""
FALSE_SHARES = (0.1, 0.3, 0.5)
FALSE_TRIES = 5
WALK = 300
"""Frames of the synthetic walk, 10 seconds."""
SMALL = Camera(262.5, 262.5, 159.5, 119.5, 320, 240)
"""The camera of the rendered rooms."""
ROUND, UNSEEN, BLOCK = 125, 30, 250
"""Frames of one round of the long walk, those of them with a covered lens, and frames per row of its table."""


def with_loops(name: str) -> Settings:
    """The settings of METHOD:PRESET, with loops."""
    settings = common.preset_of(name)
    return replace(settings, odometry=replace(settings.odometry, loops=True))


def compare_clips(clips: list[str], settings: Settings) -> list[dict[str, Any]]:
    """Errors of each clip before and after loop closure."""
    rows = []
    for clip in clips:
        metrics: dict[str, Any] = dict(run_odometry(common.open_clip(clip), settings).metrics)
        keys = (ABSOLUTE_ERROR, DRIFT, ROTATION_DRIFT)
        row = {"clip": clip} | {key: metrics[key] for key in ("keyframes", "loops", "loops_refused", FRAMES_PER_SECOND)}
        rows.append(row | {key: (metrics[f"odometry_{key}"], metrics[key]) for key in keys})
    return rows


def mapped(sequence: Sequence, settings: Settings) -> tuple[Odometry, Mapper, list[Step]]:
    """Track a sequence with a map, without finishing the map."""
    mapper = Mapper(sequence.camera)
    odometry = Odometry(sequence.camera, settings, relocaliser=mapper)
    steps = list(track(sequence, odometry=odometry, watch=mapper.watch))
    return odometry, mapper, steps


def plant_false_loops(clip: str, settings: Settings) -> list[dict[str, Any]]:
    """Absolute error with false loops in the pose graph, the worst of several tries."""
    sequence = common.open_clip(clip)
    _, mapper, steps = mapped(sequence, settings)
    truth, causal = sequence.ground_truth, trajectory_of(float(sequence.timestamps[0]), steps)
    loops = mapper.finish()
    if truth is None:
        raise GavoError(f"{clip}: no ground truth")
    poses = np.stack([keyframe.world_T_odometry for keyframe in loops.keyframes])
    edges, rng, rows = mapper.edges, np.random.default_rng(0), []
    for share in (0.0, *FALSE_SHARES):
        results = []
        for _ in range(FALSE_TRIES if share else 1):
            false = [_false_loop(rng, len(poses)) for _ in range(round(share * len(edges)))]
            solution = optimise(poses, mapper.odometry_edges(), edges + false)
            for keyframe, pose in zip(loops.keyframes, solution.world_T_camera, strict=True):
                keyframe.world_T_camera = pose
            corrected = correct(causal, Loops(loops.keyframes, edges + false, solution))
            kept = int(np.sum(solution.weights[len(edges) :] > COUNTED))
            results.append((absolute_trajectory_error(corrected, truth).rmse, kept, len(false)))
        rows.append(
            {
                "share": share,
                "planted": sum(result[2] for result in results),
                "kept": sum(result[1] for result in results),
                "worst_m": max(result[0] for result in results),
            }
        )
    return rows


def _false_loop(rng: np.random.Generator, keyframes: int) -> Edge:
    earlier, later = np.sort(rng.choice(keyframes, 2, replace=False))
    return Edge(int(earlier), int(later), exp(0.3 * rng.normal(size=6)), (0.002**2) * np.eye(6))


def walk(seed: int) -> Trajectory:
    """One round about the middle of a room, looking outwards, back to its start."""
    turn = np.linspace(0.0, 2.0 * np.pi, WALK - 30)
    return around(np.concatenate([turn, np.full(30, turn[-1])]) + 0.4 * seed)


def rounds(frames: int) -> Trajectory:
    """Many rounds about the middle of a room, at slowly varying distance from the walls."""
    turn = 2.0 * np.pi * np.arange(frames) / ROUND
    return around(turn, 0.6 + 0.15 * np.sin(0.37 * turn))


def around(turn: np.ndarray, radius: np.ndarray | float = 0.6) -> Trajectory:
    """Poses at angles `turn` about the middle of a room, at `radius` metres from it, looking outwards."""
    forward = np.stack([np.cos(turn), np.sin(turn), np.full(len(turn), -0.15)], axis=1)
    place = np.stack([np.cos(turn), np.sin(turn), 0.1 * np.sin(3 * turn)], axis=1)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(turn), 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=2)
    poses[:, :3, 3] = np.reshape(radius, (-1, 1)) * place + [0.0, 0.0, 1.35]
    return Trajectory(np.arange(len(turn)) / 30.0, poses)


def measure_walks(settings: Settings, seeds: int) -> list[dict[str, Any]]:
    """The error at the end of synthetic loops, with the first pose as the origin of both trajectories."""
    rows = []
    for seed in range(seeds):
        sequence = SyntheticSequence(seed=seed, trajectory=walk(seed), camera=SMALL)
        run = run_odometry(sequence, settings, seed=seed)
        truth = sequence.ground_truth.world_T_camera
        end = inverse(truth[0]) @ truth[-1]
        assert run.odometry is not None
        errors = [length_and_angle(inverse(end) @ poses.world_T_camera[-1]) for poses in (run.odometry, run.trajectory)]
        rows.append({"seed": seed, "before": errors[0], "after": errors[1]})
    return rows


def dark(frame: Frame, timestamp: float) -> Frame:
    """A frame as a covered lens shows it."""
    grey = np.full_like(frame.grey, 3)
    return replace(frame, grey=grey, depth=np.zeros_like(frame.depth), timestamp=timestamp, depth_timestamp=timestamp)


def measure_long(settings: Settings, frames: int) -> list[dict[str, Any]]:
    """Time and memory of a long walk, block by block."""
    sequence = SyntheticSequence(trajectory=rounds(frames), camera=SMALL)
    mapper = Mapper(sequence.camera)
    odometry = Odometry(sequence.camera, settings, relocaliser=mapper)
    odometry.warm_up()
    mapper.warm_up()
    rows: list[dict[str, Any]] = []
    costs: list[tuple[float, float]] = []
    found = 0
    for index, timestamp in enumerate(sequence.timestamps):
        frame = sequence[index]
        is_covered = index % ROUND >= ROUND - UNSEEN
        if is_covered:
            frame = dark(frame, float(timestamp))
        before = time.process_time()
        step = odometry.register(frame, float(timestamp))
        between = time.process_time()
        mapper.watch(frame, step)
        if not is_covered:
            costs.append((between - before, time.process_time() - between))
        found += step is not None and step.origin == "relocalised"
        if (index + 1) % BLOCK == 0 or index + 1 == frames:
            tracking, mapping = 1e3 * np.array(costs).T
            row = {"frames": index + 1, "tracking_ms": tracking.mean(), "mapping_ms": mapping.mean()}
            row |= {"longest_ms": mapping.max(), "resident_mib": resident(), "relocalised": found}
            row |= {"keyframes": len(mapper.keyframes.all), "searchable": len(mapper.keyframes.searchable())}
            rows.append(row | {"loops": len(mapper.edges)})
            costs = []
    return rows


def resident() -> float:
    """Resident memory of this process, MiB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def after_cover(frames: list[Frame], now: float, between: float) -> Iterator[Frame]:
    """Yield covered frames, then the given ones, with timestamps that continue from `now`."""
    for i in range(COVERED + len(frames)):
        now += between
        if i < COVERED:
            yield dark(frames[0], now)
        else:
            frame = frames[i - COVERED]
            yield replace(frame, timestamp=now, depth_timestamp=now + frame.depth_delay)


def try_covered(
    map_of: str, tried: str, foreign: list[Sequence], settings: Settings, tries: int, foreign_tries: int
) -> dict[str, Any]:
    """Relocalise after a covered lens, in the mapped scene and (which is false) in foreign ones."""
    sequence, other = common.open_clip(map_of), common.open_clip(tried)
    odometry, mapper, _ = mapped(sequence, settings)
    progress, between = odometry.progress, float(np.median(np.diff(sequence.timestamps)))
    seen = {round(float(stamp), 4) for stamp in sequence.timestamps}

    def attempt(frames: list[Frame], *origins: str) -> tuple[int, Step, float] | None:
        driver = Odometry(sequence.camera, settings, relocaliser=mapper)
        driver.progress = progress
        for i, frame in enumerate(after_cover(frames, float(sequence.timestamps[-1]), between)):
            start = time.perf_counter()
            step = driver.register(frame, frame.timestamp)
            if step is not None and i >= COVERED and step.origin in origins:
                return i - COVERED, step, time.perf_counter() - start
        return None

    rng = np.random.default_rng(0)
    starts = [i for i in range(len(other) - SOUGHT) if round(float(other.timestamps[i]), 4) not in seen]
    rows = []
    for first in sorted(rng.choice(starts, min(tries, len(starts)), replace=False)):
        found = attempt([other[int(first) + i] for i in range(SOUGHT)], "relocalised", "tracked")
        rows.append({"first": int(first), "after": None, "error_m": None, "error_rad": None})
        if found is not None:
            after, step, seconds = found
            truth = sequence.ground_truth
            assert truth is not None
            stamps = np.array([step.reference_timestamp, float(other.timestamps[int(first) + after])])
            poses, _ = truth.interpolate(stamps)
            error = length_and_angle(
                inverse(inverse(poses[1]) @ poses[0]) @ np.asarray(step.alignment.target_T_reference)
            )
            rows[-1] |= {"after": after + 1, "error_m": error[0], "error_rad": error[1], "seconds": seconds}
            rows[-1]["origin"] = step.origin
    false = 0
    for i in range(foreign_tries):
        scene = foreign[i % len(foreign)]
        first = int(rng.integers(0, len(scene) - SOUGHT))
        frames = [seen_by(sequence.camera, scene[first + k], scene.camera) for k in range(SOUGHT)]
        false += attempt(frames, "relocalised") is not None
    return {"tries": rows, "foreign": foreign_tries, "false": false}


def seen_by(camera: Camera, frame: Frame, own: Camera) -> Frame:
    """Return a frame of its own camera with its depth in the units of the map's camera.

    Raises:
        GavoError: it has another size than the map's images.
    """
    if frame.grey.shape != (camera.height, camera.width):
        raise GavoError(f"a frame of {frame.grey.shape} is not of the map's size")
    depth = np.asarray(frame.depth) * (camera.depth_scale / own.depth_scale)
    return replace(frame, depth=np.where(depth < 65535, depth, 0).round().astype(np.uint16))


def main(
    parts: str = PARTS,
    clips: str = "fr1_desk_loop,fr1_xyz:100,fr1_desk,fr1_rpy",
    method: str = "ga:fast",
    map_of: str = "fr1_desk_loop",
    tried: str = "fr1_desk",
    foreign: str = "redkitchen_7scenes",
    tries: int = 10,
    foreign_tries: int = 50,
    seeds: int = 2,
    long: int = 2000,
    json: Path | None = None,
) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        parts: comma-separated tables.
        clips: comma-separated, as for drift.py.
        method: METHOD or METHOD:PRESET.
        map_of: clip that the map of `covered` is built from.
        tried: clip of the same scene, whose other frames are seen after the cover.
        foreign: comma-separated folders of other scenes in GAVO_DATA; rendered rooms are added.
        tries: tries with frames of `tried`.
        foreign_tries: tries with frames of other scenes.
        seeds: synthetic walks.
        long: frames of the long walk.
        json: file for the figures.
    """
    settings, results, wanted = with_loops(method), {}, common.names(parts)
    if "clips" in wanted:
        results["clips"] = rows = compare_clips(common.names(clips), settings)
        common.print_table(
            "before → after loops",
            ("clip", "absolute m", "drift m/s", "deg/s", "keyframes", "loops", "refused", "frames/s"),
            [
                [row["clip"]]
                + [f"{number(row[key][0], 4)} → {number(row[key][1], 4)}" for key in (ABSOLUTE_ERROR, DRIFT)]
                + [f"{number(row[ROTATION_DRIFT][0], 2)} → {number(row[ROTATION_DRIFT][1], 2)}"]
                + [row["keyframes"], row["loops"], row["loops_refused"], number(row[FRAMES_PER_SECOND], 1)]
                for row in rows
            ],
        )
    if "false" in wanted:
        results["false"] = rows = plant_false_loops(common.names(clips)[0], settings)
        common.print_table(
            f"false loops planted in {common.names(clips)[0]}, {FALSE_TRIES} tries",
            ("share", "planted", "kept", "worst absolute m"),
            [[number(row["share"], 1), row["planted"], row["kept"], number(row["worst_m"], 4)] for row in rows],
        )
    if "synthetic" in wanted:
        results["synthetic"] = rows = measure_walks(settings, seeds)
        common.print_table(
            "error at the end of a synthetic loop",
            ("seed", "odometry mm", "deg", "with loops mm", "deg"),
            [
                [row["seed"]]
                + [number(f(part), 2) for e in ("before", "after") for f, part in zip(UNITS, row[e], strict=True)]
                for row in rows
            ],
        )
    if "long" in wanted:
        results["long"] = rows = measure_long(settings, long)
        keys = ("tracking_ms", "mapping_ms", "longest_ms", "resident_mib")
        counted = ("keyframes", "searchable", "loops", "relocalised")
        common.print_table(
            "processor time and memory of a long run",
            ("frames", "tracking ms", "map ms", "longest ms", "MiB", "keyframes", "with images", "loops", "found"),
            [[row["frames"], *(number(row[k], 1) for k in keys), *(row[k] for k in counted)] for row in rows],
        )
    if "covered" in wanted:
        scenes: list[Sequence] = [open_source(common.folder_of(name)) for name in common.names(foreign)]
        scenes += [SyntheticSequence(60, seed=seed) for seed in range(4)]
        results["covered"] = found = try_covered(map_of, tried, scenes, settings, tries, foreign_tries)
        common.print_table(
            f"covered for {COVERED} frames; {found['false']} of {found['foreign']} found at foreign scenes",
            ("first frame", "found after", "by", "off by mm", "deg", "right"),
            [
                [row["first"], row["after"] or "–", row.get("origin", "–")]
                + [number(f(row[key]) if row["after"] else None, 1) for f, key in zip(UNITS, ERRORS, strict=True)]
                + ["yes" if row["after"] and row["error_m"] < NEAR[0] and row["error_rad"] < NEAR[1] else "no"]
                for row in found["tries"]
            ],
        )
    common.record(json, "loops", results)
    return results


UNITS = (lambda metres: 1e3 * metres, np.degrees)
ERRORS = ("error_m", "error_rad")


if __name__ == "__main__":
    common.command(main)
