"""Recordings of ROS 1 and ROS 2 (SQLite, MCAP), opened by the library rosbags: messages, topics and cameras."""

import contextlib
import io
import itertools
import re
import struct
import weakref
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.camera_files.calibration import Calibration, Size, camera_from_table
from gavo_jax.datasets.assembly import MILLIMETRES
from gavo_jax.datasets.base import FrameError
from gavo_jax.datasets.files import Reading
from gavo_jax.datasets.recordings.messages import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    as_taken,
    camera_table,
    color_of,
    depth_of,
    intrinsics,
    is_calibrated,
    is_depth,
)
from gavo_jax.datasets.recordings.stamps import Topic
from gavo_jax.datasets.recordings.topics import ImageTopic, are_of_two_cameras, choose, says_rectified, says_registered
from gavo_jax.datasets.recordings.transforms import ANY_TOPIC, FIXED_TOPIC, TRANSFORMS, between, fixed_transforms
from gavo_jax.errors import GavoError, blamed

SUFFIXES = (".bag", ".mcap", ".db3")
METADATA = "metadata.yaml"
"""Name of the metadata in the folder of a ROS 2 bag."""
ZSTD = b"\x28\xb5\x2f\xfd"
"""First bytes of data compressed by zstd."""
MCAP = b"\x89MCAP0\r\n"
"""First bytes of an MCAP file."""
FOREIGN = {
    "": "its header names no profile, and the library reads only 'ros2': convert it with ros2 bag convert, if it "
    "contains messages of ROS 2",
    "ros1": "its profile is 'ros1', and the library reads only 'ros2': pass the .bag that it was made from",
}
"""What to do about an unsupported MCAP, by the profile in its header."""
HEADER = 12
"""Bytes at the start of a message up to and including its stamp."""
FEW = 30
"""Number of messages of a topic that are searched for a usable one."""
SENSOR = re.compile(r"/device_\d+/sensor_\d+(?=/)")
"""Matches the place of a sensor's topics in recordings of RealSense's SDK."""
DEPTH_UNITS = re.compile(r"/option/depth[ _]units/value", re.IGNORECASE)
"""Matches, below that place, the topic with the metres per unit of depth."""
LEAST_UNIT = 1e-6
"""Smallest unit of depth, metres."""
ROUNDED = 0.05
"""Largest difference between two camera_infos of the same camera, pixels."""


