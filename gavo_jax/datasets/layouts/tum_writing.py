"""Writing of a sequence as a folder in the layout of the TUM RGB-D benchmark."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import cv2
import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame, Sequence, require_sequence
from gavo_jax.datasets.layouts.tum import MAX_DIFFERENCE
from gavo_jax.datasets.rendered.bodies_truth import MASKS, WithBodies, write_mask, write_truth
from gavo_jax.errors import GavoError, as_path
from gavo_jax.trajectory import associate

WRITTEN = ("camera", "__iter__", "name", "ground_truth")
"""Members of `Sequence` that are needed to write it."""


def write_tum(sequence: Sequence, folder: str | Path) -> None:
    """Write a sequence as a folder in TUM layout that reads back identically, with its camera as `camera.toml`.

    Colour images are 8-bit RGB (three equal channels where frames have no colour), depth is 16-bit in the camera's raw
    units. The ground truth of moving bodies, if any, goes to `bodies_truth.csv` and `masks/`. The lists are written
    last, so that an incomplete folder is not taken for a sequence.

    Raises:
        GavoError: it is no sequence, the folder already holds one, a file cannot be written, or images are not 8-bit
            grey and 16-bit depth; or a reader would pair other images, as stamps do not increase, or depth is late.
        FrameError: a frame of the sequence cannot be read.
    """
    require_sequence(sequence, WRITTEN)
    folder = as_path(folder)
    if (folder / "rgb.txt").exists():
        raise GavoError(f"{folder}: already contains a sequence (rgb.txt)")
    try:
        for part in ("rgb", "depth"):
            (folder / part).mkdir(parents=True, exist_ok=True)
        bodies = getattr(sequence, "bodies_truth", ())
        if bodies:
            (folder / MASKS).mkdir(exist_ok=True)
        stamps, depth_stamps, rows = [], [], []
        for index, frame in enumerate(sequence):
            stamp, depth_stamp = _write_frame(frame, folder)
            stamps.append(stamp)
            depth_stamps.append(depth_stamp)
            if bodies:
                rows += write_mask(cast("WithBodies", sequence), index, frame.timestamp, stamp, folder)
        _require_pairs(stamps, depth_stamps, folder)
        (folder / "camera.toml").write_text(_camera_toml(sequence.camera), encoding="utf-8")
        if sequence.ground_truth is not None:
            sequence.ground_truth.write_tum(folder / "groundtruth.txt")
        if bodies:
            write_truth(rows, folder)
        for part, own in (("depth", depth_stamps), ("rgb", stamps)):
            lines = [f"# {part} images of {sequence.name}: timestamp filename", *(f"{s} {part}/{s}.png" for s in own)]
            (folder / f"{part}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise GavoError(f"{folder}: cannot be written: {error.strerror or error}") from None


def _require_pairs(stamps: list[str], depth_stamps: list[str], folder: Path) -> None:
    """Refuse stamps by which colour and depth would not be read as the pairs that they are.

    Raises:
        GavoError: names the first pair.
    """
    color, depth = np.array(stamps, float), np.array(depth_stamps, float)
    of_color, of_depth = associate(color, depth, MAX_DIFFERENCE)
    is_read = np.isin(np.arange(len(color)), of_color[of_color == of_depth])
    is_read[1:] &= (np.diff(color) > 0) & (np.diff(depth) > 0)
    if not is_read.all():
        index = int(np.argmin(is_read))
        own = f"frame {index}, stamps {stamps[index]} and {depth_stamps[index]}"
        raise GavoError(f"{folder}: {own}: TUM's layout pairs images by increasing stamps, and would lose this pair")


def _write_frame(frame: Frame, folder: Path) -> tuple[str, str]:
    """Write both images, and return their stamps as formatted for the lists."""
    for name, pixels, dtype in (("grey", frame.grey, np.uint8), ("depth", frame.depth, np.uint16)):
        if pixels.dtype != dtype:
            raise GavoError(f"{folder}: {name} of {pixels.dtype} cannot be stored exactly in PNG: round it first")
    delayed = frame.timestamp if frame.depth_timestamp is None else frame.depth_timestamp
    stamp, depth_stamp = (
        np.format_float_positional(seconds, unique=True, min_digits=6) for seconds in (frame.timestamp, delayed)
    )
    if frame.color is None:
        image = cv2.cvtColor(frame.grey, cv2.COLOR_GRAY2BGR)
    else:
        image = cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR)
    _write_png(folder / "rgb" / f"{stamp}.png", image)
    _write_png(folder / "depth" / f"{depth_stamp}.png", frame.depth)
    return stamp, depth_stamp


def _write_png(path: Path, image: np.ndarray) -> None:
    """Write an image (BGR or one channel); raises OSError."""
    path.write_bytes(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes())


def _camera_toml(camera: Camera) -> str:
    lines = [f"{key} = {float(getattr(camera, key))!r}" for key in ("fx", "fy", "cx", "cy")]
    lines += [f"{key} = {int(getattr(camera, key))}" for key in ("width", "height")]
    lines += [f"distortion = {[float(k) for k in camera.distortion]}", f"depth_scale = {float(camera.depth_scale)!r}"]
    if camera.vignetting:
        lines.append(f"vignetting = {[float(k) for k in camera.vignetting]}")
    lines += [f"readout = {float(camera.readout)!r}", f'model = "{camera.model}"']
    return "\n".join(lines) + "\n"
