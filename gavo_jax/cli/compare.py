"""`gavo compare`: runs several methods, including other libraries', over the same frames."""

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gavo_jax import presets
from gavo_jax.cli.options import Compare
from gavo_jax.cli.readiness import be_ready
from gavo_jax.cli.run_table import covered_in_part, path_and_end, why_no_drift
from gavo_jax.cli.selection import open_sequence
from gavo_jax.datasets.base import Sequence
from gavo_jax.datasets.selection import SYNTHETIC
from gavo_jax.early import INTERRUPTED
from gavo_jax.errors import GavoError, print_message
from gavo_jax.inspection import left_out_in_short, summary
from gavo_jax.locks import hold
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.metrics import (
    ABSOLUTE_ERROR,
    DRIFT,
    DRIFT_PER_FRAME,
    FINAL_DISTANCE,
    FRAMES_PER_SECOND,
    MILLISECONDS,
    ROTATION_DRIFT,
    drifts_of,
    run_identity,
)
from gavo_jax.output import plots
from gavo_jax.output.drawing import draw, save_figure
from gavo_jax.output.files import (
    COMPARISON,
    EXPERIMENT,
    FIGURE_NAMES,
    FRAMES,
    environment,
    prepare_folder,
    refuse_foreign,
    refuse_strange,
    remove_figures,
    remove_files,
    write_json,
)
from gavo_jax.output.report import REPORT, Picture, Table, write_report
from gavo_jax.output.screen import DASH, known_columns, number, print_table, say, waiting
from gavo_jax.output.tracked import track_visibly
from gavo_jax.peers.comparison import peer_odometry
from gavo_jax.peers.registry import PEERS, make_peer
from gavo_jax.settings_check import MAX_SEED
from gavo_jax.trajectory import Trajectory

COLUMNS = (
    ("m/s", DRIFT, 4),
    ("deg/s", ROTATION_DRIFT, 3),
    ("m/frame", DRIFT_PER_FRAME, 5),
    ("ATE m", ABSOLUTE_ERROR, 4),
    ("end m", FINAL_DISTANCE, 4),
    ("segments", "segments", 0),
    ("lost", "lost_pairs", 0),
    ("ms/pair", MILLISECONDS, 1),
    ("frames/s", FRAMES_PER_SECOND, 1),
)
"""Columns of the table: heading, key in comparison.json, decimals. The errors per frame stand in for the drift."""
PATH_COLUMNS = ("path m", "end m: x y z")
"""Columns shown when no errors are known."""
HEADINGS = ("method", *PATH_COLUMNS, *(heading for heading, _, _ in COLUMNS), "seeds", "m/s from", "to")
TABLE_CAPTION = (
    "Each method's run of median drift. m/s and deg/s: drift, the relative pose error over 1 s, root mean square (TUM "
    "evaluate_rpe.py, fixed delta). m/frame: the same from frame to frame, in place of the drift. ATE: root "
    "mean square distance of associated positions after the best rigid alignment. End: distance from the true position "
    "at the end, both relative to the first pose. Path: its length, where there is no truth; end x y z: position of "
    "the last frame seen from the first, x right, y down, z forward. Segments: stretches between which the motion is "
    "unknown. ms/pair: median, from two decoded images to the motion on the host. frames/s: from frame to pose, {cost} "
    "included."
)
MEANINGS = {
    PATH_COLUMNS[0]: "path: its length",
    PATH_COLUMNS[1]: "end: position seen from the first frame, x right, y down, z forward",
    "m/s": "m/s, deg/s: drift, the relative pose error over 1 s",
    "m/frame": "m/frame: relative pose error from frame to frame",
    "ATE m": "ATE: absolute error after alignment",
    "end m": "end: off at the last frame",
    "segments": "segments: stretches between which the motion is unknown; errors are within them",
    "ms/pair": "ms/pair: from two decoded images to their motion",
    "frames/s": "frames/s: from frame to pose, {cost} included",
}
"""Explanations of the columns, printed for those that are shown."""


class Contender(NamedTuple):
    """A method to compare, with its preset."""

    label: str
    """Name as requested: `ga`, or `ga:fast` with its own preset."""
    method: str
    preset: str | None
    """None for another library's method."""


class Entry(NamedTuple):
    """One run of one contender."""

    label: str
    metrics: dict[str, Any]
    trajectory: Trajectory


