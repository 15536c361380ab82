"""What is known of earlier pairs only later: that they followed a body, or led to an image of another moment."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

from gavo_jax.alignment.judgement import UNKNOWN
from gavo_jax.alignment.result import with_finding
from gavo_jax.odometry.driver import Step
from gavo_jax.status import AlignmentStatus


def revised(steps: Iterable[Step]) -> list[Step]:
    """The steps of a run, those that a later one revises as `moving_body` or `implausible_motion`, as its own
    statuses say, with the covariance of what is unknown.

    Their poses stay as they are: how the camera moved meanwhile, nobody saw. Lost pairs stay as they are as well.

    Args:
        steps: As the driver made them, one after the other; revising them again changes nothing.
    """
    whole = list(steps)
    for place, status in taken_back(whole).items():
        result = with_finding(whole[place].alignment, status)
        whole[place] = replace(whole[place], alignment=result._replace(covariance=UNKNOWN))
    return whole


def taken_back(steps: Sequence[Step]) -> dict[int, AlignmentStatus]:
    """Places, in a list of steps, of those that a later one revises, and what it finds.

    A step revises so many frames that became the reference. Frames between them that did not, as their images were
    doubted, do not count, and are revised as well where they are not lost.
    """
    places: dict[int, AlignmentStatus] = {}
    for last, step in enumerate(steps):
        place, left = last, step.revises
        finding = _said_of_others(step)
        while left > 0 and place > 0:
            left -= steps[place].reference_timestamp == steps[place - 1].timestamp
            place -= 1
            if not steps[place].lost:
                places[place] = finding
    return places


def _said_of_others(step: Step) -> AlignmentStatus:
    """What a step finds of those that it revises: that an image is not of its stamp's moment, or else a body."""
    found = step.alignment.statuses
    by_time = AlignmentStatus.IMPLAUSIBLE_MOTION in found or AlignmentStatus.BAD_TIMESTAMP in found
    is_body = AlignmentStatus.MOVING_BODY in found or not by_time
    return AlignmentStatus.MOVING_BODY if is_body else AlignmentStatus.IMPLAUSIBLE_MOTION
