"""bodies.csv: one row per body and frame."""

import csv
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from gavo_jax.errors import GavoError, read_text
from gavo_jax.odometry.driver import Step

BODY_COLUMNS = ("timestamp", "body", "share", "x", "y", "z", "dx", "dy", "dz", "rx", "ry", "rz", "status")
"""Columns of bodies.csv: colour timestamp in seconds, number of the body, and share of the image that it covers. Then
the world coordinates of the visible part's centroid (m), its displacement (m) and the rotation vector (rad) since the
reference frame, nan if unknown. Last the status of the motion, `seen` if there is none.
"""


def body_rows(step: Step) -> list[list[Any]]:
    """Return the values of `BODY_COLUMNS` of each body in a frame, ordered by number."""
    return [
        [f"{step.timestamp:.6f}", body.number, f"{body.share:.6f}"]
        + [f"{value:.6f}" for value in np.concatenate([body.centroid, body.displacement, body.rotation])]
        + [body.status]
        for body in sorted(step.bodies, key=lambda body: body.number)
    ]


class BodyRow(NamedTuple):
    """A row of bodies.csv without the status; see `Body` for the fields and units."""

    timestamp: float
    """Colour timestamp, seconds."""
    body: int
    share: float
    """Share of the image that the body covers."""
    centroid: Float64[np.ndarray, " 3"]
    displacement: Float64[np.ndarray, " 3"]
    rotation: Float64[np.ndarray, " 3"]


def read_bodies(path: Path) -> list[BodyRow]:
    """Return the rows of bodies.csv; none if the file does not exist.

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
