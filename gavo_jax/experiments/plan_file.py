"""Reads a plan from a TOML file: sequences × methods × presets × settings × seeds, checked before anything runs."""

import glob
import hashlib
import itertools
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gavo_jax import presets
from gavo_jax.datasets.base import Sequence as FrameSequence
from gavo_jax.datasets.selection import SYNTHETIC
from gavo_jax.errors import GavoError, read_toml, shown
from gavo_jax.experiments.plan import Part, Plan, RayOptions, Run, configuration, frames_of
from gavo_jax.experiments.values import (
    MAX_RUNS,
    flag_of,
    one_line,
    real_of,
    refuse_repeated,
    seeds_of,
    tables_of,
    text_of,
    whole_of,
)
from gavo_jax.mapping.pose_graph import require_gtsam
from gavo_jax.peers.registry import PEERS
from gavo_jax.presets import PRESETS
from gavo_jax.settings import Settings
from gavo_jax.settings_file import flatten, override, refuse_unknown, refuse_unknown_method

KEYS = ("name", "output", "seeds", "batch", "sequences", "methods", "ray")
SEQUENCE_KEYS = ("path", "name", "camera", "start", "frames", "stride", "optional")
METHOD_KEYS = ("name", "presets", "seeds", "solver", "alignment", "odometry", "sweep", "printed", "optional")
RAY_KEYS = ("cpus", "gpus")
DATA = "GAVO_DATA"
BATCH = 32
"""Default number of runs that are tracked together."""


def read_plan(path: str | Path, output: str | Path | None = None) -> Plan:
    """Read an experiment's file, check it completely, and lay out its runs.

    Args:
        path: The TOML file.
        output: Folder for the results; by default the file's own `output`, or else runs/NAME.

    Raises:
        GavoError: The message names the file, the key and the fault, and suggests the nearest key for an unknown one.
    """
    path = Path(path)
    table = read_toml(path)
    refuse_unknown(str(path), table, KEYS)
    name = text_of(f"{path}: name", table.get("name", path.stem))
    refuse_as_folder(f"{path}: name", name)
    parts, skipped = parts_of(path, table)
    default_seeds = seeds_of(f"{path}: seeds", table.get("seeds", [0]))
    methods = tables_of(f"{path}: methods", table.get("methods", []))
    if not methods:
        raise GavoError(f"{path}: methods: no [[methods]] given")
    variants: list[_Variant] = []
    for number, entry in enumerate(methods, 1):
        place = f"{path}: methods[{number}]"
        lacking = _lacking(place, entry)
        if lacking is None:
            variants += _variants(place, entry, default_seeds)
        else:
            skipped[str(entry["name"])] = lacking
    refuse_repeated(f"{path}: methods", [variant.label for variant in variants])
    runs: list[Run] = []
    if len(parts) * sum(len(variant.seeds) for variant in variants) > MAX_RUNS:
        raise GavoError(f"{path}: more than {MAX_RUNS} runs")
    for part in parts:
        try:
            sequence = part.open()
        except GavoError as error:
            raise GavoError(f"{path}: {one_line(error)}") from None
        frames = frames_of(part.name, sequence)
        for variant in variants:
            runs += _runs(part, sequence, frames, variant)
    names = [part.name for part in parts]
    for variant in variants:
        refuse_unknown(f"{path}: printed figures of {variant.label}", variant.printed, (*names, *skipped))
    printed = {
        (name, variant.label): value for variant in variants for name, value in variant.printed.items() if name in names
    }
    folder = Path(output or text_of(f"{path}: output", table.get("output", f"runs/{name}")))
    batch = whole_of(f"{path}: batch", table.get("batch", BATCH), 1)
    return Plan(name, folder, tuple(runs), tuple(skipped.values()), printed, batch, _ray(path, table))


