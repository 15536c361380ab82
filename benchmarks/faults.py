"""What damaged frames do to a run: every fault at five places of each clip, and false alarms on clean clips.

Each fault is put into the clip at evenly spaced places, in runs of its own. Prints one row per clip and fault: whether
the run came through, the share of the damaged pairs whose status is not ok, the share of the other pairs whose status
is not ok, how many pairs are off by more than 5 cm or 3 degrees and how many of these are ok, and the drift (RPE over
1 s, RMSE) over the frames that were left alone, also over that of the clean run over the very same frames. Then one row
per clip: the share of the pairs of a clean run whose status is not ok.

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
"""Frames in a row that go missing."""
WRONG = (0.05, 3.0)
"""Metres and degrees: a pair whose motion is further from the truth is wrong."""

Alter = Callable[[FrameSequence, int, Frame], Frame]


class Damaged:
    """A clip with altered frames, other frames in their place, or altered stamps.

    Attributes:
        sources: Of each frame the clip's frame whose images it has.
        timestamps: Of each frame, as the odometry is told.
        moments: When the truth is asked for each frame, seconds.
        alter: Of some frames what makes the damaged frame; may raise FrameError.
        damaged: The frames that are not as the clip has them, or that follow others than in the clip.
    """

    def __init__(self, clip: FrameSequence, sources: list[int]) -> None:
        """Take these frames of a clip, with their stamps."""
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
    """A number of frames in a row are altered."""

    def damage(clip: FrameSequence, places: list[int]) -> Damaged:
        sequence = Damaged(clip, list(range(len(clip))))
        sequence.damaged = {place + i for place in places for i in range(count) if place + i < len(clip)}
        sequence.alter = dict.fromkeys(sequence.damaged, alter)
        return sequence

    return damage


def every_frame(alter: Alter) -> Callable[[FrameSequence], Damaged]:
    """All frames are altered."""

    def change(clip: FrameSequence) -> Damaged:
        sequence = Damaged(clip, list(range(len(clip))))
        sequence.alter = dict.fromkeys(range(len(clip)), alter)
        return sequence

    return change


def with_grey(make: Callable[[np.ndarray], np.ndarray], count: int = 1) -> Fault:
    """Damage of the grey image."""
    return altered(lambda clip, index, frame: replace(frame, grey=make(frame.grey)), count)


def of_depth(make: Callable[[np.ndarray], np.ndarray]) -> Alter:
    """Damage of the depth image."""
    return lambda clip, index, frame: replace(frame, depth=make(frame.depth).astype(frame.depth.dtype))


def late(frames: int) -> Alter:
    """Depth of so many frames before, under this one's stamp."""
    return lambda clip, index, frame: replace(frame, depth=clip[max(index - frames, 0)].depth)


def with_depth(make: Callable[[np.ndarray], np.ndarray], count: int = 1) -> Fault:
    """Damage of the depth image of some frames."""
    return altered(of_depth(make), count)


def dropped(count: int, restamped: bool = False) -> Fault:
    """Frames in a row go missing; with `restamped` the stamps go on as if they had not."""

    def damage(clip: FrameSequence, places: list[int]) -> Damaged:
        missing = {place + i for place in places for i in range(count)}
        sequence = Damaged(clip, [i for i in range(len(clip)) if i not in missing])
        sequence.damaged = {sequence.sources.index(place + count) for place in places if place + count < len(clip)}
        if restamped:
            sequence.timestamps = clip.timestamps[: len(sequence)].copy()
        return sequence

    return damage


def shifted_stamp(seconds: float) -> Fault:
    """A stamp that comes so many seconds after the last one."""

    def damage(clip: FrameSequence, places: list[int]) -> Damaged:
        sequence = Damaged(clip, list(range(len(clip))))
        sequence.damaged = set(places)
        for i in places:
            sequence.timestamps[i] = sequence.timestamps[i - 1] + seconds
        return sequence

    return damage


def stale(age: int) -> Fault:
    """A frame's images are older ones, so many frames back."""

    def damage(clip: FrameSequence, places: list[int]) -> Damaged:
        sequence = Damaged(clip, list(range(len(clip))))
        sequence.damaged = {i for i in places if i >= age}
        for i in sequence.damaged:
            sequence.sources[i] = i - age
        return sequence

    return damage


def swapped(apart: int) -> Fault:
    """A frame's images and those of the next one, or of a later one, are exchanged."""

    def damage(clip: FrameSequence, places: list[int]) -> Damaged:
        sequence = Damaged(clip, list(range(len(clip))))
        sequence.damaged = {i + j for i in places for j in (0, apart)}
        for i in places:
            sequence.sources[i], sequence.sources[i + apart] = i + apart, i
        return sequence

    return damage


def exchanged_stamps(clip: FrameSequence, places: list[int]) -> Damaged:
    """A frame's stamp and that of the next one are exchanged."""
    sequence = Damaged(clip, list(range(len(clip))))
    sequence.damaged = {i + j for i in places for j in (0, 1)}
    for i in places:
        sequence.timestamps[[i, i + 1]] = sequence.timestamps[[i + 1, i]]
    sequence.moments = sequence.timestamps.copy()
    return sequence


