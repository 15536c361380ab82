"""Settings in files and by name: `solver.mutation_decay`, `alignment.loss`, `solver.population.4`.

A settings file is TOML: `method` and `preset` at the top say what it is based on, the tables `solver`, `alignment` and
`odometry` what differs from that. A run's config.json also serves as one.
"""

import dataclasses
import difflib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import jax
import numpy as np
import optax
import tomli_w

from gavo_jax import presets
from gavo_jax.errors import GavoError, as_path, parse_toml, read_json_object, read_toml, shown, write_bytes
from gavo_jax.objective.losses import LOSSES
from gavo_jax.settings import Settings
from gavo_jax.settings_check import MAX_REAL, alternatives, is_whole, kind_of, require_settings

PARTS = tuple(field.name for field in dataclasses.fields(Settings))
"""Parts of the settings: the first components of dotted names."""
OPTIMIZERS: dict[str, Callable[..., Any]] = {
    name: getattr(optax, name)
    for name in ("adabelief", "adam", "adamw", "amsgrad", "lion", "nadam", "radam", "rmsprop", "sgd", "yogi")
}
"""Optimisers of optax that need nothing but a learning rate, by name."""
CONFIG_KEYS = ("options", "sequence", *PARTS, "device", "versions")
"""Keys of a run's config.json."""
MAX_FILE_BYTES = 2**20


class NamedSettings(NamedTuple):
    """Settings with the names of the method and preset they are based on."""

    method: str
    """Name of the solver's method."""
    preset: str
    """Name of the preset."""
    settings: Settings
    """Settings of the preset with the file's changes."""


def load_settings(path: str | Path, method: str = "ga", preset: str = "default") -> NamedSettings:
    """Read a settings file, or a run's config.json.

    Args:
        path: The file.
        method: Method that it is based on if it names none.
        preset: Preset that it is based on if it names none.

    Raises:
        GavoError: It cannot be read, or holds an unknown name (with the nearest known one) or a wrong value.
    """
    path = as_path(path)
    read = read_json_object if path.suffix == ".json" else read_toml
    table = read(path, MAX_FILE_BYTES)
    if path.suffix == ".json":
        if not any(part_name in table for part_name in PARTS):
            raise GavoError(f"{path}: contains no settings: a run's config.json has {', '.join(PARTS)}")
        refuse_unknown(str(path), table, CONFIG_KEYS)
        options = table.get("options")
        names = options if isinstance(options, dict) else {}
        table = {key: names[key] for key in ("method", "preset") if key in names} | {
            part_name: _without_types(table.get(part_name, {})) for part_name in PARTS
        }
    refuse_unknown(str(path), table, ("method", "preset", *PARTS))
    method, preset = str(table.pop("method", method)), str(table.pop("preset", preset))
    refuse_unknown_method(f"{path}: method", method)
    refuse_unknown(f"{path}: preset", [preset], presets.PRESETS, "name")
    return NamedSettings(method, preset, override(presets.preset(method, preset), flatten(str(path), table), str(path)))


def save_settings(path: str | Path, settings: Settings, method: str | None = None, preset: str = "default") -> None:
    """Write every setting to a settings file, atomically.

    Args:
        path: The file, TOML.
        settings: Settings with a solver, a loss and an optimiser of this package: others have no name to be read by.
        method: Method that the file is based on; by default the solver's.
        preset: Preset that the file is based on.

    Raises:
        GavoError: The file cannot be written, or the settings are invalid or hold code of another package.
    """
    if not isinstance(settings, Settings):
        raise GavoError(f"{path}: expected Settings, got {type(settings).__name__}")
    known = {type(presets.preset(name).solver): name for name in presets.usable_methods()}
    if type(settings.solver) not in known:
        raise GavoError(f"{path}: cannot store a {type(settings.solver).__name__}: not a solver of this package")
    method = method or known[type(settings.solver)]
    if type(presets.preset(method, preset).solver) is not type(settings.solver):
        raise GavoError(f"{path}: method {method} is not that of a {type(settings.solver).__name__}")
    require_settings(settings, str(path))
    table: dict[str, Any] = {"method": method, "preset": preset}
    for part_name in PARTS:
        part = getattr(settings, part_name)
        values = {field.name: getattr(part, field.name) for field in dataclasses.fields(part) if field.repr}
        table[part_name] = {name: _as_toml(f"{path}: {part_name}.{name}", value) for name, value in values.items()}
    write_bytes(path, tomli_w.dumps(table).encode())


