"""What damaged frames do to a run: every fault at five places of one clip, and false alarms on clean clips.

Each fault is put into the clip at evenly spaced places, in runs of its own. Prints a row a fault: whether the run came
through, the share of the damaged pairs whose status is not ok, the share of the other pairs whose status is not ok, and
the drift (RPE over 1 s, RMSE) over the frames that were left alone, beside that of the clean run over the very same
frames. Then a row a clip: the share of the pairs of a clean run whose status is not ok.

    python benchmarks/faults.py
    python benchmarks/faults.py --method gauss-newton --json faults.json

On 2 cores the defaults take about 5 minutes.
"""

import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import common
import cv2
import numpy as np

from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.base import Sequence as FrameSequence
from gavo_jax.datasets.tum import read_frame
from gavo_jax.errors import GavoError
from gavo_jax.evaluation import relative_pose_error
from gavo_jax.odometry.driver import Step, track
from gavo_jax.odometry.run import trajectory_of
from gavo_jax.output.screen import number, print_table
from gavo_jax.trajectory import Trajectory

PLACES = 5
DROPPED = 3
"""Frames in a row that go missing."""

Alter = Callable[[FrameSequence, int, Frame], Frame]


class Damaged:
    """A sequence with altered frames, missing frames or altered stamps; everything else is the clip's."""

    def __init__(
        self,
        clip: FrameSequence,
        places: list[int],
        alter: Alter | None = None,
        dropped: int = 0,
        shift: float | None = None,
    ) -> None:
        """Damage a clip.

        Args:
            clip: the frames.
            places: of the clip's frames.
            alter: makes the damaged frame of each place; may raise FrameError.
            dropped: frames that go missing from each place on.
            shift: seconds from the last stamp to the stamp of each place.
        """
        self.clip, self.camera, self.name, self.ground_truth = clip, clip.camera, clip.name, clip.ground_truth
        missing = {place + i for place in places for i in range(dropped)}
        self.kept = [i for i in range(len(clip)) if i not in missing]
        self.damaged = {self.kept.index(place + dropped) for place in places}
        self.alter = alter
        self.timestamps = clip.timestamps[self.kept].copy()
        if shift is not None:
            for i in self.damaged:
                self.timestamps[i] = self.timestamps[i - 1] + shift

    def __len__(self) -> int:
        return len(self.kept)

    def __getitem__(self, index: int) -> Frame:
        frame = replace(self.clip[self.kept[index]], timestamp=float(self.timestamps[index]))
        if self.alter is not None and index in self.damaged:
            return self.alter(self.clip, self.kept[index], frame)
        return frame


def with_grey(make: Callable[[np.ndarray], np.ndarray]) -> Alter:
    """Damage of the grey image."""
    return lambda clip, index, frame: replace(frame, grey=make(frame.grey))


def with_depth(make: Callable[[np.ndarray], np.ndarray]) -> Alter:
    """Damage of the depth image."""
    return lambda clip, index, frame: replace(frame, depth=make(frame.depth))


