"""Motion of the camera among moving bodies, and theirs: clips with an inserted card, and the rendered room with bodies.

The card (`moving_clips.py`) covers 0.1, 0.25 and 0.4 of the image of each clip; each seed has another texture, speed
and distance. The room has a box, or a box and a walking figure. Prints one row per clip, body and method:

- drift (RPE over 1 s, RMSE) over that of the clean clip, median and worst. It is taken within segments; `breaks` counts
  the breaks of the trajectories, and `across` is the median with the guessed motion across them included;
- IoU of a body's mask with the true one, median over frames and bodies;
- error of a body's motion between two frames, medians: displacement of its centroid in mm, rotation in degrees;
- wrong pairs (camera motion off by more than 2 cm or 1.5 degrees), pairs whose status is not ok, and precision and
  recall of that; its share among the other pairs, and among the exact ones (off by less than 8 mm and 0.6 degrees).
  Pairs between the two limits followed a slow body.

Then one row per method over all clips and over all rooms. The rooms' ratios are large, as their clean drift is near
zero. A dash stands where a method does not track bodies.

With `--bodies told` methods get the true masks: depth is removed there and in a margin of a few pixels, and no other
bodies are sought. That is what perfect detection would give.

    python benchmarks/moving.py
    python benchmarks/moving.py --methods ga:fast,gauss-newton --bodies track --seeds 1 --json moving.json
    python benchmarks/moving.py --rooms '' --methods ga:fast --bodies told

On 2 cores the defaults take about half an hour.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import common
import cv2
import numpy as np
from moving_clips import LOOKS, CardClip

from gavo_jax.bodies.records import Body
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.base import Sequence as FrameSequence
from gavo_jax.datasets.rendered.bodies_truth import WithBodies
from gavo_jax.datasets.rendered.moving import body_of_part
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.evaluation import relative_pose_error, rotation_angle
from gavo_jax.odometry.driver import Step
from gavo_jax.odometry.run import trajectory_of
from gavo_jax.output.screen import number
from gavo_jax.output.tracked import track_visibly
from gavo_jax.peers.registry import PEERS
from gavo_jax.rigid_motions import length_and_angle
from gavo_jax.settings import Settings
from gavo_jax.trajectory import Trajectory, inverse

WRONG = (0.02, 1.5)
"""Metres and degrees: a pair is wrong if its motion is further from the truth."""
EXACT = (0.008, 0.6)
"""Metres and degrees: a pair is exact if its motion is nearer to the truth. Following a body at 30 cm/s costs 10 mm a
frame."""
LEAST_SHARE = 0.01
"""Share of the image: a body that covers less need not be found."""
TOLD, ABOUT = "told", 4
"""Mode that removes the true bodies from the depth images, and the margin about them in pixels."""
ROOM = "room"
"""Name of the rendered sequences; each seed has its own."""
PEER_NAMES = ("opencv-rgbd", "opencv-depth", "open3d-color", "open3d-hybrid")
DEFAULT_METHODS = ",".join(["ga", "gauss-newton", *(name for name in PEER_NAMES if PEERS[name].installed)])


class Case(NamedTuple):
    """A sequence with bodies, and the same one without."""

    clip: str
    body: str
    seed: int
    sequence: Any
    clean: FrameSequence


@dataclass
class Score:
    """Result of one method on one case."""

    clip: str
    body: str
    method: str
    seed: int
    drift: float
    clean_drift: float
    drift_across: float = np.nan
    """Drift as if the trajectory had no breaks."""
    breaks: int = 0
    wrong: int = 0
    wrong_flagged: int = 0
    right: int = 0
    right_flagged: int = 0
    exact: int = 0
    """Right pairs that are exact."""
    exact_flagged: int = 0
    overlaps: list[float] = field(default_factory=list)
    displacements_mm: list[float] = field(default_factory=list)
    rotations_deg: list[float] = field(default_factory=list)

    @property
    def ratio(self) -> float:
        """Drift over the clean clip's."""
        return self.drift / self.clean_drift