def assignments(texts: Iterable[str]) -> dict[str, Any]:
    """Parse texts like `alignment.points=2400` into values by dotted name; a value is TOML, or a word.

    Raises:
        GavoError: A text is not an assignment.
    """
    values: dict[str, Any] = {}
    for text in texts:
        name, sign, value = (part.strip() for part in text.partition("="))
        if not (name and sign and value):
            raise GavoError(f"--set: {shown(text)} is not NAME=VALUE")
        try:
            values[name] = parse_toml("--set", f"value = {value}")["value"]
        except GavoError:
            values[name] = value
    return values


def _without_types(part: Any) -> Any:
    """Convert a part of config.json to that of a settings file: without the type's name, and with a word for null."""
    if not isinstance(part, dict):
        return part
    return {name: "none" if value is None else value for name, value in part.items() if name != "type"}


def _as_toml(place: str, value: Any) -> Any:
    if value is None:
        return "none"
    if isinstance(value, tuple):
        return [_as_toml(place, entry) for entry in value]
    if isinstance(value, np.generic | jax.Array):
        return np.asarray(value).item()
    if callable(value):
        name = name_of(value)
        if name is None:
            raise GavoError(f"{place}: cannot store a function from outside this package")
        return name
    return value


def name_of(function: Any) -> str | None:
    """Return the name of a loss or an optimiser; None for a custom one."""
    return next((name for name, known in (LOSSES | OPTIMIZERS).items() if known is function), None)


def refuse_unknown(place: str, keys: Iterable[str], known: Iterable[str], what: str = "key") -> None:
    """Raise GavoError for the first unknown key, suggesting the nearest known one; `what` is the word for a key."""
    known = tuple(known)
    for key in keys:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1, cutoff=0.0)
            hint = f"; did you mean {shown(near[0])}?" if near else ""
            raise GavoError(f"{place}: unknown {what} {shown(key)}{hint}")


def refuse_unknown_method(place: str, method: str, others: Iterable[str] = ()) -> None:
    """Raise GavoError for an unknown method, suggesting the nearest usable one.

    Args:
        place: Begins the message.
        method: The name.
        others: Other names that are allowed.
    """
    if method not in (others := tuple(others)) + presets.methods():
        refuse_unknown(place, [method], (*presets.usable_methods(), *others), "name")


def override(settings: Settings, values: Mapping[str, Any], place: str = "settings") -> Settings:
    """Return the settings with some hyperparameters replaced.

    Args:
        settings: Settings to change.
        values: Value by dotted name. A list gives a schedule an entry per pyramid level (level 0 first); a single
            number stands for every level of a schedule of rates; `solver.population.4` names the entry of level 4. The
            word `none` switches an optional number off; losses and optax's optimisers go by their names.
        place: Where the values stand, for the message.

    Raises:
        GavoError: an unknown name (with the nearest known one), a value of the wrong kind, or one that would change
            nothing.
    """
    before = settings
    for name, value in values.items():
        part_name, _, rest = name.partition(".")
        if part_name not in PARTS:
            _refuse_part(place, part_name, settings)
        if not rest:
            raise GavoError(f"{place}: {part_name}: not a table of settings")
        part = getattr(settings, part_name)
        field, _, level = rest.partition(".")
        refuse_unknown(f"{place}: {part_name}", [field], [f.name for f in dataclasses.fields(part) if f.repr])
        current = getattr(part, field)
        where = f"{place}: {name}"
        if level:
            new: Any = _with_level(where, current, level, value)
        else:
            new = _convert(where, type(part), field, current, value)
        settings = dataclasses.replace(settings, **{part_name: dataclasses.replace(part, **{field: new})})
    require_settings(settings, place)
    _refuse_without_effect(before, settings, values, place)
    return settings


