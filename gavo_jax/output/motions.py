"""motions.csv: each pair's motion at full precision, so that a resumed run builds the same map."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gavo_jax.errors import GavoError, read_text
from gavo_jax.odometry.driver import Step

MATRICES = ("world_T_camera", "target_T_reference")
UPPER = np.triu_indices(6)
MOTION_COLUMNS = (
    ("index", "timestamp", "reference_timestamp")
    + tuple(f"{name}_{row}{column}" for name in MATRICES for row in range(3) for column in range(4))
    + tuple(f"covariance_{row}{column}" for row, column in zip(*UPPER, strict=True))
    + tuple(f"sway_{axis}" for axis in range(6))
)
"""Columns of motions.csv, one row per pair: the frame's index and timestamps (s), then the upper three rows of the
pose and of the pair's motion (m). Last the upper triangle of the motion's covariance, and its sway (v, w) in m and rad.
"""


def motion_row(step: Step) -> list[Any]:
    """Return the values of `MOTION_COLUMNS` of one step, in digits that read back exactly."""
    matrices = (step.world_T_camera, step.alignment.target_T_reference)
    numbers = [*(np.asarray(matrix, np.float64)[:3].ravel() for matrix in matrices)]
    numbers += [np.asarray(step.alignment.covariance, np.float64)[UPPER], np.asarray(step.alignment.sway, np.float64)]
    stamps = (step.timestamp, step.reference_timestamp)
    return [step.index, *(repr(float(number)) for number in (*stamps, *np.concatenate(numbers)))]


def with_motions(steps: list[Step], path: Path) -> list[Step]:
    """Return steps updated with the values of motions.csv.

    Raises:
        GavoError: It cannot be read, or belongs to other steps.
    """
    lines = read_text(path).splitlines()[1:]
    try:
        rows = list(csv.reader(lines))
        return [_with_motion(step, *row) for step, row in zip(steps, rows, strict=True)]
    except (TypeError, ValueError, csv.Error):
        raise GavoError(f"{path}: not the motions of this run") from None


def _with_motion(step: Step, index: str, *texts: str) -> Step:
    if int(index) != step.index or len(texts) != len(MOTION_COLUMNS) - 1:
        raise ValueError(index)
    *stamps, first, second, upper, sway = np.split(np.array(texts, np.float64), (1, 2, 14, 26, 47))
    covariance = np.zeros((6, 6))
    covariance[UPPER] = covariance.T[UPPER] = upper
    pose, motion = (np.vstack([rows.reshape(3, 4), [0.0, 0.0, 0.0, 1.0]]) for rows in (first, second))
    return replace(
        step,
        timestamp=stamps[0].item(),
        reference_timestamp=stamps[1].item(),
        world_T_camera=pose,
        alignment=step.alignment._replace(target_T_reference=motion, covariance=covariance, sway=sway),
    )
