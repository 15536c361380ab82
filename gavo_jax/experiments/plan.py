"""Runs that are to be made: of which frames, with what, and which of them together."""

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
    """As tables call it."""
    path: str
    """A folder, or the word synthetic."""
    camera: str = "auto"
    start: int = 0
    frames: int | None = None
    stride: int = 1

    def open(self) -> FrameSequence:
        """Return the frames, checked.

        Raises:
            GavoError: as `open_part`.
        """
        return open_part(self.path, self.camera, self.start, self.frames, self.stride)


@dataclass(frozen=True)
class Run:
    """One run, ready to go.

    Attributes:
        id: Hash of everything below and of the frames' stamps and camera: equal runs have equal ones everywhere.
        part: Which frames.
        pairs: How many pairs these make.
        pixels: Of one image.
        method: One of `presets.methods()`, or a peer.
        preset: Name of the preset; empty for a peer.
        variant: The settings that differ from the preset's, in words; mostly empty.
        seed: None for a peer, which has none.
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
    """What one batch takes of a Ray cluster: processors, and GPUs (None: one where the cluster has any)."""

    cpus: float = 2.0
    gpus: float | None = None


@dataclass(frozen=True)
class Plan:
    """What an experiment's file asks for.

    Attributes:
        name: Of the experiment.
        folder: Where the results go.
        runs: All runs, sequence by sequence.
        skipped: A line for each optional sequence that is not here.
        printed: Drift that a publication gives, by (sequence, method's label), m/s.
        batch: Most runs that are tracked together.
        ray: What a batch takes of a Ray cluster.
    """

    name: str
    folder: Path
    runs: tuple[Run, ...]
    skipped: tuple[str, ...]
    printed: Mapping[tuple[str, str], float]
    batch: int
    ray: RayOptions


def batches(runs: Iterable[Run], size: int) -> list[Batch]:
    """Put runs of one part and one program together, at most `size` of them; peers go one by one, and so do runs with a
    map.
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
    """Number of distinct compiled programs that the runs take."""
    return len({(run.pixels, program_of(run.settings)) for run in runs if run.settings is not None})


def configuration(run: Run, frames: Mapping[str, Any]) -> dict[str, Any]:
    """The full configuration of a run on frames as `frames_of` tells them, without what belongs to a machine: equal
    ones are one run.
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
    """Which frames a sequence has, by which camera, and what is true of them, without where they lie.

    Of the images the first, the middle and the last tell: two recordings may have the same name, stamps and camera.
    """
    stamps = np.ascontiguousarray(sequence.timestamps, np.float64)
    images, truth = hashlib.sha256(), sequence.ground_truth
    for index in sorted({0, len(sequence) // 2, len(sequence) - 1}):
        try:
            frame = sequence[index]
            images.update(np.asarray(frame.grey).tobytes() + np.asarray(frame.depth).tobytes())
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
        "truth_sha256": None if truth is None else hashlib.sha256(truth.world_T_camera.tobytes()).hexdigest(),
    }