def parts_of(path: Path, table: Mapping[str, Any]) -> tuple[list[Part], dict[str, str]]:
    """Return the parts of a file's [[sequences]], and by name a line for each optional one that is missing.

    Raises:
        GavoError: A key or value is wrong, a sequence is not found, two share a name, or there is none.
    """
    entries = tables_of(f"{path}: sequences", table.get("sequences", []))
    parts: list[Part] = []
    skipped: dict[str, str] = {}
    for number, entry in enumerate(entries, 1):
        place = f"{path}: sequences[{number}]"
        refuse_unknown(place, entry, SEQUENCE_KEYS)
        patterns = entry.get("path", SYNTHETIC)
        patterns = [text_of(f"{place}: path", p) for p in (patterns if isinstance(patterns, list) else [patterns])]
        if not patterns:
            raise GavoError(f"{place}: path: an empty list")
        found = _find(path.parent, patterns)
        if not found:
            line = f"{one_line(', '.join(patterns))}: no such folder here, beside {path.name}, or in {DATA}"
            if not flag_of(f"{place}: optional", entry.get("optional", False)):
                raise GavoError(f"{place}: {line}")
            name = text_of(f"{place}: name", entry.get("name", patterns[0]))
            skipped[name] = f"skipped {name}: {line} (gavo download gets TUM's sequences)"
        if len(found) > 1 and "name" in entry:
            raise GavoError(f"{place}: name: {len(found)} sequences cannot share one name")
        parts += [_part(place, path.parent, folder, entry) for folder in found]
    refuse_repeated(f"{path}: sequences", [part.name for part in parts])
    if not parts:
        raise GavoError(f"{path}: sequences: {'; '.join(skipped.values()) or 'no [[sequences]] given'}")
    return parts, skipped


def _find(beside: Path, patterns: Sequence[str]) -> list[str]:
    """Folders of the first pattern that matches any: in the working directory, beside the file, or in GAVO_DATA."""
    roots = ["", str(beside), *([os.path.expanduser(os.environ[DATA])] if os.environ.get(DATA) else [])]
    for pattern in patterns:
        if pattern == SYNTHETIC:
            return [SYNTHETIC]
        for root in roots:
            if os.path.isdir(exact := os.path.join(root, pattern)):  # its name may have brackets
                return [exact]
            matches = glob.glob(os.path.join(glob.escape(root), pattern))
            if found := sorted(filter(os.path.isdir, matches)):
                return found
    return []


def _part(place: str, beside: Path, folder: str, entry: Mapping[str, Any]) -> Part:
    start = whole_of(f"{place}: start", entry.get("start", 0), 0)
    frames = None if "frames" not in entry else whole_of(f"{place}: frames", entry["frames"], 2)
    stride = whole_of(f"{place}: stride", entry.get("stride", 1), 1)
    camera = text_of(f"{place}: camera", entry.get("camera", "auto"))
    try:
        if os.path.isfile(beside / camera):
            camera = str((beside / camera).resolve())
    except GavoError as error:
        raise GavoError(f"{place}: camera: {one_line(error)}") from None
    name = entry.get("name", Path(folder).resolve().name if folder != SYNTHETIC else SYNTHETIC)
    if "name" not in entry and (start, frames, stride) != (0, None, 1):
        name = f"{name}[{start}:{'' if frames is None else start + frames * stride}:{stride}]"
    path = folder if folder == SYNTHETIC else os.path.abspath(folder)  # workers may run elsewhere
    return Part(text_of(f"{place}: name", name), path, camera, start, frames, stride)


@dataclass(frozen=True)
class _Variant:
    """A method with one choice of settings, and the seeds it runs with."""

    method: str
    preset: str
    text: str
    settings: Settings | None
    seeds: tuple[int | None, ...]
    printed: Mapping[str, float]

    @property
    def label(self) -> str:
        return Run("", Part("", ""), 0, 0, self.method, self.preset, self.text, None, None).label


