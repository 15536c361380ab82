"""Turns command-line options into a sequence (frames and camera) and settings."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from gavo_jax import presets
from gavo_jax.camera import PRESETS
from gavo_jax.cli.options import Run, SearchOptions, Source
from gavo_jax.datasets.base import Sequence
from gavo_jax.datasets.files import Reading
from gavo_jax.datasets.live.devices import is_live
from gavo_jax.datasets.rectified import without_distortion
from gavo_jax.datasets.rendered.actors import MOST_BODIES
from gavo_jax.datasets.selection import SYNTHETIC, open_part
from gavo_jax.errors import GavoError, read_json_object
from gavo_jax.output.files import describe
from gavo_jax.settings import Settings
from gavo_jax.settings_file import NamedSettings, assignments, load_settings, override


def open_sequence(source: Source, force: bool = False, color: bool = False) -> Sequence:
    """Return the chosen frames, checked as far as possible before a run.

    Args:
        source: the options.
        force: same as `source.force`; either suffices.
        color: whether frames carry RGB besides grey.

    Raises:
        GavoError: the options, the sequence or its camera are faulty, or there are fewer than two frames.
    """
    if is_live(source.sequence):
        raise GavoError(f"{source.sequence}: a live source, which only `gavo run` accepts")
    _check_at_least("--start", source.start, 0)
    _check_at_least("--stride", source.stride, 1)
    if source.frames is not None:
        _check_at_least("--frames", source.frames, 2)
    if source.moving and source.sequence != SYNTHETIC:
        raise GavoError(f"--moving: applies only to the {SYNTHETIC} room, not to {source.sequence}")
    if not 0 <= source.moving <= MOST_BODIES:
        raise GavoError(f"--moving: must be from 0 to {MOST_BODIES}, not {source.moving}")
    sequence = open_part(
        *(source.sequence, source.camera, source.start, source.frames, source.stride),
        reading=replace(reading_of(source), color=color),
        force=force or source.force,
        moving=source.moving,
    )
    return without_distortion(sequence)  # a user-defined dataset may leave distortion in


def reading_of(source: Source) -> Reading:
    """Return how to read the source, according to the options.

    Raises:
        GavoError: a number is out of range.
    """
    check_positive("--depth-scale", source.depth_scale, 1e6)
    check_positive("--rate", source.rate, 1e4)
    return Reading(
        depth_scale=source.depth_scale,
        rate=source.rate,
        color_topic=source.colour_topic,
        depth_topic=source.depth_topic,
    )


def choose_settings(search: SearchOptions) -> NamedSettings:
    """Return the settings of the preset or file, with single ones overridden by the options.

    Raises:
        GavoError: the method, the file or a single setting is invalid.
    """
    method, preset = search.base
    if method not in presets.methods():
        raise GavoError(f"--method: {method!r} is not one of {', '.join(presets.usable_methods())}")
    if search.settings is None:
        named = NamedSettings(method, preset, presets.preset(method, preset))
    else:
        named = load_settings(search.settings, method, preset)
        for name in ("method", "preset"):
            asked, said = getattr(search, name), getattr(named, name)
            if asked not in (said, None):
                raise GavoError(f"--{name} {asked}: {search.settings} says {said}: omit one of them")
    return named._replace(settings=override(named.settings, assignments(search.set), "--set"))


FRAMES_AND_SEED = ("sequence", "start", "frames", "stride", "camera", "depth_scale", "rate", "moving", "seed")
"""Options of a run that are not settings."""


SHORTCUTS = ("reference", "on_lost", "bodies", "loops")
"""Settings of the odometry that have options of their own."""


def with_shortcuts(settings: Settings, options: Run) -> Settings:
    """Return the settings with the dedicated options (`--reference`, `--on-lost`, `--bodies`, `--loops`) applied."""
    given: dict[str, Any] = {name: value for name in SHORTCUTS if (value := getattr(options, name))}
    for name in given:
        if f"odometry.{name}" in assignments(options.set):
            option = name.replace("_", "-")
            raise GavoError(f"--{option}: --set odometry.{name} says the same: omit one of them")
    return replace(settings, odometry=replace(settings.odometry, **given))


def unchanged_preset(settings: Settings, options: Run) -> str | None:
    """Return the name of a run's preset; None if more than the dedicated options has changed its settings."""
    unchanged = with_shortcuts(presets.preset(*options.base), options)
    return options.preset if presets.are_same(settings, unchanged) else None


def settings_line(options: Run) -> str | None:
    """Return a note that only the settings of an earlier run's config.json are used.

    It lists differing options for frames and seed. None if the settings are not from a run.
    """
    path = options.settings
    if path is None or path.suffix != ".json":
        return None
    earlier, now = read_json_object(path).get("options"), describe(with_whole_paths(options))
    if not isinstance(earlier, dict):
        return None
    differing = {name: earlier[name] for name in FRAMES_AND_SEED if name in earlier and earlier[name] != now[name]}
    words = [f"{name.replace('_', '-')} {_said(now[name])} (there {_said(there)})" for name, there in differing.items()]
    return f"only the settings of {path} are used; {', '.join(words) or 'frames and seed are the same'}"


def _said(value: Any) -> str:
    return "not given" if value is None else str(value)


WORDS = (SYNTHETIC, "auto", *PRESETS)
"""Names of built-in sources and cameras; they take precedence over files of the same name."""


def with_whole_paths(options: Run) -> Run:
    """Return the options with absolute paths."""
    places = {
        name: str(Path(place).resolve())
        for name, place in (("sequence", options.sequence), ("camera", options.camera), ("settings", options.settings))
        if place is not None and place not in WORDS and Path(place).exists()
    }
    return replace(options, **places)  # pyright: ignore[reportArgumentType]


def check_positive(option: str, value: float | None, most: float) -> None:
    """Raise GavoError if a number is given and is not from 0.001 to `most`."""
    if value is not None and not 1e-3 <= value <= most:
        raise GavoError(f"{option}: must be a number from 0.001 to {most:g}, not {value:g}")


def _check_at_least(option: str, value: int, least: int) -> None:
    if value < least:
        raise GavoError(f"{option}: must be at least {least}, not {value}")
