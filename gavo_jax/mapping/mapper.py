"""The map of a run: keyframes as it goes, loops between them, and at the end a trajectory that fits all of them."""

import time
from collections import OrderedDict
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from gavo_jax.alignment.judgement import is_unknown
from gavo_jax.bodies.records import without_moving
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame, FrameError, Sequence
from gavo_jax.mapping.candidates import LoopCandidate, find_candidates
from gavo_jax.mapping.keyframes import MAX_IMAGES, Keyframe, Keyframes
from gavo_jax.mapping.pose_graph import REWEIGHTED, Solution, optimise, require_gtsam
from gavo_jax.mapping.relocalisation import Place, Recogniser
from gavo_jax.mapping.verification import Edge, Verifier
from gavo_jax.odometry.driver import Found, Moving, Step, seen_moving
from gavo_jax.odometry.overlays import AsTracked
from gavo_jax.rigid_motions import log, transport_covariance
from gavo_jax.status import BY_GRAVITY, AlignmentStatus
from gavo_jax.trajectory import inverse, stamp_name

SHORTEST = 0.01
"""Seconds between two frames below which nothing is said of the velocity: timestamps may be wrong, and where they are
right the readout is as short.
"""
STEP_FLOOR = 5e-4
"""Standard deviation, metres and radians, of a step's error beyond what its covariance says."""
DOUBTED = 0.1
"""Standard deviation given to a motion that something speaks against, metres and radians."""
UNTIED = 1.0
"""Standard deviation given to an unknown motion, metres and radians."""
GROWTH = 1.25
"""Factor by which the number of keyframes grows between two optimisations, which bounds their cost per frame."""
FIRST = 20
"""Number of keyframes at the first optimisation."""
SOUGHT_OF_SEGMENT = 5
"""Number of keyframes at either end of a segment that are searched for among those of segments it is not tied to."""
MOST_IN_THE_END = 100
"""Number of candidates, the most similar ones, that are aligned when loops are searched for again at the end."""
REMEMBERED = 64
"""Number of frames since a keyframe whose covariance is kept, for later frames that refer to them."""
SPEAKS_AGAINST = frozenset(BY_GRAVITY)
"""Findings on a motion that speak against it although it is not lost."""


class Loops(NamedTuple):
    """The map of a run."""

    keyframes: list[Keyframe]
    """In the order of their frames."""
    edges: list[Edge]
    """The loops between keyframes, `earlier` and `later` being their places in the list."""
    solution: Solution
    """The optimised graph: pose of each keyframe, weight and residual of each loop."""


class _Uncertainty(NamedTuple):
    """How uncertain the odometry's motion since the last keyframe is."""

    covariance: Float64[np.ndarray, "6 6"]
    """Covariance of δ in a_T_b · exp(δ), metres and radians."""
    in_doubt: bool
    """Whether something speaks against one of its pairs."""


