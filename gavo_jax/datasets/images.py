"""Decoding of image files: any format of OpenCV, NumPy arrays, OpenEXR; a one-line error for what cannot be read."""

import contextlib
import io
import re
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Shaped, UInt8, UInt16

from gavo_jax.camera import MAX_SIDE
from gavo_jax.datasets.base import FrameError
from gavo_jax.datasets.quiet import without_lines, without_log, without_words_on
from gavo_jax.number_types import NO_READING, Depth

COLOR_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm", ".jp2", ".avif")
"""Suffixes of colour images searched for in a folder; a file that is given by name may have any."""
DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".exr", ".npy", ".npz", ".pgm", ".pfm")

MAX_BYTES = 2**20 + 16 * MAX_SIDE**2
"""Largest file, bytes: the largest image at sixteen bytes per pixel, plus some margin."""

PNG_SIGNATURE, EXR_SIGNATURE = b"\x89PNG\r\n\x1a\n", b"\x76\x2f\x31\x01"
NPY_SIGNATURE, NPZ_SIGNATURE = b"\x93NUMPY", b"PK\x03\x04"

TIFF_ORIENTATION, TIFF_BITS, TIFF_NUMBERS = 274, 258, 339
"""TIFF tags: orientation (1 is upright), bits per sample, and sample format (3 is float)."""

PFM_SCALE = re.compile(rb"(P[fF]\s+\d+\s+\d+\s+-?)\S+(?=\s)")
"""Header of a PFM image up to the sign of its scale, which alone matters: it gives the byte order."""

JPEG_SIGNATURE = b"\xff\xd8\xff"

JPEG_WORDS = ("Corrupt JPEG data", "Premature end of JPEG", "for sequential JPEG", "JFIF revision")
"""Parts of libjpeg's messages about files that it decodes nevertheless."""

JPEG_LOSS = re.compile(
    r"[Pp]remature end|bad (?:Huffman|arithmetic)|instead of RST|before marker 0xd[0-7]|\d{4,} extraneous"
)
"""Matches those of libjpeg's messages that mean lost pixels; a few extraneous bytes, which many cameras write, do
not."""

SIGN = 128
"""Sign bit in the highest byte of a float."""

WHITES = (255, 1023, 4095, 16383, 65535)
"""Full scales of sensors, by which 16-bit intensities are normalised."""

AS_COLOR = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
AS_STORED = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION


def read_color(path: str | Path) -> UInt8[np.ndarray, "h w 3"] | UInt16[np.ndarray, "h w 3"]:
    """Return a colour image as BGR of 8 or 16 bits; grey gives three equal channels, and alpha is dropped.

    Raises:
        FrameError: it is missing, truncated, or no image of 8 or 16 bits; the message names it.
    """
    path = Path(path)
    return decode_color(read_bytes(path), str(path))


def decode_color(data: bytes, name: str) -> UInt8[np.ndarray, "h w 3"] | UInt16[np.ndarray, "h w 3"]:
    """Decode the content of a colour image, see `read_color`; `name` is for messages."""
    if data.startswith(NPY_SIGNATURE):
        image = _color_array(_decode_npy(data, name))
    else:
        image = _decode(data, name, AS_COLOR)
    if image is None or image.ndim != 3 or image.shape[-1] != 3 or image.dtype not in (np.uint8, np.uint16):
        found = "nothing" if image is None else _describe(image)
        raise FrameError(f"{name}: not a colour image: expected colour or grey of 8 or 16 bits, found {found}")
    return image


def read_depth(path: str | Path) -> Depth:
    """Return raw depth as stored in the file: 16-bit integers, or float32 for anything else.

    Invalid readings (65535, negative, NaN, infinity) are kept: see `without_invalid`. Only negative integers become 0
    where the image fits 16 bits.

    Raises:
        FrameError: it is missing, truncated, or not depth (one channel of at least 16 bits); the message names it.
    """
    path = Path(path)
    return decode_depth(read_bytes(path), str(path))


