"""What tests use to which any camera and any search will do: all the same, so that they share compiled programs."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.objective.losses import l2
from gavo_jax.settings import AlignmentOptions, OdometryOptions, Settings
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.solvers.genetic import GeneticAlgorithm

CAMERA = Camera(131.0, 131.0, 79.5, 59.5, 160, 120)
PLAIN_ERROR = AlignmentOptions(robust_scale=False, brightness=False, depth=False, last_step=False, loss=l2)
"""Grey alone: half as long to compile as the default one."""
ALONE = OdometryOptions(relight=False, recover=False, bodies="off")
"""No second search behind the first one, and nothing that looks for bodies."""
NEWTON = Settings(GaussNewton(iterations=(0, 0, 0, 10, 20)), PLAIN_ERROR, ALONE)
GENETIC = Settings(
    GeneticAlgorithm(population=(0, 0, 0, 8, 16), iterations=(0, 0, 0, 6, 8)), AlignmentOptions(last_step=False), ALONE
)
"""So few candidates find little. A pair's result is the best of them, and nothing more."""


class Rendered(SyntheticSequence):
    """A synthetic sequence that keeps its frames: several tests run over the same ones."""

    def __init__(self, frames: int, **options: Any):
        super().__init__(frames, **options)
        self.kept: dict[float, Frame] = {}

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return super().__getitem__(index)
        stamp = float(self.timestamps[index])
        if stamp not in self.kept:
            self.kept[stamp] = super().__getitem__(index)
        return self.kept[stamp]


class StandIn:
    """An aligner's empty methods, for one that finds what a test tells it: its state is the last frame's stamp."""

    def warm_up(self) -> float:
        return 0.0

    def start(self, frame: Frame) -> Any:
        return frame.timestamp

    def predict(self, state: Any, elapsed: float) -> NDArray[np.float64]:
        return np.eye(4)