def with_bodies(settings: Settings, mode: str | None) -> Settings:
    """Settings with a mode for bodies; `TOLD` switches them off, None changes nothing.

    Raises:
        GavoError: no such mode.
    """
    if mode is None:
        return settings
    return common.with_bodies(settings, "off" if mode == TOLD else mode)


@dataclass(eq=False)
class Told:
    """A sequence without depth where its bodies are.

    Attributes:
        whole: the sequence with all its depth.
    """

    whole: Any

    def __getattr__(self, name: str) -> Any:
        return getattr(self.whole, name)

    def __len__(self) -> int:
        return len(self.whole)

    def __getitem__(self, index: int) -> Frame:
        frame = self.whole[index]
        bodies = (self.whole.part_labels(index) > 0).astype(np.uint8)
        about = cv2.dilate(bodies, np.ones((2 * ABOUT + 1, 2 * ABOUT + 1), np.uint8)) > 0
        return replace(frame, depth=np.where(about, 0, frame.depth).astype(frame.depth.dtype))


def bodies_in(sequence: WithBodies, labels: np.ndarray) -> dict[int, np.ndarray]:
    """True masks by label, from a frame's part labels, of the bodies that cover enough of it."""
    bodies = body_of_part(sequence.bodies_truth)[labels]
    return {
        truth.label: bodies == truth.label
        for truth in sequence.bodies_truth
        if np.mean(bodies == truth.label) >= LEAST_SHARE
    }


def best_match(true: np.ndarray, masks: dict[int, np.ndarray]) -> tuple[int | None, float]:
    """Number of the found mask with the largest IoU with a true one, and that IoU."""
    best: tuple[int | None, float] = (None, 0.0)
    for name, mask in masks.items():
        overlap = float((mask & true).sum() / (mask | true).sum())
        if overlap > best[1]:
            best = name, overlap
    return best


def motion_errors(
    sequence: WithBodies, index: int, label: int, labels: np.ndarray, found: Body, world_T_first: np.ndarray
) -> tuple[float, float | None]:
    """Error of a body's motion between frames index - 1 and index.

    For a body of several parts the truth is the mean motion of its visible parts, without a rotation.

    Returns:
        Error of the centroid's displacement in millimetres, of the rotation in degrees; None for a non-rigid body.
    """
    truth = next(truth for truth in sequence.bodies_truth if truth.label == label)
    weights = np.array([np.sum(labels == part) for part in truth.part_labels], float)
    first_T_world = inverse(world_T_first)
    moved, motion = np.zeros(3), np.eye(4)
    for weight, poses in zip(weights / weights.sum(), truth.world_T_part, strict=True):
        motion = first_T_world @ poses[index] @ inverse(poses[index - 1]) @ world_T_first
        back = inverse(motion)
        moved += weight * (found.centroid - back[:3, :3] @ found.centroid - back[:3, 3])
    apart = 1e3 * float(np.linalg.norm(found.displacement - moved))
    if not truth.rigid:
        return apart, None
    turned = cv2.Rodrigues(found.rotation)[0]
    return apart, float(np.degrees(rotation_angle((motion[:3, :3].T @ turned)[None])[0]))


def pair_error(step: Step, poses: dict[float, np.ndarray], truth: Trajectory) -> tuple[float, float]:
    """Error of the recorded motion since a step's reference, metres and degrees; zero where the truth is unknown."""
    stamps = np.array([step.reference_timestamp, step.timestamp])
    true, valid = truth.interpolate(stamps)
    if not valid.all() or step.reference_timestamp not in poses:
        return 0.0, 0.0
    error = inverse(inverse(true[0]) @ true[1]) @ inverse(poses[step.reference_timestamp]) @ step.world_T_camera
    length, angle = length_and_angle(error)
    return float(length), float(np.degrees(angle))


