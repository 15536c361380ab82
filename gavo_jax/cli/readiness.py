"""Preparation shared by the subcommands that compute."""

import os

import jax
import numpy as np

from gavo_jax.compilation.cache import enable_compilation_cache
from gavo_jax.errors import blamed

CHOICES = ("JAX_PLATFORMS", "JAX_DEFAULT_DEVICE")
"""Environment variables that choose JAX's device."""


def be_ready() -> None:
    """Enable the compilation cache, and check that JAX has a device.

    Raises:
        GavoError: it has none, for instance because the requested GPU is missing or its memory is taken.
    """
    enable_compilation_cache()
    chosen = "".join(f", with {name}={os.environ[name]!r}" for name in CHOICES if os.environ.get(name))
    with blamed(f"JAX has no device to compute on{chosen}"):
        jax.block_until_ready(jax.device_put(np.zeros(1, np.float32)))  # transfer a number: needs no compilation
