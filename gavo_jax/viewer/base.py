"""The interface of a run's viewer, and the viewer that shows nothing."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from jaxtyping import Float

from gavo_jax.alignment.search import Population
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.mapping.mapper import Loops
from gavo_jax.odometry.driver import Step
from gavo_jax.trajectory import Trajectory

ViewerMode = Literal["none", "spawn", "web", "save"]


class Viewer:
    """A viewer that shows nothing."""

    wants_populations: bool = False
    """Whether `watch` uses the populations."""

    def open(self, title: str, camera: Camera, stamps: Float[np.ndarray, " n"], truth: Trajectory | None) -> None:
        """Begin to show a run.

        Args:
            title: Name of the run.
            camera: Camera of the frames, without distortion.
            stamps: Timestamps of all frames, seconds; of a live source, of the first.
            truth: The true trajectory, if known.
        """

    def watch(self, frame: Frame | None, step: Step | None, populations: tuple[Population, ...] = ()) -> None:
        """Show one more frame.

        Args:
            frame: The frame; None if it could not be read.
            step: The driver's record of it; None for the first frame.
            populations: Candidates of its search, coarsest level first.
        """

    def show_corrected(self, trajectory: Trajectory, loops: Loops) -> None:
        """Show the loops of a whole run, and the trajectory corrected by them.

        Args:
            trajectory: The corrected trajectory.
            loops: The map, with the places that were seen again.
        """

    def close(self) -> None:
        """Show what is still queued, then end the recording."""

    def stay(self) -> None:
        """Wait for Ctrl-C if what was shown would disappear with the process."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


NO_VIEWER = Viewer()
