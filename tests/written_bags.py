"""Bags of every kind, written with the library that reads them."""

import struct
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from gavo_jax.camera import Camera

COLOR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
KINDS = ("ros1", "sqlite", "mcap")
COMPRESSIONS = [
    *(("ros1", name) for name in ("LZ4", "BZ2")),
    *(("sqlite", name) for name in ("FILE", "MESSAGE")),
    *(("mcap", name) for name in ("FILE", "MESSAGE", "STORAGE")),
]
"""Kinds, with what compresses their files: chunks of ROS 1, and of ROS 2 the file, each message or MCAP's chunks."""


class Shot(NamedTuple):
    """One moment's images, depth in any type, with their stamps in seconds."""

    stamp: float
    bgr: np.ndarray
    depth: np.ndarray
    depth_stamp: float | None = None


class Recorder:
    """Writes messages of ROS 1 or ROS 2 by the same calls."""

    def __init__(self, path: Path, kind: str, compression: str | None = None) -> None:
        self.is_1 = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.is_1 else Stores.ROS2_HUMBLE)
        self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
        if self.is_1:
            self.writer: Any = rosbag1.Writer(path)
        else:
            plugin = StoragePlugin.SQLITE3 if kind == "sqlite" else StoragePlugin.MCAP
            self.writer = rosbag2.Writer(path, version=8, storage_plugin=plugin)
        if compression and self.is_1:
            self.writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
        elif compression:
            self.writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
        self.writer.open()
        self.connections: dict[str, Any] = {}
        self.count = 0

    def write(self, topic: str, kind: str, received: float, package: str = "sensor_msgs", **fields: Any) -> None:
        name = f"{package}/msg/{kind}"
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.store)
        message = self.store.types[name](**fields)
        serialize = self.store.serialize_ros1 if self.is_1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], int(received * 1e9), serialize(message, name))

    def header(self, stamp: float, frame: str = "camera") -> Any:
        seconds = int(stamp)
        time = self.store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=round((stamp - seconds) * 1e9))
        self.count += 1
        more = {"seq": self.count} if self.is_1 else {}
        return self.store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame, **more)

    def image(
        self,
        topic: str,
        stamp: float,
        pixels: np.ndarray,
        encoding: str,
        received: float | None = None,
        frame: str = "camera",
    ) -> None:
        rows = np.ascontiguousarray(pixels)
        self.write(
            topic,
            "Image",
            stamp if received is None else received,
            header=self.header(stamp, frame),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=rows.strides[0],
            data=rows.view(np.uint8).ravel(),
        )

    def compressed(self, topic: str, stamp: float, data: bytes, form: str) -> None:
        array = np.frombuffer(data, np.uint8)
        self.write(topic, "CompressedImage", stamp, header=self.header(stamp), format=form, data=array)

    def info(
        self,
        topic: str,
        stamp: float,
        camera: Camera,
        model: str = "plumb_bob",
        frame: str = "camera",
        roi: tuple[int, int, int, int] = (0, 0, 0, 0),
        binning: int = 0,
    ) -> None:
        """A region begins at x, y and has a width and height."""
        x, y, width, height = roi
        region = self.store.types["sensor_msgs/msg/RegionOfInterest"](x, y, height, width, False)
        matrix = np.hstack([camera.matrix, np.zeros((3, 1))])
        names = ("D", "K", "R", "P") if self.is_1 else ("d", "k", "r", "p")
        values = (np.array(camera.distortion), camera.matrix.ravel(), np.eye(3).ravel(), matrix.ravel())
        self.write(
            topic,
            "CameraInfo",
            stamp,
            header=self.header(stamp, frame),
            height=camera.height,
            width=camera.width,
            distortion_model=model,
            binning_x=binning,
            binning_y=binning,
            roi=region,
            **dict(zip(names, values, strict=True)),
        )

    def fixed(
        self,
        stamp: float,
        frames: dict[tuple[str, str], tuple[list[float], list[float]]],
        topic: str = "/tf_static",
    ) -> None:
        """Transforms by parent and child: shift and quaternion (x, y, z, w)."""
        types, entries = self.store.types, []
        for (parent, child), (shift, turn) in frames.items():
            transform = types["geometry_msgs/msg/Transform"](
                types["geometry_msgs/msg/Vector3"](*shift), types["geometry_msgs/msg/Quaternion"](*turn)
            )
            kind = types["geometry_msgs/msg/TransformStamped"]
            entries.append(kind(header=self.header(stamp, parent), child_frame_id=child, transform=transform))
        self.write(topic, "TFMessage", stamp, "tf2_msgs", transforms=entries)

    def close(self) -> None:
        self.writer.close()


def raw(recorder: Recorder, shot: Shot, depth_stamp: float) -> None:
    encoding = "16UC1" if shot.depth.dtype == np.uint16 else "32FC1"
    recorder.image(COLOR, shot.stamp, shot.bgr[..., ::-1], "rgb8")
    recorder.image(DEPTH, depth_stamp, shot.depth, encoding)


def compressed(recorder: Recorder, shot: Shot, depth_stamp: float, ending: str = ".png") -> None:
    jpeg = [cv2.IMWRITE_JPEG_QUALITY, 90] if ending == ".jpg" else []
    color = cv2.imencode(ending, shot.bgr, jpeg)[1].tobytes()
    recorder.compressed(f"{COLOR}/compressed", shot.stamp, color, "rgb8; jpeg compressed bgr8" if jpeg else "png")
    header, depth = struct.pack("<iff", 0, 0.0, 0.0), shot.depth
    form = "16UC1; compressedDepth png"
    if shot.depth.dtype != np.uint16:
        header, form = struct.pack("<iff", 0, 10000.0, -100.0), "32FC1; compressedDepth png"
        with np.errstate(divide="ignore"):
            depth = np.where(shot.depth > 0, 10000.0 / shot.depth - 100.0, 0).round().astype(np.uint16)
    data = header + cv2.imencode(".png", depth)[1].tobytes()
    recorder.compressed(f"{DEPTH}/compressedDepth", depth_stamp, data, form)


def jpeg(recorder: Recorder, shot: Shot, depth_stamp: float) -> None:
    compressed(recorder, shot, depth_stamp, ".jpg")


STYLES: dict[str, Callable[[Recorder, Shot, float], None]] = {"raw": raw, "compressed": compressed, "jpeg": jpeg}


def record(
    path: Path, kind: str, style: str, shots: Iterable[Shot], camera: Camera | None, compression: str | None = None
) -> Path:
    """Write a recording and return its path: a file for ROS 1, else a folder."""
    path = path.with_suffix(".bag") if kind == "ros1" else path
    recorder = Recorder(path, kind, compression)
    for shot in shots:
        if camera is not None:
            for topic in (COLOR, DEPTH):
                recorder.info(topic.replace("image_raw", "camera_info"), shot.stamp, camera)
        STYLES[style](recorder, shot, shot.stamp if shot.depth_stamp is None else shot.depth_stamp)
    recorder.close()
    return path