def compare(options: Compare) -> int:
    """Run the methods one after the other; write comparison.json, trajectories and figures; print a table."""
    contenders = _parse_methods(options.methods, options.preset)
    if not 1 <= options.seeds <= MAX_SEED:
        raise GavoError(f"--seeds: must be from 1 to {MAX_SEED}, not {options.seeds}")
    sequence = open_sequence(options)
    be_ready()
    peers = {one.method: peer_odometry(one.method, sequence.camera) for one in contenders if one.preset is None}
    folder = prepare_folder(options.output or Path("runs") / f"{sequence.name}-compare-{options.preset}")
    with hold(folder):
        refuse_foreign(folder, FRAMES, EXPERIMENT)
        if (folder / COMPARISON).exists():
            say(f"the earlier comparison in {folder} is replaced")
        else:
            refuse_strange(folder, (REPORT, *FIGURE_NAMES, *_earlier_trajectories(folder)), "a comparison")
        remove_files(folder, COMPARISON, REPORT, *_earlier_trajectories(folder))
        remove_figures(folder)
        say(summary(sequence))
        if line := left_out_in_short(sequence):
            say(f"{line}; gavo inspect shows why")
        entries, status = _run_contenders(options, contenders, sequence, peers, folder)
        planned = sum(1 if contender.preset is None else options.seeds for contender in contenders)
        cut_short = f"interrupted: {len(entries)} of {planned} runs were done" if status == INTERRUPTED else ""
        _write(options, sequence, entries, folder, cut_short)
        if cut_short:
            print_message(cut_short)
    say(f"files in {folder}")
    return status


def _earlier_trajectories(folder: Path) -> list[str]:
    """Return the names of trajectory files left by an earlier comparison, whatever its methods and seeds."""
    methods = "|".join(map(re.escape, (*presets.methods(), *PEERS)))
    form = rf"({methods})(-({'|'.join(presets.PRESETS)}))?(-seed\d+)?\.txt"
    return [path.name for path in folder.iterdir() if re.fullmatch(form, path.name)]


def _run_contenders(
    options: Compare, contenders: list[Contender], sequence: Sequence, peers: dict[str, Odometry], folder: Path
) -> tuple[list[Entry], int]:
    """Run them one after the other, each with its seeds; return the finished runs and the exit status.

    Raises:
        KeyboardInterrupt: the user interrupted before the first run finished.
    """
    entries: list[Entry] = []
    try:
        for contender in contenders:
            for seed in range(options.seeds) if contender.preset is not None else (None,):
                entry = _run_contender(sequence, contender, seed, peers.get(contender.method))
                suffix = "" if seed is None or options.seeds == 1 else f"-seed{seed}"
                entry.trajectory.write_tum(folder / f"{contender.label.replace(':', '-')}{suffix}.txt")
                entries.append(entry)
    except KeyboardInterrupt:
        if not entries:
            raise
        return entries, INTERRUPTED
    return entries, 0


def _write(options: Compare, sequence: Sequence, entries: list[Entry], folder: Path, cut_short: str) -> None:
    """Write comparison.json, print the table, then write figures and the report, which says if runs are missing."""
    typical = _typical_runs(entries)
    write_json(folder / COMPARISON, [entry.metrics for entry in entries])
    title = f"{sequence.name}, {len(sequence)} frames, preset {options.preset}"
    rows = _rows(entries, typical)
    cost = "rendering" if options.sequence == SYNTHETIC else "reading and decoding"
    _print(title, rows, options.seeds, cost)
    for line in _without_drift(entries):
        say(line)
    for entry in typical:
        if reason := why_no_drift(entry.metrics, entry.trajectory, sequence.ground_truth is not None):
            say(reason)
            break
    if _drifts(entries) and (part := covered_in_part(typical[0].trajectory, sequence.ground_truth)):
        say(part)
    with waiting("drawing figures …"):
        pictures = _draw(entries, typical, sequence, folder)
    write_report(
        folder / REPORT,
        f"gavo compare: {title}",
        [Table(TABLE_CAPTION.format(cost=cost), *known_columns(HEADINGS, rows))],
        pictures,
        {"options": options, "camera": sequence.camera},
        _versions(entries),
        f"First frame at {sequence.timestamps[0]:.6f} s, last at {sequence.timestamps[-1]:.6f} s; "
        f"device {entries[0].metrics['device']}." + f" The comparison was {cut_short}." * bool(cut_short),
    )


def _print(title: str, rows: list[list[Any]], seeds: int, cost: str) -> None:
    """Print the table, with the columns about seeds only if there are several; `cost` names the work besides poses."""
    shown = len(HEADINGS) if seeds > 1 else 1 + len(PATH_COLUMNS) + len(COLUMNS)
    columns, cells = known_columns(HEADINGS[:shown], [row[:shown] for row in rows])
    print_table(title, columns, cells)
    for heading, meaning in MEANINGS.items():
        if heading in columns:
            say(f"{meaning.format(cost=cost)}.")


def _draw(entries: list[Entry], typical: list[Entry], sequence: Sequence, folder: Path) -> list[Picture]:
    """Write the figures, where matplotlib is installed."""
    estimates = {entry.label: entry.trajectory for entry in typical}
    ours = [name for name in estimates if name not in PEERS]
    pictures = draw(folder, estimates, sequence.ground_truth, ours)
    drifts = _drifts(entries)
    if plots.available() and drifts:
        figure = plots.plot_drift({sequence.name: drifts}, ours)
        pictures.append(save_figure(figure, folder, "drift"))
    return pictures