def decode_depth(data: bytes, name: str) -> Depth:
    """Decode the content of a depth image, see `read_depth`; `name` is for messages."""
    if data.startswith(NPY_SIGNATURE):
        image = _decode_npy(data, name)
    elif data.startswith(NPZ_SIGNATURE):
        image = _decode_npz(data, name)
    elif data.startswith(EXR_SIGNATURE):
        image = _decode_exr(data, name)
    else:
        image = _unpacked(_decode(data, name, AS_STORED))
    if image.ndim == 3 and image.shape[-1] == 1:
        image = image[..., 0]
    elif image.ndim == 3 and image.shape[0] == 1:  # channel first, as in PyTorch
        image = image[0]
    elif image.shape[2:] in ((3,), (4,)) and image.dtype.itemsize > 1 and _is_grey(image):
        image = image[..., 0]
    if image.ndim != 2 or image.dtype.itemsize < 2 or image.dtype.kind not in "uif":
        found = _describe(image)
        if image.dtype == np.uint8:
            several = (
                " or numbers packed into channels, as in CARLA: write those" if image.ndim == 3 else ": write depth"
            )
            found += f", a picture of depth{several} as 16 bits or floats"
        raise FrameError(f"{name}: not a depth image: expected one channel of 16 bits or of floats, found {found}")
    if image.dtype.kind in "ui" and image.max() <= NO_READING:
        return np.maximum(image, 0).astype(np.uint16)  # fits 16 bits, whatever the stored type
    return to_float32(image)


def _unpacked(image: np.ndarray) -> np.ndarray:
    """Unpack little-endian floats stored as four 8-bit channels, as by TartanAir; other images are returned unchanged.

    In a real RGBA image the alpha channel has its top bit set somewhere, or is 0 everywhere. In packed depth that bit
    is the sign, which is never set.
    """
    if image.dtype != np.uint8 or image.shape[2:] != (4,) or not 0 < image[..., 3].max() < SIGN:
        return image
    return np.ascontiguousarray(image).view("<f4")[..., 0]


def _is_grey(image: Shaped[np.ndarray, "h w channels"]) -> bool:
    """Whether the three channels of colour are equal, as where Blender writes depth; a fourth is transparency."""
    is_float = image.dtype.kind == "f"
    return all(np.array_equal(image[..., 0], image[..., i], equal_nan=is_float) for i in (1, 2))


def to_float32(image: np.ndarray) -> Float[np.ndarray, "h w"]:
    """Convert to single precision; values that are too large become infinite."""
    with np.errstate(over="ignore"):
        return image.astype(np.float32)


def to_8_bits(image: Shaped[np.ndarray, "h w *channels"], white: int) -> UInt8[np.ndarray, "h w *channels"]:
    """Scale intensities so that `white` becomes 255; 8-bit images are returned unchanged."""
    return image if image.dtype == np.uint8 else cv2.convertScaleAbs(image, alpha=255.0 / white)


def white_of(image: Shaped[np.ndarray, "h w *channels"]) -> int:
    """The smallest full scale that covers an image's intensities: 16-bit images often hold only 10, 12 or 14 bits."""
    most = int(image.max(initial=0))
    return next(white for white in WHITES if most <= white)


def without_invalid(depth: Depth) -> np.ndarray:
    """Return raw depth with invalid readings set to 0: 65535 (of 16 bits), negative, NaN, infinity."""
    if depth.dtype == np.uint16:
        return cv2.threshold(depth, NO_READING - 1, 0, cv2.THRESH_TOZERO_INV)[1] if depth.max() == NO_READING else depth
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def read_bytes(path: Path) -> bytes:
    """Return a file's content.

    Raises:
        FrameError: it is missing, not a file, too large or unreadable.
    """
    try:
        if path.exists() and not path.is_file():
            raise FrameError(f"{path}: not a file")
        if path.stat().st_size > MAX_BYTES:
            raise FrameError(f"{path}: larger than {MAX_BYTES} bytes, the limit for up to {MAX_SIDE} pixels a side")
        return path.read_bytes()
    except FileNotFoundError:
        raise FrameError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        if isinstance(error, FrameError):
            raise
        raise FrameError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