class Mapper:
    """Watches a run and keeps its map.

    Args:
        camera: Camera of the frames, without distortion.
        most: Maximum number of keyframes that keep their images.
        synchronise: Whether keyframes' depth is moved to when their colour image was taken.

    Raises:
        GavoError: GTSAM is not installed.
    """

    def __init__(self, camera: Camera, most: int = MAX_IMAGES, synchronise: bool = True):
        require_gtsam()
        self.keyframes = Keyframes(camera, most, synchronise)
        self.verifier = Verifier(self.keyframes.camera)
        self.recogniser = Recogniser(self.keyframes.camera, self.verifier)
        self.edges: list[Edge] = []
        self._place: Place | None = None
        self._known: OrderedDict[str, _Uncertainty] = OrderedDict()
        self._first: Frame | None = None
        self._newest: tuple[Frame, Step, Float64[np.ndarray, " 6"]] | None = None
        self._next, self._scale = FIRST, 1.0

    def warm_up(self) -> float:
        """Compile what is needed, or load it; return the seconds this took."""
        start = time.perf_counter()
        self.verifier.warm_up()
        return time.perf_counter() - start

    def watch(self, frame: Frame | None, step: Step | None, moving: Moving = seen_moving) -> None:
        """Take in a frame (None: it could not be read) with its step (None: it is the first).

        What moves on its own is no part of a map: two frames that show the same body would be tied by it.

        Args:
            frame: The frame.
            step: The driver's step for it.
            moving: Where bodies are in the frame of a step.
        """
        if step is None:
            self._first = frame
            return
        if step.alignment.status is AlignmentStatus.NO_REFERENCE:  # no frame before was usable
            self._first = None
        if step.lost:
            return
        self._take_back(step)
        twist = _own_velocity(step)
        if self._first is not None and not self.keyframes.all:
            is_reference = stamp_name(self._first.timestamp) == stamp_name(step.reference_timestamp)
            self._add(self.keyframes.make(self._first, 0, 0, np.eye(4), twist if is_reference else np.zeros(6)))
        self._first = None
        due, is_found = self.is_due(step), step.origin == "relocalised"
        if is_found:
            twist = np.zeros(6)
        else:
            self._follow(step)
        if frame is not None and (due or _may_be_keyframe(step)):
            frame = without_moving(frame, moving(step))
        if frame is not None and due:
            keyframe = self._made(frame, step, twist, None if is_found else self._known.get(stamp_name(step.timestamp)))
            self._add(keyframe)
            if is_found:
                self._tie(keyframe)
            else:
                self._look_back(step)
            self._newest = None
        elif frame is not None and _may_be_keyframe(step):
            self._newest = frame, step, twist

    def find(self, frame: Frame, segment: int) -> Found | None:
        """Return where a frame was taken that nothing ties to earlier frames; see `driver.Relocaliser`."""
        earlier = [k for k in self.keyframes.searchable() if k.segment < segment]  # not what came of this one
        self._place = place = self._find(frame, earlier) if earlier else None
        if place is None or place.edge.alignment is None:
            return None
        world_T_camera = place.keyframe.world_T_odometry @ place.edge.earlier_T_later
        return Found(place.edge.alignment, place.keyframe.timestamp, world_T_camera, place.keyframe.segment)

    def _find(self, frame: Frame, keyframes: list[Keyframe]) -> Place | None:
        """Return where a frame was taken, according to some keyframes."""
        lost = self.keyframes.make(frame, -1, -1, np.eye(4), np.zeros(6))
        return self.recogniser.find(lost, keyframes)

    def is_due(self, step: Step) -> bool:
        """Whether a step's frame will become a keyframe."""
        if step.origin != "tracked":  # a guess ties it to nothing
            return step.origin == "relocalised"
        return step.depth_is_trusted and self.keyframes.is_due(step.world_T_camera, step.segment)

    def replay(
        self, sequence: Sequence, steps: list[Step], moving: Moving = seen_moving, is_drawn_on: bool = False
    ) -> None:
        """Rebuild the map of a run that was cut short; only frames that are, or may become, keyframes are decoded.

        Args:
            sequence: The frames of the run.
            steps: The steps that it had made.
            moving: Where bodies are in the frame of a step.
            is_drawn_on: Whether overlays are drawn into the images: then all of them are decoded, to find these again.
        """
        frames = AsTracked(sequence, steps, is_drawn_on)
        self.watch(_decoded(frames, 0), None)
        last = max((step.index for step in steps if _may_be_keyframe(step)), default=0)
        for step in steps:
            frame = _decoded(frames, step.index) if self.is_due(step) or step.index == last else None
            if frame is not None and step.origin == "relocalised":
                reference = stamp_name(step.reference_timestamp)
                by = [k for k in self.keyframes.searchable() if stamp_name(k.timestamp) == reference]
                self._place = self._find(frame, by)
            self.watch(frame, step, moving)

    def finish(self, steps: Iterable[Step] = ()) -> Loops:
        """Make the last frame a keyframe, search for loops once more with all that is known, and optimise.

        Args:
            steps: The run's steps, as revised by later ones: more of them may be in doubt.
        """
        if self._newest is not None:
            frame, step, twist = self._newest
            self._add(self._made(frame, step, twist, self._known.get(stamp_name(step.timestamp))))
            self._newest = None
        steps = list(steps)
        self._doubt(steps)
        self._distrust({step.index for step in steps if not step.depth_is_trusted})
        if not self.keyframes.all:
            return Loops([], [], Solution(np.zeros((0, 4, 4)), np.zeros(0), np.zeros((0, 6)), 1.0))
        self._optimise(reweighted=1)
        if self._join():
            self._optimise(reweighted=1)
        candidates = [candidate for keyframe in self.keyframes.searchable() for candidate in self._candidates(keyframe)]
        candidates.sort(key=lambda candidate: -candidate.likeness)
        self._close(candidates[:MOST_IN_THE_END])
        return Loops(self.keyframes.all, self.edges, self._optimise(REWEIGHTED))

    def _join(self) -> bool:
        """Tie segments, or those tied to each other, to earlier ones, until no more can be; whether any was tied."""
        kept, asked, joined = self.keyframes.searchable(), {}, False
        for _ in {keyframe.segment for keyframe in kept}:
            first = tied_segments(self.keyframes.all, self.edges)
            for root in sorted(set(first.values())):
                own = [keyframe for keyframe in kept if first[keyframe.segment] == root]
                others = [keyframe for keyframe in kept if first[keyframe.segment] < root]
                if asked.get(root) != (len(own), len(others)) and self._tie_to(own, others):
                    joined = True
                    break
                asked[root] = len(own), len(others)
            else:
                break
        return joined

    def _tie_to(self, own: list[Keyframe], others: list[Keyframe]) -> bool:
        """Tie some keyframes to others by the first or last of each of their segments; whether one was found."""
        if not others:
            return False
        for segment in dict.fromkeys(keyframe.segment for keyframe in own):
            ones = [keyframe for keyframe in own if keyframe.segment == segment]
            first, rest = ones[:SOUGHT_OF_SEGMENT], ones[SOUGHT_OF_SEGMENT:]
            for keyframe in (*first, *reversed(rest[-SOUGHT_OF_SEGMENT:])):
                place = self.recogniser.find(keyframe, others)
                if place is not None:
                    later = max(keyframe, place.keyframe, key=lambda one: one.number)
                    self._link(later, in_order(place.edge))
                    return True
        return False

    def _made(
        self, frame: Frame, step: Step, twist: Float64[np.ndarray, " 6"], uncertainty: "_Uncertainty | None"
    ) -> Keyframe:
        """A step's frame as a keyframe, with the covariance of the way to it from the last one."""
        covariance = None if uncertainty is None else uncertainty.covariance
        keyframe = self.keyframes.make(frame, step.index, step.segment, step.world_T_camera, twist, covariance)
        keyframe.in_doubt = uncertainty is not None and uncertainty.in_doubt
        return keyframe

    def _doubt(self, steps: Iterable[Step]) -> None:
        """Mark the ways between keyframes as doubtful if they contain motions that are in doubt in hindsight."""
        tracked = {stamp_name(step.timestamp): step for step in steps if not step.lost}
        stamps = {stamp_name(keyframe.timestamp) for keyframe in self.keyframes.all}
        for keyframe in self.keyframes.all:
            step = tracked.get(stamp_name(keyframe.timestamp))
            while step is not None:
                keyframe.in_doubt |= is_in_doubt(step)
                before = stamp_name(step.reference_timestamp)
                earlier = None if before in stamps else tracked.get(before)
                step = earlier if earlier and earlier.index < step.index else None  # stamps may repeat

    def _take_back(self, step: Step) -> None:
        """Distrust the frames before a step that turn out to have followed a body: it may be all that they show."""
        if step.revises and AlignmentStatus.MOVING_BODY in step.alignment.statuses:
            self._distrust(set(range(step.index - step.revises, step.index)))

    def _distrust(self, frames: set[int]) -> None:
        """Drop loops and images of keyframes that turned out to be wrong, by their frames' indices."""
        wrong = {keyframe.number for keyframe in self.keyframes.all if keyframe.index in frames}
        self.edges = [edge for edge in self.edges if wrong.isdisjoint((edge.earlier, edge.later))]
        for keyframe in self.keyframes.searchable():
            if keyframe.number in wrong:
                keyframe.give_up_images()

    def _follow(self, step: Step) -> None:
        """Accumulate the covariance of the motion since the last keyframe."""
        reference = stamp_name(step.reference_timestamp)
        before = self._known.get(reference)
        covariance = _covariance(step)
        if before is not None and np.isfinite(covariance).all():
            self._known.move_to_end(reference)  # many frames may have the same one
            motion = np.asarray(step.alignment.target_T_reference, np.float64)
            covariance = transport_covariance(motion, before.covariance + covariance)
            self._known[stamp_name(step.timestamp)] = _Uncertainty(covariance, before.in_doubt or is_in_doubt(step))
            if len(self._known) > REMEMBERED:
                self._known.popitem(last=False)

    def _look_back(self, step: Step) -> None:
        """Keep the covariance from a new keyframe to its reference, from which later frames may continue."""
        covariance = _covariance(step)
        if np.isfinite(covariance).all():
            self._known[stamp_name(step.reference_timestamp)] = _Uncertainty(covariance, is_in_doubt(step))

    def _add(self, keyframe: Keyframe) -> None:
        self.keyframes.add(keyframe)
        self._known.clear()
        self._known[stamp_name(keyframe.timestamp)] = _Uncertainty(np.zeros((6, 6)), False)
        self._close(self._candidates(keyframe))
        if len(self.keyframes.all) >= self._next:
            self._next = int(GROWTH * len(self.keyframes.all)) + 1
            self._optimise()

    def _tie(self, keyframe: Keyframe) -> None:
        """Tie a keyframe to the one that it was found by."""
        if self._place is not None:
            self._link(keyframe, self._place.edge._replace(later=keyframe.number))
        self._place = None

    def _link(self, keyframe: Keyframe, edge: Edge) -> None:
        """Keep an edge, without the alignment that it came from."""
        if edge.earlier not in keyframe.linked:
            keyframe.linked.add(edge.earlier)
            self.edges.append(edge._replace(alignment=None))

    def _candidates(self, keyframe: Keyframe) -> list[LoopCandidate]:
        """Loop candidates of a keyframe."""
        earlier = [other for other in self.keyframes.searchable() if other.number < keyframe.number]
        return find_candidates(keyframe, earlier, self.keyframes.camera)

    def _close(self, candidates: list[LoopCandidate]) -> None:
        """Verify candidates, and keep the loops that stand."""
        for candidate, edge in zip(candidates, self.verifier.verify(candidates), strict=True):
            candidate.later.tried[candidate.earlier.number] = candidate.later_T_earlier
            if edge is not None:
                self._link(candidate.later, edge)

    def _optimise(self, reweighted: int = 0) -> Solution:
        """Optimise the poses of all keyframes."""
        keyframes = self.keyframes.all
        poses = np.stack([keyframe.world_T_camera for keyframe in keyframes])
        solution = optimise(poses, self.odometry_edges(), self.edges, self._scale, reweighted)
        self._scale = solution.scale
        for keyframe, pose in zip(keyframes, solution.world_T_camera, strict=True):
            keyframe.world_T_camera = pose
        return solution

    def odometry_edges(self) -> list[Edge]:
        """The odometry's motions between consecutive keyframes."""
        keyframes = self.keyframes.all
        edges = []
        for a, b in zip(keyframes, keyframes[1:], strict=False):
            covariance = UNTIED**2 * np.eye(6) if b.step is None or a.segment != b.segment else b.step
            if b.in_doubt:
                covariance = covariance + DOUBTED**2 * np.eye(6)
            edges.append(Edge(a.number, b.number, inverse(a.world_T_odometry) @ b.world_T_odometry, covariance))
        return edges