def exceeds(error: tuple[float, float], limits: tuple[float, float]) -> bool:
    """Whether either part of an error is larger than its limit."""
    return error[0] > limits[0] or error[1] > limits[1]


def run(label: str, sequence: Any, contender: common.Contender, seed: int, score: Score | None = None) -> Trajectory:
    """Track a sequence, and add its statuses, masks and bodies' motions to a score if given."""
    truth, odometry = sequence.ground_truth, contender.make(sequence.camera, seed)
    first = float(sequence.timestamps[0])
    world_T_first = truth.interpolate(sequence.timestamps[:1], max_gap=np.inf)[0][0]
    poses: dict[float, np.ndarray] = {first: np.eye(4)}
    errors: list[tuple[float, float]] = []

    def on_step(step: Step) -> None:
        poses[step.timestamp] = step.world_T_camera
        if score is None:
            return
        errors.append(pair_error(step, poses, truth))
        labels = sequence.part_labels(step.index)
        masks = {body.number: body.mask for body in step.bodies}
        bodies = {body.number: body for body in step.bodies}
        for label, mask in bodies_in(sequence, labels).items():
            number, overlap = best_match(mask, masks)
            score.overlaps.append(overlap)
            if number is not None and np.isfinite(bodies[number].displacement).all():
                apart, turned = motion_errors(sequence, step.index, label, labels, bodies[number], world_T_first)
                score.displacements_mm.append(apart)
                score.rotations_deg += [] if turned is None else [turned]

    steps = track_visibly(label, sequence, odometry, on_step).outcome(sequence).steps
    if score is not None:
        for error, step in zip(errors, steps, strict=True):
            count(score, error, step.alignment.status != 0)
    return trajectory_of(first, steps)


def count(score: Score, error: tuple[float, float], flagged: bool) -> None:
    """Add one pair to a score."""
    wrong, exact = exceeds(error, WRONG), not exceeds(error, EXACT)
    score.wrong += wrong
    score.wrong_flagged += wrong and flagged
    score.right += not wrong
    score.right_flagged += flagged and not wrong
    score.exact += exact
    score.exact_flagged += flagged and exact


def cases(clips: str, shares: str, rooms: str, seeds: range, frames: int) -> Iterator[Case]:
    """All sequences with bodies, grouped by clip.

    Raises:
        GavoError: a clip cannot be read or has no truth; invalid share or number of bodies.
    """
    for name in common.names(clips):
        whole = common.open_clip(f"{name}:{frames}")
        for seed in seeds:
            for share in map(share_of, common.names(shares)):
                card = CardClip(whole, share, seed, LOOKS[seed % len(LOOKS)])
                yield Case(name, f"card {share:g}", seed, card, whole)
    for seed in seeds:
        clean = SyntheticSequence(frames, seed=seed)
        for bodies in common.counts(rooms) if rooms else []:
            yield Case(ROOM, f"{bodies} moving", seed, SyntheticSequence(frames, seed=seed, bodies=bodies), clean)


def share_of(text: str) -> float:
    """Parse a share of the image.

    Raises:
        GavoError: not a number between 0 and 1.
    """
    try:
        share = float(text)
    except ValueError:
        share = 0.0
    if not 0 < share < 1:
        raise GavoError(f"--shares: {text}: not a share of the image between 0 and 1")
    return share


def drift(trajectory: Trajectory, truth: Trajectory) -> float:
    """RPE over 1 s, RMSE of its translation, m/s; infinite if no segment is that long.

    Raises:
        GavoError: the truth covers too little.
    """
    try:
        return relative_pose_error(trajectory, truth).translation.rmse
    except GavoError:
        if not trajectory.segments.any():
            raise
        return np.inf


