"""Use of JAX in 32 bits and its default modes, which this package's programs need, whatever the caller has set.

Every computation begins here, so forked processes, which cannot compute, are detected here, too.
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
"""Modes with their default values and context managers. NaN and infinity are not errors here: they stand for unknown
values and invalid candidates. Images come from the host, and results go there. The generator determines what a seed
draws."""


def choose_usual() -> None:
    """Set the usual modes for every thread of this process, overriding environment variables.

    This is for the command, which owns its process.
    """
    for name, (usual, _) in USUAL.items():
        jax.config.update(name, usual)
    jax.config.update("jax_disable_jit", False)  # a frame would take minutes


def in_32_bits(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function run with JAX in 32 bits (without `jax_enable_x64`) and in the other modes of `USUAL`.

    Modes are per thread: functions that are passed to another thread must be wrapped, too. In a forked process the
    function raises as `refuse_fork` does.
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
"""Id of the process that computed first."""


def refuse_fork() -> None:
    """Refuse to compute in a process that was forked from one that has computed.

    Raises:
        GavoError: it was. JAX's threads do not exist in it, and it would wait for them for ever.
    """
    global _process
    _process = _process or os.getpid()
    if _process != os.getpid():
        raise GavoError(
            "this process was forked from one in which JAX has computed, and would hang: start processes with "
            "multiprocessing.get_context('spawn')"
        )
