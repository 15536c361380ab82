"""The interface of every source of frames: `Frame` and the `Sequence` protocol."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol, overload

import numpy as np
from jax.core import Tracer
from jaxtyping import Float, UInt8

from gavo_jax.camera import Camera
from gavo_jax.camera_check import require_camera
from gavo_jax.camera_files.calibration import MOST_DELAY
from gavo_jax.errors import GavoError, as_number
from gavo_jax.number_types import Depth, is_real
from gavo_jax.trajectory import Trajectory


class FrameError(GavoError):
    """A single frame cannot be read; the rest of the sequence may be fine."""


TRACED = "gavo_jax needs concrete numbers on the host: call it outside jax.jit, jax.vmap and jax.grad"


def require_image(name: str, image: Any, size: tuple[int, ...]) -> None:
    """Refuse anything but an image of real numbers of the given size.

    Raises:
        FrameError: It is of another shape, holds something else, or is being traced.
    """
    if isinstance(image, Tracer):
        raise FrameError(TRACED)
    kind = image.dtype if hasattr(image, "dtype") else np.asarray(image).dtype
    if np.shape(image) != size or not is_real(kind):
        helps = "; frame_of makes a Frame from a colour image" if name == "grey" and np.ndim(image) == 3 else ""
        fault = f"{name} image is {kind} of shape {np.shape(image)}: expected numbers of shape {size}"
        raise FrameError(fault + helps)


BRIGHTEST = 400.0
"""Highest grey level that sharpening and cubic interpolation can reach; images of ten bits or more exceed it."""


def require_grey_levels(grey: Any) -> None:
    """Refuse grey images whose levels don't span 0 to 255 but 0 to 1, far more than 255, or far below 0.

    Raises:
        FrameError: They are floats, none above 1, and not all black; or some are above `BRIGHTEST`; or the least is
            below 0 by more than half of the greatest, which sharpening does not cause.
    """
    values = np.asarray(grey)
    if values.dtype == np.uint8:
        return
    values = values[np.isfinite(values)]
    if not values.size:
        return
    least, most = float(np.min(values)), float(np.max(values))
    if least < 0.0 and -least > 0.5 * most:
        raise FrameError(f"grey levels must range from 0 to 255, not from {least:g}: add what was subtracted")
    if not np.issubdtype(values.dtype, np.integer) and 0.0 < most <= 1.0:
        raise FrameError("grey levels must range from 0 to 255, not from 0 to 1: multiply by 255")
    if most > BRIGHTEST:
        raise FrameError(f"grey levels must range from 0 to 255, not to {most:g}: scale the image")


def as_seconds(name: str, stamp: Any) -> float:
    """Copy a time in seconds to a plain number, since an array may be overwritten later.

    Raises:
        GavoError: It is not a single number but, say, text or a date.
    """
    return as_number(name, stamp, "expected seconds as a number")


def index_at(timestamps: Float[np.ndarray, " n"], stamp: float) -> int:
    """Index of the frame whose colour stamp is nearest to `stamp`; the stamps need not increase."""
    return int(np.argmin(np.abs(timestamps - stamp)))


YEAR = 365.25 * 86400
"""Length of a year, seconds."""
LATEST = 1e11
"""Largest stamp of any clock, seconds; milliseconds since 1970 exceed it."""


def require_begin_in_seconds(stamp: float) -> None:
    """Refuse the first stamp of a stream if it counts milliseconds, microseconds or nanoseconds since 1970.

    Raises:
        FrameError: It exceeds `LATEST`: as seconds it would be thousands of years.
    """
    if LATEST < abs(stamp) < np.inf:
        raise FrameError(f"timestamp: expected seconds, but {stamp:.0f} of them are {stamp / YEAR:.0f} years")


class TimestampError(FrameError):
    """The timestamp of a frame is in doubt."""


SAME_STAMP = 1e-6
"""Largest change of a stamp by writing it to a file, seconds."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One RGB-D image. Arrays may have any number type; `Odometry.warm_up` compiles for 8-bit grey and 16-bit depth.

    Attributes:
        grey: intensities, 0 to 255.
        depth: raw depth along z, registered to `grey`; metres = depth / camera.depth_scale. 0, and 65535 in 16-bit
            images, is no reading.
        timestamp: stamp of the colour image, seconds.
        color: RGB, if the sequence was asked for it.
        depth_timestamp: stamp of the depth image, seconds, if known: the two are not exposed together.

    Raises:
        GavoError: A stamp is not a number.
    """

    grey: UInt8[np.ndarray, "height width"]
    depth: Depth
    timestamp: float
    color: UInt8[np.ndarray, "height width 3"] | None = None
    depth_timestamp: float | None = None

    def __post_init__(self):
        for name in ("timestamp", "depth_timestamp"):
            if (stamp := getattr(self, name)) is not None or name == "timestamp":
                object.__setattr__(self, name, as_seconds(name, stamp))

    @property
    def depth_delay(self) -> float:
        """Seconds from the colour image to the depth image; 0 if unknown, or beyond `MOST_DELAY`: of another clock."""
        delay = 0.0 if self.depth_timestamp is None else self.depth_timestamp - self.timestamp
        return delay if abs(delay) <= MOST_DELAY + SAME_STAMP else 0.0

    def copied(self) -> "Frame":
        """The frame in arrays of its own, for who keeps it: a source may decode the next one into the same arrays."""
        color = None if self.color is None else np.array(self.color)
        return replace(self, grey=np.array(self.grey), depth=np.array(self.depth), color=color)

    def at(self, timestamp: float) -> "Frame":
        """The same images with another stamp; depth keeps its delay, unless beyond `MOST_DELAY`.

        Where the stamps differ by less than `SAME_STAMP`, depth keeps its stamp, as several frames may share one depth
        image.
        """
        if timestamp == self.timestamp:
            return self
        depth = self.depth_timestamp
        if depth is not None and not abs(timestamp - self.timestamp) < SAME_STAMP:
            depth = timestamp + self.depth_delay
        return replace(self, timestamp=timestamp, depth_timestamp=depth)


TRACKED = ("camera", "timestamps", "__len__", "__getitem__")
"""Members of `Sequence` that tracking needs."""
RUN = (*TRACKED, "name", "ground_truth", "check")
"""Members of `Sequence` that a run needs."""


def require_sequence(sequence: Any, needed: tuple[str, ...] = TRACKED) -> None:
    """Refuse anything but a sequence (a list of frames, a generator, a path), and a custom one that is incomplete.

    Raises:
        GavoError: It lacks a needed member of `Sequence`.
    """
    kind = type(sequence).__name__
    lacking = [name for name in needed if not hasattr(sequence, name)]
    if isinstance(sequence, type) or "camera" in lacking:
        fault = f"expected a Sequence, got {kind}"
        raise GavoError(fault + ": use gavo.open_source(path), or Odometry.register frame by frame")
    if lacking:
        raise GavoError(f"{kind} is not a Sequence: it has no {', '.join(lacking)}")


class Sequence(Protocol):
    """Frames in the order of their stamps, read one at a time.

    `sequence[i]` decodes frame i (negative i counts from the end). It raises IndexError if i is out of range, and
    `FrameError` if that frame cannot be read. `sequence[start:stop:stride]` is again a sequence, with the same name,
    camera and ground truth. Iteration goes through `[i]`.
    """

    @property
    def name(self) -> str:
        """Short name for tables and folders."""
        ...

    @property
    def camera(self) -> Camera:
        """The camera of the returned frames: without distortion if the sequence undistorts them."""
        ...

    @property
    def ground_truth(self) -> Trajectory | None:
        """The true trajectory with its own stamps (not one pose per frame), or None."""
        ...

    @property
    def timestamps(self) -> Float[np.ndarray, " frames"]:
        """Stamp of each frame, seconds."""
        ...

    def __len__(self) -> int:
        """Return the number of frames."""
        ...

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> "Sequence": ...

    def __iter__(self) -> Iterator[Frame]:
        """Decode frame after frame."""
        ...

    def check(self) -> None:
        """Refuse, before a run, a sequence that is faulty as a whole.

        Raises:
            GavoError: names the file and the fault.
        """
        ...


def require_parts(sequence: Sequence) -> None:
    """Refuse a custom sequence whose camera, stamps or ground truth have the wrong type or shape.

    Raises:
        GavoError: names the part.
    """
    kind, truth = type(sequence).__name__, sequence.ground_truth
    require_camera(sequence.camera)
    if np.shape(sequence.timestamps) != (len(sequence),):
        shape = np.shape(sequence.timestamps)
        raise GavoError(f"{kind}: timestamps: expected one for each of {len(sequence)} frames, got shape {shape}")
    if (held := np.asarray(sequence.timestamps).dtype).kind not in "iuf":
        raise GavoError(f"{kind}: timestamps: expected seconds, got {held}")
    if not isinstance(truth, Trajectory | None):
        raise GavoError(f"{kind}: ground_truth: expected a Trajectory or None, got {type(truth).__name__}")
