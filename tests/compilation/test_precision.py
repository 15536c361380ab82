"""In a program that computes in 64 bits, the results are the same ones, bit for bit."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from small import CAMERA, GENETIC

import gavo_jax as gavo
from gavo_jax.cli import main
from gavo_jax.compilation.precision import USUAL, in_32_bits
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence

FRAMES = SyntheticSequence(frames=4, camera=CAMERA)
SETTINGS = replace(GENETIC, odometry=replace(GENETIC.odometry, bodies="mask"))


def test_results_are_those_of_32_bits(tmp_path: Path, wanted: list[np.ndarray]) -> None:
    """In a process of its own: the switch is for the whole program, and threads begin with it."""
    program = (
        "import sys; import numpy as np; from test_precision import results\n"
        "import jax; assert jax.numpy.zeros(1).dtype == np.float64\n"
        "np.savez(sys.argv[1], *results()); assert jax.numpy.zeros(1).dtype == np.float64"
    )
    places = os.pathsep.join([*map(str, Path(__file__).parents[:2]), os.environ.get("PYTHONPATH", "")])
    outside = {**os.environ, "JAX_ENABLE_X64": "1", "PYTHONPATH": places}
    subprocess.run([sys.executable, "-c", program, str(tmp_path / "found.npz")], env=outside, check=True)
    with np.load(tmp_path / "found.npz") as found:
        for name, one in zip(found.files, wanted, strict=True):
            np.testing.assert_array_equal(found[name], one)


@pytest.fixture(scope="module")
def wanted() -> list[np.ndarray]:
    return results()


def results() -> list[np.ndarray]:
    """Motions and covariances of a pair, of a batch and of a run."""
    one = gavo.align(FRAMES[0], FRAMES[1], CAMERA, SETTINGS, guess=np.eye(4))
    batch = gavo.align_batch([FRAMES[0]], [FRAMES[1]], CAMERA, SETTINGS)
    run = gavo.run_odometry(FRAMES, SETTINGS)
    found = [one, batch, *run.alignments]
    return [np.asarray(leaf) for result in found for leaf in (result.target_T_reference, result.covariance)]


def test_where_it_is_switched_off_nothing_changes() -> None:
    with jax.enable_x64(True):
        assert jax.numpy.zeros(1).dtype == np.float64
        assert in_32_bits(lambda: jax.numpy.zeros(1))().dtype == np.float32
        assert jax.numpy.zeros(1).dtype == np.float64
    assert in_32_bits(lambda: jax.numpy.zeros(1))().dtype == np.float32


@pytest.mark.parametrize(
    "mode",
    [
        partial(jax.numpy_rank_promotion, "raise"),
        partial(jax.numpy_dtype_promotion, "strict"),
        partial(jax.debug_nans, True),
        partial(jax.debug_infs, True),
        partial(jax.debug_key_reuse, True),
        partial(jax.transfer_guard, "disallow"),
        partial(jax.transfer_guard_host_to_device, "disallow"),
        partial(jax.transfer_guard_device_to_host, "disallow"),
    ],
    ids=["ranks", "types", "not-a-number", "infinity", "keys", "transfers", "transfers there", "transfers back"],
)
def test_modes_that_look_for_errors_do_not_look_here(mode: Callable[[], Any], wanted: list[np.ndarray]) -> None:
    """They ended in tracebacks: ours leaves promotion to JAX, and not-a-number stands for what is not known. Images
    come from the host.
    """
    with mode():
        found = results()
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    "mode", [partial(jax.default_prng_impl, "rbg"), partial(jax.threefry_partitionable, False)], ids=["rbg", "parts"]
)
def test_a_seed_draws_the_same_numbers_whatever_generator_is_chosen_outside(
    mode: Callable[[], Any], wanted: list[np.ndarray]
) -> None:
    with mode():
        found = results()
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_command_has_the_usual_modes_in_every_thread() -> None:
    """Environment variables choose others for the whole process: `gavo run` ended in a traceback as it drew figures."""
    unusual = {"jax_numpy_rank_promotion": "raise", "jax_transfer_guard": "disallow", "jax_default_prng_impl": "rbg"}
    try:
        for name, value in unusual.items():
            jax.config.update(name, value)
        main(["--version"])
        assert not [name for name, (usual, _) in USUAL.items() if getattr(jax.config, name) != usual]
        assert (jax.numpy.ones((2, 3)) + np.ones(3)).shape == (2, 3)
    finally:
        for name in unusual:
            jax.config.update(name, USUAL[name][0])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_process_that_was_forked_after_the_first_result_is_told_and_does_not_wait_for_ever() -> None:
    program = (
        "import os; from gavo_jax.compilation.precision import in_32_bits; from gavo_jax import GavoError\n"
        "import jax; compute = in_32_bits(lambda: float(jax.numpy.zeros(1)[0])); compute()\n"
        "if os.fork():\n"
        "    os.wait(); print('parent:', compute())\n"
        "else:\n"
        "    try: compute()\n"
        "    except GavoError as fault: print('child:', fault, flush=True)\n"
        "    os._exit(0)"
    )
    command = [sys.executable, "-W", "ignore", "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    child, parent = done.stdout.splitlines()
    assert child.startswith("child: this process was forked") and "spawn" in child and parent == "parent: 0.0"
