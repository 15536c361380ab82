"""Fixtures of the tests of the driver and its parts."""

import pytest
from driving import CAMERA, FRAMES, run
from small import Rendered

from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.odometry.run import OdometryRun


@pytest.fixture(scope="session")
def sequence() -> SyntheticSequence:
    """Twelve frames with a Kinect's noise."""
    return Rendered(frames=FRAMES, camera=CAMERA)


@pytest.fixture(scope="session")
def plain_run(sequence: SyntheticSequence) -> OdometryRun:
    return run(sequence)
