"""What is known of earlier pairs only later: that they followed a body."""

from collections.abc import Iterable
from dataclasses import replace

from gavo_jax.alignment.judgement import UNKNOWN
from gavo_jax.alignment.result import with_finding
from gavo_jax.odometry.driver import Step
from gavo_jax.status import AlignmentStatus


def revised(steps: Iterable[Step]) -> list[Step]:
    """The steps of a run, those that a later one revises as `moving_body`, with the covariance of what is unknown.

    Their poses stay as they are: how the camera moved meanwhile, nobody saw. Lost pairs stay as they are as well.

    Args:
        steps: As the driver made them, one after the other; revising them again changes nothing.
    """
    whole = list(steps)
    for place, step in enumerate(list(whole)):
        for earlier in range(max(place - step.revises, 0), place):
            whole[earlier] = whole[earlier] if whole[earlier].lost else _of_a_body(whole[earlier])
    return whole


def _of_a_body(step: Step) -> Step:
    result = with_finding(step.alignment, AlignmentStatus.MOVING_BODY)
    return replace(step, alignment=result._replace(covariance=UNKNOWN))
