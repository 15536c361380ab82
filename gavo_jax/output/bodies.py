"""bodies.csv: a row per body and frame."""

import csv
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from gavo_jax.errors import GavoError, read_text
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
    """A row of bodies.csv, without the status."""

    timestamp: float
    """Colour stamp, seconds."""
    body: int
    share: float
    """Share of the image that the body covers."""
    centroid: Float64[np.ndarray, " 3"]
    displacement: Float64[np.ndarray, " 3"]
    rotation: Float64[np.ndarray, " 3"]
    """Metres, metres and radians in the world, as of `Body`."""


def read_bodies(path: Path) -> list[BodyRow]:
    """Return the rows of bodies.csv; none if there is no such file.

    Raises:
        GavoError: It cannot be read.
    """
    if not path.exists():
        return []
    try:
        return [_row(*fields) for fields in csv.reader(read_text(path).splitlines()[1:])]
    except (TypeError, ValueError, csv.Error):
        raise GavoError(f"{path}: not a table of a run's bodies") from None


def _row(timestamp: str, body: str, share: str, *more: str) -> BodyRow:
    *numbers, _ = more
    return BodyRow(float(timestamp), int(body), float(share), *np.array(numbers, np.float64).reshape(3, 3))
