"""JAX in 32 bits and its usual modes, whatever the program around it has chosen: what is compiled here needs them.

Whatever computes begins here, so here it is seen, too, whether it can.
"""

import os
from collections.abc import Callable
from contextlib import ExitStack
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import jax

from gavo_jax.errors import GavoError

P = ParamSpec("P")
R = TypeVar("R")

USUAL: dict[str, tuple[Any, Callable[[Any], Any]]] = {
    "jax_enable_x64": (False, jax.enable_x64),
    "jax_numpy_rank_promotion": ("allow", jax.numpy_rank_promotion),
    "jax_numpy_dtype_promotion": ("standard", jax.numpy_dtype_promotion),
    "jax_debug_nans": (False, jax.debug_nans),
    "jax_debug_infs": (False, jax.debug_infs),
    "jax_debug_key_reuse": (False, jax.debug_key_reuse),
    "jax_transfer_guard": (None, lambda _: jax.transfer_guard("allow")),
    "jax_transfer_guard_host_to_device": (None, lambda _: jax.transfer_guard_host_to_device("allow")),
    "jax_transfer_guard_device_to_device": (None, lambda _: jax.transfer_guard_device_to_device("allow")),
    "jax_transfer_guard_device_to_host": (None, lambda _: jax.transfer_guard_device_to_host("allow")),
    "jax_default_prng_impl": ("threefry2x32", jax.default_prng_impl),
    "jax_threefry_partitionable": (True, jax.threefry_partitionable),
}
"""Modes, what they are as JAX comes, and what sets them. Here not-a-number and infinity are no errors: they stand for
what is not known, or worth nothing. Images come from the host, and what is found goes there. What a seed draws is up to
the generator."""


def choose_usual() -> None:
    """Have every thread of this process in the usual modes: for the command, whose process it is. What environment
    variables choose is for other programs.
    """
    for name, (usual, _) in USUAL.items():
        jax.config.update(name, usual)


def in_32_bits(function: Callable[P, R]) -> Callable[P, R]:
    """The function as it is in a process that has switched on neither JAX's 64 bits (`jax_enable_x64`) nor another mode
    of `USUAL`.

    The switches are those of each thread: what is handed to another one has to be wrapped, too. What it raises in a
    process that was forked is `refuse_fork`'s.
    """

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        refuse_fork()
        changed = [(usual, switch) for name, (usual, switch) in USUAL.items() if getattr(jax.config, name) != usual]
        with ExitStack() as modes:
            for usual, switch in changed:
                modes.enter_context(switch(usual))
            return function(*args, **kwargs)

    return call


_process: int | None = None
"""The one that came here first."""


def refuse_fork() -> None:
    """Refuse a process that was forked from one that has computed.

    Raises:
        GavoError: it was. JAX's threads are not in it, and it would wait for them for ever.
    """
    global _process
    _process = _process or os.getpid()
    if _process != os.getpid():
        raise GavoError(
            "this process was forked from one in which JAX has computed, and would wait for ever: start processes with "
            "multiprocessing.get_context('spawn')"
        )