def _covariance(step: Step) -> Float64[np.ndarray, "6 6"]:
    """Covariance of a step's motion in the reference's camera."""
    return mirrored(np.asarray(step.alignment.covariance, np.float64)) + STEP_FLOOR**2 * np.eye(6)


def _own_velocity(step: Step) -> Float64[np.ndarray, " 6"]:
    """Motion of the points in the camera at a step's moment, m/s and rad/s.

    This is the mean since its reference, corrected by the sway that the rolling shutter reveals; 0 where no camera is
    as fast as the timestamps say, or the motion took another time or is unknown.
    """
    seconds, result = step.timestamp - step.reference_timestamp, step.alignment
    if seconds < SHORTEST or AlignmentStatus.IMPLAUSIBLE_MOTION in result.statuses or is_unknown(result):
        return np.zeros(6)
    motion, sway = (np.asarray(of, np.float64) for of in (result.target_T_reference, result.sway))
    return (log(motion) + sway) / seconds


def mirrored(covariance: Float64[np.ndarray, "6 6"]) -> Float64[np.ndarray, "6 6"]:
    """A covariance made exactly symmetric from its upper triangle, as motions.csv keeps it.

    A computed covariance is symmetric but for its last digits, and a resumed run has to make the same map.
    """
    return np.triu(covariance) + np.triu(covariance, 1).T


