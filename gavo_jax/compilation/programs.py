"""Large programs whose traced form is kept between processes.

JAX's own cache keeps what XLA compiled, but to look that up the function must first be traced and lowered. For a
frame's program this takes longer than everything after it (`benchmarks/footprint.py`). So the lowered form is kept too,
as serialised by `jax.export`. A file's name identifies the program (function, settings, shapes, JAX's configuration);
its seal identifies what that was made from (this package's code, versions). If either changes, the program is traced
again.
"""

import dataclasses
import hashlib
import inspect
import platform
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import cache, update_wrapper
from importlib.metadata import version
from operator import attrgetter
from pathlib import Path
from typing import Any, Generic, NamedTuple, ParamSpec, TypeVar, get_args, get_type_hints

import jax
import numpy as np
from jax import export
from jax.core import Tracer

from gavo_jax.compilation.waits import counted_wait
from gavo_jax.errors import GavoError, write_bytes

P = ParamSpec("P")
R = TypeVar("R")

OURS = __name__.partition(".")[0]
TRACED_WITH = ("jax", "jaxlib", "jaxlie", "numpy", "optax")
"""Packages whose code is traced along with ours; their versions show whether it has changed."""

OPTIONS = tuple(
    name for name in sorted(jax.config.values) if hasattr(jax.config, name) and "transfer_guard" not in name
)
"""Names of JAX's options, except the transfer guards: these apply when a program runs and are not part of it."""
_configuration = attrgetter(*OPTIONS)
"""Returns the values of `OPTIONS` in `jax.config`, as seen by this thread."""

_folder: Path | None = None
_loaded: dict[Any, Callable[..., Any]] = {}
_loading: dict[Any, threading.Lock] = {}
_lock = threading.Lock()


def keep_programs_in(folder: Path | None) -> None:
    """Set the folder where every `CachedProgram` keeps its traced forms; None, the default, keeps none."""
    global _folder
    if folder != _folder:
        _loaded.clear()
    _folder = folder


class Kind(NamedTuple):
    """Shape and type of an input, which a program is compiled for."""

    shape: tuple[int, ...]
    type: Any
    """Number type of NumPy or JAX, or a Python number's own."""
    weak: bool
    """Whether the type is weak, as a Python number's."""

    @classmethod
    def of(cls, leaf: Any) -> "Kind":
        """Return the kind of an array or a number."""
        if type(leaf) in (bool, int, float):
            return cls((), type(leaf), True)
        return cls(leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False))

    def __repr__(self) -> str:
        return f"{self.type}{self.shape}{'*' * self.weak}"


