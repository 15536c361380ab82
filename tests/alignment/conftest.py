"""Fixtures of the tests of alignment."""

import pytest
from aligning import FRAMES
from small import CAMERA

from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.sensor_noise import NONE
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence


@pytest.fixture(scope="session")
def sequence() -> SyntheticSequence:
    """Noise-free, 640 x 480."""
    return SyntheticSequence(frames=30, noise=NONE)


@pytest.fixture(scope="session")
def frames(sequence: SyntheticSequence) -> dict[int, Frame]:
    return {i: sequence[i] for i in FRAMES}


@pytest.fixture(scope="session")
def small_frames() -> dict[int, Frame]:
    """Of the same room, 160 x 120: for what any search shows."""
    small = SyntheticSequence(frames=30, noise=NONE, camera=CAMERA)
    return {i: small[i] for i in (0, 1, 8, 9)}
