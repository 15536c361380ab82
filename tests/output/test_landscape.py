"""The landscape: its lowest point is the motion that was found, and it is flat where the images say little."""

from dataclasses import replace

import numpy as np
from small import CAMERA

from gavo_jax.alignment.pairs import align
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.odometry.driver import Odometry
from gavo_jax.output import drawing
from gavo_jax.output.landscape import STEPS, error_landscape
from gavo_jax.presets import preset
from gavo_jax.settings import AlignmentOptions
from gavo_jax.solvers.gauss_newton import GaussNewton


def test_lowest_at_the_optimum_and_steeper_along_the_best_direction():
    reference, target = SyntheticSequence(frames=2, camera=CAMERA)
    found = align(reference, target, CAMERA, GaussNewton())
    landscape = error_landscape(reference, target, CAMERA, found, AlignmentOptions(), (3, 2))
    assert np.allclose(landscape.directions @ landscape.directions.T, np.eye(2), atol=1e-6)
    variances = np.diag(landscape.directions @ np.asarray(found.covariance, np.float64) @ landscape.directions.T)
    assert variances[0] > variances[1]
    middle = STEPS // 2
    assert landscape.steps[middle] == 0 and list(landscape.errors) == [3, 2]
    worst, best = landscape.errors[2]
    assert abs(int(np.argmin(best)) - middle) <= 1 and abs(int(np.argmin(worst)) - middle) <= 2
    assert best[middle + 8] > worst[middle + 8] > worst[middle]


def test_what_a_run_knew_beside_the_pair_is_named_only_where_it_did():
    rolling, paper = replace(CAMERA, readout=0.02), preset("gauss-newton", "paper")
    assert drawing._beside_the_pair(Odometry(rolling, preset("ga"))) == ["a keyframe", "the shutter's readout"]
    assert drawing._beside_the_pair(Odometry(CAMERA, preset("ga"))) == ["a keyframe"]
    assert drawing._beside_the_pair(Odometry(rolling, paper)) == []