def _decode(data: bytes, name: str, flags: int) -> np.ndarray:
    if not data:
        raise FrameError(f"{name}: empty file: download or copy it again")
    if data.startswith(PNG_SIGNATURE):
        _check_png(data, name)
    elif not _is_known(data):
        other = next((words for begin, words in IN_PLACE if data.lstrip().lower().startswith(begin)), None)
        raise FrameError(
            f"{name}: {other or f'not an image that OpenCV can decode (begins with {data[:8]!r}): convert it to PNG'}"
        )
    data = PFM_SCALE.sub(rb"\g<1>1", data, 1) if data.startswith((b"Pf", b"PF")) else _unturned(data, name)
    image = _decoded(data, flags, name)
    if image is None and flags == AS_COLOR:
        image = _decoded(data, AS_STORED, name)  # an intact image that is not colour: the caller says so
    if image is None:
        raise FrameError(f"{name}: truncated or damaged image: download or copy it again")
    if max(image.shape[:2]) > MAX_SIDE:
        height, width = image.shape[:2]
        raise FrameError(f"{name}: is {width}x{height} pixels: more than {MAX_SIDE} a side")
    return image


def _unturned(data: bytes, name: str) -> bytes:
    """Reset the orientation tag of a TIFF, which OpenCV would apply; other files are returned unchanged.

    Orientation tags are ignored in all formats, since colour and depth have to be aligned.

    Raises:
        FrameError: a TIFF of 16-bit floats, which OpenCV does not decode.
    """
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(data[:4])
    if order is None:
        return data
    tags: dict[int, int] = {}
    with contextlib.suppress(struct.error):  # truncated: OpenCV will fail on it
        (start,) = struct.unpack_from(f"{order}I", data, 4)
        (count,) = struct.unpack_from(f"{order}H", data, start)
        for at in range(start + 2, start + 2 + 12 * count, 12):
            tag, value = struct.unpack_from(f"{order}H6xH", data, at)
            tags[tag] = value
            if tag == TIFF_ORIENTATION:
                data = data[: at + 8] + struct.pack(f"{order}H", 1) + data[at + 10 :]
    if tags.get(TIFF_NUMBERS) == 3 and tags.get(TIFF_BITS) == 16:
        raise FrameError(f"{name}: a TIFF of 16-bit floats, which OpenCV does not decode: write 32 bits, or .npy")
    return data


def _decoded(data: bytes, flags: int, name: str) -> np.ndarray | None:
    """Decode a file with OpenCV; None if that fails.

    A damaged JPEG, of which libjpeg makes up a part with no more than a message on stderr, raises `FrameError`.
    """
    with without_lines(*JPEG_WORDS) if data.startswith(JPEG_SIGNATURE) else contextlib.nullcontext([]) as said:
        try:
            with without_log():
                image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except (cv2.error, MemoryError):
            image = None
    if any(map(JPEG_LOSS.search, said)):
        raise FrameError(f"{name}: damaged JPEG image, part of which is lost: download or copy it again")
    return image


SIGNATURES = (
    PNG_SIGNATURE,
    JPEG_SIGNATURE,
    b"BM",
    b"II*\0",
    b"MM\0*",
    b"II+\0",
    b"MM\0+",
    b"RIFF",
    b"\0\0\0\x0cjP",
    b"\xff\x4f\xff\x51",
    b"#?R",
    b"GIF8",
    *(b"P" + kind for kind in (b"1", b"2", b"3", b"4", b"5", b"6", b"7", b"f", b"F")),
)
"""First bytes of the formats that OpenCV decodes."""


WEB_PAGE = "a web page instead of an image: download or copy the file again"

IN_PLACE = (
    (b"version https://git-lfs", "a Git LFS pointer instead of the image: fetch it (git lfs pull)"),
    (b"<!doctype", WEB_PAGE),
    (b"<html", WEB_PAGE),
)
"""First bytes, in small letters, of what servers give in place of images, and what helps."""


def _is_known(data: bytes) -> bool:
    """Whether a file begins like an image that OpenCV decodes (AVIF's signature follows at byte 4)."""
    return data.startswith(SIGNATURES) or data[4:12] in (b"ftypavif", b"ftypavis")


