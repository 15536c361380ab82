"""Shared code of the benchmarks: clips and methods by name, drift over seeds, tables and the record of a run."""

import hashlib
import json
import os
import shlex
import sys
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # as the package does if it imports JAX first

import jax
import numpy as np
import records
import tyro

from gavo_jax import presets
from gavo_jax.camera import Camera
from gavo_jax.compilation.cache import enable_compilation_cache
from gavo_jax.compilation.compiler import processor
from gavo_jax.datasets.base import Sequence as FrameSequence
from gavo_jax.datasets.registry import open_source
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.metrics import DRIFT, MILLISECONDS, ROTATION_DRIFT
from gavo_jax.output import plots, screen
from gavo_jax.output.files import environment, prepare_folder, write_json
from gavo_jax.output.screen import number
from gavo_jax.output.tracked import track_visibly
from gavo_jax.peers.comparison import peer_odometry
from gavo_jax.peers.registry import PEERS
from gavo_jax.settings import Settings
from gavo_jax.trajectory import Trajectory

CLIPS = "fr1_xyz,fr1_desk,fr1_rpy"
CLIP_FRAMES = {"fr1_xyz": 90}
"""Frames taken of a clip whose name gives no number: the paper's first experiment uses 90 of fr1_xyz."""


def command(main: Callable[..., Any]) -> None:
    """Run a benchmark's `main` as a command: its arguments are the options, the module's docstring the help text.

    The option `--record FILE` is added.
    """
    enable_compilation_cache()
    try:
        arguments, file = take_record(sys.argv[1:])
        tyro.cli(main, args=arguments, description=f"{sys.modules[main.__module__].__doc__}\n{RECORD_HELP}")
        if file is not None:
            records.write_record(file, printed_record(Path(sys.argv[0]).stem, arguments))
            print(f"recorded in {file}; `python benchmarks/records.py` puts it onto the pages")
    except GavoError as error:
        print(f"{Path(sys.argv[0]).name}: {error}", file=sys.stderr)
        sys.exit(2)


RECORD_HELP = "With --record FILE the tables that are printed are written as a record, too (benchmarks/records.py)."

