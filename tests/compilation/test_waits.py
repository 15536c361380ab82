"""Time that is spent waiting for programs is told apart from work, in other threads too."""

import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from gavo_jax.compilation.waits import Stopwatch, counted_map, counted_wait

WAIT = 0.05


def work(waits: int) -> int:
    for _ in range(waits):
        with counted_wait():
            time.sleep(WAIT)
    return waits


@pytest.mark.parametrize(("threads", "least"), [(1, 3), (2, 2)])
def test_the_wait_of_a_pool_is_that_of_its_slowest_thread(threads: int, least: int) -> None:
    """Programs that a run needs late were compiled in the time of an experiment's runs."""
    stopwatch = Stopwatch()
    with ThreadPoolExecutor(threads) as pool:
        assert counted_map(pool, work, (1, 2, 0)) == [1, 2, 0]
    assert least * WAIT <= stopwatch.waited <= 3.5 * WAIT + 0.5
    assert stopwatch.seconds < WAIT
