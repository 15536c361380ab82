"""How large a motion each method still finds: success rate on pairs k frames apart, from the identity.

A pair counts as found when its motion is within 5 cm and 3 degrees of the ground truth, interpolated at the colour
timestamps. Gaps count frames of the clip: if it keeps every 4th frame of a sequence, the motion is four times larger.

Prints one row per method (presets as METHOD:PRESET, peers by name): its success rate for each gap, median over the
seeds. The last rows have the number of pairs, their median motion, and how many of them see at least a tenth of each
other's points. A second table has the median errors of the pairs found, a third those of the pairs that every method
found. The last table rates the status as a detector of failure: precision (share of the flagged pairs that had failed),
recall (share of the failed pairs that were flagged), and milliseconds per pair. A peer's status is the flag that it
returns.

    python benchmarks/basin.py
    python benchmarks/basin.py --clip fr1_desk --gaps 3,10 --methods ga:wide,opencv-rgbd --json basin.json
    python benchmarks/basin.py --clip fr1_desk_loop --gaps 2,3,4,8 --step 1 --methods ga:wide,sift-pnp,orb-pnp
    python benchmarks/basin.py --figure docs
    python benchmarks/basin.py --recorded benchmarks/records/basin.toml,benchmarks/records/basin-wide.toml --figure docs

On 2 cores the defaults take about 10 minutes.
"""

import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import common
import jax
import numpy as np
from records import Record, read_record

from gavo_jax.alignment.pairs import align
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame, Sequence
from gavo_jax.errors import GavoError
from gavo_jax.evaluation import rotation_angle
from gavo_jax.output import plots
from gavo_jax.output.screen import number
from gavo_jax.peers.registry import PEERS, make_peer
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import inverse

METHODS = "ga:wide,ga,pso:wide,gauss-newton:wide,gauss-newton," + common.installed_peers()
TITLE = "success rate on "
MAX_TRANSLATION, MAX_ROTATION = 0.05, 3.0
"""Metres and degrees: a motion counts as found if its errors are smaller."""
LEAST_OVERLAP = 0.1
"""Share of each frame's points that the other must see for the pair to count as overlapping."""


class Pair(NamedTuple):
    """Two frames of a clip and the true motion between them."""

    reference: int
    target: int
    target_T_reference: np.ndarray


class Attempt(NamedTuple):
    """A method's result on a pair."""

    target_T_reference: np.ndarray
    flagged: bool
    """Whether the method itself reports a failure."""


Aligner = Callable[[Frame, Frame, int], Attempt]
"""Aligns a pair, given reference, target and seed."""


def pairs_apart(sequence: Sequence, gap: int, step: int) -> list[Pair]:
    """The pairs `gap` frames apart, every `step` frames; those without ground truth are left out.

    Raises:
        GavoError: the sequence has no ground truth.
    """
    if sequence.ground_truth is None:
        raise GavoError(f"{sequence.name}: has no ground truth")
    world_T_camera, valid = sequence.ground_truth.interpolate(sequence.timestamps)
    return [
        Pair(i, i + gap, inverse(world_T_camera[i + gap]) @ world_T_camera[i])
        for i in range(0, len(sequence) - gap, step)
        if valid[i] and valid[i + gap]
    ]


def make_aligner(name: str, camera: Camera) -> Aligner:
    """Make the aligner of a method or peer by its name.

    Raises:
        GavoError: unknown name.
    """
    if name in PEERS:
        peer = make_peer(name, camera)

        def by_peer(reference: Frame, target: Frame, seed: int) -> Attempt:
            del seed
            result = peer.align(peer.prepare(reference), peer.prepare(target))
            return Attempt(result.target_T_reference, not result.success)

        return by_peer
    settings = common.preset_of(name)

    def by_solver(reference: Frame, target: Frame, seed: int) -> Attempt:
        key = jax.random.key(seed)
        result = align(reference, target, camera, settings, key=key)
        return Attempt(np.asarray(result.target_T_reference, np.float64), result.status != AlignmentStatus.OK)

    return by_solver


def motion_size(a_T_b: np.ndarray) -> tuple[float, float]:
    """Length (m) and angle (degrees) of a rigid motion."""
    return float(np.linalg.norm(a_T_b[:3, 3])), float(np.degrees(rotation_angle(a_T_b[None, :3, :3])[0]))


