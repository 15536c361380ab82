"""bodies.csv: a row per body and frame."""

from typing import Any

import numpy as np

from gavo_jax.odometry.driver import Step

BODY_COLUMNS = ("timestamp", "body", "share", "x", "y", "z", "dx", "dy", "dz", "rx", "ry", "rz", "status")
"""Colour stamp in seconds; number of the body; share of the image that it covers; centroid of what is seen of it in the
world, m; displacement of that centroid since the last frame, m, and rotation vector, rad: nan where no motion is known;
status of its motion, `seen` where there is none."""


def body_rows(step: Step) -> list[list[Any]]:
    """Values of `BODY_COLUMNS` of every body in a frame, by number."""
    return [
        [f"{step.timestamp:.6f}", body.number, f"{body.share:.6f}"]
        + [f"{value:.6f}" for value in np.concatenate([body.centroid, body.displacement, body.rotation])]
        + [body.status]
        for body in sorted(step.bodies, key=lambda body: body.number)
    ]