class Bag:
    """A recording opened by the library, whose exceptions are turned into one-line errors."""

    def __init__(self, path: Path) -> None:
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise GavoError(f"{path}: recordings of ROS need the extra [bag]: pip install 'gavo-jax[bag]'") from None
        self.path = path
        if path.is_file() and path.suffix not in SUFFIXES:
            raise GavoError(f"{path}: the suffix must be in lower case ({path.suffix.lower()}): rename it")
        if path.is_dir() and path.suffix == ".bag":
            raise GavoError(f"{path}: a ROS 2 folder that the library takes for a ROS 1 file: rename it")
        with legible(path):
            self._reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self._reader.open()
            _own_files(self._reader)
        weakref.finalize(self, _close, self._reader)
        self.kinds = {c.topic: c.msgtype for c in self._reader.connections if c.msgtype in (IMAGE, COMPRESSED)}

    @property
    def files(self) -> tuple[Path, ...]:
        """The files of the recording with messages, compressed ones too."""
        files = [self.path] if self.path.is_file() else sorted(self.path.iterdir())
        return tuple(path for path in files if set(path.suffixes) & set(SUFFIXES))

    def stream(self, names: list[str], start: int | None = None) -> Iterator[tuple[str, bytes, str]]:
        """Topic, content and type of messages in the order of their arrival, from time `start` (ns) on."""
        connections = [connection for connection in self._reader.connections if connection.topic in names]
        for connection, _, raw in self._reader.messages(connections, start=start):
            if self._reader.is2 and bytes(raw[:4]) == ZSTD:
                raise GavoError(
                    f"{self.path}: its messages are compressed (zstd), as stated in its {METADATA}: pass the folder "
                    "that contains both"
                )
            yield connection.topic, bytes(raw), connection.msgtype

    def deserialize(self, raw: bytes, kind: str) -> Any:
        """Deserialise a message; raises `FrameError` if it is damaged."""
        with legible(self.path, FrameError):
            return self._reader.deserialize(raw, kind)

    def topic(self, name: str) -> Topic:
        """Collect the stamps of a topic's messages."""
        connections = [connection for connection in self._reader.connections if connection.topic == name]
        received, stamps = [], []
        with legible(self.path):
            for _, time, raw in self._reader.messages(connections):
                received.append(time)
                stamps.append(_stamp(raw, self._reader.is2))
        return Topic(name, self.kinds[name], np.array(received, np.int64), np.array(stamps))

    def first(self, name: str, is_good: Callable[[Any], bool] = lambda message: True) -> Any | None:
        """The first good message among the first few of a topic; None if none is."""
        with legible(self.path):
            few = itertools.islice(self.stream([name]), FEW)
            messages = (self._reader.deserialize(raw, kind) for _, raw, kind in few)
            return next(filter(is_good, messages), None)

    def size(self, name: str) -> Size:
        """Width and height of the first image of a topic."""
        kind, message = self.kinds[name], self.first(name)
        if kind == IMAGE:
            return int(message.width), int(message.height)  # pyright: ignore[reportOptionalMemberAccess]
        read = depth_of if is_depth(kind, message, name) else color_of
        height, width = read(kind, message, name).shape[:2]
        return width, height

    def choose(self, reading: Reading) -> tuple[str, str]:
        """The colour and depth topics: the ones given, else chosen by their messages and names."""
        images = {}
        for name, kind in sorted(self.kinds.items()):
            if (message := self.first(name)) is not None:
                images[name] = ImageTopic.of(kind, message, name)
        if self.kinds and not images:
            raise GavoError(f"{self.path}: contains no images: no messages on {', '.join(sorted(self.kinds))}")
        color, depth = choose(self.path, images, reading.color_topic, reading.depth_topic)
        are_named = reading.color_topic is not None and reading.depth_topic is not None
        if are_of_two_cameras(color, depth) and not are_named:
            frames = images[color].frame, images[depth].frame
            if frames[0] == frames[1] or self._between(*frames)[0] is None:
                raise GavoError(
                    f"{self.path}: {color} and {depth} belong to two cameras, judging by their names: "
                    "pass --colour-topic and --depth-topic if they belong to one"
                )
        return color, depth

    def depth_scale(self, depth: str) -> float | None:
        """Units per metre of a depth topic, as RealSense's SDK records them; None if the recording does not say.

        Raises:
            GavoError: the value is no unit, or changes within the recording.
        """
        sensor = SENSOR.match(depth)
        topics = [connection.topic for connection in self._reader.connections] if sensor else []
        told = next((name for name in topics if sensor and _is_unit_of(sensor[0], name)), None)
        if told is None:
            return None
        place = f"{self.path}: {told}"
        with blamed(f"{place}: expected metres per unit"):
            units = {float(self.deserialize(raw, kind).data) for _, raw, kind in self.stream([told])}
        if faults := [unit for unit in units if not LEAST_UNIT < unit <= 1]:
            hint = "pass --depth-scale, in units per metre"
            raise GavoError(f"{place}: expected metres per unit, found {faults[0]:g}: {hint}")
        if len(units) > 1:
            raise GavoError(f"{place}: the unit of depth changes within the recording: pass --depth-scale")
        return 1 / float(f"{units.pop():.6g}") if units else None  # stored as a float of 32 bits

    def calibration(self, color: str, depth: str) -> Calibration:
        """The cameras of two topics, from the camera_info beside each."""
        found = self._info(color)
        if found is None:
            raise GavoError(f"{self.path}: no camera_info for {color}: pass --camera")
        name, info = found
        camera = self._camera(name, info, color)
        other = self._info(depth)
        moved = None if other is None else self._camera(*other, depth)
        if other is None or moved is None:
            return self._alone(camera, name, (color, depth), info.header.frame_id)
        frames = (info.header.frame_id, other[1].header.frame_id)
        says_so = says_registered(color, depth)
        is_one_place = frames[0] == frames[1] or not all(frames) or says_so
        are_placed = any(frames) or says_so  # two unnamed frames need not be the same
        color_T_depth, where = self._between(*frames) if are_placed else (None, "")
        if _is_same(moved, camera):
            color_T_depth = np.eye(4) if is_one_place else color_T_depth
            has_one_lens = moved.distortion == camera.distortion or says_rectified(color) == says_rectified(depth)
            if has_one_lens and color_T_depth is not None and np.allclose(color_T_depth, np.eye(4)):
                return Calibration(camera, origin=name, states_depth_scale=False)
        if color_T_depth is None:
            raise GavoError(
                f"{self.path}: {depth} belongs to another camera than {color}, and neither {FIXED_TOPIC} nor "
                f"{ANY_TOPIC} contains a fixed transform between them: "
                "pass --camera with a file for both cameras ([depth], colour_T_depth), or another --depth-topic"
            )
        origin = f"{name} and {other[0]}" if frames[0] == frames[1] else f"{name}, {other[0]} and {where}"
        return Calibration(camera, moved, color_T_depth, origin, states_depth_scale=False)

    def _alone(self, camera: Camera, name: str, topics: tuple[str, str], frame: str) -> Calibration:
        """One camera for both topics, if depth, without a camera_info, isn't in another frame."""
        image = self.first(topics[1])
        other = frame if image is None else image.header.frame_id
        color_T_depth, _ = self._between(frame, other)
        if frame and other and (color_T_depth is None or not np.allclose(color_T_depth, np.eye(4))):
            raise GavoError(
                f"{self.path}: no camera_info for {topics[1]}, whose images are in the frame {other[:60]!r}, not in "
                f"{frame[:60]!r} like {topics[0]}: pass --camera with a file for both cameras ([depth], "
                "colour_T_depth), or for one if depth is registered to colour"
            )
        return Calibration(camera, origin=name, states_depth_scale=False)

    def _between(self, a: str, b: str) -> tuple[np.ndarray | None, str]:
        """`a_T_b` and the topic that it comes from; None if unknown."""
        found = between(self._fixed, a, b)
        return (found, FIXED_TOPIC) if found is not None else (between(self._unchanged, a, b), ANY_TOPIC)

    @cached_property
    def _fixed(self) -> dict[tuple[str, str], np.ndarray]:
        """Transforms that are published once."""
        return self._transforms(FIXED_TOPIC)

    @cached_property
    def _unchanged(self) -> dict[tuple[str, str], np.ndarray]:
        """Transforms that are published once, or repeatedly without changes."""
        return self._transforms(FIXED_TOPIC, ANY_TOPIC)

    def _transforms(self, *names: str) -> dict[tuple[str, str], np.ndarray]:
        """The transforms on some topics that never change."""
        topics = [c.topic for c in self._reader.connections if c.topic in names and c.msgtype == TRANSFORMS]
        with blamed(f"{self.path}: {' and '.join(names)}"):
            raw = self.stream(topics) if topics else ()
            return fixed_transforms(self._reader.deserialize(content, kind) for _, content, kind in raw)

    def _info(self, topic: str) -> tuple[str, Any] | None:
        """Name and first message of the camera_info beside an image topic, preferably one with a calibration.

        RealSense's own recordings have it in `info/` beside `image/`.
        """
        infos = [c.topic for c in self._reader.connections if c.msgtype == CAMERA_INFO]
        parts = topic.split("/")
        beside = ["/".join(parts[:length]) for length in range(len(parts) - 1, 0, -1)]
        for name in (f"{place}/{inner}camera_info" for place in beside for inner in ("", "info/")):
            if name in infos and (message := self.first(name, is_calibrated) or self.first(name)) is not None:
                self._refuse_another_camera(name, message)
                return name, message
        return None

    def _refuse_another_camera(self, name: str, info: Any) -> None:
        """Refuse a camera that changes within the recording, as one that zooms or switches its mode does."""
        with legible(self.path):
            # but for the stamp, all messages are usually the same
            distinct = {raw[HEADER:]: (raw, kind) for _, raw, kind in self.stream([name])}
            others = [self._reader.deserialize(*content) for content in distinct.values()]
        numbers = [intrinsics(one) for one in (info, *others) if is_calibrated(one)]
        for other in numbers[1:]:
            if not _are_alike(other, numbers[0]):
                fx = f"fx is {numbers[0][0]:g} at first, {other[0]:g} later"
                raise GavoError(
                    f"{self.path}: {name}: the camera changes within the recording ({fx}): pass --camera with one that "
                    "applies throughout"
                )

    def _camera(self, name: str, info: Any, topic: str) -> Camera:
        place = f"{self.path}: {name}"
        if not is_calibrated(info):
            raise GavoError(f"{place}: all zero, as the camera was never calibrated: pass --camera")
        with blamed(place):
            table = as_taken(place, camera_table(info, says_rectified(topic)), info, partial(self.size, topic))
            return camera_from_table(place, table, MILLIMETRES)


