"""Checks that the images a run has seen are unchanged when it is resumed."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

TAIL = 64
"""Bytes read at a file's end. In a PNG they hold the checksum of all pixels, so that nothing else is needed."""


class SeenImages:
    """A digest of image files, updated frame by frame.

    Args:
        files: Files of each frame, in order; empty if frames do not come from files.
    """

    def __init__(self, files: Sequence[Sequence[Path]] = ()) -> None:
        self._files, self._count, self._sha256 = files, 0, hashlib.sha256()

    def up_to(self, index: int) -> str:
        """Add the frames up to an index, and return the digest of all so far."""
        for paths in self._files[self._count : index + 1]:
            for path in paths:
                self._sha256.update(_fingerprint(path))
        self._count = max(self._count, index + 1)
        return self._sha256.hexdigest()


def _fingerprint(path: Path) -> bytes:
    """Return a hash of a file's size and last bytes, or zeros if it is unreadable."""
    try:
        with path.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(size - TAIL, 0))
            return hashlib.sha256(size.to_bytes(8) + file.read(TAIL)).digest()
    except OSError:
        return bytes(32)
