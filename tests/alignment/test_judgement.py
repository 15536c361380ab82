"""The last step, the covariance, and what is said against a motion."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from aligning import difference, run, target_T_reference

from gavo_jax.alignment.information import Information
from gavo_jax.alignment.judgement import Examination, find_against
from gavo_jax.alignment.pairs import align
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.objective.derivatives import Linearization
from gavo_jax.objective.error import Scales
from gavo_jax.objective.estimates import ExplainedShare
from gavo_jax.settings import AlignmentOptions, Settings
from gavo_jax.solvers.genetic import GeneticAlgorithm
from gavo_jax.status import AlignmentStatus, as_findings, gravest


def test_a_last_step_centres_what_a_short_search_leaves(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    solver = GeneticAlgorithm(population=16, iterations=(0, 2, 3, 8, 10))
    truth = target_T_reference(sequence, 0, 1)

    def off(last_step: bool) -> tuple[list[float], list[float]]:
        settings = Settings(solver, AlignmentOptions(last_step=last_step, depth=False))
        found = [align(frames[0], frames[1], sequence.camera, settings, key=jax.random.key(k)) for k in range(5)]
        return [difference(a.target_T_reference, truth)[0] for a in found], [float(a.error) for a in found]

    (with_step, error), (without, error_before) = off(True), off(False)
    assert np.median(with_step) < 0.7 * np.median(without)
    assert np.all(np.array(error) <= 1.003 * np.array(error_before))


def test_last_steps_reach_the_minimum_from_far(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    """A search of two generations a level ends some 5 mm off, and a single step a millimetre."""
    settings = Settings(GeneticAlgorithm(population=16, iterations=(0, 2, 2, 2, 2)), AlignmentOptions())
    found = [align(frames[0], frames[1], sequence.camera, settings, key=jax.random.key(k)) for k in range(5)]
    truth = target_T_reference(sequence, 0, 1)
    assert np.median([difference(one.target_T_reference, truth)[0] for one in found]) < 5e-4


@pytest.mark.parametrize(
    ("scale", "asked", "status"),
    [
        (1.0, 100, AlignmentStatus.OK),
        (1.001, 100, AlignmentStatus.NOT_RIGID),
        (1.0, 1900, AlignmentStatus.OK),
        (1.0, 2100, AlignmentStatus.NO_DEPTH),
    ],
)
def test_what_speaks_against_a_motion_whatever_the_images(scale: float, asked: int, status: AlignmentStatus) -> None:
    """It is not rigid; or of the points that were asked for too few have a reading."""
    motion = np.diag([scale, scale, scale, 1.0]).astype(np.float32)
    model = Linearization(jnp.float32(20.0), jnp.float32(0.9), jnp.zeros(6), 1e4 * jnp.eye(6))
    points = SimpleNamespace(q=jnp.ones(100))
    information = Information(jnp.eye(6), 1e4 * jnp.ones(6), jnp.ones(6, bool))
    explained = ExplainedShare(jnp.float32(1.0), jnp.float32(1.0))
    reference = SimpleNamespace(points=points, grey=jnp.arange(100.0))
    objective: Any = SimpleNamespace(
        scales=Scales.unit(), reference=reference, is_out_of_view=lambda overlap: overlap < 0.35
    )

    @jax.jit
    def judge(motion: jax.Array) -> jax.Array:
        examination = Examination(motion, jnp.float32(100.0), model, jnp.eye(6), information, explained)
        return gravest(
            as_findings(
                find_against(examination, 1e-6 * jnp.eye(6), objective, jnp.float32(np.inf), jnp.float32(asked))
            )
        )

    assert AlignmentStatus(int(judge(motion))) is status


def test_covariance_is_positive_definite(sequence: SyntheticSequence, frames: dict[int, Frame]) -> None:
    for method in ("ga", "gauss-newton"):
        covariance = np.asarray(run(method, frames[0], frames[1], sequence.camera).covariance, float)
        np.testing.assert_array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > 0
        deviation = np.sqrt(np.diag(covariance))
        assert np.all(deviation < 0.02) and np.all(deviation > 1e-7)


def test_covariance_covers_the_error_under_noise() -> None:
    noisy = SyntheticSequence(frames=30)
    distances = []
    for i in range(0, 12, 2):
        result = run("gauss-newton", noisy[i], noisy[i + 1], noisy.camera)
        delta = np.linalg.inv(np.asarray(result.target_T_reference, float)) @ target_T_reference(noisy, i, i + 1)
        small = np.array([*delta[:3, 3], delta[2, 1], delta[0, 2], delta[1, 0]])
        distances.append(small @ np.linalg.solve(np.asarray(result.covariance, float), small))
    # chi-square with six degrees of freedom has a median of 5.3
    assert 1 < np.median(distances) < 20