def overlap(reference: Frame, target_T_reference: np.ndarray, camera: Camera) -> float:
    """Share of a frame's points that are in view of another camera."""
    row, column = np.mgrid[4 : camera.height : 8, 4 : camera.width : 8]
    z = reference.depth[row, column] / float(camera.depth_scale)
    points = np.asarray(camera.back_project(np.stack([column, row], axis=-1)[z > 0], z[z > 0]))
    seen = points @ target_T_reference[:3, :3].T + target_T_reference[:3, 3]
    pixels = np.asarray(camera.project(seen[seen[:, 2] > 0]))
    size = np.array([camera.width, camera.height])
    return float(np.sum(np.all((pixels > -0.5) & (pixels < size - 0.5), axis=1)) / max(len(points), 1))


def attempt_pairs(
    sequence: Sequence, pairs: list[Pair], aligners: dict[str, Aligner], seeds: int
) -> list[dict[str, Any]]:
    """Run every method on every pair, once per seed; a peer runs once."""
    records = []
    for pair in pairs:
        reference, target = sequence[pair.reference], sequence[pair.target]
        length, angle = motion_size(pair.target_T_reference)
        views = ((reference, pair.target_T_reference), (target, inverse(pair.target_T_reference)))
        seen = min(overlap(frame, motion, sequence.camera) for frame, motion in views)
        for name, aligner in aligners.items():
            for seed in range(1 if name in PEERS else seeds):
                start = time.perf_counter()
                attempt = aligner(reference, target, seed)
                milliseconds = (time.perf_counter() - start) * 1e3
                error = motion_size(inverse(pair.target_T_reference) @ attempt.target_T_reference)
                records.append(
                    {
                        "gap": pair.target - pair.reference,
                        "reference": pair.reference,
                        "method": name,
                        "seed": seed,
                        "motion_m": length,
                        "motion_deg": angle,
                        "overlap": seen,
                        "error_m": error[0],
                        "error_deg": error[1],
                        "found": error[0] < MAX_TRANSLATION and error[1] < MAX_ROTATION,
                        "flagged": bool(attempt.flagged),
                        "milliseconds": milliseconds,
                    }
                )
    return records


