"""JAX in 32 bits, whatever the program around it has chosen: all that is compiled here is written for them."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
R = TypeVar("R")


def in_32_bits(function: Callable[P, R]) -> Callable[P, R]:
    """The function as it is in a process that has not switched on JAX's 64 bits (`jax_enable_x64`).

    The switch is one of each thread: what is handed to another one has to be wrapped, too.
    """

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if not jax.config.read("jax_enable_x64"):
            return function(*args, **kwargs)
        with jax.enable_x64(False):
            return function(*args, **kwargs)

    return call