def _lacking(place: str, entry: Mapping[str, Any]) -> str | None:
    """Return a line for an optional peer that is not installed; None for a method that can run.

    Raises:
        GavoError: A peer that is not optional is not installed.
    """
    info = PEERS.get(str(entry.get("name")))
    if info is None or info.installed:
        return None
    line = f"{info.name}: needs {info.module}: pip install 'gavo-jax[peers]'"
    if not flag_of(f"{place}: optional", entry.get("optional", False)):
        raise GavoError(f"{place}: {line}")
    return f"skipped {line}"


def _variants(place: str, entry: Mapping[str, Any], default_seeds: tuple[int, ...]) -> list[_Variant]:
    refuse_unknown(place, entry, METHOD_KEYS)
    method = str(entry.get("name"))
    refuse_unknown_method(f"{place}: name", method, PEERS)
    printed = {
        text_of(place, name): real_of(f"{place}: printed.{name}", value)
        for name, value in flatten(f"{place}: printed", entry.get("printed", {})).items()
    }
    if method in PEERS:
        refuse_unknown(f"{place}: {method} has no settings", entry, ("name", "printed", "optional"))
        return [_Variant(method, "", "", None, (None,), printed)]
    names = entry.get("presets", ["default"])
    if not isinstance(names, list) or not names:
        raise GavoError(f"{place}: presets: not a list of names")
    refuse_unknown(f"{place}: presets", map(str, names), PRESETS)
    seeds = seeds_of(f"{place}: seeds", entry["seeds"]) if "seeds" in entry else default_seeds
    rooms = {room: entry[room] for room in ("solver", "alignment", "odometry") if room in entry}
    fixed = flatten(place, rooms)
    swept = flatten(f"{place}: sweep", entry.get("sweep", {}))
    for name, values in swept.items():
        if not isinstance(values, list) or not values:
            raise GavoError(f"{place}: sweep.{one_line(name)}: not a list of values")
        if any(other == name or other.startswith(f"{name}.") for other in fixed):
            raise GavoError(f"{place}: sweep.{one_line(name)}: has a fixed value, too")
    variants = []
    for preset in names:
        for choice in itertools.product(*swept.values()):
            values = fixed | dict(zip(swept, choice, strict=True))
            settings = override(presets.preset(method, preset), values, place)
            require_what_loops_need(place, settings)
            text = ", ".join(f"{name.partition('.')[2]}={_short(value)}" for name, value in values.items())
            variants.append(_Variant(method, preset, text, settings, seeds, printed))
    return variants


def refuse_as_folder(place: str, name: str) -> None:
    """Raise GavoError if a name leads out of the folder that results are in."""
    if {"/", "\\"} & set(name) or name in (".", ".."):
        raise GavoError(f"{place}: {shown(name)} names the folder of the results, so it cannot be a path")


def require_what_loops_need(place: str, settings: Settings) -> None:
    """Raise GavoError if the settings close loops but GTSAM is not installed."""
    try:
        if settings.odometry.loops:
            require_gtsam()
    except GavoError as error:
        raise GavoError(f"{place}: {error}") from None


def _runs(part: Part, sequence: FrameSequence, frames: dict[str, Any], variant: _Variant) -> list[Run]:
    pairs, pixels = len(sequence) - 1, sequence.camera.width * sequence.camera.height
    shared = (part, pairs, pixels, variant.method, variant.preset, variant.text)
    runs = []
    for seed in variant.seeds:
        run = Run("", *shared, seed, variant.settings)
        canonical = json.dumps(configuration(run, frames), sort_keys=True, allow_nan=False)
        identity = hashlib.sha256(canonical.encode()).hexdigest()[:32]
        runs.append(Run(identity, *shared, seed, variant.settings))
    return runs


def _ray(path: Path, table: Mapping[str, Any]) -> RayOptions:
    values = table.get("ray", {})
    place = f"{path}: ray"
    refuse_unknown(place, flatten(place, values), RAY_KEYS)
    return RayOptions(**{key: real_of(f"{place}.{key}", value) for key, value in values.items()})


def _short(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) and float(f"{value:g}") == value else str(value)