def success_rates(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row per gap: pairs, median motion and each method's success rate, median over the seeds."""
    rows = []
    for gap in dict.fromkeys(r["gap"] for r in records):
        of_gap = [r for r in records if r["gap"] == gap]
        motions = {r["reference"]: (r["motion_m"], r["motion_deg"]) for r in of_gap}
        length, angle = np.median(list(motions.values()), axis=0)
        rates = {}
        for name in dict.fromkeys(r["method"] for r in of_gap):
            by_seed: dict[int, list[bool]] = {}
            for r in of_gap:
                if r["method"] == name:
                    by_seed.setdefault(r["seed"], []).append(r["found"])
            rates[name] = float(np.median([np.mean(found) for found in by_seed.values()]))
        row: dict[str, Any] = {"gap": gap, "pairs": len(motions), "motion_m": length, "motion_deg": angle}
        overlapping = {r["reference"] for r in of_gap if r["overlap"] >= LEAST_OVERLAP}
        rows.append(row | {"overlapping": len(overlapping), "success": rates})
    return rows


def median_errors(records: list[dict[str, Any]], of_all: bool = False) -> list[dict[str, Any]]:
    """One row per gap and method: median errors of the pairs found, metres and degrees; None where there are none.

    `of_all` takes only the pairs that every method found, so that methods can be compared.
    """
    rows = []
    for gap in dict.fromkeys(r["gap"] for r in records):
        missed = {r["reference"] for r in records if r["gap"] == gap and of_all and not r["found"]}
        for name in dict.fromkeys(r["method"] for r in records):
            own = [r for r in records if r["gap"] == gap and r["method"] == name and r["found"]]
            found = [r for r in own if r["reference"] not in missed]
            metres, degrees = (
                float(np.median([r[key] for r in found])) if found else None for key in ("error_m", "error_deg")
            )
            rows.append({"gap": gap, "method": name, "found": len(found), "error_m": metres, "error_deg": degrees})
    return rows


def status_agreement(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row per method: precision and recall of its status as a sign of failure; None where undefined."""
    rows = []
    for name in dict.fromkeys(r["method"] for r in records):
        own = [r for r in records if r["method"] == name]
        failed, flagged = sum(not r["found"] for r in own), sum(r["flagged"] for r in own)
        both = sum(r["flagged"] and not r["found"] for r in own)
        rows.append(
            {
                "method": name,
                "attempts": len(own),
                "failed": failed,
                "flagged": flagged,
                "precision": both / flagged if flagged else None,
                "recall": both / failed if failed else None,
                "milliseconds": float(np.median([r["milliseconds"] for r in own])),
            }
        )
    return rows


def main(
    clip: str = "fr1_rpy",
    gaps: str = "1,3,6,10,15,30",
    methods: str = METHODS,
    step: int = 4,
    seeds: int = 1,
    json: Path | None = None,
    figure: Path | None = None,
    recorded: str = "",
) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clip: one clip, named as for drift.py.
        gaps: comma-separated distances of a pair's frames, in frames.
        methods: comma-separated METHOD, METHOD:PRESET or names of peers.
        step: frames between the starts of two pairs.
        seeds: runs of each of our methods per pair.
        json: file for every attempt and the rates.
        figure: folder for basin.png and basin.svg.
        recorded: comma-separated files that `--json` or `--record` wrote before, to draw together; nothing is
            measured.
    """
    if recorded.endswith(".toml"):
        _draw_records([read_record(Path(name)) for name in common.names(recorded)], figure or Path())
        return {}
    if recorded:
        found = common.read_records(recorded, "basin")
        attempts = [attempt for one in found for attempt in one["attempts"]]
        _draw(attempts, found[0]["clip"], figure or Path())
        return {"attempts": attempts}
    sequence = common.open_clip(clip)
    sequence.check()
    aligners = {name: make_aligner(name, sequence.camera) for name in common.names(methods)}
    records: list[dict[str, Any]] = []
    for gap in map(int, common.names(gaps)):
        records += attempt_pairs(sequence, pairs_apart(sequence, gap, step), aligners, seeds)
    if not records:
        raise GavoError(f"{clip}: no two frames with ground truth lie {gaps} frames apart")
    rates, agreement = success_rates(records), status_agreement(records)
    gap_names = [f"{row['gap']} frame{'s' * (row['gap'] > 1)}, {row['motion_deg']:.0f}°" for row in rates]
    rows: list[list[Any]] = [[name, *(number(row["success"][name], 2) for row in rates)] for name in aligners]
    motions = [f"{row['pairs']}, {row['motion_m']:.3f} m" for row in rates]
    overlapping = ["(that overlap)", *(str(row["overlapping"]) for row in rates)]
    common.print_table(f"{TITLE}{clip}", ("method", *gap_names), [*rows, ["(pairs, motion)", *motions], overlapping])
    errors, of_all = median_errors(records), median_errors(records, of_all=True)
    for title, of in (("", errors), (" by all", of_all)):
        rows = [
            [name]
            + [f"{number(row['error_m'], 4)} {number(row['error_deg'], 2)}" for row in of if row["method"] == name]
            for name in aligners
        ]
        common.print_table(f"median error of the found{title}, m and degrees", ("method", *gap_names), rows)
    rows = [
        [row["method"], row["attempts"], row["failed"], row["flagged"]]
        + [number(row["precision"], 2), number(row["recall"], 2), number(row["milliseconds"], 0)]
        for row in agreement
    ]
    common.print_table(
        "status against failure", ("method", "tries", "failed", "flagged", "precision", "recall", "ms/pair"), rows
    )
    results = {
        "clip": clip,
        "success": rates,
        "errors": errors,
        "errors_of_all": of_all,
        "status": agreement,
        "attempts": records,
    }
    common.record(json, "basin", results)
    if figure is not None:
        _draw(records, clip, figure)
    return results


def _draw(records: list[dict[str, Any]], clip: str, folder: Path) -> None:
    rates = success_rates(records)
    motion = np.array([row["motion_deg"] for row in rates])
    success = {name: np.array([row["success"][name] for row in rates]) for name in rates[0]["success"]}
    ours = [name for name in success if name not in PEERS]
    common.save_figure(plots.plot_basin(motion, success, clip, ours), folder, "basin", [motion, success])


def _draw_records(found: Iterable[Record], folder: Path) -> None:
    """Draw the success rates of records; a method may lack some of the gaps."""
    tables = [table for record in found for table in record.tables if table.title.startswith(TITLE)]
    gaps = sorted({float(heading.split(", ")[1].rstrip("°")) for table in tables for heading in table.columns[1:]})
    success: dict[str, np.ndarray] = {}
    for table in tables:
        angles = [float(heading.split(", ")[1].rstrip("°")) for heading in table.columns[1:]]
        for name, *cells in table.rows:
            if not name.startswith("("):
                rates = dict(zip(angles, map(float, cells), strict=True))
                success[name] = np.array([rates.get(gap, np.nan) for gap in gaps])
    ours = sorted((name for name in success if name not in PEERS), key=METHODS.split(",").index)
    success = {name: success[name] for name in (*ours, *(name for name in success if name in PEERS))}
    clip = tables[0].title.removeprefix(TITLE)
    common.save_figure(plots.plot_basin(np.array(gaps), success, clip, ours), folder, "basin", [gaps, success])


if __name__ == "__main__":
    common.command(main)
