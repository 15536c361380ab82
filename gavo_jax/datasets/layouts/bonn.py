"""The Bonn RGB-D Dynamic dataset (Palazzolo et al. 2019): TUM's layout, with true poses of the camera's markers."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from gavo_jax.camera import preset_for_sequence
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.own_camera import own_camera_file
from gavo_jax.datasets.truth import TRUTH, Counted
from gavo_jax.errors import GavoError, GavoWarning, read_text
from gavo_jax.trajectory import Trajectory
from gavo_jax.trajectory_rows import TRAJECTORY_HEADER

ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
MARKERS = np.array(
    [[1.0157, 0.1828, -0.2389, 0.0113], [0.0009, -0.8431, -0.6413, -0.0098], [-0.3009, 0.6147, -0.8085, 0.0111]]
)
"""T_ros and T_m of the dataset's page, where the camera's pose for a row T is T_ros · T · T_ros · T_m."""


class Bonn(TumSequence):
    """A folder in TUM's layout whose name begins with `rgbd_bonn_`; its ground truth is converted to the camera.

    It is not where `write_tum` has written the folder: with a camera file, and poses that are the camera's already.
    """

    kind: ClassVar[str] = "Bonn RGB-D Dynamic sequence"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by its lists and its name."""
        try:
            is_bonn = preset_for_sequence(path.resolve().name) == "bonn"
        except GavoError:
            return False
        return is_bonn and super().recognises(path)

    @classmethod
    def truth(cls, folder: Path, stamps: list[float], counted: Counted | None) -> tuple[Trajectory | None, list[str]]:
        """The markers' true poses, converted to the camera."""
        found, unread = super().truth(folder, stamps, counted)
        has_own_camera = own_camera_file(folder) is not None
        if found is None or has_own_camera and _is_of_camera(folder / TRUTH):
            return found, unread
        if has_own_camera:
            line = (
                f"{folder / TRUTH}: poses converted from the markers to the camera, as in Bonn's dataset: if they are"
            )
            warnings.warn(f"{line} the camera's already, rename the folder", GavoWarning, stacklevel=2)
        return replace(found, world_T_camera=found.world_T_camera @ markers_T_camera()), unread


def _is_of_camera(file: Path) -> bool:
    """Whether a trajectory was written as that of a camera by this package; the dataset's own has another heading."""
    return file.is_file() and TRAJECTORY_HEADER in read_text(file)


def markers_T_camera() -> Float[np.ndarray, "4 4"]:
    """Return the camera's pose among its markers, with the rotation nearest to that of T_m, which is scaled by 1.06."""
    left, _, right = np.linalg.svd(MARKERS[:, :3])
    moved = np.eye(4)
    moved[:3] = np.column_stack([left @ right, MARKERS[:, 3]])
    return ROS @ moved
