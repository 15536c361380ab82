"""A custom dataset: frames stored as arrays in one .npz file.

Run it as `python examples/own_dataset.py [FILE.npz]`; without a file it writes one from the synthetic room first.
"""

import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import overload

import numpy as np

import gavo_jax as gavo


@dataclass(frozen=True)
class ArraySequence:
    """Frames from `grey`, `depth` and `timestamps` of equal length; see `gavo.Sequence` for the required interface."""

    name: str
    camera: gavo.Camera
    grey: np.ndarray
    depth: np.ndarray
    timestamps: np.ndarray
    ground_truth: gavo.Trajectory | None = None

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.timestamps)

    @overload
    def __getitem__(self, index: int) -> gavo.Frame: ...
    @overload
    def __getitem__(self, index: slice) -> "ArraySequence": ...
    def __getitem__(self, index: int | slice) -> "gavo.Frame | ArraySequence":
        """Return a frame, or for a slice a sequence."""
        if isinstance(index, slice):
            return replace(self, grey=self.grey[index], depth=self.depth[index], timestamps=self.timestamps[index])
        return gavo.Frame(self.grey[index], self.depth[index], float(self.timestamps[index]))

    def __iter__(self) -> Iterator[gavo.Frame]:
        """Iterate over the frames."""
        return (self[i] for i in range(len(self)))

    def check(self) -> None:
        """Check the whole sequence before a run."""
        if not len(self.grey) == len(self.depth) == len(self.timestamps):
            raise gavo.GavoError(f"{self.name}: grey, depth and timestamps differ in length")


def main(file: str | None = None, frames: int = 10) -> gavo.OdometryRun:
    """Track the frames of a file; its camera is the synthetic room's."""
    gavo.enable_compilation_cache()
    room = gavo.SyntheticSequence(frames=frames)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(file or f"{folder}/room.npz")
        if file is None:
            grey, depth = np.stack([frame.grey for frame in room]), np.stack([frame.depth for frame in room])
            np.savez(path, grey=grey, depth=depth, timestamps=room.timestamps)
        arrays = np.load(path)
        sequence = ArraySequence(path.stem, room.camera, arrays["grey"], arrays["depth"], arrays["timestamps"])
    run = gavo.run_odometry(sequence, gavo.preset("ga", "fast"))
    print(f"{sequence.name}: {run.metrics['frames']} frames, {run.metrics['lost_pairs']} pairs lost")
    return run


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None)