def duplicated(clip: FrameSequence, places: list[int]) -> Damaged:
    """Every frame comes twice, the second time half an interval later and a grey level off here and there."""
    del places
    sequence = Damaged(clip, [i for i in range(len(clip)) for _ in (0, 1)])
    middle = clip.timestamps[:-1] + np.diff(clip.timestamps) / 2
    sequence.timestamps[1:-1:2], sequence.timestamps[-1] = middle, clip.timestamps[-1] + 1 / 60
    sequence.moments = sequence.timestamps.copy()
    sequence.damaged = set(range(1, len(sequence), 2))
    sequence.alter = dict.fromkeys(sequence.damaged, jitter)
    return sequence


def jitter(clip: FrameSequence, index: int, frame: Frame) -> Frame:
    """A grey level off here and there."""
    change = np.random.default_rng(index).integers(-1, 2, frame.grey.shape)
    return replace(frame, grey=np.clip(frame.grey + change, 0, 255).astype(frame.grey.dtype))


def half_old(clip: FrameSequence, index: int, frame: Frame) -> Frame:
    """The image's lower half is that of three frames before."""
    grey = frame.grey.copy()
    grey[len(grey) // 2 :] = clip[max(index - 3, 0)].grey[len(grey) // 2 :]
    return replace(frame, grey=grey)


def permuted(depth: np.ndarray) -> np.ndarray:
    """Depth whose tiles are mixed up."""
    tiles = [tile for row in np.split(depth, 8) for tile in np.split(row, 8, axis=1)]
    order = np.random.default_rng(0).permutation(64)
    return np.block([[tiles[order[8 * i + j]] for j in range(8)] for i in range(8)])


def frozen_depth(clip: FrameSequence, places: list[int]) -> Damaged:
    """Depth that stands still for ten frames."""
    sequence = Damaged(clip, list(range(len(clip))))
    for place in places:
        depth = clip[place - 1].depth
        frozen = {i for i in range(place, min(place + 10, len(clip)))}
        sequence.damaged |= frozen
        sequence.alter |= dict.fromkeys(frozen, lambda clip, index, frame, depth=depth: replace(frame, depth=depth))
    return sequence


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
        return replace(open_pair([(color, depth)], Calibration(clip.camera))[0], timestamp=frame.timestamp)


def zoom(image: np.ndarray) -> np.ndarray:
    """The middle of an image, a fifth larger, in its place."""
    height, width = image.shape
    part = image[height // 12 : height - height // 12, width // 12 : width - width // 12]
    return cv2.resize(part, (width, height), interpolation=cv2.INTER_NEAREST)


def noise(grey: np.ndarray) -> np.ndarray:
    """Independent grey levels, evenly spread."""
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
    "depth of 2 m": with_depth(lambda depth: np.full_like(depth, 10000)),
    "depth shifted": with_depth(lambda depth: np.roll(depth, 40, axis=1)),
    "depth old": altered(late(5)),
    "depth frozen": frozen_depth,
    "depth x 2 for 10": with_depth(lambda depth: np.minimum(depth.astype(int) * 2, 65535), 10),
    "depth upside down for 10": with_depth(np.flipud, 10),
    "depth of 2 m for 10": with_depth(lambda depth: np.full_like(depth, 10000), 10),
}
LAWFUL: dict[str, Fault] = {
    "gain x 0.4 for 10": with_grey(lambda grey: (grey * 0.4).astype(grey.dtype), 10),
    "contrast / 12 for 10": with_grey(lambda grey: (100 + grey / 12).astype(grey.dtype), 10),
}
"""What a camera may do: none of these frames should be lost."""


class Row(NamedTuple):
    """What one fault did."""

    clip: str
    fault: str
    crashed: bool
    flagged: float
    """Share of the damaged pairs."""
    false_alarms: float
    """Share of the other pairs."""
    wrong: int
    """Pairs whose motion is wrong, wherever they are."""
    silent: int
    """Pairs whose motion is wrong and whose status is `ok`."""
    drift: float
    """m/s, over the frames left alone; median over the seeds."""
    clean_drift: float
    statuses: dict[str, int]
    """Of the damaged pairs."""

    @property
    def ratio(self) -> float:
        """Drift against the clean run's."""
        return self.drift / self.clean_drift


def is_wrong(step: Step, sequence: Damaged, truth: Trajectory) -> bool:
    """Whether the motion that a step was given lies far from the truth at its stamps."""
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
    """Drift over the poses of some stamps, m/s."""
    chosen = np.isin(trajectory.timestamps, stamps)
    return relative_pose_error(trajectory[chosen], truth).translation.rmse


def known_drift(trajectory: Trajectory, stamps: np.ndarray, truth: Trajectory) -> float | None:
    """The same; None where the trajectory is broken into segments of less than a second."""
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
    """One fault, a run a seed."""
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
        drifts.append(drift(trajectory, sequence.moments[alone], truth))
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
        clips: the clips to damage, and to count false alarms on, with commas between.
        method: METHOD or METHOD:PRESET.
        faults: names with commas between.
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
