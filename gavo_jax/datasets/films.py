"""Colour that was recorded as a film beside images of depth: a frame's place is FILM/000012, as if it were a folder.

Frames come in the order of their numbers: one that lies behind is sought from the beginning, as no film tells for sure
where to find it.
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

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read once: it would write on standard error, by its own threads

FILMS = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm", ".mpg", ".mpeg")
"""Endings of films; whether one can be decoded, only opening it tells."""

MOST_FRAMES = 10**6
"""Frames of nine hours: a film that claims more is taken for one of none."""

_READING = threading.Lock()
"""Held while a frame is decoded: a film is read by one at a time."""


def film_of(place: Path) -> Path | None:
    """The film that a frame lies in; None for an image that is a file of its own."""
    film = place.parent
    return film if film.suffix.lower() in FILMS and film.is_file() else None


def file_of(place: Path) -> Path:
    """The file that an image lies in, be it a film."""
    return film_of(place) or place


def frames_of(film: Path) -> list[Path]:
    """Places of the frames that a film claims to have; none where it cannot be decoded."""
    try:
        with _READING:
            count = _opened(film).count
    except GavoError:
        return []
    return [film / f"{number:06}" for number in range(count)] if count < MOST_FRAMES else []


def rate_of(film: Path) -> float:
    """Frames per second that a film claims to have; 0 where it does not say it.

    Raises:
        GavoError: it cannot be decoded.
    """
    with _READING:
        return _opened(film).rate


def read_frame(place: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Decode a frame, BGR, as it was recorded: what says that it is to be turned is left aside, as depth lies like it.

    Raises:
        FrameError: the film cannot be decoded, or not as far as that.
    """
    film = place.parent
    with _READING:
        try:
            image = _opened(film).read(int(place.name))
        except GavoError as error:
            raise FrameError(str(error)) from None
    if image is None:
        raise FrameError(f"{film}: frame {int(place.name)}: the film cannot be decoded as far as that")
    return image


def _opened(film: Path) -> "_Film":
    return _open_film(film, *_written(film))


def _written(film: Path) -> tuple[int, int, int]:
    """When a film was written, its size, and the process: another may come to its place, and forks have places of their
    own in it.
    """
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
            raise GavoError(f"{self._path}: no film that can be decoded: write its frames as images")
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        self._next = 0

    def read(self, number: int) -> UInt8[np.ndarray, "h w 3"] | None:
        """Return a frame; None where the film ends before."""
        if number < self._next:
            self._open()
        with without_log():
            while self._next < number and self._capture.grab():
                self._next += 1
            is_there, image = self._capture.read() if self._next == number else (False, None)
        if not is_there or image is None:
            self._next = MOST_FRAMES  # where it stands is open: begin anew
            return None
        self._next += 1
        return np.asarray(image)
