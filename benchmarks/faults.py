"""Robustness to damaged frames: every fault at five places of each clip, and false alarms on clean clips.

Each fault is injected at evenly spaced places of the clip, in runs of its own. Prints for each clip and fault:

- whether the run finished;
- the share of the damaged pairs, and of the other pairs, whose status is not ok;
- how many pairs are off by more than 5 cm or 3 degrees, and how many of these are ok;
- drift (RPE over 1 s, RMSE) over the undamaged frames, also over the clean run's on the same frames.

Then one row per clip: the share of the pairs of a clean run whose status is not ok.

    python benchmarks/faults.py
    python benchmarks/faults.py --method gauss-newton --json faults.json

On 2 cores the defaults take about 20 minutes.
"""

import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import common
import cv2
import numpy as np

from gavo_jax.camera_files.calibration import Calibration
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.base import Sequence as FrameSequence
from gavo_jax.datasets.files import open_pair
from gavo_jax.errors import GavoError
from gavo_jax.evaluation import relative_pose_error
from gavo_jax.odometry.driver import Step
from gavo_jax.odometry.hindsight import revised
from gavo_jax.odometry.run import trajectory_of
from gavo_jax.odometry.stream import track
from gavo_jax.output.screen import number
from gavo_jax.rigid_motions import length_and_angle
from gavo_jax.trajectory import Trajectory, inverse

PLACES = 5
DROPPED = 3
"""Consecutive frames that are dropped."""
WRONG = (0.05, 3.0)
"""Metres and degrees: a pair is wrong if its motion is further from the truth."""

Alter = Callable[[FrameSequence, int, Frame], Frame]


class Damaged:
    """A clip with altered frames, other frames in their place, or altered stamps.

    Attributes:
        sources: For each frame, the index of the clip's frame whose images it has.
        timestamps: Timestamp of each frame, as given to the odometry.
        moments: Time at which the truth of each frame is taken, seconds.
        alter: For some frames, the function that damages them; may raise FrameError.
        damaged: Indices of the frames that differ from the clip's, or follow another frame than in the clip.
    """

    def __init__(self, clip: FrameSequence, sources: list[int]) -> None:
        """Take the given frames of a clip, with their timestamps."""
        self.clip, self.camera, self.name, self.ground_truth = clip, clip.camera, clip.name, clip.ground_truth
        self.sources = sources
        self.timestamps = clip.timestamps[sources].copy()
        self.moments = self.timestamps.copy()
        self.alter: dict[int, Alter] = {}
        self.damaged: set[int] = set()

    def __len__(self) -> int:
        return len(self.sources)

    def __getitem__(self, index: int) -> Frame:
        frame = self.clip[self.sources[index]]
        stamp = float(self.timestamps[index])
        frame = replace(frame, timestamp=stamp, depth_timestamp=stamp + frame.depth_delay)
        return self.alter[index](self.clip, self.sources[index], frame) if index in self.alter else frame


Fault = Callable[[FrameSequence, list[int]], Damaged]
"""Damages a clip at some places."""


def altered(alter: Alter, count: int = 1) -> Fault:
    """Alter `count` consecutive frames at each place."""

    def damage(clip: FrameSequence, places: list[int]) -> Damaged:
        sequence = Damaged(clip, list(range(len(clip))))
        sequence.damaged = {place + i for place in places for i in range(count) if place + i < len(clip)}
        sequence.alter = dict.fromkeys(sequence.damaged, alter)
        return sequence

    return damage


def every_frame(alter: Alter) -> Callable[[FrameSequence], Damaged]:
    """Alter all frames."""

    def change(clip: FrameSequence) -> Damaged:
        sequence = Damaged(clip, list(range(len(clip))))
        sequence.alter = dict.fromkeys(range(len(clip)), alter)
        return sequence

    return change


def with_grey(make: Callable[[np.ndarray], np.ndarray], count: int = 1) -> Fault:
    """Damage the grey image of some frames."""
    return altered(lambda clip, index, frame: replace(frame, grey=make(frame.grey)), count)


def of_depth(make: Callable[[np.ndarray], np.ndarray]) -> Alter:
    """Damage the depth image of a frame."""
    return lambda clip, index, frame: replace(frame, depth=make(frame.depth).astype(frame.depth.dtype))


