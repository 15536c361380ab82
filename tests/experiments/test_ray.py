"""The same experiment on a Ray cluster, in good times and bad."""

import importlib
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from gavo_jax.experiments.executors import LocalExecutor, Outcome, RayExecutor
from gavo_jax.experiments.plan import Plan, RayOptions
from gavo_jax.experiments.plan_file import read_plan
from gavo_jax.experiments.runner import run_experiment
from gavo_jax.experiments.table import Table

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'gavo-jax[ray]'")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default")]
FIGURES = ("run", "label", "seed", "frames", "lost_pairs", "rpe_translation_rmse_m_per_frame", "distance_error_final_m")
RUNS = 8


@pytest.fixture
def plan(write_experiment: Callable[..., Path], tmp_path: Path) -> Plan:
    methods = '[[methods]]\nname = "gauss-newton"\npresets = ["fast"]\n'
    return read_plan(write_experiment(f"seeds = {RUNS}\nbatch = 1\n[ray]\ncpus = 1\n", methods, 6), tmp_path / "out")


def figures(table: Table) -> list[tuple[Any, ...]]:
    return [tuple(row[name] for name in FIGURES) for row in table.read()]


@pytest.fixture
def expected(plan: Plan, tmp_path: Path) -> list[tuple[Any, ...]]:
    table = Table(tmp_path / "local")
    assert run_experiment(plan, table, LocalExecutor()) == (RUNS, [])
    return figures(table)


@pytest.fixture
def shut_down() -> Iterator[None]:
    yield
    ray.shutdown()


class Recording:
    """An executor whose outcomes are counted and watched."""

    def __init__(self, executor: RayExecutor, on_first: Callable[[], None]) -> None:
        self.executor, self.on_first = executor, on_first
        self.runs: list[str] = []

    def slots(self) -> int:
        return self.executor.slots()

    def run(self, *arguments: Any, **options: Any) -> Iterator[Outcome]:
        for outcome in self.executor.run(*arguments, **options):
            if not self.runs:
                self.on_first()
            self.runs += [row["run"] for row in outcome.rows]
            yield outcome


def children_of(pid: int) -> list[int]:
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal():
            try:
                parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:
                continue
            if parent == pid:
                found += [int(folder.name), *children_of(int(folder.name))]
    return found


def kill_a_worker() -> None:
    """Kill one process, below this one, that is at work on a batch."""
    for pid in children_of(os.getpid()):
        if b"ray::_run_cached" in Path(f"/proc/{pid}/cmdline").read_bytes():
            os.kill(pid, signal.SIGKILL)
            return
    pytest.fail("no worker is at work")


def test_a_killed_worker_is_retried_and_the_numbers_are_those_of_local(plan, expected, tmp_path, shut_down):
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    recording = Recording(RayExecutor(plan.ray), kill_a_worker)
    table = Table(tmp_path / "ray")
    assert run_experiment(plan, table, recording) == (RUNS, [])
    assert figures(table) == expected
    assert len(recording.runs) == len(set(recording.runs)) == RUNS


def test_a_node_is_removed(plan, expected, tmp_path, shut_down):
    cluster = importlib.import_module("ray.cluster_utils").Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        node = cluster.add_node(num_cpus=1)
        ray.init(address=cluster.address, log_to_driver=False)
        assert sum(found["Alive"] for found in ray.nodes()) == 2
        recording = Recording(RayExecutor(plan.ray), lambda: cluster.remove_node(node, allow_graceful=False))
        table = Table(tmp_path / "ray")
        assert run_experiment(plan, table, recording) == (RUNS, [])
        deadline = time.monotonic() + 60
        while sum(found["Alive"] for found in ray.nodes()) > 1 and time.monotonic() < deadline:
            time.sleep(0.5)
        assert sum(found["Alive"] for found in ray.nodes()) == 1
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert figures(table) == expected
    assert len(recording.runs) == len(set(recording.runs)) == RUNS


def test_more_than_the_cluster_has_is_refused(shut_down):
    from gavo_jax.errors import GavoError

    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
    with pytest.raises(GavoError, match="GPU"):
        RayExecutor(RayOptions(gpus=1000))