_printed: list[records.Table] = []
_told: list[str] = []
"""Tables and sentences that this process has printed, in order."""


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print a table of a text column and number columns, and keep it for the record."""
    screen.print_table(title, columns, rows)
    cells = tuple(tuple(str(cell) or records.UNKNOWN for cell in row) for row in rows)
    _printed.append(records.Table(title, tuple(columns), cells))


def tell(sentence: str) -> None:
    """Print a sentence, and keep it for the record."""
    print(f"{sentence}\n")
    _told.append(f"{sentence[:1].upper()}{sentence[1:]}.")


def take_record(arguments: Sequence[str]) -> tuple[list[str], Path | None]:
    """Split `--record FILE` off: return the other arguments, and the file.

    Raises:
        GavoError: no file is named.
    """
    rest = list(arguments)
    if "--record" not in rest:
        return rest, None
    place = rest.index("--record")
    if place + 1 == len(rest):
        raise GavoError("--record: name the file, as benchmarks/records/drift.toml")
    file = Path(rest[place + 1])
    del rest[place : place + 2]
    return rest, file


def printed_record(benchmark: str, arguments: Sequence[str]) -> records.Record:
    """Make a record of what this process printed."""
    here = machine()
    versions = here["versions"]
    named = {"JAX": "jax", "NumPy": "numpy", "OpenCV": "opencv"}
    return records.Record(
        benchmark,
        shlex.join(["python", f"benchmarks/{benchmark}.py", *arguments]),
        here["date"][:10],
        f"{here['processor']}, {here['cores']} cores, {here['device']}",
        ", ".join(f"{name} {versions[key]}" for name, key in named.items()),
        tuple(_printed),
        told=tuple(_told),
    )


def names(text: str) -> list[str]:
    """Split comma-separated names."""
    return [name.strip() for name in text.split(",") if name.strip()]


def names_among(known: Collection[str], what: str, text: str) -> list[str]:
    """Split comma-separated names, all of which must be known.

    Raises:
        GavoError: a name is unknown.
    """
    for name in (chosen := names(text)):
        if name not in known:
            raise GavoError(f"unknown {what} {name!r}: not one of {', '.join(known)}")
    return chosen


def counts(text: str) -> list[int]:
    """Split comma-separated whole numbers.

    Raises:
        GavoError: an entry is not a whole number, or there is none.
    """
    if not names(text) or not all(name.isdecimal() for name in names(text)):
        raise GavoError(f"{text}: not whole numbers with commas between")
    return [int(name) for name in names(text)]


def open_clip(text: str) -> FrameSequence:
    """Open a clip by its name.

    Args:
        text: NAME, or NAME:FRAMES for its first FRAMES frames. NAME is a folder of a layout that `gavo inspect` knows,
            one of GAVO_DATA's folders, or the word synthetic.

    Raises:
        GavoError: no such folder, GAVO_DATA not set, or FRAMES is not a number of at least 2.
    """
    name, _, count = text.partition(":")
    if count and not (count.isdecimal() and int(count) >= 2):
        raise GavoError(f"{text}: not NAME or NAME:FRAMES with at least 2 frames")
    frames = int(count) if count else CLIP_FRAMES.get(name)
    if name == "synthetic":
        return SyntheticSequence(frames)
    return open_source(folder_of(name))[:frames]


def folder_of(name: str) -> Path:
    """The folder of that path, else that of GAVO_DATA.

    Raises:
        GavoError: no such folder, and GAVO_DATA is not set.
    """
    folder = Path(name)
    if folder.is_dir():
        return folder
    data = os.environ.get("GAVO_DATA")
    if not data:
        raise GavoError(f"{name}: no such folder, and GAVO_DATA does not name the folder of the clips")
    return Path(os.path.expanduser(data)) / name  # no shell expands it in environment files


def open_true_clip(text: str) -> tuple[FrameSequence, Trajectory]:
    """Open a clip, as `open_clip` does, and return it with its ground truth.

    Raises:
        GavoError: as by `open_clip`, or there is no ground truth.
    """
    clip = open_clip(text)
    if clip.ground_truth is None:
        raise GavoError(f"{text}: no ground truth")
    return clip, clip.ground_truth


class Contender(NamedTuple):
    """A method in a comparison."""

    name: str
    make: Callable[[Camera, int], Odometry]
    """Makes a new driver for a camera and a seed."""
    random: bool
    """Whether the seed can change the result; a peer's cannot."""


def preset_contender(name: str, settings: Settings) -> Contender:
    """Make a contender of one of our own methods."""

    def make(camera: Camera, seed: int) -> Odometry:
        return Odometry(camera, settings, seed=seed)

    return Contender(name, make, True)


def preset_of(name: str) -> Settings:
    """The settings of METHOD, METHOD:PRESET or METHOD:PRESET:BODIES, where BODIES is what `--bodies` takes.

    Raises:
        GavoError: unknown method or preset, or invalid BODIES.
    """
    method, _, rest = name.partition(":")
    preset, _, bodies = rest.partition(":")
    settings = presets.preset(method, preset or "default")
    return with_bodies(settings, bodies) if bodies else settings


def with_bodies(settings: Settings, bodies: Any) -> Settings:
    """Settings that treat bodies in a given way.

    Raises:
        GavoError: there is no such way.
    """
    return replace(settings, odometry=replace(settings.odometry, bodies=bodies))


def parse_methods(text: str) -> list[Contender]:
    """The contenders of a list like `ga,ga:fast,opencv-rgb`: what `preset_of` takes, or the name of a peer.

    Raises:
        GavoError: unknown method, preset or peer.
    """
    return [
        Contender(name, lambda camera, _, name=name: peer_odometry(name, camera), False)
        if name in PEERS
        else preset_contender(name, preset_of(name))
        for name in names(text)
    ]


def installed_peers() -> str:
    """Comma-separated names of the peers whose libraries are installed."""
    return ",".join(name for name, info in PEERS.items() if info.installed)