def late(frames: int) -> Alter:
    """Replace a frame's depth by that of `frames` frames before, under its own timestamp."""
    return lambda clip, index, frame: replace(frame, depth=clip[max(index - frames, 0)].depth)


def with_depth(make: Callable[[np.ndarray], np.ndarray], count: int = 1) -> Fault:
    """Damage the depth image of some frames."""
    return altered(of_depth(make), count)


def dropped(count: int, restamped: bool = False) -> Fault:
    """Drop consecutive frames; with `restamped` the timestamps continue without a gap."""

    def damage(clip: FrameSequence, places: list[int]) -> Damaged:
        missing = {place + i for place in places for i in range(count)}
        sequence = Damaged(clip, [i for i in range(len(clip)) if i not in missing])
        sequence.damaged = {sequence.sources.index(place + count) for place in places if place + count < len(clip)}
        if restamped:
            sequence.timestamps = clip.timestamps[: len(sequence)].copy()
        return sequence

    return damage


def shifted_stamp(seconds: float) -> Fault:
    """Set a frame's timestamp to `seconds` after the previous one."""

    def damage(clip: FrameSequence, places: list[int]) -> Damaged:
        sequence = Damaged(clip, list(range(len(clip))))
        sequence.damaged = set(places)
        for i in places:
            sequence.timestamps[i] = sequence.timestamps[i - 1] + seconds
        return sequence

    return damage


def delayed(seconds: float) -> Fault:
    """Stamp a frame `seconds` late, and those that it holds up 2 ms apart, as a driver does that stamps on arrival."""

    def damage(clip: FrameSequence, places: list[int]) -> Damaged:
        sequence = Damaged(clip, list(range(len(clip))))
        sequence.timestamps[places] += seconds
        for i in range(1, len(clip)):
            sequence.timestamps[i] = max(sequence.timestamps[i], sequence.timestamps[i - 1] + 0.002)
        sequence.damaged = set(np.flatnonzero(sequence.timestamps != sequence.moments).tolist())
        return sequence

    return damage


def stale(age: int) -> Fault:
    """Replace a frame's images by those of `age` frames before."""

    def damage(clip: FrameSequence, places: list[int]) -> Damaged:
        sequence = Damaged(clip, list(range(len(clip))))
        sequence.damaged = {i for i in places if i >= age}
        for i in sequence.damaged:
            sequence.sources[i] = i - age
        return sequence

    return damage


def swapped(apart: int) -> Fault:
    """Exchange a frame's images with those of the frame `apart` frames later."""

    def damage(clip: FrameSequence, places: list[int]) -> Damaged:
        sequence = Damaged(clip, list(range(len(clip))))
        sequence.damaged = {i + j for i in places for j in (0, apart)}
        for i in places:
            sequence.sources[i], sequence.sources[i + apart] = i + apart, i
        return sequence

    return damage


def exchanged_stamps(clip: FrameSequence, places: list[int]) -> Damaged:
    """Exchange the timestamps of a frame and the next one."""
    sequence = Damaged(clip, list(range(len(clip))))
    sequence.damaged = {i + j for i in places for j in (0, 1)}
    for i in places:
        sequence.timestamps[[i, i + 1]] = sequence.timestamps[[i + 1, i]]
    sequence.moments = sequence.timestamps.copy()
    return sequence


def duplicated(clip: FrameSequence, places: list[int]) -> Damaged:
    """Repeat every frame half an interval later, with jitter in its grey levels."""
    del places
    sequence = Damaged(clip, [i for i in range(len(clip)) for _ in (0, 1)])
    halves = np.diff(clip.timestamps) / 2
    sequence.timestamps[1::2] += np.append(halves, np.median(halves))
    sequence.moments = sequence.timestamps.copy()
    sequence.damaged = set(range(1, len(sequence), 2))
    sequence.alter = dict.fromkeys(sequence.damaged, jitter)
    return sequence


def jitter(clip: FrameSequence, index: int, frame: Frame) -> Frame:
    """Change each pixel by at most one grey level, at random."""
    change = np.random.default_rng(index).integers(-1, 2, frame.grey.shape)
    return replace(frame, grey=np.clip(frame.grey + change, 0, 255).astype(frame.grey.dtype))


