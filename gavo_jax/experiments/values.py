"""Checks of the values in an experiment or tuning file; `place` says in error messages where a value stands."""

from collections.abc import Sequence
from typing import Any

from gavo_jax.errors import GavoError, shown
from gavo_jax.settings_check import MAX_REAL, MAX_SEED

MAX_RUNS = 1_000_000


def seeds_of(place: str, value: Any) -> tuple[int, ...]:
    """Return distinct seeds from a list, or 0 to N - 1 from a number N; otherwise raise GavoError."""
    if isinstance(value, list):
        seeds = tuple(whole_of(place, seed, 0) for seed in value)
        refuse_repeated(place, seeds)
    else:
        seeds = tuple(range(whole_of(place, value, 1))) if whole_of(place, value, 1) <= MAX_RUNS else ()
    if not seeds or max(seeds) > MAX_SEED:
        raise GavoError(f"{place}: must be a number of seeds, or a list of seeds from 0 to {MAX_SEED}")
    return seeds


def tables_of(place: str, value: Any) -> list[dict[str, Any]]:
    """Return a list of tables, or raise GavoError."""
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise GavoError(f"{place}: must be given as [[{place.rpartition(' ')[2]}]] tables")
    return value


def text_of(place: str, value: Any) -> str:
    """Return a non-empty text without null characters, or raise GavoError."""
    if not isinstance(value, str) or not value or "\0" in value:
        raise GavoError(f"{place}: must be text, not {shown(value)}")
    return value


def flag_of(place: str, value: Any) -> bool:
    """Return a Boolean, or raise GavoError."""
    if not isinstance(value, bool):
        raise GavoError(f"{place}: must be true or false, not {shown(value)}")
    return value


def whole_of(place: str, value: Any, least: int) -> int:
    """Return a whole number of at least `least`, or raise GavoError."""
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise GavoError(f"{place}: must be a whole number of at least {least}, not {shown(value)}")
    return value


def real_of(place: str, value: Any) -> float:
    """Return a non-negative number as a float, or raise GavoError."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= MAX_REAL:
        raise GavoError(f"{place}: must be a number of at least 0, not {shown(value)}")
    return float(value)


def refuse_repeated(place: str, values: Sequence[Any]) -> None:
    """Raise GavoError if a value is given twice."""
    for value in values:
        if values.count(value) > 1:
            raise GavoError(f"{place}: {shown(value)} is given twice")


def one_line(words: Any) -> str:
    """Join words into one line of a message, cut to 400 characters."""
    return " ".join(str(words).split())[:400]