def _is_unit_of(sensor: str, topic: str) -> bool:
    """Whether a topic holds the unit of depth of a sensor in a recording of RealSense's SDK."""
    return topic.startswith(sensor) and bool(DEPTH_UNITS.fullmatch(topic.removeprefix(sensor)))


class _File(io.BufferedReader):
    """A file that is closed when it is garbage collected, since sequences aren't closed explicitly."""

    def close(self) -> None:
        self.raw.close()
        super().close()


def _own_files(reader: Any) -> None:
    """Replace the files that the library opened by ones that close themselves.

    The library fails to close a ROS 1 file while a message of its last chunk is still referenced.
    """
    for part in reader.readers:
        if isinstance(file := getattr(part, "bio", None), io.BufferedReader):
            part.bio = _File(io.FileIO(file.name))
            file.close()


@contextlib.contextmanager
def legible(path: Path, kind: type[GavoError] = GavoError) -> Iterator[None]:
    """Turn the library's exceptions about a damaged recording into a one-line error with advice."""
    with blamed(f"{path}: cannot be read as a bag", lambda words: kind(f"{words}; {_mending(path)}")):
        yield


def _mending(path: Path) -> str:
    """Suggest a fix for a damaged recording."""
    files = [path] if path.is_file() else list(path.iterdir())
    profiles = {_profile(file) for file in files if file.suffix.lower() == ".mcap"}
    if (profile := next(iter(profiles - {"ros2", None}), None)) is not None:
        return FOREIGN.get(profile, f"its profile is {profile[:40]!r}, and the library reads only 'ros2'")
    kinds = {file.suffix.lower() for file in files}
    tool = "mcap recover" if ".mcap" in kinds else "rosbag reindex" if ".bag" in kinds else "ros2 bag reindex"
    return f"download or copy it again, or repair it with {tool}"


