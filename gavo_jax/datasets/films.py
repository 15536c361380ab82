"""Colour recorded as a film beside depth images: a frame has the path FILM/000012, as if the film were a folder.

Frames are decoded in sequence. To go back, the film is decoded from its beginning, as seeking is not reliable in films.
"""

import os
import threading
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from gavo_jax.datasets.base import FrameError
from gavo_jax.datasets.quiet import without_log
from gavo_jax.errors import GavoError

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read once; else FFmpeg's threads write to stderr

FILMS = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm", ".mpg", ".mpeg")
"""Suffixes of films; whether one can be decoded only shows when it is opened."""

MOST_FRAMES = 10**6
"""Frames of nine hours; a film that claims more is treated as having none."""

_READING = threading.Lock()
"""Held while a frame is decoded: only one thread may read a film at a time."""


def film_of(place: Path) -> Path | None:
    """The film that contains a frame; None for an image file."""
    film = place.parent
    return film if film.suffix.lower() in FILMS and film.is_file() else None


def file_of(place: Path) -> Path:
    """The file that holds an image: the film or the image file itself."""
    return film_of(place) or place


def frames_of(film: Path) -> list[Path]:
    """Paths of the frames that a film claims to have; none where it cannot be decoded."""
    try:
        with _READING:
            count = _opened(film).count
    except GavoError:
        return []
    return [film / f"{number:06}" for number in range(count)] if count < MOST_FRAMES else []


def rate_of(film: Path) -> float:
    """Frames per second according to the film; 0 where it does not say.

    Raises:
        GavoError: it cannot be decoded.
    """
    with _READING:
        return _opened(film).rate


def read_frame(place: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Decode a frame, BGR, as it was recorded: a rotation tag is ignored, as depth isn't rotated either.

    Raises:
        FrameError: the film cannot be decoded, or not up to that frame.
    """
    film = place.parent
    with _READING:
        try:
            image = _opened(film).read(int(place.name))
        except GavoError as error:
            raise FrameError(str(error)) from None
    if image is None:
        raise FrameError(f"{film}: frame {int(place.name)}: the film cannot be decoded that far")
    return image


def _opened(film: Path) -> "_Film":
    return _open_film(film, *_written(film))


def _written(film: Path) -> tuple[int, int, int]:
    """Cache key of an open film: modification time, size and process (files may be replaced, and forks read alone)."""
    try:
        status = film.stat()
    except OSError as error:
        raise GavoError(f"{film}: {error.strerror}") from None
    return status.st_mtime_ns, status.st_size, os.getpid()


@lru_cache(maxsize=1)
def _open_film(film: Path, written: int, size: int, process: int) -> "_Film":
    return _Film(film)


class _Film:
    """A film that is open at one of its frames.

    Attributes:
        count: frames, as it claims.
        rate: frames per second, as it claims.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._open()
        self.count = round(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self.rate = float(self._capture.get(cv2.CAP_PROP_FPS))

    def _open(self) -> None:
        with without_log():
            self._capture = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG)
        if not self._capture.isOpened():
            raise GavoError(f"{self._path}: the film cannot be decoded: write its frames as images")
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        self._next = 0

    def read(self, number: int) -> UInt8[np.ndarray, "h w 3"] | None:
        """Return a frame; None where the film ends before it."""
        if number < self._next:
            self._open()
        with without_log():
            while self._next < number and self._capture.grab():
                self._next += 1
            is_there, image = self._capture.read() if self._next == number else (False, None)
        if not is_there or image is None:
            self._next = MOST_FRAMES  # the position is unknown: reopen
            return None
        self._next += 1
        return np.asarray(image)
