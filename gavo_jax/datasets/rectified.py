"""Frames and sequences prepared for tracking: plain arrays without lens distortion."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, overload

import numpy as np
from jaxtyping import Float

from gavo_jax.camera import Camera
from gavo_jax.datasets.bars import without_bars
from gavo_jax.datasets.base import Frame, Sequence, require_image
from gavo_jax.errors import GavoError
from gavo_jax.number_types import as_array, as_depth
from gavo_jax.trajectory import Trajectory


def rectified(frame: Frame, camera: Camera) -> Frame:
    """A frame of plain arrays, without lens distortion and black bars.

    Raises:
        FrameError: An image is not of the camera's size, or not one number per pixel.
        GavoError: `frame` is no Frame.
    """
    if not isinstance(frame, Frame):
        raise GavoError(f"expected a Frame, got {type(frame).__name__}: use gavo.Frame(grey, depth, timestamp)")
    for name, image in (("grey", frame.grey), ("depth", frame.depth)):
        require_image(name, image, (camera.height, camera.width))
    grey, depth = camera.undistort(*without_bars(as_array(frame.grey), as_depth(frame.depth)))
    color = None if frame.color is None else camera.undistort_image(frame.color)
    return replace(frame, grey=grey, depth=depth, color=color)


def rectified_at(sequence: Sequence, index: int) -> Frame:
    """A frame of a sequence, `rectified`, at the sequence's stamp.

    Raises:
        FrameError: It cannot be read, or `rectified` refuses it.
    """
    return rectified(sequence[index], sequence.camera.rectified()).at(float(sequence.timestamps[index]))


def without_distortion(sequence: Sequence) -> Sequence:
    """Wrap a sequence so that its frames have no lens distortion or vignetting; without any it is returned as it is."""
    return Rectified(sequence) if not sequence.camera.is_rectified else sequence


class Rectified:
    """A sequence with lens distortion removed from its frames; everything else is passed through."""

    def __init__(self, recorded: Sequence) -> None:
        self._recorded = recorded

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # looked up by `copy` before __init__
            raise AttributeError(name)
        return getattr(self._recorded, name)

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self._recorded.name

    @property
    def camera(self) -> Camera:
        """Camera of the recording without distortion."""
        return self._recorded.camera.rectified()

    @property
    def ground_truth(self) -> Trajectory | None:
        """Ground truth of the recording."""
        return self._recorded.ground_truth

    @property
    def timestamps(self) -> Float[np.ndarray, " frames"]:
        """Stamps of the recording, seconds."""
        return self._recorded.timestamps

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._recorded)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> "Rectified": ...
    def __getitem__(self, index: int | slice) -> "Frame | Rectified":
        """Decode a frame and undistort it, or return the sequence of a slice."""
        if isinstance(index, slice):
            return Rectified(self._recorded[index])
        return rectified(self._recorded[index], self._recorded.camera)

    def __iter__(self) -> Iterator[Frame]:
        """Decode and undistort frame after frame."""
        return (self[index] for index in range(len(self)))

    def check(self) -> None:
        """Check the recording."""
        self._recorded.check()
