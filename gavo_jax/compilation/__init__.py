"""Checks of JAX's version and modes, compiled programs and their cache, and the time spent waiting for them."""
