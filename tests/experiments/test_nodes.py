"""What a batch takes of a Ray cluster must fit one of its nodes."""

import sys
from types import SimpleNamespace

import pytest

from gavo_jax.errors import GavoError
from gavo_jax.experiments.executors import RayExecutor
from gavo_jax.experiments.plan import RayOptions


@pytest.fixture
def executor_on(monkeypatch):
    """Join a cluster of nodes with these (processors, GPUs), without Ray."""

    def join(nodes, **options):
        found = [{"Alive": True, "Resources": {"CPU": cpus, "GPU": gpus}} for cpus, gpus in nodes]
        total = {name: sum(node["Resources"][name] for node in found) for name in ("CPU", "GPU")}

        def options_of(**amounts):
            if amounts["num_gpus"] > 1 and amounts["num_gpus"] % 1:
                raise ValueError("GPU resource quantities >1 must be whole numbers.")
            return amounts

        stub = SimpleNamespace(
            is_initialized=lambda: True,
            cluster_resources=lambda: total,
            nodes=lambda: [*found, {"Alive": False, "Resources": {"CPU": 64.0, "GPU": 8.0}}],
            remote=lambda _: SimpleNamespace(options=options_of),
        )
        monkeypatch.setitem(sys.modules, "ray", stub)
        return RayExecutor(RayOptions(**options))

    return join


def test_a_batch_that_no_node_can_run_is_refused(executor_on):
    """It waited for ever, as the nodes together had enough."""
    with pytest.raises(GavoError, match="a batch takes 2 GPU, but no node of the cluster has more than 1"):
        executor_on([(4.0, 1.0), (4.0, 1.0)], gpus=2.0)
    with pytest.raises(GavoError, match="a batch takes 2 CPU"):
        executor_on([(0.0, 0.0)])


@pytest.mark.parametrize(
    ("nodes", "options", "slots"),
    [
        ([(1.0, 0.0), (1.0, 0.0)], {}, 2),
        ([(3.0, 0.0), (3.0, 0.0)], {"cpus": 2.0}, 2),
        ([(8.0, 0.0), (1.0, 2.0)], {"cpus": 2.0}, 1),
        ([(4.0, 2.0), (4.0, 0.0)], {"cpus": 1.0, "gpus": 0.5}, 4),
        ([(4.0, 0.0)], {"cpus": 0.0, "gpus": 0.0}, 1),
    ],
)
def test_a_batch_takes_no_more_processors_than_a_node_has(executor_on, nodes, options, slots):
    """By default it takes two, and waited for ever on nodes of one; what is left over of two nodes makes no slot."""
    assert executor_on(nodes, **options).slots() == slots


def test_an_amount_that_ray_refuses_is_one_line(executor_on):
    """It was a traceback."""
    with pytest.raises(GavoError, match="whole numbers"):
        executor_on([(4.0, 4.0)], gpus=1.5)
