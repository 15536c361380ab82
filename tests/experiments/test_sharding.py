"""The same pairs on one device, on eight, and on two processes."""

import os
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from sharded_pairs import METHOD, PAIRS, pairs

from gavo_jax.alignment import Alignment, align_batch
from gavo_jax.errors import GavoError
from gavo_jax.experiments.sharding import align_batch_sharded
from gavo_jax.presets import get_preset

SCRIPT = Path(__file__).with_name("sharded_pairs.py")
TIMEOUT = 300


def start(out: Path, devices: int, *distributed: object) -> subprocess.Popen[str]:
    environment = {
        **os.environ,
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}",
    }
    command = [sys.executable, str(SCRIPT), str(out), *map(str, distributed)]
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


@pytest.fixture(scope="module")
def alone() -> Alignment:
    references, targets, camera, keys = pairs()
    preset = get_preset(METHOD)
    return align_batch(references, targets, camera, preset.solver, keys, options=preset.alignment)


def agrees(found: Mapping[str, np.ndarray], alone: Alignment) -> None:
    """To rounding."""
    assert len(found["xi"]) == PAIRS == len(np.unique(found["xi"][:, 0]))
    np.testing.assert_allclose(found["xi"], alone.xi, atol=1e-5)
    np.testing.assert_allclose(found["error"], alone.error, rtol=1e-4)
    np.testing.assert_allclose(found["covariance"], alone.covariance, rtol=1e-2, atol=1e-9)


def test_eight_devices(alone, tmp_path):
    process = start(tmp_path / "out.npz", 8)
    assert process.communicate(timeout=TIMEOUT)[1] is not None and process.returncode == 0
    found = np.load(tmp_path / "out.npz")
    assert found["devices"].tolist() == [8, 8]
    agrees(found, alone)


def test_two_processes(alone, tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    processes = [start(tmp_path / f"{i}.npz", 2, address, 2, i) for i in range(2)]
    try:
        errors = [process.communicate(timeout=TIMEOUT)[1] for process in processes]
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert [process.returncode for process in processes] == [0, 0], errors
    first, second = (np.load(tmp_path / f"{i}.npz") for i in range(2))
    assert first["devices"].tolist() == [4, 2]
    agrees(first, alone)
    assert all(np.array_equal(first[name], second[name]) for name in first.files)


def test_sides_of_different_length_are_refused():
    references, targets, camera, _ = pairs()
    with pytest.raises(GavoError, match="11 references but 10 targets"):
        align_batch_sharded(references, tuple(side[:10] for side in targets), camera)