def _check_png(data: bytes, name: str) -> None:
    """Refuse a PNG that is too large or has a damaged chunk: OpenCV silently decodes part of a truncated one."""
    at = len(PNG_SIGNATURE)
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(memoryview(data)[at + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise FrameError(f"{name}: damaged PNG image (checksum): download or copy it again")
        if at == len(PNG_SIGNATURE):
            if kind != b"IHDR" or length != 13:
                break
            width, height = struct.unpack_from(">II", data, at + 8)
            if max(width, height) > MAX_SIDE:
                raise FrameError(f"{name}: is {width}x{height} pixels: more than {MAX_SIDE} a side")
        if kind == b"IEND":
            return
        at = end + 4
    raise FrameError(f"{name}: truncated PNG image (no end): download or copy it again")


def _decode_npy(data: bytes, name: str) -> np.ndarray:
    file = io.BytesIO(data)
    try:
        image = np.load(file, allow_pickle=False)
    except Exception as error:  # of many types: NumPy parses a damaged header as Python
        raise FrameError(f"{name}: not a NumPy array of numbers: {' '.join(str(error).split())[:100]}") from None
    if not 2 <= image.ndim <= 3 or min(image.shape) == 0 or max(image.shape) > MAX_SIDE:
        raise FrameError(f"{name}: not an image: an array of shape {image.shape}")
    if image.dtype.kind not in "uif":
        raise FrameError(f"{name}: not an image: an array of {image.dtype}")
    return image.astype(image.dtype.newbyteorder("="))


def _decode_npz(data: bytes, name: str) -> np.ndarray:
    """Decode an archive of NumPy arrays: the array named depth, else the only one."""
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
        named = [entry for entry in archive.infolist() if entry.filename == "depth.npy"]
        chosen = named or archive.infolist()
        if len(chosen) != 1:
            found = ", ".join(entry.filename for entry in chosen)[:100] or "none"
            raise FrameError(f"{name}: one of several arrays has to be named depth: found {found}")
        if chosen[0].file_size > MAX_BYTES:
            raise FrameError(f"{name}: larger than {MAX_BYTES} bytes, the limit for up to {MAX_SIDE} pixels a side")
        content = archive.read(chosen[0])
    except FrameError:
        raise
    except Exception:  # of many types, depending on the compression
        raise FrameError(f"{name}: truncated or damaged archive of NumPy arrays: download or copy it again") from None
    return _decode_npy(content, name)


def _color_array(image: np.ndarray) -> np.ndarray:
    """Convert an array of grey, RGB or RGBA to BGR; any other is returned unchanged."""
    if image.ndim == 2 or image.shape[-1] == 1:
        return np.repeat(image.reshape(*image.shape[:2], 1), 3, axis=-1)
    return np.ascontiguousarray(image[..., 2::-1]) if image.shape[-1] in (3, 4) else image


def _decode_exr(data: bytes, name: str) -> np.ndarray:
    try:
        import OpenEXR  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise FrameError(
            f"{name}: OpenEXR images need the extra [exr] (pip install 'gavo-jax[exr]'); or use TIFF or .npy"
        ) from None
    with tempfile.NamedTemporaryFile(suffix=".exr") as file:  # the library only reads files
        file.write(data)
        file.flush()
        try:
            with without_words_on(file.name):
                channels = OpenEXR.File(file.name).channels()
        except Exception:  # of several undocumented types, with messages about internals
            raise FrameError(f"{name}: truncated or damaged OpenEXR image: download or copy it again") from None
    return _depth_channel(channels, name)


def _depth_channel(channels: Mapping[str, Any], name: str) -> np.ndarray:
    """Return the channel of an OpenEXR image named as depth, else the only one; equal colour channels count as one."""
    parts = {key: key.lower().split(".") for key in channels}
    named = [key for key in channels if parts[key][-1] in ("z", "d") or any("depth" in part for part in parts[key])]
    chosen = named or list(channels)
    if len(chosen) != 1:
        found = ", ".join(chosen)[:100] or "none"
        raise FrameError(f"{name}: one channel of this OpenEXR image has to be depth, named Z: found {found}")
    pixels = np.asarray(channels[chosen[0]].pixels)
    if pixels.ndim == 3 and not _is_grey(pixels):
        raise FrameError(f"{name}: a colour OpenEXR image ({chosen[0]}) without a depth channel named Z")
    return pixels[..., 0] if pixels.ndim == 3 else pixels


def _describe(image: np.ndarray) -> str:
    channels = 1 if image.ndim == 2 else image.shape[-1]
    kind = {"f": "floats of ", "i": "signed ", "u": ""}.get(image.dtype.kind, f"{image.dtype} of ")
    return f"{channels} channel{'s' * (channels != 1)} of {kind}{8 * image.dtype.itemsize} bits"
