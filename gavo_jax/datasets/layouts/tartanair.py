"""Trajectories of TartanAir (Wang et al. 2020), rendered, of its first and its second version."""

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
from gavo_jax.datasets.files import Entry, Reading, own_camera_file, size_of_most
from gavo_jax.datasets.layouts.numbered import NumberedFolder, found_among
from gavo_jax.datasets.names import Found
from gavo_jax.datasets.truth import in_order, numbers_in, posed
from gavo_jax.errors import GavoError

FIRST, SECOND = "left", "lcam_front"
"""The camera that is read of either version, as its folders and files are named."""

RATE_OF_SECOND = 10.0
"""Frames per second, as the second version's page has it; that of the first does not say it."""

SIZES = ((640, 480), (640, 640))
"""Of the images of either version."""

FOCAL = 320.0
"""Pixels, of both: a view of 90 degrees across."""

BODY_T_CAMERA = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""The poses' axes are north, east and down of the world and forward, right and down of the camera."""


class TartanAir(NumberedFolder):
    """A trajectory: `image_left/`, `depth_left/`, `pose_left.txt`, or the same of `lcam_front` in the second version.

    Depth is registered, in metres: floats of NumPy, or packed into images of four channels. The sky is 10 km away, so
    that what depth looks like tells nothing of its unit.
    """

    kind: ClassVar[str] = "TartanAir trajectory"
    DEPTH_SCALE: ClassVar[float] = METRES

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise the second version by its folders, the first one by its images' names: others have such folders."""
        color, depth = (path / f"{kind}_{FIRST}" for kind in ("image", "depth"))
        is_first = any(color.glob(f"*_{FIRST}.*")) and any(depth.glob(f"*_{FIRST}_depth.*"))
        return is_first or _is_second(path)

    @classmethod
    def find(cls, path: Path) -> Found:
        """Each kind has a folder."""
        camera = SECOND if _is_second(path) else FIRST
        folders = [path / f"{kind}_{camera}" for kind in ("image", "depth")]
        for folder, other in zip(folders, reversed(folders), strict=True):
            if not folder.is_dir():
                raise GavoError(f"{folder}: no such folder beside {other.name}: download it, too")
        color, depth = folders
        return found_among(color.glob(f"*_{camera}.*"), depth.glob(f"*_{camera}_depth.*"))

    @classmethod
    def calibrate(cls, path: Path, entries: Sequence[Entry], reading: Reading) -> Calibration:
        """A camera file in the folder, else the camera that the images of this size were rendered with."""
        if (file := own_camera_file(path)) is not None:
            return load_calibration(file, partial(size_of_most, entries), METRES)
        width, height = size = size_of_most(entries)
        if size not in SIZES:
            known = " or ".join(f"{width}x{height}" for width, height in SIZES)
            raise GavoError(f"{path}: images of {width}x{height}, and it was rendered at {known}: say --camera")
        camera = Camera(FOCAL, FOCAL, width / 2, height / 2, width, height, depth_scale=METRES)
        return Calibration(camera, origin="the one that TartanAir was rendered with")

    @classmethod
    def stamps(cls, path: Path) -> dict[int, float]:
        """Count by the rate of the second version."""
        return {number: number / RATE_OF_SECOND for number in cls.find(path).color} if _is_second(path) else {}

    @classmethod
    def poses(cls, path: Path) -> dict[int, Float[np.ndarray, "4 4"]]:
        """A row of tx ty tz qx qy qz qw for each frame."""
        file, poses = path / f"pose_{SECOND if _is_second(path) else FIRST}.txt", {}
        for number, place, row in in_order(file, cls.find(path).color) if file.exists() else ():
            values = numbers_in(place, row, 7)
            if values is not None and (pose := posed(values)) is not None:
                poses[number] = pose @ BODY_T_CAMERA
        return poses

    @classmethod
    def open(cls, path: Path, reading: Reading) -> Self:
        """Find the files and read poses; the unit of depth is known."""
        return super().open(path, replace(reading, depth_scale=reading.depth_scale or METRES))


def _is_second(path: Path) -> bool:
    return any((path / f"{kind}_{SECOND}").is_dir() for kind in ("image", "depth"))
