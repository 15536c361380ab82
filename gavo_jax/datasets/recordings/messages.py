"""Decoding of images and cameras in messages of ROS 1 and 2: raw, compressed, and compressedDepth."""

import math
import re
import struct
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from gavo_jax.camera_files.words import camera_info_distortion
from gavo_jax.datasets.base import FrameError
from gavo_jax.datasets.images import PNG_SIGNATURE, decode_color, decode_depth, to_float32
from gavo_jax.errors import GavoError

IMAGE, COMPRESSED, CAMERA_INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))

LAYOUTS: dict[str, tuple[str, int, int | None]] = {
    "rgb8": ("u1", 3, cv2.COLOR_RGB2BGR),
    "bgr8": ("u1", 3, None),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2BGR),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2BGR),
    "8UC3": ("u1", 3, None),
    "8UC4": ("u1", 4, cv2.COLOR_BGRA2BGR),
    "mono8": ("u1", 1, cv2.COLOR_GRAY2BGR),
    "8UC1": ("u1", 1, cv2.COLOR_GRAY2BGR),
    "rgb16": ("u2", 3, cv2.COLOR_RGB2BGR),
    "bgr16": ("u2", 3, None),
    "16UC3": ("u2", 3, None),
    "mono16": ("u2", 1, cv2.COLOR_GRAY2BGR),
    "16UC1": ("u2", 1, cv2.COLOR_GRAY2BGR),
    "Z16": ("u2", 1, cv2.COLOR_GRAY2BGR),
    "bayer_rggb8": ("u1", 1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": ("u1", 1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": ("u1", 1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": ("u1", 1, cv2.COLOR_BayerGB2BGR),
    "bayer_rggb16": ("u2", 1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr16": ("u2", 1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg16": ("u2", 1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg16": ("u2", 1, cv2.COLOR_BayerGB2BGR),
    "nv12": ("u1", 1, cv2.COLOR_YUV2BGR_NV12),
    "nv21": ("u1", 1, cv2.COLOR_YUV2BGR_NV21),
    "yuv422": ("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": ("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": ("u1", 2, cv2.COLOR_YUV2BGR_YUYV),
    "yuyv": ("u1", 2, cv2.COLOR_YUV2BGR_YUYV),
    "32FC1": ("f4", 1, None),
    "64FC1": ("f8", 1, None),
}
"""Number type, channels and conversion to BGR of each encoding (None: it is BGR already, or depth)."""

SPELLINGS = {name.lower(): name for name in LAYOUTS} | {"y8": "mono8", "yuy2": "yuyv"}
"""The encodings by other spellings that drivers use, in lower case."""

HALVED = ("nv12", "nv21")
"""Encodings whose rows of luma are followed by half as many rows of chroma, subsampled by two."""

DEPTH_ENCODINGS = ("16UC1", "32FC1", "64FC1", "mono16", "Z16")
"""Encodings of raw depth images; Z16 is what librealsense calls 16UC1."""

FILM = re.compile(r"(?i)\b(?:[hx]\.?26[45]|hevc|avc|vp[89]|av1|theora)\b")
"""Matches formats of video codecs, whose frames cannot be decoded on their own."""

DEPTH_HEADER = 12
"""Size of the header before the image in a compressedDepth message, bytes: a format and two coefficients."""

AS_COMPRESSED = re.compile(r"\bcompressed +(\w+)")
"""Matches the encoding, before compression, in the format of compressed images."""

INFRARED = re.compile(r"(?:^|[/_])(?:ir|infra|infrared|amplitude|intensity|disparity|confidence)\d*(?:[/_]|$)")
"""Matches names of topics whose numbers are intensity, disparity or confidence, not depth."""


def encoding_of(kind: str, message: Any) -> str:
    """The encoding of an image message, as `LAYOUTS` spells it, or the format of a compressed one."""
    if kind != IMAGE:
        return message.format
    encoding: str = message.encoding
    return SPELLINGS.get(encoding.lower(), encoding)


def is_depth(kind: str, message: Any, topic: str) -> bool:
    """Whether an image message holds depth, by its encoding, or if that is ambiguous by the topic's name."""
    encoding = encoding_of(kind, message)
    is_named = "depth" in topic.lower()
    if INFRARED.search(topic) and not is_named:
        return False
    if "compressedDepth" in encoding or "32FC1" in encoding or "16UC1" in encoding or encoding in ("Z16", "64FC1"):
        return True
    return is_named and ("mono16" in encoding or kind == COMPRESSED and "jp" not in encoding.lower())


def color_of(kind: str, message: Any, name: str) -> np.ndarray:
    """Decode a colour message to BGR of 8 or 16 bits.

    Raises:
        FrameError: an unknown encoding, or too few bytes; the message contains `name`.
    """
    if kind == COMPRESSED:
        if FILM.search(message.format):
            raise FrameError(
                f"{name}: a film ({message.format[:40]!r}), in which an image depends on others: record JPEG or PNG"
            )
        image = decode_color(bytes(message.data), name)
        mosaic = _mosaic(message.format)
        return image if mosaic is None else _converted(np.ascontiguousarray(image[..., 0]), mosaic, name)
    pixels = _pixels(message, name)
    if pixels.dtype.kind == "f":
        raise FrameError(f"{name}: encoding {message.encoding} is not colour")
    return _converted(pixels, encoding_of(kind, message), name)


def _mosaic(form: str) -> str | None:
    """The Bayer encoding that compressed images still have; None if they were converted before compression."""
    compressed = AS_COMPRESSED.search(form)
    encoding = compressed.group(1) if compressed else form.partition(";")[0].strip()
    return encoding if encoding.startswith("bayer_") and encoding in LAYOUTS else None


def _converted(pixels: np.ndarray, encoding: str, name: str) -> np.ndarray:
    """Convert the pixels of a message to BGR."""
    conversion = LAYOUTS[encoding][2]
    try:
        return pixels if conversion is None else cv2.cvtColor(pixels, conversion)
    except cv2.error:
        size = f"{pixels.shape[1]}x{pixels.shape[0]}"
        raise FrameError(f"{name}: {size} pixels cannot have the encoding {encoding}") from None


def depth_of(kind: str, message: Any, name: str) -> np.ndarray:
    """Decode a depth message to raw depth, 16-bit integers or float32.

    Raises:
        FrameError: not depth, an unknown encoding, or too few bytes; the message contains `name`.
    """
    if kind == IMAGE:
        if encoding_of(kind, message) not in DEPTH_ENCODINGS:
            raise FrameError(
                f"{name}: encoding {message.encoding[:40]!r} is not depth: expected {', '.join(DEPTH_ENCODINGS)}"
            )
        pixels = _pixels(message, name)
        return pixels if pixels.dtype == np.uint16 else to_float32(pixels)
    data = bytes(message.data)
    has_header = data[DEPTH_HEADER:].startswith(PNG_SIGNATURE)
    if "compressedDepth" not in message.format and not has_header:
        return decode_depth(data, name)
    if not has_header:
        raise FrameError(
            f"{name}: compressed depth of format {message.format[:40]!r}: only PNG is supported; record that, or "
            "raw images"
        )
    _, slope, offset = struct.unpack_from("<iff", data)
    stored = decode_depth(data[DEPTH_HEADER:], name)
    if not _is_inverse(message.format, slope):
        return stored
    with np.errstate(divide="ignore"):  # quantised inverse depth; 0 = no reading
        return np.where(stored > 0, np.float32(slope) / (stored.astype(np.float32) - np.float32(offset)), np.float32(0))


def _is_inverse(form: str, slope: float) -> bool:
    """Whether compressed depth is inverse depth: for 32FC1, or if the format doesn't say and the slope is above 0.

    For 16UC1 the slope is ignored: the transport leaves it uninitialised.
    """
    return "32FC1" in form or "16UC1" not in form and math.isfinite(slope) and slope > 0


def _pixels(message: Any, name: str) -> np.ndarray:
    """The pixels of a raw image message, not converted, [h, w] or [h, w, channels]."""
    encoding = encoding_of(IMAGE, message)
    layout = LAYOUTS.get(encoding)
    if layout is None:
        raise FrameError(f"{name}: encoding {message.encoding[:40]!r} is not one of {', '.join(LAYOUTS)}")
    number, channels, _ = layout
    dtype = np.dtype(number).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = int(message.height), int(message.width), int(message.step)
    if encoding in HALVED:
        if height % 2 or width % 2:
            raise FrameError(
                f"{name}: {width}x{height} pixels of {message.encoding}, which needs an even width and height"
            )
        height = height * 3 // 2
    row = width * channels * dtype.itemsize
    data = np.asarray(message.data, np.uint8)
    if min(height, width) < 1 or step < row or data.size < step * (height - 1) + row:
        raise FrameError(f"{name}: {data.size} bytes for {width}x{height} pixels of {message.encoding}: too few")
    whole = data[: step * height] if data.size >= step * height else np.pad(data, (0, step * height - data.size))
    rows = np.ascontiguousarray(whole.reshape(height, step)[:, :row]).view(dtype)
    rows = rows.astype(dtype.newbyteorder("="), copy=False)
    return rows if channels == 1 else rows.reshape(height, width, channels)


def is_calibrated(info: Any) -> bool:
    """Whether a camera_info holds a calibration: drivers without one send zeros."""
    return info.width > 0 and any(_numbers(info, "k"))


def intrinsics(info: Any) -> list[float]:
    """Return fx, cx, fy, cy, width and height of a camera_info."""
    fx, _, cx, _, fy, cy, *_ = _numbers(info, "k")
    return [fx, cx, fy, cy, float(info.width), float(info.height)]


def _numbers(info: Any, name: str) -> list[float]:
    """Return the numbers of a camera_info's field: k, d or p, which ROS 1 writes K, D and P."""
    return [float(value) for value in getattr(info, name, getattr(info, name.upper(), ()))]


def camera_table(info: Any, rectified: bool) -> dict[str, Any]:
    """Convert a camera_info to the keys of a camera file.

    Args:
        info: the message, of ROS 1 (K, D, P) or ROS 2 (k, d, p).
        rectified: whether the images are free of distortion, so that the projection matrix applies.
    """
    k, d, p = (_numbers(info, name) for name in ("k", "d", "p"))
    size = {"width": int(info.width), "height": int(info.height)}
    if rectified and any(p):
        return {"fx": p[0], "fy": p[5], "cx": p[2], "cy": p[6], **size}
    lens = {} if rectified else camera_info_distortion(info.distortion_model, d if any(d) else [])
    return {"fx": k[0], "fy": k[4], "cx": k[2], "cy": k[5], **size, **lens}


def as_taken(place: str, table: dict[str, Any], info: Any, find_size: Callable[[], tuple[int, int]]) -> dict[str, Any]:
    """Adapt a sensor's camera to images that are cropped (roi) or binned, according to its camera_info.

    If the images have the stated size nevertheless, the numbers are taken to be theirs already, as in some drivers.

    Args:
        place: names the topic in messages.
        table: camera of the full sensor, from `camera_table`.
        info: the message.
        find_size: finds width and height of the images; called only if needed.

    Raises:
        GavoError: the images have the full size, but the region does not start at the sensor's corner.
    """
    region, whole = info.roi, (table["width"], table["height"])
    offset, groups = (int(region.x_offset), int(region.y_offset)), (int(info.binning_x) or 1, int(info.binning_y) or 1)
    sides = int(region.width) or whole[0], int(region.height) or whole[1]
    if (*offset, *groups) == (0, 0, 1, 1) and sides == whole:
        return table
    size = find_size()
    if size == whole:
        if any(offset):
            raise GavoError(
                f"{place}: a region (roi) starts at {offset[0]} {offset[1]}, but images have the full size, "
                f"{size[0]}x{size[1]}; it is unclear whether its numbers apply to them: pass --camera"
            )
        return table
    if size != (sides[0] // groups[0], sides[1] // groups[1]):
        return table
    table = {**table, "width": size[0], "height": size[1]}
    for focal, middle, start, group in zip(("fx", "fy"), ("cx", "cy"), offset, groups, strict=True):
        table[focal] /= group
        table[middle] = (table[middle] - start + 0.5) / group - 0.5
    return table
