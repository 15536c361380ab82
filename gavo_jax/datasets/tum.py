"""Sequences in the folder layout of the TUM RGB-D benchmark (Sturm et al. 2012)."""

import math
import os
import struct
import zlib
from collections.abc import Iterator
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, overload

import cv2
import numpy as np
from jaxtyping import Float

from gavo_jax.camera import Camera, camera_for_sequence, load_camera
from gavo_jax.datasets.base import Frame, FrameError
from gavo_jax.errors import GavoError, data_rows
from gavo_jax.trajectory import Trajectory, associate

MAX_DIFFERENCE = 0.02
"""Colour and depth stamps at least this far apart, in seconds, are not of one frame."""

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
GREYSCALE = 0
"""PNG colour type of images with one channel and no palette."""


class TumSequence:
    """A folder with `rgb.txt`, `depth.txt`, the PNG images they list and, where known, `groundtruth.txt`.

    Colour and depth are paired by time (`associate`: greedy, one to one, |Δt| < `max_difference`); frames come in the
    order of their colour stamps and carry them. Lists need not be sorted; of rows with equal stamps the first is kept.
    Images are decoded one by one when asked for, and nothing of them is kept.

    Attributes:
        name: the folder's name, unless given.
        camera: of the frames as they come: without distortion when they are undistorted, else as recorded.
        ground_truth: `groundtruth.txt` as it stands, or None where there is no such file.
    """

    def __init__(
        self,
        folder: str | Path,
        camera: Camera | str | None = "auto",
        color: bool = False,
        undistort: bool = True,
        max_difference: float = MAX_DIFFERENCE,
        name: str | None = None,
    ) -> None:
        """Read the lists and the ground truth; no image yet (see `check`).

        Args:
            folder: holds the lists.
            camera: a camera, what `load_camera` takes, or "auto" (or None): the preset the folder's name speaks of.
            color: whether frames carry RGB beside grey.
            undistort: whether lens distortion is taken out of the frames.
            max_difference: seconds.
            name: overrides the folder's name.

        Raises:
            GavoError: missing folder or list, malformed row (file:line), a path that leaves the folder (through a link,
                too), no pair of stamps near enough, unusable ground truth, unknown camera.
        """
        self.folder = Path(folder)
        try:
            resolved = self.folder.resolve()
            if not resolved.is_dir():
                raise GavoError(f"{self.folder}: no such folder")
        except (OSError, RuntimeError, ValueError) as error:
            raise error if isinstance(error, GavoError) else GavoError(f"{str(folder)!r}: unusable: {error}") from None
        self.name = name or resolved.name
        if camera is None or camera == "auto":
            camera = camera_for_sequence(resolved.name)
        self._recorded = camera if isinstance(camera, Camera) else load_camera(camera)
        self._undistort, self._color = undistort, color
        self.camera = self._recorded.rectified() if undistort else self._recorded
        color_stamps, color_paths = _read_list(resolved, self.folder / "rgb.txt")
        depth_stamps, depth_paths = _read_list(resolved, self.folder / "depth.txt")
        color_index, depth_index = associate(color_stamps, depth_stamps, max_difference)
        if len(color_index) == 0:
            raise GavoError(
                f"{self.folder}: no stamps of rgb.txt and depth.txt within {max_difference:g} s of each other"
            )
        self._timestamps, self._depth_timestamps = color_stamps[color_index], depth_stamps[depth_index]
        self._paths = [(color_paths[i], depth_paths[j]) for i, j in zip(color_index, depth_index, strict=True)]
        truth = self.folder / "groundtruth.txt"
        self.ground_truth = Trajectory.read_tum(truth) if truth.exists() else None

    @property
    def timestamps(self) -> Float[np.ndarray, " frames"]:
        """Colour stamp of each frame, seconds."""
        return self._timestamps

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._paths)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> "TumSequence": ...
    def __getitem__(self, index: int | slice) -> "Frame | TumSequence":
        """Decode frame `index`, or return the sequence of a slice.

        Raises:
            IndexError: no such frame.
            FrameError: one of its two images is missing, torn, or of the wrong size or kind.
        """
        if isinstance(index, slice):
            part = copy(self)
            part._timestamps, part._paths = self._timestamps[index], self._paths[index]
            part._depth_timestamps = self._depth_timestamps[index]
            return part
        color_path, depth_path = self._paths[index]
        timestamp, depth_timestamp = float(self._timestamps[index]), float(self._depth_timestamps[index])
        frame = read_frame(color_path, depth_path, self._recorded, timestamp, self._color, self._undistort)
        return replace(frame, depth_timestamp=depth_timestamp)

    def __iter__(self) -> Iterator[Frame]:
        """Decode frame after frame; raises `FrameError` at one that cannot be read."""
        return (self[index] for index in range(len(self)))

    def check(self) -> None:
        """Refuse what can be known before a run: a missing image among these frames, an unusable first frame.

        Raises:
            GavoError: names the image and the fault.
        """
        if len(self) == 0:
            raise GavoError(f"{self.folder}: no frames in the chosen range")
        for paths in self._paths:
            for path in paths:
                if not os.path.isfile(path):
                    raise GavoError(f"{path}: listed image is missing")
        self[0]