def two_metres(clip: FrameSequence, index: int, frame: Frame) -> Frame:
    """Set all depth to 2 m."""
    return replace(frame, depth=np.full_like(frame.depth, round(2 * float(clip.camera.depth_scale))))


def half_old(clip: FrameSequence, index: int, frame: Frame) -> Frame:
    """Replace the lower half of the grey image by that of three frames before."""
    grey = frame.grey.copy()
    grey[len(grey) // 2 :] = clip[max(index - 3, 0)].grey[len(grey) // 2 :]
    return replace(frame, grey=grey)


def permuted(depth: np.ndarray) -> np.ndarray:
    """Shuffle the tiles of a depth image."""
    tiles = [tile for row in np.split(depth, 8) for tile in np.split(row, 8, axis=1)]
    order = np.random.default_rng(0).permutation(64)
    return np.block([[tiles[order[8 * i + j]] for j in range(8)] for i in range(8)])


def frozen_depth(clip: FrameSequence, places: list[int]) -> Damaged:
    """Freeze the depth image for ten frames."""
    sequence = Damaged(clip, list(range(len(clip))))
    for place in places:
        depth = clip[place - 1].depth
        frozen = {i for i in range(place, min(place + 10, len(clip)))}
        sequence.damaged |= frozen
        sequence.alter |= dict.fromkeys(frozen, lambda clip, index, frame, depth=depth: replace(frame, depth=depth))
    return sequence


def half_missing(depth: np.ndarray) -> np.ndarray:
    """Remove the left half of a depth image."""
    return np.where(np.arange(depth.shape[1]) < depth.shape[1] // 2, 0, depth).astype(depth.dtype)


def not_a_number(grey: np.ndarray) -> np.ndarray:
    """The image as floats, with NaN in the first tenth of its rows."""
    values = grey.astype(np.float32)
    values[: len(values) // 10] = np.nan
    return values


def torn(clip: FrameSequence, index: int, frame: Frame) -> Frame:
    """Read the frame from files whose colour image is truncated."""
    with tempfile.TemporaryDirectory() as name:
        color, depth = Path(name) / "color.png", Path(name) / "depth.png"
        data = cv2.imencode(".png", frame.grey)[1].tobytes()
        color.write_bytes(data[: len(data) // 2])
        depth.write_bytes(cv2.imencode(".png", frame.depth)[1].tobytes())
        return replace(open_pair([(color, depth)], Calibration(clip.camera))[0], timestamp=frame.timestamp)


def zoom(image: np.ndarray) -> np.ndarray:
    """Magnify the middle of an image by a fifth to the full size."""
    height, width = image.shape
    part = image[height // 12 : height - height // 12, width // 12 : width - width // 12]
    return cv2.resize(part, (width, height), interpolation=cv2.INTER_NEAREST)


def noise(grey: np.ndarray) -> np.ndarray:
    """Independent, uniformly distributed grey levels."""
    return np.random.default_rng(0).integers(0, 256, grey.shape).astype(grey.dtype)


FAULTS: dict[str, Fault] = {
    "black": with_grey(np.zeros_like),
    "white": with_grey(lambda grey: np.full_like(grey, 255)),
    "saturated": with_grey(lambda grey: np.minimum(grey.astype(int) * 3, 255).astype(grey.dtype)),
    "noise": with_grey(noise),
    "frozen duplicate": altered(lambda clip, index, frame: replace(clip[index - 1], timestamp=frame.timestamp)),
    "no depth": with_depth(np.zeros_like),
    "half the depth": with_depth(half_missing),
    "depth in millimetres": with_depth(lambda depth: depth // 5),
    "not a number": with_grey(not_a_number),
    "truncated PNG": altered(torn),
    "dropped frames": dropped(DROPPED),
    "stamp out of order": shifted_stamp(-0.01),
    "equal stamps": shifted_stamp(0.0),
    "stamp too late": shifted_stamp(0.1),
    "stamp too early": shifted_stamp(0.005),
    "late by 60 ms": delayed(0.06),
    "late by 90 ms": delayed(0.09),
    "stale by 10": stale(10),
    "stale by 6": stale(6),
    "swapped": swapped(1),
    "swapped around one": swapped(2),
    "stamps exchanged": exchanged_stamps,
    "zoomed": altered(lambda clip, index, frame: replace(frame, grey=zoom(frame.grey), depth=zoom(frame.depth))),
    "jump of 10": dropped(10, restamped=True),
    "4 dropped and restamped": dropped(4, restamped=True),
    "60 Hz of duplicates": duplicated,
    "lower half old": altered(half_old),
    "depth x 2": with_depth(lambda depth: np.minimum(depth.astype(int) * 2, 65535)),
    "depth x 1.5": with_depth(lambda depth: depth * 1.5),
    "depth upside down": with_depth(np.flipud),
    "depth permuted": with_depth(permuted),
    "depth of 2 m": altered(two_metres),
    "depth shifted": with_depth(lambda depth: np.roll(depth, 40, axis=1)),
    "depth old": altered(late(5)),
    "depth frozen": frozen_depth,
    "depth x 2 for 10": with_depth(lambda depth: np.minimum(depth.astype(int) * 2, 65535), 10),
    "depth upside down for 10": with_depth(np.flipud, 10),
    "depth of 2 m for 10": altered(two_metres, 10),
}
LAWFUL: dict[str, Fault] = {
    "gain x 0.4 for 10": with_grey(lambda grey: (grey * 0.4).astype(grey.dtype), 10),
    "contrast / 12 for 10": with_grey(lambda grey: (100 + grey / 12).astype(grey.dtype), 10),
}
"""Changes that a camera may make: none of these frames should be lost."""


class Row(NamedTuple):
    """Result of one fault on one clip."""

    clip: str
    fault: str
    crashed: bool
    flagged: float
    """Share of the damaged pairs whose status is not ok."""
    false_alarms: float
    """Share of the other pairs whose status is not ok."""
    wrong: int
    """Pairs whose motion is wrong, damaged or not."""
    silent: int
    """Pairs whose motion is wrong and whose status is `ok`."""
    drift: float
    """m/s, over the undamaged frames; median over the seeds."""
    clean_drift: float
    statuses: dict[str, int]
    """Count of each status among the damaged pairs."""

    @property
    def ratio(self) -> float:
        """Drift over the clean run's."""
        return self.drift / self.clean_drift


def is_wrong(step: Step, sequence: Damaged, truth: Trajectory) -> bool:
    """Whether a step's motion is wrong; False for a step without a motion or without ground truth."""
    if not np.isfinite(np.asarray(step.alignment.error)):
        return False
    before = int(np.argmin(np.abs(sequence.timestamps - step.reference_timestamp)))
    poses, valid = truth.interpolate(sequence.moments[[before, step.index]])
    if not valid.all():
        return False
    error = inverse(inverse(poses[1]) @ poses[0]) @ np.asarray(step.alignment.target_T_reference)
    length, angle = length_and_angle(error)
    return bool(length > WRONG[0] or np.degrees(angle) > WRONG[1])


def drift(trajectory: Trajectory, stamps: np.ndarray, truth: Trajectory) -> float:
    """Drift over the poses at some timestamps, m/s."""
    chosen = np.isin(trajectory.timestamps, stamps)
    return relative_pose_error(trajectory[chosen], truth).translation.rmse


def known_drift(trajectory: Trajectory, stamps: np.ndarray, truth: Trajectory) -> float | None:
    """Drift as by `drift`; None if the trajectory is broken into segments of less than a second."""
    try:
        return drift(trajectory, stamps, truth)
    except GavoError:
        return None


def follow(sequence: Any, contender: common.Contender, seed: int) -> tuple[list[Step], Trajectory]:
    """Steps and trajectory of one run."""
    steps = revised(track(sequence, odometry=contender.make(sequence.camera, seed)))
    return steps, trajectory_of(float(sequence.timestamps[0]), steps)


def measure(
    name: str, fault: str, clip: FrameSequence, clean: list[Trajectory], contender: common.Contender, truth: Trajectory
) -> Row:
    """Run one fault, once per seed."""
    places = [len(clip) * (i + 1) // (PLACES + 1) for i in range(PLACES)]
    flagged, alarms, drifts, clean_drifts, wrong = [], [], [], [], []
    statuses: Counter[str] = Counter()
    for seed, reference in enumerate(clean):
        sequence = (FAULTS | LAWFUL)[fault](clip, places)
        try:
            steps, trajectory = follow(sequence, contender, seed)
        except Exception as error:
            print(f"{fault}: {type(error).__name__}: {error}")
            return Row(name, fault, True, 0.0, 0.0, 0, 0, np.nan, np.nan, {})
        for step in steps:
            (flagged if step.index in sequence.damaged else alarms).append(step.alignment.status.value != 0)
        wrong += [step.alignment.status == 0 for step in steps if is_wrong(step, sequence, truth)]
        statuses.update(s.alignment.status.name.lower() for s in steps if s.index in sequence.damaged)
        alone = [i for i in range(len(sequence)) if i not in sequence.damaged]
        moments = dict(zip(sequence.timestamps, sequence.moments, strict=True))
        trajectory = replace(trajectory, timestamps=np.array([moments[stamp] for stamp in trajectory.timestamps]))
        drifts.append(known_drift(trajectory, sequence.moments[alone], truth) or np.nan)
        clean_drifts.append(drift(reference, clip.timestamps[np.array(sequence.sources)[alone]], truth))
    medians = float(np.median(drifts)), float(np.median(clean_drifts))
    return Row(
        name,
        fault,
        False,
        float(np.mean(flagged)),
        float(np.mean(alarms)),
        len(wrong),
        sum(wrong),
        *medians,
        dict(statuses),
    )


def main(
    clips: str = common.CLIPS,
    method: str = "ga",
    faults: str = ",".join(FAULTS | LAWFUL),
    seeds: int = 1,
    json: Path | None = None,
) -> dict[str, Any]:
    """Measure, print and return the figures.

    Args:
        clips: comma-separated clips to damage, and to count false alarms on.
        method: METHOD or METHOD:PRESET.
        faults: comma-separated names.
        seeds: runs of each fault.
        json: file for the figures.
    """
    contender = common.parse_methods(method)[0]
    chosen, rows = common.names_among(FAULTS | LAWFUL, "fault", faults), []
    for clip in common.names(clips):
        sequence, truth = common.open_true_clip(clip)
        clean = [follow(sequence, contender, seed)[1] for seed in range(seeds)]
        for name in chosen:
            rows.append(measure(clip, name, sequence, clean, contender, truth))
            print(f"{clip} {name}: {rows[-1].silent} of {rows[-1].wrong} wrong pairs ok", file=sys.stderr)
    cells = [
        [
            row.clip,
            row.fault,
            "crashed" if row.crashed else "through",
            f"{row.flagged:.0%}",
            f"{row.false_alarms:.1%}",
            f"{row.silent} of {row.wrong}",
            number(row.drift, 4),
            number(row.ratio, 3),
            ", ".join(row.statuses),
        ]
        for row in rows
    ]
    columns = ("clip", "fault", "run", "flagged", "others", "wrong ok", "m/s", "ratio", "statuses")
    common.print_table(f"{PLACES} places of each clip, {contender.name}", columns, cells)
    wrong, silent = sum(row.wrong for row in rows), sum(row.silent for row in rows)
    common.tell(f"{silent} of {wrong} wrong pairs are ok")
    alarms = []
    for name in common.names(clips):
        counts = Counter(step.alignment.status.name.lower() for step in follow(common.open_clip(name), contender, 0)[0])
        pairs = counts.total()
        alarms.append(
            {"clip": name, "pairs": pairs, "false_alarms": 1 - counts["ok"] / pairs, "statuses": dict(counts)}
        )
    cells = [[row["clip"], row["pairs"], f"{row['false_alarms']:.1%}", str(row["statuses"])] for row in alarms]
    common.print_table("clean clips", ("clip", "pairs", "flagged", "statuses"), cells)
    results = {"faults": [{**row._asdict(), "ratio": row.ratio} for row in rows], "clean": alarms}
    common.record(json, "faults", results)
    return results


if __name__ == "__main__":
    common.command(main)
