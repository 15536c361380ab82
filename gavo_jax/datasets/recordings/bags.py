"""Sequences from recordings of ROS 1 and ROS 2 (SQLite, MCAP), which are read as a stream."""

import contextlib
import threading
from collections.abc import Iterator
from copy import copy
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar, Self, overload

import numpy as np
from jaxtyping import Float

from gavo_jax.camera import Camera
from gavo_jax.camera_files.calibration import Calibration, Size
from gavo_jax.datasets.assembly import MILLIMETRES, DepthImage, DepthUnit, FrameAssembler, common_white, float_unit
from gavo_jax.datasets.base import Frame, FrameError
from gavo_jax.datasets.depth_unit import KINECTS, better_scale, sample_depth
from gavo_jax.datasets.files import Reading, places_of_a_few
from gavo_jax.datasets.recordings.messages import color_of, depth_of
from gavo_jax.datasets.recordings.recording import METADATA, SENSOR, SUFFIXES, Bag, legible
from gavo_jax.datasets.recordings.stamps import Topic, in_one_time, of_one_run, once
from gavo_jax.datasets.recordings.topics import says_rectified
from gavo_jax.errors import GavoError
from gavo_jax.trajectory import Trajectory, associate

FAR_AHEAD = 64
"""Most messages that are skipped on the way to a frame; for one further ahead the reader seeks by time."""

NOWHERE: tuple[int, int] = (2**62, 2**62)
"""Position of a stream before it is opened: after every message."""


class BagSequence:
    """Frames of a recording: a colour topic and a depth topic, paired by the stamps of their message headers.

    Messages are read in sequence and not cached; a frame out of order is sought by its time.

    Attributes:
        name: name of the file or folder.
        calibration: the cameras as they record.
        ground_truth: None, as recordings hold none.
        left_out: messages that are not used, and why, one line per reason.
        kind: name of the kind of source.
    """

    kind: ClassVar[str] = "ROS bag"

    def __init__(self, path: Path, reading: Reading) -> None:
        """Read the stamps of both topics, and the camera.

        Raises:
            GavoError: no bag or a damaged one, no colour or depth topic or an ambiguous choice, no camera, no frames.
        """
        self._bag = Bag(path)
        self.name = path.resolve().name if path.is_dir() else path.resolve().stem
        self.ground_truth: Trajectory | None = None
        color, depth = self._bag.choose(reading)
        topics = of_one_run(*in_one_time(self._bag.topic(color), self._bag.topic(depth)))
        self._topics = tuple(map(once, topics))
        i, j = associate(self._topics[0].stamps, self._topics[1].stamps, reading.max_difference)
        if len(i) == 0:
            spans = " and ".join(topic.span for topic in self._topics)
            raise GavoError(f"{path}: no stamps within {reading.max_difference:g} s of each other: {spans}")
        order = np.argsort(self._topics[0].stamps[i], kind="stable")
        self._pairs = np.stack([i, j], 1)[order]
        self._timestamps = self._topics[0].stamps[i][order]
        self.left_out = []
        for topic, other in zip(self._topics, (depth, color), strict=True):
            unpaired = len(topic.stamps) - topic.aside - topic.repeated - len(i)
            for count, why in (
                (topic.aside, topic.why),
                (topic.repeated, "the same stamp as an earlier one"),
                (unpaired, f"none of {other} within {reading.max_difference:g} s"),
            ):
                self.left_out += [f"{count} of {topic.name}: {why}"] * (count > 0)
        self.calibration = self._calibrate(path, reading)
        self._stream = _Stream(self._bag, self._topics)
        self._shared = _Shared(self, reading)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise a recording by the file's suffix, or the folder's metadata."""
        return (path / METADATA).is_file() if path.is_dir() else path.is_file() and path.suffix.lower() in SUFFIXES

    @classmethod
    def open(cls, path: Path, reading: Reading) -> Self:
        """Open the recording as specified by `reading`."""
        return cls(path, reading)

    @property
    def timestamps(self) -> Float[np.ndarray, " frames"]:
        """Colour stamp of each frame, seconds."""
        return self._timestamps

    @property
    def files(self) -> list[tuple[Path, ...]]:
        """Files of each frame's images: those of the recording, with the first frame, as they hold all."""
        return [self._bag.files, *((),) * (len(self) - 1)][: len(self)]

    @property
    def topics(self) -> tuple[str, str]:
        """Names of the colour and depth topics."""
        color, depth = self._topics
        return color.name, depth.name

    @property
    def camera(self) -> Camera:
        """Camera of the returned frames."""
        return self._shared.assembler.camera

    @property
    def depth_unit(self) -> DepthUnit:
        """Units of depth in the messages, and in frames."""
        return self._shared.assembler.unit

    @property
    def unit_is_assumed(self) -> bool:
        """Whether the depth unit is not stated: RealSense's SDK does not follow the convention of ROS, millimetres."""
        return bool(SENSOR.match(self._topics[1].name)) and not self.calibration.states_depth_scale

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._pairs)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> "BagSequence": ...
    def __getitem__(self, index: int | slice) -> "Frame | BagSequence":
        """Decode frame `index`, or return the sequence of a slice.

        Raises:
            IndexError: no such frame.
            FrameError: one of its images cannot be decoded.
        """
        if isinstance(index, slice):
            part = copy(self)
            part._pairs, part._timestamps = self._pairs[index], self._timestamps[index]
            return part
        bgr, depth, stamps = self._decoded(index)
        return self._shared.assembler.frame(bgr, depth, self._label(0, stamps[0]), *stamps)

    def __iter__(self) -> Iterator[Frame]:
        """Decode frame after frame; raises `FrameError` at one that cannot be decoded."""
        return (self[index] for index in range(len(self)))

    def raw_depth(self, index: int) -> np.ndarray:
        """The depth image of a frame as recorded."""
        return self._decoded(index)[1].raw

    def check(self) -> None:
        """Refuse an empty sequence, or an unusable first frame.

        Raises:
            GavoError: there is no frame, or the first cannot be decoded.
        """
        if len(self) == 0:
            raise GavoError(f"{self.name}: no frames in the chosen range")
        self[0]

    def _decoded(self, index: int) -> tuple[np.ndarray, DepthImage, tuple[float, float]]:
        pair = self._pairs[index]
        stamps = tuple(float(topic.stamps[at]) for topic, at in zip(self._topics, pair, strict=True))
        color, depth = self._stream.messages(int(pair[0]), int(pair[1]))
        names = [self._label(at, stamp) for at, stamp in enumerate(stamps)]
        bgr = color_of(self._topics[0].kind, color, names[0])
        raw = depth_of(self._topics[1].kind, depth, names[1])
        return bgr, DepthImage(raw, names[1]), (stamps[0], stamps[1])

    def _label(self, topic: int, stamp: float) -> str:
        return f"{self._bag.path}: {self._topics[topic].name} at {stamp:.6f}"

    def _size(self) -> Size:
        """Width and height of the first colour image."""
        return self._bag.size(self._topics[0].name)

    def _calibrate(self, path: Path, reading: Reading) -> Calibration:
        own = partial(self._bag.calibration, *(topic.name for topic in self._topics))
        is_rectified = says_rectified(self._topics[0].name)
        found = reading.calibration(own, self._size, MILLIMETRES, is_rectified)  # units of 16UC1, by REP 118
        if reading.depth_scale is not None:
            return found.with_depth_scale(reading.depth_scale)
        if found.states_depth_scale and found.preset is None:
            return found
        told = self._bag.depth_scale(self._topics[1].name)
        return found if told is None else replace(found.with_depth_scale(told), preset=None)