def _refuse_without_effect(before: Settings, after: Settings, values: Mapping[str, Any], place: str) -> None:
    """Raise GavoError for a new value that has no effect because of another one.

    Files that name every field (`save_settings`) are exempt: they also hold values without effect.
    """
    for part_name in PARTS:
        part, earlier = getattr(after, part_name), getattr(before, part_name)
        fields = [field for field in dataclasses.fields(part) if field.repr]
        if all(f"{part_name}.{field.name}" in values for field in fields):
            continue
        for field in fields:
            name, other = f"{part_name}.{field.name}", field.metadata.get("instead_of")
            is_idle = other is not None and getattr(part, other) is not None
            if is_idle and name in values and getattr(part, field.name) != getattr(earlier, field.name):
                raise GavoError(f"{place}: {name} applies only if {part_name}.{other} is none: set that instead")


def takes_whole(settings: Settings, name: str) -> bool:
    """Whether a setting, by its dotted name, takes whole numbers."""
    part_name, field, *_ = name.split(".")
    part = getattr(settings, part_name)
    return _takes_whole(type(part), field, getattr(part, field))


def _takes_whole(owner: type, field: str, current: Any) -> bool:
    return is_whole(current) or int in alternatives(kind_of(owner, field))


def _refuse_part(place: str, name: str, settings: Settings) -> NoReturn:
    """Raise GavoError for a name that begins with no part of the settings, suggesting the nearest full name."""
    parts = {part: [field.name for field in dataclasses.fields(getattr(settings, part))] for part in PARTS}
    whole = {field: f"{part}.{field}" for part, names in parts.items() for field in names}
    whole |= {part: part for part in PARTS}
    near = difflib.get_close_matches(name, whole, n=1, cutoff=0.0)[0]
    raise GavoError(f"{place}: unknown key {shown(name)}; did you mean {shown(whole[near])}?")


def flatten(place: str, table: Mapping[str, Any], is_leaf: Callable[[Any], bool] | None = None) -> dict[str, Any]:
    """Flatten nested tables into one, with dotted names.

    Raises:
        GavoError: What is at `place` is not a table.
    """
    if not isinstance(table, Mapping):
        raise GavoError(f"{place}: not a table")
    flat: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, Mapping) and not (is_leaf and is_leaf(value)):
            flat |= {f"{key}.{name}": leaf for name, leaf in flatten(f"{place}.{key}", value, is_leaf).items()}
        else:
            flat[key] = value
    return flat


def _with_level(where: str, current: Any, level: str, value: Any) -> tuple[Any, ...]:
    if not isinstance(current, tuple) or not level.isdecimal() or int(level) >= len(current):
        raise GavoError(f"{where}: no such entry in {current!r}")
    entries = list(current)
    entries[int(level)] = _plain(value, is_whole(current))
    return tuple(entries)


def _convert(where: str, owner: type, field: str, current: Any, value: Any) -> Any:
    """Convert a TOML value to what the field holds: words become functions or None, lists become tuples."""
    kinds = alternatives(kind_of(owner, field))
    if value == "none":
        if type(None) not in kinds:
            raise GavoError(f"{where}: cannot be none")
        return None
    if callable(current):
        return _callable(where, field, current, value)
    whole = _takes_whole(owner, field, current)
    if isinstance(value, list):
        return tuple(_plain(entry, whole) for entry in value)
    if isinstance(current, tuple) and not whole:
        return (_plain(value, whole),) * len(current)
    return _plain(value, whole)


def _plain(value: Any, whole: bool) -> Any:
    """Convert a number to the field's type; anything else is left for `require_settings` to refuse."""
    is_number = isinstance(value, int) and not isinstance(value, bool)
    return float(value) if is_number and not whole and abs(value) <= MAX_REAL else value


def _callable(where: str, field: str, current: Any, value: Any) -> Any:
    known = LOSSES if field == "loss" else OPTIMIZERS
    if value == getattr(current, "__name__", None) and value not in known:  # the registered method's own
        return current
    if not isinstance(value, str):
        raise GavoError(f"{where}: must be a name, not {shown(value)}")
    refuse_unknown(where, [value], known, "name")
    return known[value]