def measure_drift(clips: Sequence[str], contenders: Sequence[Contender], seeds: int) -> list[dict[str, Any]]:
    """Run every contender over every clip with every seed; a peer runs once per clip.

    Contenders take turns within each seed, so that a slow spell of the machine affects all of them.

    Returns:
        The metrics of each run (as in `metrics.json`, times included) with `clip`, `name`, `seed` and `random`.

    Raises:
        GavoError: a clip cannot be read, or its ground truth covers less than a second.
    """
    runs = []
    for clip in clips:
        sequence = open_clip(clip)
        sequence.check()
        for seed in range(seeds):
            for contender in contenders:
                if seed > 0 and not contender.random:
                    continue
                odometry = contender.make(sequence.camera, seed)
                tracked = track_visibly(f"{clip}, {contender.name}, seed {seed}", sequence, odometry)
                metrics = tracked.outcome(sequence).figures
                if metrics[DRIFT] is None:
                    raise GavoError(f"{clip}: no ground truth over a second of it")
                runs.append({"clip": clip, "name": contender.name, "seed": seed, "random": contender.random, **metrics})
    return runs


class Summary(NamedTuple):
    """One contender on one clip, over the seeds."""

    clip: str
    name: str
    translation: float
    """Median drift, m/s."""
    translation_spread: float
    """Largest over smallest."""
    rotation: float
    """Median drift, deg/s."""
    rotation_spread: float
    lost: int
    """Lost pairs of the worst run."""
    milliseconds: float
    """Median over the runs of the median time per pair."""
    runs: int


def summarise(runs: Sequence[dict[str, Any]]) -> list[Summary]:
    """Median and spread over the seeds of each clip and contender, in the order of the runs."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for run in runs:
        groups.setdefault((run["clip"], run["name"]), []).append(run)
    summaries = []
    for (clip, name), group in groups.items():
        translation, rotation = (np.array([run[key] for run in group]) for key in (DRIFT, ROTATION_DRIFT))
        summaries.append(
            Summary(
                clip,
                name,
                float(np.median(translation)),
                float(translation.max() / translation.min()),
                float(np.median(rotation)),
                float(rotation.max() / rotation.min()),
                max(run["lost_pairs"] for run in group),
                float(np.median([run[MILLISECONDS] for run in group])),
                len(group),
            )
        )
    return summaries


DRIFT_COLUMNS = ("method", "m/s", "max/min", "deg/s", "max/min", "lost", "ms/pair", "runs")


def drift_row(summary: Summary) -> list[str]:
    """Format a summary as cells of `DRIFT_COLUMNS`."""
    return [
        summary.name,
        number(summary.translation, 4),
        number(summary.translation_spread, 3),
        number(summary.rotation, 3),
        number(summary.rotation_spread, 3),
        str(summary.lost),
        number(summary.milliseconds, 1),
        str(summary.runs),
    ]


def geometric_mean(values: Sequence[float]) -> float:
    """Geometric mean of positive numbers."""
    return float(np.exp(np.mean(np.log(values))))


def record(path: Path | None, benchmark: str, results: dict[str, Any]) -> None:
    """Write the results as JSON with date, machine and versions; do nothing if path is None."""
    if path is not None:
        write_json(path, {"benchmark": benchmark, **machine(), **results})


def read_records(paths: str, benchmark: str) -> list[dict[str, Any]]:
    """Read comma-separated files that `record` wrote.

    Raises:
        GavoError: a file cannot be read or is not of that benchmark.
    """
    records = []
    for path in names(paths):
        try:
            found = json.loads(Path(path).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise GavoError(f"{path}: cannot be read: {error}") from None
        if not isinstance(found, dict) or found.get("benchmark") != benchmark:
            raise GavoError(f"{path}: was not written by {benchmark}.py --json")
        records.append(found)
    return records


def save_figure(figure: Any, folder: Path, name: str, drawn: Any) -> None:
    """Save a figure of `plots` as PNG and SVG in a folder, which is created if missing.

    The PNG holds a digest of the data drawn, so that a test can detect an outdated picture.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    plots.save(figure, prepare_folder(folder), name)
    words = json.dumps(drawn, sort_keys=True, default=lambda array: np.asarray(array).tolist())
    info = PngInfo()
    info.add_text("drawn", hashlib.sha256(words.encode()).hexdigest())
    path = folder / f"{name}.png"
    with Image.open(path) as image:
        image.load()
    image.save(path, pnginfo=info, optimize=True)


def machine() -> dict[str, Any]:
    """Date, processor, cores, device and versions."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "processor": processor(),
        "cores": os.cpu_count(),
        "device": jax.devices()[0].device_kind,
        "versions": environment(),
    }
