"""Drift of every method on every clip: ours with their presets, and the peers.

Prints, for each clip, one row per method: drift (RPE over 1 s, RMSE) of translation in m/s and of rotation in deg/s,
each as the median over the seeds with its spread (largest over smallest), the lost pairs of the worst run, and the
milliseconds per pair. A last table has the ratios to the best peer and of the GA to Gauss-Newton, clip by clip, with
their geometric mean and the worst. The best peer is chosen for each clip, in translation and in rotation separately.

    python benchmarks/drift.py
    python benchmarks/drift.py --clips fr1_xyz:30 --methods ga,gauss-newton,opencv-rgb --seeds 2 --json drift.json
    python benchmarks/drift.py --figure docs
    python benchmarks/drift.py --recorded ours.json,peers.json --figure docs
    python benchmarks/drift.py --recorded benchmarks/records/drift.toml,… --figure docs

Clips are NAME or NAME:FRAMES: a folder in TUM layout, a folder of GAVO_DATA, or the word synthetic. Methods are METHOD,
METHOD:PRESET, or the name of a peer. On 2 cores the defaults take about half an hour, most of it for `ga:paper`, which
runs at full resolution as in the paper; without it, ten minutes.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import common
import numpy as np
from records import Record, read_record

from gavo_jax.odometry.metrics import DRIFT, ROTATION_DRIFT
from gavo_jax.output import plots
from gavo_jax.output.screen import number
from gavo_jax.peers.registry import PEERS

TITLE = "drift on "
METHODS = "ga,pso,gauss-newton,adam,ga:paper,ga:fast," + common.installed_peers()


class Ratio(NamedTuple):
    """Ratios of a figure to its reference, clip by clip."""

    name: str
    by_clip: dict[str, float]

    @property
    def mean(self) -> float:
        """Geometric mean over the clips."""
        return common.geometric_mean(list(self.by_clip.values()))

    @property
    def worst(self) -> float:
        """Largest over the clips."""
        return max(self.by_clip.values())


def ratios(summaries: list[common.Summary]) -> list[Ratio]:
    """Ratios of our methods to the best peer, and of each GA preset to Gauss-Newton's of the same name."""
    clips = list(dict.fromkeys(summary.clip for summary in summaries))
    by_key = {(summary.clip, summary.name): summary for summary in summaries}
    contenders = list(dict.fromkeys(summary.name for summary in summaries))
    ours, peers = [n for n in contenders if n not in PEERS], [n for n in contenders if n in PEERS]
    pairs: list[tuple[str, list[str], str]] = [(name, peers, "best peer") for name in ours if peers]
    for name in ours:
        rival = name.replace("ga", "gauss-newton", 1)
        if name.partition(":")[0] == "ga" and rival in ours:
            pairs.append((name, [rival], rival))
    found = []
    for name, rivals, title in pairs:
        for what in ("translation", "rotation"):
            by_clip = {
                clip: getattr(by_key[clip, name], what) / min(getattr(by_key[clip, r], what) for r in rivals)
                for clip in clips
            }
            found.append(Ratio(f"{name} / {title}, {what}", by_clip))
    return found


def drifts(runs: list[dict[str, Any]]) -> dict[str, dict[str, np.ndarray]]:
    """Translation (m/s) and rotation (deg/s) of every run, [runs, 2], by clip and method."""
    found: dict[str, dict[str, np.ndarray]] = {}
    for run in runs:
        clip = found.setdefault(run["clip"], {})
        row = np.array([[run[DRIFT], run[ROTATION_DRIFT]]])
        clip[run["name"]] = np.concatenate([clip[run["name"]], row]) if run["name"] in clip else row
    return found


def medians(records: Sequence[Record]) -> dict[str, dict[str, np.ndarray]]:
    """Drifts as in `drifts`, but from records: one row for each method, the median."""
    found: dict[str, dict[str, np.ndarray]] = {}
    for table in (table for record in records for table in record.tables if table.title.startswith(TITLE)):
        clip = found.setdefault(table.title.removeprefix(TITLE).partition(",")[0], {})
        places = [table.columns.index(name) for name in ("m/s", "deg/s")]
        clip.update({row[0]: np.array([[float(row[i]) for i in places]]) for row in table.rows})
    return found


def main(
    clips: str = common.CLIPS,
    methods: str = METHODS,
    seeds: int = 5,
    json: Path | None = None,
    figure: Path | None = None,
    recorded: str = "",
) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clips: comma-separated names.
        methods: comma-separated names.
        seeds: runs of each of our methods.
        json: file for all runs and the summary.
        figure: folder for drift.png and drift.svg.
        recorded: comma-separated files that `--json` or `--record` wrote before, to draw together; nothing is
            measured.
    """
    if recorded.endswith(".toml"):
        _draw(medians([read_record(Path(name)) for name in common.names(recorded)]), figure or Path())
        return {}
    if recorded:
        earlier = [run for found in common.read_records(recorded, "drift") for run in found["runs"]]
        _draw(drifts(earlier), figure or Path())
        return {"runs": earlier}
    runs = common.measure_drift(common.names(clips), common.parse_methods(methods), seeds)
    summaries = common.summarise(runs)
    for clip in common.names(clips):
        rows = [common.drift_row(summary) for summary in summaries if summary.clip == clip]
        common.print_table(f"{TITLE}{clip}, {runs[0]['device']}", common.DRIFT_COLUMNS, rows)
    compared = ratios(summaries)
    if compared:
        rows = [
            [r.name, *(number(value, 3) for value in r.by_clip.values()), number(r.mean, 3), number(r.worst, 3)]
            for r in compared
        ]
        common.print_table("ratios of the medians", ("", *common.names(clips), "geometric mean", "worst"), rows)
    results = {
        "runs": runs,
        "summary": [summary._asdict() for summary in summaries],
        "ratios": [{**r._asdict(), "geometric_mean": r.mean, "worst": r.worst} for r in compared],
    }
    common.record(json, "drift", results)
    if figure is not None:
        _draw(drifts(runs), figure)
    return results


def _draw(clips: dict[str, dict[str, np.ndarray]], folder: Path) -> None:
    ours = [name for methods in clips.values() for name in methods if name not in PEERS]
    common.save_figure(plots.plot_drift(clips, ours), folder, "drift", clips)


if __name__ == "__main__":
    common.command(main)
