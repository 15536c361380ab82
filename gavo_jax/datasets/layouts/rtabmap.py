"""Exports of RTAB-Map: the images of a map's nodes, by `rtabmap-export` or its database viewer."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import ClassVar

from gavo_jax.camera_files.calibration import Calibration, load_calibration
from gavo_jax.datasets.assembly import MILLIMETRES
from gavo_jax.datasets.files import Entry, Reading, size_of_most
from gavo_jax.datasets.layouts.image_folders import plain_files
from gavo_jax.datasets.layouts.numbered import of_each_frame
from gavo_jax.datasets.layouts.plain_folder import PlainFolder
from gavo_jax.datasets.own_camera import own_camera_file
from gavo_jax.errors import GavoError


class RtabMap(PlainFolder):
    """Images in `rgb/` and `depth/`, cameras in `calib/` or `calib.yaml`; each may be prefixed by the map's name.

    Depth is registered, in millimetres. Names are stamps or node ids. Images are rectified, so the distortion in camera
    files is ignored, as RTAB-Map itself does.
    """

    kind: ClassVar[str] = "export of RTAB-Map"
    depth_is_of_view: ClassVar[bool] = True
    scale_is_open: ClassVar[bool] = False
    ESTIMATES: ClassVar[str] = "*poses*.txt"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a folder by the camera files beside the images."""
        return bool(_cameras(path)) and super().recognises(path)

    @classmethod
    def calibrate(cls, path: Path, entries: Sequence[Entry], reading: Reading) -> Calibration:
        """The camera file in the folder, else the common camera of the images."""
        if own_camera_file(path) is not None:
            return super().calibrate(path, entries, reading)
        files = _cameras(path)
        second = files[0].with_name(f"{entries[0].color.stem}_1.yaml")
        if second in files:
            how = "cut them apart, and pass --camera"
            raise GavoError(f"{second}: belongs to a second camera, whose images are joined to the first one's: {how}")
        load = partial(
            load_calibration, size=partial(size_of_most, entries), depth_scale=MILLIMETRES, is_rectified=True
        )
        return load(files[0]) if files[0].parent == path else of_each_frame(files[0].parent, files, load)


def _cameras(path: Path) -> list[Path]:
    """The camera files: in a folder named like that of colour, with `calib` for `rgb`, else a single file named so."""
    color, _ = plain_files(path)
    if not color or color[0].parent == path or "rgb" not in color[0].parent.name:
        return []
    folder = color[0].parent.with_name(color[0].parent.name.replace("rgb", "calib"))
    alone = folder.with_name(f"{folder.name}.yaml")
    return sorted(folder.glob("*.yaml")) or [alone] * alone.is_file()
