"""The bodies of a finished run, read from bodies.csv and masks/."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from gavo_jax.bodies.records import Body
from gavo_jax.odometry.driver import Step
from gavo_jax.output.bodies import BodyRow, read_bodies
from gavo_jax.output.files import BODIES, ODOMETRY
from gavo_jax.output.masks import read_labels
from gavo_jax.trajectory import Trajectory, inverse, stamp_name


class RecordedBodies:
    """Restores the bodies of a recorded run's steps, without the bodies' alignments.

    Args:
        folder: Folder of the run.

    Raises:
        GavoError: A file cannot be read.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self._rows: dict[str, list[BodyRow]] = {}
        for row in read_bodies(folder / BODIES):
            self._rows.setdefault(stamp_name(row.timestamp), []).append(row)
        self._odometry: dict[str, np.ndarray] = {}
        if (folder / ODOMETRY).exists():  # bodies are in its world, steps in the one corrected by loops
            odometry = Trajectory.read_tum(folder / ODOMETRY)
            self._odometry = dict(zip(map(stamp_name, odometry.timestamps), odometry.world_T_camera, strict=True))

    def restore(self, step: Step) -> Step:
        """Return a step with its bodies, in the world of its pose.

        Raises:
            GavoError: Their mask image cannot be read.
        """
        rows = self._rows.get(stamp_name(step.timestamp), [])
        labels = read_labels(self._folder, step.timestamp) if rows else None
        if labels is None:
            return step
        before = self._odometry.get(stamp_name(step.timestamp), step.world_T_camera)
        bodies = (_body(row, labels).moved(step.world_T_camera @ inverse(before)) for row in rows)
        return replace(step, bodies=tuple(bodies))


def _body(row: BodyRow, labels: np.ndarray) -> Body:
    height, width = labels.shape
    field = np.where(labels == row.body, np.float32(1.0), np.float32(-1.0))
    return Body(row.body, row.share, row.centroid, row.displacement, row.rotation, None, field, (height, width))