class _Shared:
    """The kind of a recording's images, found once from a few of them and shared by its slices."""

    def __init__(self, sequence: BagSequence, reading: Reading):
        self._sequence, self._reading = sequence, reading

    @cached_property
    def assembler(self) -> FrameAssembler:
        sequence, reading = self._sequence, self._reading
        colors, depths = [], []
        for at in places_of_a_few(len(sequence)):
            with contextlib.suppress(FrameError):
                bgr, depth, _ = sequence._decoded(at)
                colors.append(bgr)
                depths.append(depth)
        calibration = sequence.calibration
        if any(depth.raw.dtype != np.uint16 for depth in depths):
            unit = float_unit(depths, calibration, reading.depth_scale)
        else:
            scale = calibration.color.depth_scale
            if calibration.preset is not None and reading.depth_scale is None:
                scale = _scale_of_integers(depths, calibration)
            unit = DepthUnit(scale, scale, False if reading.depth_scale is None else None)
        return FrameAssembler(calibration, unit, common_white(colors), reading.color, reading.undistort)


def _scale_of_integers(depths: list[DepthImage], calibration: Calibration) -> float:
    """Millimetres, usual in messages, unless depth looks otherwise: a preset's scale holds for its own files only."""
    sample = sample_depth([depth.raw for depth in depths])
    if sample is None:
        return MILLIMETRES
    return better_scale(sample, MILLIMETRES, calibration.color, calibration.preset in KINECTS) or MILLIMETRES


class _Stream:
    """Reads the messages of frames; each message is read only once if frames are requested in order."""

    def __init__(self, bag: Bag, topics: tuple[Topic, ...]) -> None:
        self._bag, self._topics, self._lock = bag, topics, threading.Lock()
        self._numbers = {topic.name: at for at, topic in enumerate(topics)}
        self._coming: Iterator[tuple[str, bytes, str]] = iter(())
        self._next: list[int] = list(NOWHERE)
        self._pending: dict[tuple[int, int], tuple[bytes, str]] = {}

    def messages(self, *wanted: int) -> list[Any]:
        """The messages with these numbers, one of each topic.

        Raises:
            FrameError: the recording ends before them, or a message cannot be read.
        """
        with self._lock:
            for key in [key for key in self._pending if key[1] < wanted[key[0]]]:
                del self._pending[key]
            if any(self._is_out_of_reach(topic, number) for topic, number in enumerate(wanted)):
                self._enter(wanted)
            while missing := [key for key in enumerate(wanted) if key not in self._pending]:
                with legible(self._bag.path, FrameError):
                    found = next(self._coming, None)
                if found is None:
                    self._next = list(NOWHERE)
                    raise FrameError(f"{self._bag.path}: ends before message {missing[0][1]}")
                name, raw, kind = found
                topic = self._numbers[name]
                self._pending[topic, self._next[topic]] = raw, kind
                self._next[topic] += 1
            return [self._bag.deserialize(*self._pending[key]) for key in enumerate(wanted)]

    def _is_out_of_reach(self, topic: int, number: int) -> bool:
        ahead = number - self._next[topic]
        return (topic, number) not in self._pending and not 0 <= ahead <= FAR_AHEAD

    def _enter(self, wanted: tuple[int, ...]) -> None:
        """Seek to the earlier of the wanted messages."""
        start = min(int(topic.received[number]) for topic, number in zip(self._topics, wanted, strict=True))
        self._next = [int(np.searchsorted(topic.received, start)) for topic in self._topics]
        self._pending.clear()
        self._coming = self._bag.stream([topic.name for topic in self._topics], start)