def _parse_methods(text: str, preset: str) -> list[Contender]:
    """Return the methods between the commas, each with the common preset or its own after a colon.

    Raises:
        GavoError: a method is unknown, repeated, or lacks the preset.
    """
    found: list[Contender] = []
    for label in (name.strip() for name in text.split(",")):
        method, colon, own = label.partition(":")
        if method not in (*presets.methods(), *PEERS):
            known = ", ".join((*presets.usable_methods(), *PEERS))
            raise GavoError(f"--methods: unknown method {method!r}: not one of {known}")
        if method in PEERS and colon:
            raise GavoError(f"--methods: {label}: another library's method has no preset")
        contender = Contender(label, method, None if method in PEERS else own if colon else preset)
        if contender[1:] in [earlier[1:] for earlier in found]:
            raise GavoError(f"--methods: {label} is given twice")
        if contender.preset is not None:
            try:
                presets.preset(method, contender.preset)
            except GavoError as error:
                raise GavoError(f"--methods: {label}: {error}") from None
        found.append(contender)
    return found


def _run_contender(sequence: Sequence, contender: Contender, seed: int | None, peer: Odometry | None) -> Entry:
    """Run one contender once; a peer has no seed.

    Raises:
        KeyboardInterrupt: the user interrupted the run; an unfinished run is not compared.
    """
    label, method, preset_name = contender
    if preset_name is not None:
        odometry = Odometry(sequence.camera, presets.preset(method, preset_name), seed=seed or 0)
    else:
        assert peer is not None
        odometry = peer
    tracked = track_visibly(label if seed is None else f"{label}, seed {seed}", sequence, odometry)
    if tracked.interrupted:
        raise KeyboardInterrupt
    outcome = tracked.outcome(sequence)
    metrics = {
        **run_identity(sequence.name, method, preset_name, seed),
        **outcome.figures,
        "versions": make_peer(method, sequence.camera).versions if peer else environment(),
    }
    return Entry(label, metrics, outcome.trajectory)


def _typical_runs(entries: list[Entry]) -> list[Entry]:
    """Return each contender's run of median drift, in order; of two middle runs, the better.

    A run without a drift, of a camera that was lost, is worse than any with one.
    """
    by_label: dict[str, list[Entry]] = {}
    for entry in entries:
        by_label.setdefault(entry.label, []).append(entry)
    return [_median(runs) for runs in by_label.values()]


def _median(runs: list[Entry]) -> Entry:
    drifts = [drifts_of(run.metrics)[0] for run in runs]
    return runs[np.argsort(drifts, kind="stable")[(len(runs) - 1) // 2]]


def _drifts(entries: list[Entry]) -> dict[str, Float[np.ndarray, "runs 2"]]:
    """Return the drift in translation (m/s) and rotation (deg/s) of every run, by contender; empty if none has any."""
    runs: dict[str, list[tuple[float, float]]] = {}
    for entry in entries:
        runs.setdefault(entry.label, []).append(drifts_of(entry.metrics))
    is_any = any(entry.metrics[DRIFT] is not None for entry in entries)
    return {label: np.array(values) for label, values in runs.items()} if is_any else {}


def _without_drift(entries: list[Entry]) -> list[str]:
    """Return sentences on the methods of which only some runs have a drift."""
    drifts = {label: np.isinf(runs[:, 0]) for label, runs in _drifts(entries).items()}
    return [
        f"No drift in {np.count_nonzero(lost)} of {len(lost)} runs of {label}, which count as infinite: no tracked "
        "part lasts 1 s."
        for label, lost in drifts.items()
        if 0 < np.count_nonzero(lost) < len(lost)
    ]


def _shown(metrics: dict[str, Any], key: str) -> float | None:
    """Return a metric as the table shows it.

    Errors per frame appear only without drift over a second, segments only if there are several.
    """
    is_left_out = metrics[DRIFT] is not None if key == DRIFT_PER_FRAME else key == "segments" and metrics[key] == 1
    return None if is_left_out else metrics[key]


def _versions(entries: list[Entry]) -> dict[str, str]:
    return {name: version for entry in entries for name, version in entry.metrics["versions"].items()}


def _rows(entries: list[Entry], typical: list[Entry]) -> list[list[Any]]:
    rows = []
    for run in typical:
        drifts = [drifts_of(entry.metrics)[0] for entry in entries if entry.label == run.label]
        cells = [number(_shown(run.metrics, key), digits) for _, key, digits in COLUMNS]
        span = [number(found if (found := extreme(drifts)) < np.inf else None) for extreme in (min, max)]
        path, end = path_and_end(run.trajectory)
        is_all = run.metrics[DRIFT_PER_FRAME] is None
        of_path = [number(path), end or DASH] if is_all else [DASH] * len(PATH_COLUMNS)
        rows.append([run.label, *of_path, *cells, len(drifts), *span])
    return rows
