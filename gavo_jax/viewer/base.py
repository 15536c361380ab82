"""A viewer of a run: what it is told, and the one that shows nothing and costs nothing."""

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
    """Whether `watch` makes anything of the candidates."""

    def open(self, title: str, camera: Camera, stamps: Float[np.ndarray, " n"], truth: Trajectory | None) -> None:
        """Begin to show a run.

        Args:
            title: its name.
            camera: of the frames, without distortion.
            stamps: of all frames, seconds.
            truth: the true trajectory, where it is known.
        """

    def watch(self, frame: Frame | None, step: Step | None, populations: tuple[Population, ...] = ()) -> None:
        """Show one more frame.

        Args:
            frame: the frame, or None where it could not be read.
            step: what the odometry said of it; None for the first frame.
            populations: candidates of its search, coarsest level first.
        """

    def show_corrected(self, trajectory: Trajectory, loops: Loops) -> None:
        """Show what a map of the whole run says.

        Args:
            trajectory: as the map corrects it.
            loops: the map, with the places that were seen again.
        """

    def close(self) -> None:
        """Show what is still waiting, then end the recording."""

    def stay(self) -> None:
        """Keep what was shown in reach until the user has seen enough (Ctrl-C), where it would go with the process."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


NO_VIEWER = Viewer()