def in_order(edge: Edge) -> Edge:
    """The edge from its earlier keyframe to its later one."""
    if edge.earlier < edge.later:
        return edge
    return edge._replace(
        earlier=edge.later,
        later=edge.earlier,
        earlier_T_later=inverse(edge.earlier_T_later),
        covariance=transport_covariance(edge.earlier_T_later, edge.covariance),
    )


def tied_segments(keyframes: list[Keyframe], edges: Iterable[Edge]) -> dict[int, int]:
    """Return, for each segment, the first one that edges tie it to, directly or not; itself where nothing does."""
    first = {keyframe.segment: keyframe.segment for keyframe in keyframes}
    for edge in edges:
        a, b = (first[keyframes[number].segment] for number in (edge.earlier, edge.later))
        if a != b:
            first = {segment: min(a, b) if to in (a, b) else to for segment, to in first.items()}
    return first


def is_in_doubt(step: Step) -> bool:
    """Whether something speaks against a motion that is not lost: it may be off by more than its covariance says."""
    return not SPEAKS_AGAINST.isdisjoint(step.alignment.statuses)


def _may_be_keyframe(step: Step) -> bool:
    """Whether a step's frame becomes a keyframe if it is the run's last one."""
    return step.origin == "tracked" and not step.lost and step.depth_is_trusted


def _decoded(frames: AsTracked, index: int) -> Frame | None:
    try:
        return frames[index]
    except FrameError:
        return None