def read_frame(
    color_path: str | Path,
    depth_path: str | Path,
    camera: Camera,
    timestamp: float = 0.0,
    color: bool = False,
    undistort: bool = True,
) -> Frame:
    """Read one RGB-D frame from two PNG files: 8-bit colour (or grey) and 16-bit single-channel depth.

    Args:
        color_path: the colour image.
        depth_path: the depth image, registered to it.
        camera: as recorded; both images must have its size.
        timestamp: seconds.
        color: whether the frame carries RGB beside grey. Grey is the same either way.
        undistort: whether the camera's distortion is taken out; the frame is then of `camera.rectified()`.

    Raises:
        FrameError: an image is missing, torn, or of the wrong size or kind; the message names it.
    """
    bgr = _decode(Path(color_path), camera, depth=False)
    depth = _decode(Path(depth_path), camera, depth=True)
    grey = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)
    rgb = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB) if color else None
    if undistort:
        grey, depth = camera.undistort(grey, depth)
        rgb = None if rgb is None else camera.undistort_image(rgb)
    return Frame(grey=grey, depth=depth, timestamp=timestamp, color=rgb)


class _PngHeader(NamedTuple):
    width: int
    height: int
    bits: int
    color_type: int


def _read_list(root: Path, path: Path) -> tuple[np.ndarray, list[Path]]:
    """Read `timestamp path` rows: stamps in increasing order, [n], and the images' paths, which stay below `root`."""
    images: dict[float, Path] = {}
    for place, fields in data_rows(path):
        if len(fields) != 2:
            raise GavoError(f"{place}: expected `timestamp path`, found {len(fields)} fields")
        try:
            stamp = float(fields[0])
        except ValueError:
            stamp = math.nan
        if not math.isfinite(stamp):
            raise GavoError(f"{place}: not a time stamp: {fields[0][:60]!r}")
        try:
            image = (root / fields[1]).resolve()
        except (OSError, RuntimeError, ValueError):
            raise GavoError(f"{place}: not a usable path: {fields[1][:60]!r}") from None
        if not image.is_relative_to(root):
            raise GavoError(f"{place}: path leaves the sequence's folder: {fields[1][:200]!r}")
        images.setdefault(stamp, path.parent / fields[1])
    if not images:
        raise GavoError(f"{path}: lists no images")
    stamps = sorted(images)
    return np.array(stamps), [images[stamp] for stamp in stamps]


def _decode(path: Path, camera: Camera, depth: bool) -> np.ndarray:
    """Return depth as uint16 [height, width] or colour as uint8 BGR [height, width, 3] of a file that is whole."""
    data = _read_bytes(path, limit=2**20 + 16 * camera.width * camera.height)
    header = _png_header(path, data)
    if (header.width, header.height) != (camera.width, camera.height):
        size = f"{header.width}x{header.height}"
        raise FrameError(f"{path}: is {size} pixels, the camera's images are {camera.width}x{camera.height}")
    if depth and (header.bits, header.color_type) != (16, GREYSCALE):
        raise FrameError(f"{path}: not a depth image: expected one channel of 16 bits")
    if not depth and header.bits > 8:
        raise FrameError(f"{path}: not a colour image of 8 bits but of {header.bits}")
    flags = cv2.IMREAD_UNCHANGED if depth else cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    shape = (camera.height, camera.width) if depth else (camera.height, camera.width, 3)
    if image is None or image.shape != shape or image.dtype != (np.uint16 if depth else np.uint8):
        raise FrameError(f"{path}: cannot be decoded")
    return image


def _read_bytes(path: Path, limit: int) -> bytes:
    try:
        if path.exists() and not path.is_file():
            raise FrameError(f"{path}: not a file")
        if path.stat().st_size > limit:
            raise FrameError(f"{path}: too large for an image of this camera")
        return path.read_bytes()
    except FileNotFoundError:
        raise FrameError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        if isinstance(error, FrameError):
            raise
        raise FrameError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


def _png_header(path: Path, data: bytes) -> _PngHeader:
    """Return the header of a PNG whose chunks are all whole (OpenCV decodes a torn one in part, silently)."""
    if not data.startswith(PNG_SIGNATURE):
        raise FrameError(f"{path}: not a PNG image")
    header, at = None, len(PNG_SIGNATURE)
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(memoryview(data)[at + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise FrameError(f"{path}: damaged PNG image (checksum)")
        if header is None:
            if kind != b"IHDR" or length != 13:
                break
            header = _PngHeader(*struct.unpack_from(">IIBB", data, at + 8))
        if kind == b"IEND":
            return header
        at = end + 4
    raise FrameError(f"{path}: torn PNG image (no end)")
