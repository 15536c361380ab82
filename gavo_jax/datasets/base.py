"""What every source of frames offers: `Frame` and the `Sequence` protocol."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol, overload

import numpy as np
from jax.core import Tracer
from jaxtyping import Float, UInt8

from gavo_jax.camera import Camera, require_camera
from gavo_jax.errors import GavoError, as_number
from gavo_jax.image.numbers import Depth, is_real
from gavo_jax.trajectory import Trajectory


class FrameError(GavoError):
    """A single frame that cannot be read: a fault of that frame, not of the whole sequence."""


TRACED = "gavo_jax looks at its numbers on the host: call it outside jax.jit, jax.vmap and jax.grad"


def require_image(name: str, image: Any, size: tuple[int, ...]) -> None:
    """Refuse what is no image of real numbers of a size.

    Raises:
        FrameError: It is of another shape, holds something else, or is being traced.
    """
    if isinstance(image, Tracer):
        raise FrameError(TRACED)
    kind = image.dtype if hasattr(image, "dtype") else np.asarray(image).dtype
    if np.shape(image) != size or not is_real(kind):
        helps = "; frame_of makes a Frame of a colour image" if name == "grey" and np.ndim(image) == 3 else ""
        fault = f"{name} image is {kind} of shape {np.shape(image)}: numbers of shape {size} are needed"
        raise FrameError(fault + helps)


BRIGHTEST = 400.0
"""Grey levels: sharpening and cubic interpolation reach no further; images of ten bits and more do."""


def require_grey_levels(grey: Any) -> None:
    """Refuse grey images whose levels reach to 1, far beyond 255, or as far below 0 as above.

    Raises:
        FrameError: They are floats, none above 1, and not all black; or some are above `BRIGHTEST`; or the least is
            below 0 by more than half of the greatest, which sharpening does not do.
    """
    values = np.asarray(grey)
    if values.dtype == np.uint8:
        return
    values = values[np.isfinite(values)]
    if not values.size:
        return
    least, most = float(np.min(values)), float(np.max(values))
    if least < 0.0 and -least > 0.5 * most:
        raise FrameError(f"grey levels reach from 0 to 255, not from {least:g}: add what was taken from them")
    if not np.issubdtype(values.dtype, np.integer) and 0.0 < most <= 1.0:
        raise FrameError("grey levels reach from 0 to 255, not from 0 to 1: multiply by 255")
    if most > BRIGHTEST:
        raise FrameError(f"grey levels reach from 0 to 255, not to {most:g}: scale the image")


def as_seconds(name: str, stamp: Any) -> float:
    """A time in seconds as a number of its own: an array may hold the next one soon.

    Raises:
        GavoError: It is no single number, but text, a date.
    """
    return as_number(name, stamp, "seconds are needed, a number")


def index_at(timestamps: Float[np.ndarray, " n"], stamp: float) -> int:
    """The frame whose colour stamp is nearest to one; the stamps need not rise."""
    return int(np.argmin(np.abs(timestamps - stamp)))


YEAR = 365.25 * 86400
"""Seconds."""
LATEST = 1e11
"""Seconds: no clock shows more, and milliseconds since 1970 are more."""


def require_begin_in_seconds(stamp: float) -> None:
    """Refuse the first stamp of a stream where it counts milliseconds, microseconds or nanoseconds since 1970.

    Raises:
        FrameError: It is, in seconds, thousands of years from now.
    """
    if LATEST < abs(stamp) < np.inf:
        raise FrameError(f"timestamp: seconds are needed, and {stamp:.0f} of them are {stamp / YEAR:.0f} years")


class TimestampError(FrameError):
    """A frame whose time is in doubt."""


SAME_STAMP = 1e-6
"""Seconds by which a stamp changes as it is written."""
MOST_DELAY = 0.1
"""Seconds: depth that is further from its colour image has a stamp that tells nothing."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One RGB-D image, its arrays of any numbers: bytes and 16 bits are those that `Odometry.warm_up` compiles for.

    Attributes:
        grey: intensities, 0 to 255.
        depth: raw depth along z, registered to `grey`; metres = depth / camera.depth_scale. 0, and of 16 bits 65535,
            is no reading.
        timestamp: of the colour image, seconds.
        color: RGB, where the sequence was asked for it.
        depth_timestamp: of the depth image, seconds, where it is known: the two are not exposed together.

    Raises:
        GavoError: A stamp is no number.
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
        """Seconds from the colour image to the depth image; 0 where that is not known, or beyond `MOST_DELAY`."""
        delay = 0.0 if self.depth_timestamp is None else self.depth_timestamp - self.timestamp
        return delay if abs(delay) <= MOST_DELAY else 0.0

    def at(self, timestamp: float) -> "Frame":
        """The same images with another stamp, depth as long after it as before. Where only the last digits of the stamp
        differ depth keeps its own, as several frames may share one depth image.
        """
        if timestamp == self.timestamp:
            return self
        depth = self.depth_timestamp
        if depth is not None and not abs(timestamp - self.timestamp) < SAME_STAMP:
            depth = timestamp + self.depth_delay
        return replace(self, timestamp=timestamp, depth_timestamp=depth)


TRACKED = ("camera", "timestamps", "__len__", "__getitem__")
"""What tracking needs of a `Sequence`."""
RUN = (*TRACKED, "name", "ground_truth", "check")
"""What a run needs."""


def require_sequence(sequence: Any, needed: tuple[str, ...] = TRACKED) -> None:
    """Refuse what is no sequence (a list of frames, a generator, a path), and one of somebody's own that lacks a part.

    Raises:
        GavoError: It lacks what is needed of a `Sequence`.
    """
    kind = type(sequence).__name__
    lacking = [name for name in needed if not hasattr(sequence, name)]
    if isinstance(sequence, type) or "camera" in lacking:
        fault = f"a Sequence is needed, not {kind}"
        raise GavoError(fault + ": gavo.open_source(path), or Odometry.register frame by frame")
    if lacking:
        raise GavoError(f"{kind} is no Sequence: it has no {', '.join(lacking)}")


class Sequence(Protocol):
    """Frames in the order of their stamps, read one at a time.

    `sequence[i]` decodes frame i (negative i counts from the end) and raises IndexError outside and `FrameError`
    where that frame cannot be read; `sequence[start:stop:stride]` is a sequence again, with the same name, camera and
    ground truth. Iteration goes through `[i]`.
    """

    @property
    def name(self) -> str:
        """Short name for tables and folders."""
        ...

    @property
    def camera(self) -> Camera:
        """The camera of the frames as they come: without distortion where the sequence undistorts them."""
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
        """Refuse, before a run, what is wrong with the sequence as a whole.

        Raises:
            GavoError: names the file and the fault.
        """
        ...


def require_parts(sequence: Sequence) -> None:
    """Refuse a sequence of somebody's own whose camera, stamps or ground truth are of another kind.

    Raises:
        GavoError: names the part.
    """
    kind, truth = type(sequence).__name__, sequence.ground_truth
    require_camera(sequence.camera)
    if np.shape(sequence.timestamps) != (len(sequence),):
        shape = np.shape(sequence.timestamps)
        raise GavoError(f"{kind}: timestamps: one for each of {len(sequence)} frames is needed, not shape {shape}")
    if not isinstance(truth, Trajectory | None):
        raise GavoError(f"{kind}: ground_truth: a Trajectory or None is needed, not {type(truth).__name__}")
