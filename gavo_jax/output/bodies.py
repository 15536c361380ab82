"""bodies.csv: a row per body and frame."""

import csv
from pathlib import Path
from typing import Any, NamedTuple

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


class BodyRow(NamedTuple):
    """What a row of bodies.csv says of how much moves."""

    timestamp: float
    """Colour stamp, seconds."""
    body: int
    share: float
    """Of the image."""


def read_bodies(path: Path) -> list[BodyRow]:
    """The rows of bodies.csv; none where there is no such file."""
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        rows = csv.DictReader(file)
        return [BodyRow(float(row["timestamp"]), int(row["body"]), float(row["share"])) for row in rows]