def _profile(file: Path) -> str | None:
    """The profile in the header (first record) of an MCAP; None if there is no such header."""
    with contextlib.suppress(OSError, struct.error, UnicodeDecodeError), file.open("rb") as stream:
        magic, kind, _, length = struct.unpack("<8sBQI", stream.read(21))
        if (magic, kind) == (MCAP, 1) and len(profile := stream.read(min(length, 64))) == length:
            return profile.decode()
    return None


def _close(reader: Any) -> None:
    """Close a recording that is no longer referenced, ignoring failures of the library."""
    with contextlib.suppress(Exception):
        reader.close()


def _stamp(raw: Any, is_2: bool) -> float:
    """The stamp, seconds, in the header at the start of every image message."""
    data = bytes(raw[:12])
    if len(data) < 12:
        return 0.0
    order = "<" if not is_2 or data[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack(f"{order}{'i' if is_2 else 'I'}I", data[4:12])
    return seconds + nanoseconds * 1e-9


def _is_same(a: Camera, b: Camera) -> bool:
    """Whether two cameras have the same size and intrinsics (not distortion), up to rounding."""
    return _are_alike(*((c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in (a, b)))


def _are_alike(a: Iterable[float], b: Iterable[float]) -> bool:
    """Whether the numbers of two cameras agree up to rounding."""
    return bool(np.allclose(list(a), list(b), rtol=0, atol=ROUNDED))
