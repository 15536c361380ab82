"""The same pairs on one device, on eight, and on two processes with four each.

XLA compiles a program for each number of pairs and orders its sums as suits it, so results are equal to rounding, not
to the last bit. A random search enlarges that with every generation: two of them are compared, which differ wholly
where the random numbers do.
"""

import os
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from sharded_pairs import FIGURES, METHODS, PAIRS, figures_of, pairs

from gavo_jax.alignment.pairs import align_batch
from gavo_jax.errors import GavoError
from gavo_jax.experiments.sharding import align_batch_sharded

SCRIPT = Path(__file__).with_name("sharded_pairs.py")
TIMEOUT = 300
DEVICES = 8


def start(out: Path, devices: int, names: str, *distributed: object) -> subprocess.Popen[str]:
    environment = {
        **os.environ,
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": os.pathsep.join(sys.path),
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}",
    }
    command = [sys.executable, str(SCRIPT), str(out), names, *map(str, distributed)]
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


@pytest.fixture(scope="module")
def alone() -> dict[str, np.ndarray]:
    """The figures of every method for the whole batch on one device."""
    return figures_of(align_batch)


def agrees(found: Mapping[str, np.ndarray], alone: Mapping[str, np.ndarray]) -> None:
    """To rounding."""
    for name in (name for name in METHODS if f"{name}_xi" in found):
        xi, error, covariance = (found[f"{name}_{figure}"] for figure in FIGURES)
        assert len(np.unique(xi, axis=0)) == PAIRS
        np.testing.assert_allclose(xi, alone[f"{name}_xi"], atol=1e-5)
        np.testing.assert_allclose(error, alone[f"{name}_error"], rtol=1e-4)
        np.testing.assert_allclose(covariance, alone[f"{name}_covariance"], rtol=1e-2, atol=1e-9)


def test_other_keys_give_other_motions(alone):
    """So that agreement says that every device has its own pairs' keys."""
    others = figures_of(align_batch, seed=6)
    assert np.all(np.abs(others["ga_xi"] - alone["ga_xi"]).max(axis=1) > 1e-4)
    np.testing.assert_array_equal(others["gauss-newton_xi"], alone["gauss-newton_xi"])


def test_eight_devices(alone, tmp_path):
    process = start(tmp_path / "out.npz", DEVICES, ",".join(METHODS))
    assert process.communicate(timeout=TIMEOUT)[1] is not None and process.returncode == 0
    found = np.load(tmp_path / "out.npz")
    assert found["devices"].tolist() == [DEVICES, DEVICES]
    agrees(found, alone)


def test_two_processes(alone, tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    # the search that takes random numbers: each process has to give its pairs their own
    processes = [start(tmp_path / f"{i}.npz", DEVICES // 2, "ga", address, 2, i) for i in range(2)]
    try:
        errors = [process.communicate(timeout=TIMEOUT)[1] for process in processes]
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert [process.returncode for process in processes] == [0, 0], errors
    first, second = (np.load(tmp_path / f"{i}.npz") for i in range(2))
    assert first["devices"].tolist() == [DEVICES, DEVICES // 2]
    agrees(first, alone)
    assert all(np.array_equal(first[name], second[name]) for name in first.files)


def test_sides_of_different_length_are_refused():
    references, targets, camera, _ = pairs(0)
    with pytest.raises(GavoError, match="11 references but 10 targets"):
        align_batch_sharded(references, tuple(side[:10] for side in targets), camera)
