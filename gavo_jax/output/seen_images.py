"""Checks that the images a run has seen are unchanged when it is resumed."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

BLOCKS, BLOCK = 16, 4096
"""Number of blocks that are read of a file, spread evenly from its first to its last bytes, and their size in bytes.
The last bytes of a PNG hold the checksum of all pixels; other formats have none.
"""


class SeenImages:
    """A digest of image files, updated frame by frame.

    Args:
        files: Files of each frame, in order; none of a frame whose images are in a file of an earlier one.
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
    """Return a hash of a file's size and some of its bytes, or zeros if it is unreadable."""
    try:
        with path.open("rb") as file:
            size = file.seek(0, 2)
            seen = hashlib.sha256(size.to_bytes(8))
            for block in range(BLOCKS):
                file.seek(max(size - BLOCK, 0) * block // (BLOCKS - 1))
                seen.update(file.read(BLOCK))
                if size <= BLOCK:
                    break
            return seen.digest()
    except OSError:
        return bytes(32)