def measure(chosen: Iterator[Case], contenders: list[common.Contender], told: bool = False) -> list[Score]:
    """Run every method on every case, and once per seed on its clean clip; a peer runs once on each clean clip.

    Args:
        chosen: The cases.
        contenders: The methods.
        told: Whether the methods get the true masks.
    """
    clean: dict[tuple[str, str, int], float] = {}
    scores = []
    for case in chosen:
        for contender in contenders:
            seed = case.seed if contender.random else 0
            key = case.clip, contender.name, case.seed if case.clip == ROOM else seed
            label = f"{case.clip}, {contender.name}, seed {case.seed}"
            if key not in clean:
                clean[key] = drift(run(label, case.clean, contender, seed), case.clean.ground_truth)  # pyright: ignore[reportArgumentType]
            score = Score(case.clip, case.body, contender.name, case.seed, np.nan, clean[key])
            sequence = Told(case.sequence) if told else case.sequence
            trajectory = run(f"{label}, {case.body}", sequence, contender, seed, score)
            score.drift = drift(trajectory, case.sequence.ground_truth)
            whole = Trajectory(trajectory.timestamps, trajectory.world_T_camera)
            score.drift_across = drift(whole, case.sequence.ground_truth)
            score.breaks = len(np.unique(trajectory.segments)) - 1
            scores.append(score)
            print(f"{label}, {case.body}: drift {score.ratio:.2f} times the clean clip's", file=sys.stderr)
    return scores


class Summary(NamedTuple):
    """One method over some cases; None where undefined."""

    clip: str
    body: str
    method: str
    drift: float
    """Median, m/s."""
    ratio_median: float
    ratio_worst: float
    ratio_across: float
    """Median, with the motion across breaks included."""
    breaks: int
    overlap: float | None
    """Median over frames and bodies."""
    displacement_mm: float | None
    rotation_deg: float | None
    wrong: int
    flagged: int
    """Pairs whose status is not ok, wrong or not."""
    recall: float | None
    """Share of the wrong pairs that are flagged."""
    precision: float | None
    """Share of the flagged pairs that are wrong."""
    false_alarms: float | None
    """Share of the right pairs that are flagged."""
    exact_flagged: float | None
    """Share of the exact pairs that are flagged."""
    runs: int


def summarise(clip: str, body: str, scores: list[Score]) -> Summary:
    """The summary of one method's scores."""

    def median(values: list[float]) -> float | None:
        return float(np.median(values)) if values else None

    wrong, right, exact = (sum(getattr(score, name) for score in scores) for name in ("wrong", "right", "exact"))
    caught, alarms = (sum(getattr(score, name) for score in scores) for name in ("wrong_flagged", "right_flagged"))
    ratios = [score.ratio for score in scores]
    return Summary(
        clip,
        body,
        scores[0].method,
        float(np.median([score.drift for score in scores])),
        float(np.median(ratios)),
        float(max(ratios)),
        float(np.median([score.drift_across / score.clean_drift for score in scores])),
        sum(score.breaks for score in scores),
        median([value for score in scores for value in score.overlaps]),
        median([value for score in scores for value in score.displacements_mm]),
        median([value for score in scores for value in score.rotations_deg]),
        wrong,
        caught + alarms,
        caught / wrong if wrong else None,
        caught / (caught + alarms) if caught + alarms else None,
        alarms / right if right else None,
        sum(score.exact_flagged for score in scores) / exact if exact else None,
        len(scores),
    )


def groups(scores: list[Score], *names: str) -> list[list[Score]]:
    """Group scores by some fields, in order of first appearance."""
    found: dict[tuple[Any, ...], list[Score]] = {}
    for score in scores:
        found.setdefault(tuple(getattr(score, name) for name in names), []).append(score)
    return list(found.values())


COLUMNS = (
    *("clip", "body", "method", "m/s", "ratio", "worst", "across", "breaks", "IoU", "mm", "deg"),
    *("wrong", "flagged", "precision", "recall", "others", "exact", "runs"),
)


