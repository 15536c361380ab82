"""Scenes for neural mapping: Replica in the layout of Semantic-NeRF and vMAP, and Neural RGB-D."""

from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from gavo_jax.camera import Camera
from gavo_jax.camera_files.calibration import Calibration
from gavo_jax.datasets.assembly import MILLIMETRES
from gavo_jax.datasets.files import Size
from gavo_jax.datasets.layouts.image_folders import plain_files
from gavo_jax.datasets.layouts.nerf import FLIP
from gavo_jax.datasets.layouts.numbered import NumberedFolder, found_among
from gavo_jax.datasets.names import Found
from gavo_jax.datasets.truth import in_order, pose_of
from gavo_jax.errors import GavoError, number, read_text


class NeuralScene(NumberedFolder):
    """A scene with a centred principal point, a single focal length, and depth along z in millimetres."""

    POSES: ClassVar[str]
    """File of poses, each of sixteen numbers."""
    FROM_OURS: ClassVar[np.ndarray] = np.eye(4)
    """Rotation from our camera axes to those of the poses."""

    @classmethod
    def focal(cls, path: Path, width: int) -> tuple[float, str]:
        """The focal length, pixels, and its origin for messages."""
        raise NotImplementedError

    @classmethod
    def own_camera(cls, path: Path, size: Size) -> Calibration:
        """A camera with this focal length and the image's middle as principal point."""
        width, height = size
        focal, origin = cls.focal(path, width)
        middle = (width - 1) / 2, (height - 1) / 2
        return Calibration(Camera(focal, focal, *middle, width, height, depth_scale=MILLIMETRES), origin=origin)

    @classmethod
    def poses(cls, path: Path) -> dict[int, Float[np.ndarray, "4 4"]]:
        """Poses by image number, or in order if there are as many as images."""
        file = path / cls.POSES
        rows = in_order(file, cls.find(path).color) if file.is_file() else ()
        found = {number: pose_of(place, row) for number, place, row in rows}
        return {number: pose @ cls.FROM_OURS for number, pose in found.items() if pose is not None}


class SemanticReplica(NeuralScene):
    """A room of Replica as rendered for Semantic-NeRF and vMAP: `rgb/rgb_0.png`, `depth/`, `traj_w_c.txt`."""

    kind: ClassVar[str] = "Replica room of Semantic-NeRF"
    POSES: ClassVar[str] = "traj_w_c.txt"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by the file of poses beside images."""
        return (path / cls.POSES).is_file() and all(plain_files(path))

    @classmethod
    def focal(cls, path: Path, width: int) -> tuple[float, str]:
        """The focal length of a 90 degree field of view."""
        return width / 2, "the one that it was rendered with, of 90 degrees"


class NeuralRgbd(NeuralScene):
    """A scene of Neural RGB-D (Azinović et al. 2022): `images/img0.png`, `depth_filtered/depth0.png`, `focal.txt`.

    Cameras in `poses.txt` look along -z; four rows of NaN stand for a frame without a pose.
    """

    kind: ClassVar[str] = "scene of Neural RGB-D"
    POSES: ClassVar[str] = "poses.txt"
    FROM_OURS: ClassVar[np.ndarray] = FLIP
    FOCAL: ClassVar[str] = "focal.txt"
    DEPTH: ClassVar[str] = "depth_filtered"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by `focal.txt` beside the image folders."""
        return (path / cls.FOCAL).is_file() and all((path / name).is_dir() for name in ("images", cls.DEPTH))

    @classmethod
    def find(cls, path: Path) -> Found:
        """Colour, and the filtered depth that the method itself uses, which is always present."""
        return found_among((path / "images").glob("*"), (path / cls.DEPTH).glob("*"))

    @classmethod
    def focal(cls, path: Path, width: int) -> tuple[float, str]:
        """The focal length in `focal.txt`."""
        file = path / cls.FOCAL
        try:
            return number(read_text(file).strip()), str(file)
        except GavoError:
            raise
        except ValueError:
            raise GavoError(f"{file}: expected a focal length in pixels, and nothing else") from None
