"""Hindsight on earlier pairs: they followed a body, led to an image of another moment, or had wrong depth."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import accumulate, pairwise

import numpy as np
from jaxtyping import Float64

from gavo_jax.alignment.judgement import UNKNOWN, is_unknown
from gavo_jax.alignment.result import with_finding
from gavo_jax.odometry.driver import Step
from gavo_jax.odometry.plausibility import image_shift
from gavo_jax.rigid_motions import interpolate, log
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import inverse


def revised(steps: Iterable[Step]) -> list[Step]:
    """The steps of a run, with those that later steps revise flagged and given an unknown covariance.

    They become `moving_body`, `implausible_motion` or `depth_mismatch`, by the statuses of the step that revises them.
    Their poses stay, as nobody saw how the camera really moved. Lost pairs stay as they are as well.

    Args:
        steps: The driver's steps, in order; revising them again changes nothing.
    """
    whole = list(steps)
    for place, status in taken_back(whole).items():
        if is_unknown(whole[place].alignment):  # its status says why
            continue
        result = with_finding(whole[place].alignment, status)
        whole[place] = replace(whole[place], alignment=result._replace(covariance=UNKNOWN))
    return whole


def taken_back(steps: Sequence[Step]) -> dict[int, AlignmentStatus]:
    """Indices of the steps that turn out to be wrong, with the status that each one gets.

    `Step.revises` counts frames that became the reference. Frames in between that did not, as their images were
    doubted, are not counted. They are revised as well unless they are lost.
    """
    places = dict.fromkeys(sorted(of_other_moments(steps)), AlignmentStatus.IMPLAUSIBLE_MOTION)
    for last, step in enumerate(steps):
        place, left = last, step.revises
        finding = _said_of_others(step)
        while left > 0 and place > 0:
            left -= steps[place].reference_timestamp == steps[place - 1].timestamp
            place -= 1
            if not steps[place].lost:
                places[place] = finding
        if step.revises and AlignmentStatus.BAD_TIMESTAMP in step.alignment.statuses:
            later = last + 1  # it is not known when these began
            while later < len(steps) and steps[later].reference_timestamp == step.reference_timestamp:
                if not steps[later].lost:
                    places[later] = finding
                later += 1
    return places


def _said_of_others(step: Step) -> AlignmentStatus:
    """The fault that a step finds in those that it revises: timestamps, depth, or else a body.

    The step's first status has precedence: more may have been found since, in its image or by a later step.
    """
    telling = (AlignmentStatus.MOVING_BODY, *BY_TIME, AlignmentStatus.DEPTH_MISMATCH)
    first, found = step.alignment.status, step.alignment.statuses
    if first not in telling:
        first = next((status for status in telling if status in found), AlignmentStatus.MOVING_BODY)
    return AlignmentStatus.IMPLAUSIBLE_MOTION if first in BY_TIME else first


BY_TIME = (AlignmentStatus.IMPLAUSIBLE_MOTION, AlignmentStatus.BAD_TIMESTAMP)
"""Statuses of a step that revises others because of their timestamps."""


MUCH_SMOOTHER, MIN_JERKS = 5.0, 0.1
"""An image is of another moment if the path is this many times smoother without it, or with it and one of the next two
swapped. Its changes of motion must also move the image by more than this many radians in sum. Even the path of a camera
that turns round at every frame gets smoother by a factor of three at most.
"""
BEFORE, AFTER = 2, 3
"""Numbers of poses before and after such an image that are used."""


def of_other_moments(steps: Sequence[Step]) -> set[int]:
    """Indices of the motions to and from images that break an otherwise smooth path.

    The path is that of the motions as they were found, before any correction by loops. Lost frames are not on it.
    """
    places: set[int] = set()
    for chain in _chains(steps):
        motions = [np.asarray(steps[place].alignment.target_T_reference, np.float64) for place in chain]
        poses = list(accumulate(map(inverse, motions), np.matmul, initial=np.eye(4)))
        stamps = np.array([steps[chain[0]].reference_timestamp, *(steps[place].timestamp for place in chain)])
        turns = [there @ back < 0 for there, back in pairwise(map(log, motions))]
        for middle in range(BEFORE, len(poses) - 2):
            if turns[middle - 1]:
                window = slice(middle - BEFORE, middle + AFTER + 1)
                wrong = _misplaced(poses[window], stamps[window])
                places |= {chain[middle - BEFORE + k + step - 1] for k in wrong for step in (0, 1)}
    return places


def _chains(steps: Sequence[Step]) -> Iterator[list[int]]:
    """Indices of steps that are not lost, in chains in which each step begins where the one before ended."""
    chain: list[int] = []
    for place, step in enumerate(steps):
        if step.lost:
            continue
        if chain and step.reference_timestamp != steps[chain[-1]].timestamp:
            yield chain
            chain = []
        chain.append(place)
    if chain:
        yield chain


def _misplaced(poses: Sequence[np.ndarray], stamps: Float64[np.ndarray, " n"]) -> tuple[int, ...]:
    """Which of some poses, the third among them, are of other moments than their timestamps say, if any."""
    here, later = BEFORE, BEFORE + 1
    share = float((stamps[here] - stamps[here - 1]) / (stamps[later] - stamps[here - 1]))
    changed = [{here: interpolate(poses[here - 1], poses[later], share)}]
    changed += [{here: poses[k], k: poses[here]} for k in range(later, len(poses) - 1)]
    found, most = {}, MUCH_SMOOTHER
    for other in changed:
        whole = slice(max(max(other), later) + 2)
        jerks = _jerks(poses[whole], stamps[whole])
        smooth = _jerks([other.get(k, pose) for k, pose in enumerate(poses[whole])], stamps[whole])
        smoother = jerks / max(smooth, 1e-9)
        if jerks > MIN_JERKS and smoother > most:
            found, most = other, smoother
    return tuple(found)


def _jerks(poses: Sequence[np.ndarray], stamps: np.ndarray) -> float:
    """Return by how much the changes of motion along a path move the image, in sum, radians."""
    seconds = np.diff(stamps)
    speeds = np.array([log(inverse(a) @ b) for a, b in pairwise(poses)]) / seconds[:, None]
    changes = np.diff(speeds, axis=0) * np.median(seconds)
    return float(np.sum(image_shift(np.linalg.norm(changes[:, :3], axis=1), np.linalg.norm(changes[:, 3:], axis=1))))