def row(summary: Summary) -> list[str]:
    """Format a summary as cells of `COLUMNS`."""

    def percent(share: float | None) -> str:
        return "–" if share is None else f"{share:.1%}"

    return [
        summary.clip,
        summary.body,
        summary.method,
        number(summary.drift, 4),
        number(summary.ratio_median, 2),
        number(summary.ratio_worst, 2),
        number(summary.ratio_across, 2),
        str(summary.breaks),
        number(summary.overlap, 2),
        number(summary.displacement_mm, 1),
        number(summary.rotation_deg, 2),
        str(summary.wrong),
        str(summary.flagged),
        percent(summary.precision),
        percent(summary.recall),
        percent(summary.false_alarms),
        percent(summary.exact_flagged),
        str(summary.runs),
    ]


def below_peers(scores: list[Score], method: str) -> tuple[int, int]:
    """Count the cases where a method's drift is below every peer's, and the cases that have peers."""
    below = total = 0
    for case in groups(scores, "clip", "body", "seed"):
        peers = [score.drift for score in case if score.method in PEERS]
        own = [score.drift for score in case if score.method == method]
        if peers and own:
            total += 1
            below += own[0] < min(peers)
    return below, total


def main(
    clips: str = common.CLIPS,
    shares: str = "0.1,0.25,0.4",
    rooms: str = "1,2",
    methods: str = DEFAULT_METHODS,
    bodies: str | None = None,
    seeds: int = 3,
    first_seed: int = 0,
    frames: int = 60,
    json: Path | None = None,
) -> list[Summary]:
    """Measure, print and return the figures.

    Args:
        clips: comma-separated clips to put a card into; none if empty.
        shares: comma-separated shares of the image that the card covers, median over the frames.
        rooms: comma-separated numbers of bodies in the rendered room; none if empty.
        methods: comma-separated METHOD, METHOD:PRESET or names of peers.
        bodies: how our own methods treat bodies: off, mask or track; as in their settings if left out. With told
            all methods get the true masks.
        seeds: runs of each, each with its own card or room.
        first_seed: seed of the first run. The first three were looked at while this was developed.
        frames: first frames to take of each clip.
        json: file for the figures.
    """
    contenders = [
        common.preset_contender(name, with_bodies(common.preset_of(name), bodies))
        if name not in PEERS
        else common.parse_methods(name)[0]
        for name in common.names(methods)
    ]
    chosen = cases(clips, shares, rooms, range(first_seed, first_seed + seeds), frames)
    scores = measure(chosen, contenders, told=bodies == TOLD)
    if not scores:
        raise GavoError("nothing to measure: no clips and no rooms, or no methods")
    parts = [summarise(group[0].clip, group[0].body, group) for group in groups(scores, "clip", "body", "method")]
    whole = [
        summarise(name, "all", group)
        for name, some in (
            ("all clips", [score for score in scores if score.clip != ROOM]),
            ("all rooms", [score for score in scores if score.clip == ROOM]),
        )
        for group in groups(some, "method")
    ]
    counted = f"{seeds} seeds from {first_seed} on" if first_seed else f"{seeds} seeds"
    title = f"{frames} frames, {counted}, bodies {bodies or 'as by default'}"
    common.print_table(title, COLUMNS, [row(summary) for summary in [*parts, *whole]])
    standing = {}
    for method in dict.fromkeys(summary.method for summary in whole):
        below, total = standing[method] = below_peers(scores, method)
        if method not in PEERS and total:
            print(f"{method}: below every peer in {below} of {total} runs")
    common.record(
        json,
        "moving",
        {
            "bodies": bodies,
            "frames": frames,
            "summary": [summary._asdict() for summary in [*parts, *whole]],
            "below_peers": standing,
            "runs": [{**vars(score), "ratio": score.ratio} for score in scores],
        },
    )
    return [*parts, *whole]


if __name__ == "__main__":
    common.command(main)
