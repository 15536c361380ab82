"""The Bonn RGB-D Dynamic dataset (Palazzolo et al. 2019): TUM's layout, with the true poses of the camera's markers."""

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from gavo_jax.camera import preset_for_sequence
from gavo_jax.datasets.files import own_camera_file
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.truth import Seconds
from gavo_jax.errors import GavoError
from gavo_jax.trajectory import Trajectory

ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
MARKERS = np.array(
    [[1.0157, 0.1828, -0.2389, 0.0113], [0.0009, -0.8431, -0.6413, -0.0098], [-0.3009, 0.6147, -0.8085, 0.0111]]
)
"""T_ros and T_m of the dataset's page, which has T_ros · T · T_ros · T_m for the camera's pose of a row T."""


class Bonn(TumSequence):
    """A folder of TUM's layout whose name begins with `rgbd_bonn_`; its truth becomes that of the camera."""

    kind: ClassVar[str] = "Bonn RGB-D Dynamic sequence"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by its lists and its name, where no camera file of somebody's own lies in it."""
        try:
            is_bonn = preset_for_sequence(path.resolve().name) == "bonn"
        except GavoError:
            return False
        return is_bonn and super().recognises(path) and own_camera_file(path) is None

    @classmethod
    def truth(cls, folder: Path, stamps: list[float], seconds: Seconds | None) -> tuple[Trajectory | None, list[str]]:
        """The markers' true poses, moved to the camera."""
        found, unread = super().truth(folder, stamps, seconds)
        if found is None:
            return found, unread
        return replace(found, world_T_camera=found.world_T_camera @ markers_T_camera()), unread


def markers_T_camera() -> Float[np.ndarray, "4 4"]:
    """Return where the camera lies among its markers: of T_m, which is scaled by 1.06, the nearest rotation."""
    left, _, right = np.linalg.svd(MARKERS[:, :3])
    moved = np.eye(4)
    moved[:3] = np.column_stack([left @ right, MARKERS[:, 3]])
    return ROS @ moved
