"""Validation of settings from any source: Python, a file or the command line."""

import dataclasses
import operator
import types
import typing
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any, Literal

import jax
import numpy as np
from jax.core import Tracer

from gavo_jax.errors import GavoError, shown
from gavo_jax.image.pyramid import LEVELS
from gavo_jax.objective.losses import fault_of_loss
from gavo_jax.solvers.base import Schedule

MAX_WHOLE, MAX_REAL = 2**31 - 1, 3e38
"""Largest integer and float of the device."""
MAX_SEED = 2**32 - 1
"""Largest seed of JAX's keys in 32 bits: larger ones would be truncated, so that two seeds could coincide."""


def as_seed(seed: Any, name: str = "seed") -> int:
    """Return a seed as a Python int.

    Raises:
        GavoError: It is not a whole number from 0 to `MAX_SEED`.
    """
    try:
        number = operator.index(seed)
    except TypeError:
        number = -1
    if not 0 <= number <= MAX_SEED:
        raise GavoError(f"{name}: must be a whole number from 0 to {MAX_SEED}, not {shown(seed)}")
    return number


def require_settings(settings: Any, place: str = "settings") -> None:
    """Check that settings are ones that a search can run with.

    A field's annotation gives the type of its value; `static` and `within` give the range. Unknown types are not
    checked: a custom solver may hold anything.

    Args:
        settings: `Settings`.
        place: Begins the message.

    Raises:
        GavoError: A value is of the wrong kind or out of its range.
    """
    for room in dataclasses.fields(settings):
        part, kind = getattr(settings, room.name), kind_of(type(settings), room.name)
        if isinstance(part, type) or not isinstance(part, kind):
            raise GavoError(f"{place}: {room.name}: must be of type {kind.__name__}, not {shown(part)}")
    _require_pytree(f"{place}: solver", settings.solver)
    for name, part, field in _fields(settings):
        _require_kind(f"{place}: {name}", getattr(part, field.name), kind_of(type(part), field.name), field.default)
    if fault := fault_of_loss(settings.alignment.loss):
        raise GavoError(f"{place}: alignment.loss: {shown(settings.alignment.loss)}: {fault}")
    _require_kind(f"{place}: solver.iterations", settings.solver.iterations, tuple[int, ...], ())
    if min(settings.solver.iterations) < 0:
        raise GavoError(f"{place}: solver.iterations: must be at least 0, not {min(settings.solver.iterations)}")
    if not any(settings.solver.iterations):
        raise GavoError(f"{place}: solver.iterations: every level has 0")
    for name, part, field in _fields(settings):
        for level, entry in _searched(getattr(part, field.name), settings.solver.levels):
            if not (entry is None or isinstance(entry, Tracer)):
                _require_range(f"{place}: {name}{'' if level is None else f', level {level}'}", entry, field)


@cache
def kind_of(owner: type, field: str) -> Any:
    """Return the type in a field's annotation; `object` if that cannot be resolved."""
    try:
        return typing.get_type_hints(owner, include_extras=True)[field]
    except (NameError, KeyError):
        return object


def alternatives(kind: Any) -> tuple[Any, ...]:
    """Return the members of a union, or the type itself."""
    return typing.get_args(kind) if typing.get_origin(kind) in (typing.Union, types.UnionType) else (kind,)


def is_whole(value: Any) -> bool:
    """Whether a field with this default takes whole numbers."""
    return all(isinstance(entry, int) for entry in (value if isinstance(value, tuple) else (value,)))


def _require_pytree(where: str, solver: Any) -> None:
    if any(leaf is solver for leaf in jax.tree.leaves(solver)):
        words = "is not a pytree: decorate it with @jax.tree_util.register_dataclass"
        raise GavoError(f"{where}: {type(solver).__name__} {words}")


def _fields(settings: Any) -> Iterator[tuple[str, Any, dataclasses.Field[Any]]]:
    """Yield every setting's dotted name, the part that holds it, and its field."""
    for room in dataclasses.fields(settings):
        part = getattr(settings, room.name)
        for field in dataclasses.fields(part) if dataclasses.is_dataclass(part) else ():
            yield f"{room.name}.{field.name}", part, field


def _searched(value: Any, levels: tuple[int, ...]) -> list[tuple[int | None, Any]]:
    """Return the entries that count: if there is one per level, those of the levels that are searched."""
    if not isinstance(value, tuple):
        return [(None, value)]
    return [(level, value[level]) for level in levels] if len(value) == LEVELS else [(None, one) for one in value]


def _require_kind(where: str, value: Any, kind: Any, default: Any) -> None:
    kinds = [_kind(one, default) for one in alternatives(kind)]
    if not any(fits(value) for _, fits in kinds):
        *others, last = (words for words, _ in kinds)
        allowed = f"{', '.join(others)} or {last}" if others else last
        hint = ": use a tuple" if isinstance(value, list) else ""
        raise GavoError(f"{where}: must be {allowed}, not {shown(value)}{hint}")


def _kind(kind: Any, default: Any) -> tuple[str, Callable[[Any], bool]]:
    """Return a type in words, and a function that checks whether a value is of it."""
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if kind is types.NoneType:
        return "none", lambda value: value is None
    if kind is bool:
        return "true or false", lambda value: isinstance(value, bool | np.bool_)
    if kind in (int, float):
        return _NUMBER[kind is int], lambda value: _is_number(value, kind is int)
    if kind == Schedule:
        number = int if is_whole(default) else float
        words, is_list = _kind(tuple[number, ...], default)
        return f"{_NUMBER[number is int]} or {words}", lambda value: is_list(value) or _is_number(value, number is int)
    if origin is tuple:
        count, whole = LEVELS if parts[-1] is Ellipsis else len(parts), parts[0] is int

        def fits(value: Any) -> bool:
            return isinstance(value, tuple) and len(value) == count and all(_is_number(one, whole) for one in value)

        return f"a list of {count} {'whole ' if whole else ''}numbers", fits
    if origin is Literal:
        return f"one of {', '.join(parts)}", lambda value: isinstance(value, str) and value in parts
    if origin is Callable:
        return "a function", callable
    return "", lambda value: True


_NUMBER = ("a number", "a whole number")


def _is_number(value: Any, whole: bool) -> bool:
    """Whether a value is a single number that the device can hold; a traced one has no value yet."""
    if isinstance(value, Tracer):
        return not whole
    if isinstance(value, bool | np.bool_ | list | tuple | dict) or np.ndim(value) != 0:
        return False
    kind = getattr(np.asarray(value).dtype, "kind", "")
    return kind in ("iu" if whole else "iuf") and bool(abs(value) <= (MAX_WHOLE if whole else MAX_REAL))


def _require_range(where: str, value: Any, field: dataclasses.Field[Any]) -> None:
    least, most = field.metadata.get("range", (None, None))
    least = 0 if least is None and is_whole(field.default) else least
    if least is not None and value < least:
        raise GavoError(f"{where}: must be at least {least}, not {value}")
    if most is not None and value > most:
        raise GavoError(f"{where}: must be at most {most}, not {value}")