def half_missing(depth: np.ndarray) -> np.ndarray:
    """Depth without its left half."""
    return np.where(np.arange(depth.shape[1]) < depth.shape[1] // 2, 0, depth).astype(depth.dtype)


def not_a_number(grey: np.ndarray) -> np.ndarray:
    """The image as floats, a tenth of its rows not a number."""
    values = grey.astype(np.float32)
    values[: len(values) // 10] = np.nan
    return values


def torn(clip: FrameSequence, index: int, frame: Frame) -> Frame:
    """What reading the frame from files gives, of which the colour image ends in the middle."""
    with tempfile.TemporaryDirectory() as name:
        color, depth = Path(name) / "color.png", Path(name) / "depth.png"
        data = cv2.imencode(".png", frame.grey)[1].tobytes()
        color.write_bytes(data[: len(data) // 2])
        depth.write_bytes(cv2.imencode(".png", frame.depth)[1].tobytes())
        return read_frame(color, depth, clip.camera, frame.timestamp)


def noise(grey: np.ndarray) -> np.ndarray:
    """Independent grey levels, evenly spread."""
    return np.random.default_rng(0).integers(0, 256, grey.shape).astype(grey.dtype)


FAULTS: dict[str, dict[str, Any]] = {
    "black": {"alter": with_grey(np.zeros_like)},
    "white": {"alter": with_grey(lambda grey: np.full_like(grey, 255))},
    "saturated": {"alter": with_grey(lambda grey: np.minimum(grey.astype(int) * 3, 255).astype(grey.dtype))},
    "noise": {"alter": with_grey(noise)},
    "frozen duplicate": {"alter": lambda clip, index, frame: replace(clip[index - 1], timestamp=frame.timestamp)},
    "no depth": {"alter": with_depth(np.zeros_like)},
    "half the depth": {"alter": with_depth(half_missing)},
    "depth in millimetres": {"alter": with_depth(lambda depth: (depth // 5).astype(depth.dtype))},
    "not a number": {"alter": with_grey(not_a_number)},
    "truncated PNG": {"alter": torn},
    "dropped frames": {"dropped": DROPPED},
    "stamp out of order": {"shift": -0.01},
    "equal stamps": {"shift": 0.0},
}


class Row(NamedTuple):
    """What one fault did."""

    fault: str
    crashed: bool
    flagged: float
    """Share of the damaged pairs."""
    false_alarms: float
    """Share of the other pairs."""
    drift: float
    """m/s, over the frames left alone; median over the seeds."""
    clean_drift: float
    statuses: dict[str, int]
    """Of the damaged pairs."""

    @property
    def ratio(self) -> float:
        """Drift against the clean run's."""
        return self.drift / self.clean_drift


def drift(trajectory: Trajectory, stamps: np.ndarray, truth: Trajectory) -> float:
    """Drift over the poses of some stamps, m/s."""
    chosen = np.isin(trajectory.timestamps, stamps)
    part = Trajectory(trajectory.timestamps[chosen], trajectory.world_T_camera[chosen])
    return relative_pose_error(part, truth).translation.rmse


def follow(sequence: Any, contender: common.Contender, seed: int) -> tuple[list[Step], Trajectory]:
    """Steps and trajectory of one run."""
    steps = list(track(sequence, odometry=contender.make(sequence.camera, seed)))
    return steps, trajectory_of(float(sequence.timestamps[0]), steps)


def measure(
    fault: str, clip: FrameSequence, clean: list[Trajectory], contender: common.Contender, truth: Trajectory
) -> Row:
    """One fault, a run a seed."""
    places = [len(clip) * (i + 1) // (PLACES + 1) for i in range(PLACES)]
    flagged, alarms, drifts, clean_drifts = [], [], [], []
    statuses: Counter[str] = Counter()
    for seed, reference in enumerate(clean):
        sequence = Damaged(clip, places, **FAULTS[fault])
        try:
            steps, trajectory = follow(sequence, contender, seed)
        except Exception as error:
            print(f"{fault}: {type(error).__name__}: {error}")
            return Row(fault, True, 0.0, 0.0, np.nan, np.nan, {})
        for step in steps:
            (flagged if step.index in sequence.damaged else alarms).append(step.alignment.status.value != 0)
        statuses.update(s.alignment.status.name.lower() for s in steps if s.index in sequence.damaged)
        alone = [stamp for i, stamp in enumerate(sequence.timestamps) if i not in sequence.damaged]
        drifts.append(drift(trajectory, np.array(alone), truth))
        clean_drifts.append(drift(reference, np.array(alone), truth))
    medians = float(np.median(drifts)), float(np.median(clean_drifts))
    return Row(fault, False, float(np.mean(flagged)), float(np.mean(alarms)), *medians, dict(statuses))


def main(
    clip: str = "fr1_xyz",
    clips: str = common.CLIPS,
    method: str = "ga",
    faults: str = ",".join(FAULTS),
    seeds: int = 1,
    json: Path | None = None,
) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clip: the clip to damage.
        clips: clean clips to count false alarms on, with commas between.
        method: METHOD or METHOD:PRESET.
        faults: names with commas between.
        seeds: runs of each fault.
        json: file for the figures.
    """
    contender = common.parse_methods(method)[0]
    for name in common.names(faults):
        if name not in FAULTS:
            raise GavoError(f"unknown fault {name!r}: not one of {', '.join(FAULTS)}")
    sequence = common.open_clip(clip)
    if sequence.ground_truth is None:
        raise GavoError(f"{clip}: no ground truth")
    clean = [follow(sequence, contender, seed)[1] for seed in range(seeds)]
    rows = [measure(name, sequence, clean, contender, sequence.ground_truth) for name in common.names(faults)]
    cells = [
        [
            row.fault,
            "crashed" if row.crashed else "through",
            f"{row.flagged:.0%}",
            f"{row.false_alarms:.1%}",
            number(row.drift, 4),
            number(row.clean_drift, 4),
            number(row.ratio, 3),
            ", ".join(row.statuses),
        ]
        for row in rows
    ]
    columns = ("fault", "run", "flagged", "others flagged", "m/s", "clean m/s", "ratio", "statuses")
    print_table(f"{PLACES} places of {clip}, {contender.name}", columns, cells)
    alarms = []
    for name in common.names(clips):
        counts = Counter(step.alignment.status.name.lower() for step in follow(common.open_clip(name), contender, 0)[0])
        pairs = counts.total()
        alarms.append(
            {"clip": name, "pairs": pairs, "false_alarms": 1 - counts["ok"] / pairs, "statuses": dict(counts)}
        )
    cells = [[row["clip"], row["pairs"], f"{row['false_alarms']:.1%}", str(row["statuses"])] for row in alarms]
    print_table("clean clips", ("clip", "pairs", "flagged", "statuses"), cells)
    results = {"faults": [{**row._asdict(), "ratio": row.ratio} for row in rows], "clean": alarms}
    common.record(json, "faults", results)
    return results


if __name__ == "__main__":
    common.command(main)
