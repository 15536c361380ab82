"""A camera file without a readout, and a shutter that rolls."""

from dataclasses import replace
from typing import Any

import pytest
from small import CAMERA

from gavo_jax.cli.run import _doubts_about_shutter


@pytest.mark.parametrize(
    ("flagged", "readout", "is_told"), [(28, 0.0, True), (28, 0.02, False), (2, 0.0, False), (0, 0.0, False)]
)
def test_a_shutter_that_is_not_stated_may_look_like_bodies(flagged: int, readout: float, is_told: bool) -> None:
    """28 of 39 pairs of a static desk were `moving_body`, and nothing spoke of the shutter."""
    metrics: dict[str, Any] = {"pairs": 39, "statuses": {"ok": 39 - flagged, "moving_body": flagged}}
    assert bool(list(_doubts_about_shutter(replace(CAMERA, readout=readout), metrics))) == is_told
