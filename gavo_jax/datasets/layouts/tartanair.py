"""Rendered trajectories of TartanAir (Wang et al. 2020), versions 1 and 2."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
from jaxtyping import Float

from gavo_jax.camera import Camera
from gavo_jax.camera_files.calibration import Calibration, load_calibration
from gavo_jax.datasets.assembly import METRES
from gavo_jax.datasets.files import Entry, Reading, size_of_most
from gavo_jax.datasets.layouts.numbered import NumberedFolder, found_among
from gavo_jax.datasets.names import Found
from gavo_jax.datasets.own_camera import own_camera_file
from gavo_jax.datasets.truth import in_order, numbers_in, posed
from gavo_jax.errors import GavoError

FIRST, SECOND = "left", "lcam_front"
"""The camera that is read in each version, as named in its folders and files."""

RATE_OF_SECOND = 10.0
"""Frames per second according to the second version's page; the first version's does not state it."""

SIZES = ((640, 480), (640, 640))
"""Image size of each version."""

FOCAL = 320.0
"""Focal length of both versions, pixels: a horizontal field of view of 90 degrees."""

BODY_T_CAMERA = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From our camera axes to those of the poses: forward, right, down (the world's are north, east, down)."""


class TartanAir(NumberedFolder):
    """A trajectory: `image_left/`, `depth_left/`, `pose_left.txt`, or the same of `lcam_front` in the second version.

    Depth is registered, in metres, as NumPy floats or packed into four-channel images. The sky is 10 km away, so the
    unit cannot be guessed from the depth.
    """

    kind: ClassVar[str] = "TartanAir trajectory"
    DEPTH_SCALE: ClassVar[float] = METRES

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise version 2 by its folders and version 1 by its image names, as its folder names are common."""
        color, depth = (path / f"{kind}_{FIRST}" for kind in ("image", "depth"))
        is_first = any(color.glob(f"*_{FIRST}.*")) and any(depth.glob(f"*_{FIRST}_depth.*"))
        return is_first or _is_second(path)

    @classmethod
    def find(cls, path: Path) -> Found:
        """The images of both kinds, each in its folder."""
        camera = SECOND if _is_second(path) else FIRST
        folders = [path / f"{kind}_{camera}" for kind in ("image", "depth")]
        for folder, other in zip(folders, reversed(folders), strict=True):
            if not folder.is_dir():
                raise GavoError(f"{folder}: no such folder beside {other.name}: download it, too")
        color, depth = folders
        return found_among(color.glob(f"*_{camera}.*"), depth.glob(f"*_{camera}_depth.*"))

    @classmethod
    def calibrate(cls, path: Path, entries: Sequence[Entry], reading: Reading) -> Calibration:
        """The camera file in the folder, else the camera with which images of this size were rendered."""
        if (file := own_camera_file(path)) is not None:
            return load_calibration(file, partial(size_of_most, entries), METRES)
        width, height = size = size_of_most(entries)
        if size not in SIZES:
            known = " or ".join(f"{width}x{height}" for width, height in SIZES)
            raise GavoError(f"{path}: images of {width}x{height}, but it was rendered at {known}: pass --camera")
        camera = Camera(FOCAL, FOCAL, width / 2, height / 2, width, height, depth_scale=METRES)
        return Calibration(camera, origin="the one that TartanAir was rendered with")

    @classmethod
    def stamps(cls, path: Path) -> dict[int, float]:
        """Stamps from the frame numbers at the rate of the second version; empty for the first."""
        return {number: number / RATE_OF_SECOND for number in cls.find(path).color} if _is_second(path) else {}

    @classmethod
    def poses(cls, path: Path) -> dict[int, Float[np.ndarray, "4 4"]]:
        """Poses from rows of tx ty tz qx qy qz qw, one per frame."""
        file, poses = path / f"pose_{SECOND if _is_second(path) else FIRST}.txt", {}
        for number, place, row in in_order(file, cls.find(path).color) if file.exists() else ():
            values = numbers_in(place, row, 7)
            if values is not None and (pose := posed(values)) is not None:
                poses[number] = pose @ BODY_T_CAMERA
        return poses

    @classmethod
    def open(cls, path: Path, reading: Reading) -> Self:
        """Open the folder; its depth unit is known."""
        return super().open(path, replace(reading, depth_scale=reading.depth_scale or METRES))


def _is_second(path: Path) -> bool:
    return any((path / f"{kind}_{SECOND}").is_dir() for kind in ("image", "depth"))
