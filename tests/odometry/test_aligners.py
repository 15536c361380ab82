"""The search as an aligner: warming up leaves no trace."""

import gc

import numpy as np
import pytest
from driving import CAMERA, SEARCH_ALONE

from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.odometry.driver import Odometry


@pytest.mark.parametrize("collects", [False, True])
def test_warming_up_leaves_the_garbage_collector_as_it_was(collects: bool) -> None:
    before = gc.isenabled()
    try:
        (gc.enable if collects else gc.disable)()
        Odometry(CAMERA, SEARCH_ALONE).warm_up()
        assert gc.isenabled() == collects
    finally:
        (gc.enable if before else gc.disable)()


def test_warm_up_leaves_no_trace(sequence: SyntheticSequence) -> None:
    steps = []
    for warm in (True, False):
        odometry = Odometry(CAMERA, SEARCH_ALONE)
        if warm:
            assert odometry.warm_up() > 0
        assert odometry.register(sequence[0], 0.0) is None
        step = odometry.register(sequence[1], float(sequence.timestamps[1]))
        assert step is not None
        steps.append(step)
    np.testing.assert_array_equal(steps[0].world_T_camera, steps[1].world_T_camera)
