"""The runs of an experiment: their frames and settings, and the batches they form."""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gavo_jax.datasets.base import FrameError
from gavo_jax.datasets.base import Sequence as FrameSequence
from gavo_jax.datasets.selection import open_part
from gavo_jax.experiments.together import program_of
from gavo_jax.output.files import describe
from gavo_jax.settings import Settings


@dataclass(frozen=True)
class Part:
    """Frames of one sequence."""

    name: str
    """Name in tables."""
    path: str
    """A folder, or `synthetic`."""
    camera: str = "auto"
    start: int = 0
    frames: int | None = None
    stride: int = 1

    def open(self) -> FrameSequence:
        """Open the frames and check them.

        Raises:
            GavoError: as `open_part`.
        """
        return open_part(self.path, self.camera, self.start, self.frames, self.stride)


@dataclass(frozen=True)
class Run:
    """One run, ready to go.

    Attributes:
        id: Hash of the run's `configuration`: equal runs have equal hashes on every machine.
        part: Frames to track.
        pairs: Number of pairs of successive frames.
        pixels: Number of pixels of an image.
        method: One of `presets.methods()`, or a peer.
        preset: Name of the preset; empty for a peer.
        variant: Settings that differ from the preset's, as text; usually empty.
        seed: Random seed; None for a peer.
        settings: Effective settings; None for a peer.
    """

    id: str = field(compare=False)
    part: Part
    pairs: int
    pixels: int
    method: str
    preset: str
    variant: str
    seed: int | None
    settings: Settings | None

    @property
    def label(self) -> str:
        """Name of method, preset and variant in tables."""
        name = self.method if self.preset in ("", "default") else f"{self.method}, {self.preset}"
        return f"{name}, {self.variant}" if self.variant else name


@dataclass(frozen=True)
class Batch:
    """Runs of one program over the same frames, tracked together."""

    part: Part
    runs: tuple[Run, ...]


@dataclass(frozen=True)
class RayOptions:
    """Processors and GPUs that a batch takes on a Ray cluster (`gpus` None: one GPU if the cluster has any)."""

    cpus: float = 2.0
    gpus: float | None = None


@dataclass(frozen=True)
class Plan:
    """The contents of an experiment's file, checked and laid out as runs.

    Attributes:
        name: Name of the experiment.
        folder: Folder for the results.
        runs: All runs, sequence by sequence.
        skipped: One line for each missing optional sequence or peer.
        printed: Published drift by (sequence, label), m/s.
        batch: Largest number of runs that are tracked together.
        ray: Resources that a batch takes on a Ray cluster.
    """

    name: str
    folder: Path
    runs: tuple[Run, ...]
    skipped: tuple[str, ...]
    printed: Mapping[tuple[str, str], float]
    batch: int
    ray: RayOptions


def batches(runs: Iterable[Run], size: int) -> list[Batch]:
    """Group runs of the same frames and program into batches of at most `size`.

    A peer or a run with a map is a batch of its own.
    """
    groups: dict[Any, list[Run]] = {}
    for run in runs:
        together = run.id if run.settings is None or run.settings.odometry.loops else program_of(run.settings)
        groups.setdefault((run.part, run.method, together), []).append(run)
    return [
        Batch(group[0].part, tuple(group[first : first + size]))
        for group in groups.values()
        for first in range(0, len(group), size)
    ]


def programs(runs: Iterable[Run]) -> int:
    """Number of distinct compiled programs that the runs need."""
    return len({(run.pixels, program_of(run.settings)) for run in runs if run.settings is not None})


def configuration(run: Run, frames: Mapping[str, Any]) -> dict[str, Any]:
    """The full configuration of a run, without anything specific to a machine: equal configurations are one run.

    Args:
        run: The run; its id is not used.
        frames: Its frames, as described by `frames_of`.
    """
    return describe(
        {
            "sequence": frames,
            "method": run.method,
            "preset": run.preset,
            "variant": run.variant,
            "seed": run.seed,
            "settings": run.settings,
        }
    )


def frames_of(name: str, sequence: FrameSequence) -> dict[str, Any]:
    """Describe a sequence's frames, camera and ground truth by value, without file paths.

    Hashes of the first, middle and last image, and of when their depth was taken, tell apart recordings of the same
    name, timestamps and camera.
    """
    stamps = np.ascontiguousarray(sequence.timestamps, np.float64)
    images, truth, true_poses = hashlib.sha256(), sequence.ground_truth, hashlib.sha256()
    for part in () if truth is None else (truth.world_T_camera, truth.timestamps, truth.segments):
        true_poses.update(np.ascontiguousarray(part).tobytes())
    for index in sorted({0, len(sequence) // 2, len(sequence) - 1}):
        try:
            frame = sequence[index]
            images.update(np.asarray(frame.grey).tobytes() + np.asarray(frame.depth).tobytes())
            images.update(np.float64(frame.depth_delay).tobytes())
        except FrameError:
            images.update(b"unreadable")
    return {
        "name": name,
        "frames": len(sequence),
        "first_timestamp": float(stamps[0]),
        "last_timestamp": float(stamps[-1]),
        "timestamps_sha256": hashlib.sha256(stamps.tobytes()).hexdigest(),
        "camera": sequence.camera,
        "images_sha256": images.hexdigest(),
        "truth_sha256": None if truth is None else true_poses.hexdigest(),
    }