class CachedProgram(Generic[P, R]):
    """A function compiled as by `jax.jit`, whose traced form is kept in the folder of `keep_programs_in`.

    Third-party code in the settings (a loss, a solver) may have changed by the next time. With it, and inside another
    program, this is just `jax.jit`.

    Args:
        function: Takes trees of arrays and numbers by position, and `static` arguments by keyword.
        static: Names of keyword arguments that are part of the program.
        returns: The NamedTuples that it returns; those in their fields are found by their types.
    """

    def __init__(self, function: Callable[P, R], static: tuple[str, ...] = (), returns: tuple[type, ...] = ()):
        self._function, self._jitted = function, jax.jit(function, static_argnames=static)
        for node in returns:
            _register(node)
        update_wrapper(self, function)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Run the program."""
        leaves, structure = jax.tree.flatten(args)
        is_traced = any(isinstance(leaf, Tracer) for leaf in leaves)
        if is_traced or jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
            return self._jitted(*args, **kwargs)
        kinds = tuple(map(Kind.of, leaves))
        signature = self._signature(structure, kinds, kwargs)
        program = _loaded.get(signature)
        try:
            if program is not None:
                return program(*leaves)
            with _lock:
                loading = _loading.setdefault(signature, threading.Lock())
            with counted_wait(), loading:  # each program is loaded once, different ones concurrently
                program = _loaded.get(signature)
                if program is None:
                    program = _loaded[signature] = self._load(leaves, structure, kinds, kwargs)
                return program(*leaves)  # compiles it, if `_load` did not
        except ValueError:  # a kept program is for the default device, and these inputs may be on another
            return self._jitted(*args, **kwargs)

    def is_kept(self, *args: P.args, **kwargs: P.kwargs) -> bool:
        """Whether a call would find its program, in memory or in the folder, and trace nothing."""
        if _folder is None:
            return False
        leaves, structure = jax.tree.flatten(args)
        kinds = tuple(map(Kind.of, leaves))
        if self._signature(structure, kinds, kwargs) in _loaded:
            return True
        try:
            return _read(self._path(_folder, structure, kinds, kwargs)) is not None
        except Foreign:
            return False

    def _signature(self, structure: Any, kinds: tuple[Kind, ...], static: dict[str, Any]) -> Any:
        """Return what identifies a program in this process."""
        return self._function, structure, kinds, tuple(static.items()), _configuration(jax.config)

    def _path(self, folder: Path, structure: Any, kinds: tuple[Kind, ...], static: dict[str, Any]) -> Path:
        """Return the file of a program; raise Foreign if it cannot be kept."""
        settings = identify((jax.tree.unflatten(structure, kinds), static))
        function = self._function
        configuration = list(zip(OPTIONS, _configuration(jax.config), strict=True))
        program = (function.__module__, function.__qualname__, settings, configuration, jax.default_backend())
        digest = hashlib.sha256(repr(program).encode()).hexdigest()
        return folder / f"{function.__name__.strip('_')}-{digest[:32]}"

    def _load(
        self, leaves: list[Any], structure: Any, kinds: tuple[Kind, ...], static: dict[str, Any]
    ) -> Callable[..., R]:
        """Return the program as a function of the leaves.

        It is read from its file, or traced and written there; if it cannot be kept, it is a plain `jax.jit`.
        """

        def of_leaves(*leaves: Any) -> R:
            return self._function(*jax.tree.unflatten(structure, leaves), **static)

        jitted = jax.jit(of_leaves)
        if _folder is None:
            return jitted
        try:
            path = self._path(_folder, structure, kinds, static)
        except Foreign:
            return jitted
        data = _read(path)
        if data is None:
            try:
                data = bytes(export.export(jitted)(*leaves).serialize())
            except (NotImplementedError, ValueError):  # an operation that JAX cannot export on this backend
                return jitted
            _write(path, data)
        # some versions of JAX set up LAPACK only when they lower a call of it: jax-ml/jax#29610
        jax.jit(jax.lax.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), np.float32))
        # compiled here, as the jitted form would compile again when it is called with its own results; and for abstract
        # inputs, as the key in JAX's cache depends on whether inputs are on the host or on the device
        return jax.jit(export.deserialize(bytearray(data)).call).lower(*map(_abstract, leaves)).compile()


def _abstract(leaf: Any) -> Any:
    """Return what a program is compiled for: an array without its device and values, or a Python number."""
    kind = Kind.of(leaf)
    return leaf if kind.shape == () and kind.weak else jax.ShapeDtypeStruct(kind.shape, kind.type, weak_type=kind.weak)


def _register(node: type) -> None:
    """Register a NamedTuple, and those in it, for serialisation; without it no program with one can be kept."""
    try:
        export.register_namedtuple_serialization(node, serialized_name=f"{node.__module__}.{node.__qualname__}")
    except ValueError:  # registered already, by another program
        return
    for hint in get_type_hints(node).values():
        for part in (hint, *get_args(hint)):
            if isinstance(part, type) and issubclass(part, tuple) and hasattr(part, "_fields"):
                _register(part)


class Foreign(Exception):
    """Code that may have changed undetected."""


def identify(value: Any) -> Any:
    """Describe settings by nested texts that are the same in every process.

    Raises:
        Foreign: They contain something that is neither known code nor a plain value.
    """
    if isinstance(value, Kind | str | bool | int | float | None):
        return repr(value)
    if isinstance(value, type) or inspect.isfunction(value):
        return _known(value)
    if isinstance(value, dict):
        return [(name, identify(entry)) for name, entry in value.items()]
    if type(value) in (tuple, list):
        return [type(value).__name__, *map(identify, value)]
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return [_known(type(value)), *map(identify, value)]
    if dataclasses.is_dataclass(value):
        fields = (field.name for field in dataclasses.fields(value))
        return [_known(type(value)), *((name, identify(getattr(value, name))) for name in fields)]
    raise Foreign


def _known(code: Any) -> str:
    """Return the full name of a class or function of this package or of those it is traced with; else raise Foreign."""
    module = sys.modules.get(code.__module__)
    may_be_known = code.__module__.partition(".")[0] in (OURS, *TRACED_WITH)
    if not may_be_known or getattr(module, code.__name__, None) is not code:
        raise Foreign
    return f"{code.__module__}.{code.__name__}"


@cache
def _made_from() -> bytes:
    """Return a digest of this package's code and of the versions that it is traced with."""
    digest = hashlib.sha256(repr([platform.python_version(), *map(version, TRACED_WITH)]).encode())
    folder = Path(__file__).parents[1]
    for path in sorted(folder.rglob("*.py")):
        digest.update(str(path.relative_to(folder)).encode() + b"\0" + path.read_bytes())
    return digest.digest()


def _seal(data: bytes) -> bytes:
    return hashlib.sha256(_made_from() + data).digest()


def _read(path: Path) -> bytes | None:
    """Return what the same code wrote to a file; None if the file is missing, stale or damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    seal, data = content[:32], content[32:]
    return data if seal == _seal(data) else None


def _write(path: Path, data: bytes) -> None:
    """Write a file atomically, ignoring failures: without it only time is lost."""
    with suppress(OSError, GavoError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, _seal(data) + data)
