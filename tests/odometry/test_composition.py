"""The aligner that settings ask for: what stands behind what."""

from dataclasses import replace

import jax
import pytest
from driving import CAMERA, PLAIN, SEARCH_ALONE, SOLVER

from gavo_jax.bodies.aligner import BodyAware
from gavo_jax.bodies.rival import WithRival
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.odometry.aligners import Search
from gavo_jax.odometry.composition import wide_search
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.relighting import Relighting
from gavo_jax.odometry.run import run_odometry
from gavo_jax.odometry.second_thoughts import DoubtingDepth, Polished, Recovering
from gavo_jax.settings import Settings
from gavo_jax.solvers.base import Solver
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.solvers.genetic import GeneticAlgorithm


@pytest.mark.slow
def test_the_wide_search_recovers_what_the_default_loses() -> None:
    jump = SyntheticSequence(frames=60, camera=CAMERA)[::25]
    lost = run_odometry(jump, Settings(GaussNewton(), odometry=PLAIN)).metrics["lost_pairs"]
    assert lost > 0
    assert run_odometry(jump, GaussNewton()).metrics["lost_pairs"] < lost


@pytest.mark.parametrize(
    "solver",
    [GaussNewton(iterations=(10, 0, 0, 0, 0)), GeneticAlgorithm(iterations=(10, 8, 8, 10, 12)), SOLVER],
)
def test_the_wide_search_searches_every_level_that_the_references_have(solver: Solver) -> None:
    """Of a solver that searches the full image it left that level out, and the first hard pair ended in a traceback."""
    search = Search(CAMERA, replace(SEARCH_ALONE, solver=solver), jax.random.key(0))
    wide = wide_search(search)
    assert wide.settings.solver.levels == solver.levels
    shapes = jax.eval_shape(lambda: wide.blank_state()), jax.eval_shape(lambda: search.blank_state())
    assert shapes[0] == shapes[1]


def test_the_wide_search_stands_behind_the_default_one() -> None:
    aligner = Odometry(CAMERA, SOLVER, seed=3).aligner
    assert isinstance(aligner, Recovering) and isinstance(aligner.first, DoubtingDepth)
    rivalled = aligner.first.first, aligner.first.alone, aligner.second
    first, alone, second = (one.first for one in rivalled if isinstance(one, WithRival))
    assert isinstance(first, BodyAware) and isinstance(alone, BodyAware) and isinstance(second, BodyAware)
    relighting, wide = first.search, second.search
    assert isinstance(relighting, Relighting) and isinstance(wide, Search)
    assert first.first == relighting and alone.search == relighting
    search = relighting.search
    assert isinstance(search, Search) and relighting.first is search and wide.key == search.key
    assert second.first == Polished(wide, search)
    assert wide.settings.alignment.scouts > 0 and wide.settings.odometry.reference == "previous"
    assert wide.settings.solver.levels == SOLVER.levels
    assert wide.settings.alignment.points == search.settings.alignment.points
    assert isinstance(Odometry(CAMERA, SEARCH_ALONE).aligner, Search)
