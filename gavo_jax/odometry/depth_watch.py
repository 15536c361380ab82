"""Evidence against a run's depth as a whole, from its first frame on: how it changes, and where its edges lie."""

from typing import NamedTuple

from gavo_jax.alignment.result import Alignment, with_finding
from gavo_jax.bodies.records import Body, covered, without_moving
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.depth_edges import DepthEdges
from gavo_jax.odometry.depth_change import DepthChange, depth_on_grid
from gavo_jax.status import AlignmentStatus


class DepthWatch(NamedTuple):
    """What is known of a run's depth."""

    change: DepthChange
    edges: DepthEdges
    found_wrong: bool = False
    """Whether the depth was found to be wrong at the last pair."""

    @property
    def is_wrong(self) -> bool:
        """Whether its change or its edges speak against it."""
        return self.change.is_unexplained or bool(self.edges.fault)

    def pairs_covered(self, pairs: int) -> int:
        """Return how many of the last `pairs` pairs are spoken against."""
        by_change = self.change.pairs_covered(pairs) if self.change.is_unexplained else 0
        return max(by_change, self.edges.pairs_covered(pairs) if self.edges.fault else 0)

    def blamed(self, result: Alignment, revises: int, pairs: int) -> tuple[Alignment, int]:
        """Blame the depth for the pairs before the one at which it is found wrong; see `Step.revises`.

        Args:
            result: Result of that pair. Its status is what the earlier ones get.
            revises: Number of pairs before it that are wrong for another reason.
            pairs: Number of pairs before it.

        Returns:
            The result and the number of wrong pairs; as they were if fewer of them are the depth's fault.
        """
        covered = self.pairs_covered(pairs)
        if covered < max(revises, 1):
            return result, revises
        return result._replace(status=AlignmentStatus.DEPTH_MISMATCH), covered


def watch_from(before: DepthWatch | None, frame: Frame, camera: Camera) -> DepthWatch:
    """Continue with another reference, or start with a run's first one."""
    if before is None:
        change = DepthChange(depth_on_grid(frame, camera), frame.depth_delay)
        return DepthWatch(change, DepthEdges.none().after(frame, camera))
    return before._replace(change=before.change.seen_from(frame, camera), edges=before.edges.after(frame, camera))


def judge_by_depth(
    watch: DepthWatch, frame: Frame, bodies: tuple[Body, ...], elapsed: float, result: Alignment, camera: Camera
) -> tuple[Alignment, DepthWatch]:
    """A pair's result, with `DEPTH_MISMATCH` among its findings if the run's depth is wrong, and the updated watch.

    A pair whose own depth is in doubt tells nothing of the run's: its depth became wrong, which is already reported.

    Args:
        watch: What was known before.
        frame: The target.
        bodies: Bodies that move on their own in it.
        elapsed: Time between the two images, seconds.
        result: Result of the pair.
        camera: Camera of both frames.
    """
    if AlignmentStatus.DEPTH_MISMATCH in result.statuses:
        return result, watch
    explained = float(result.explained.grey)
    at_rest = without_moving(frame, covered(bodies), border=0.0)
    change = watch.change.after(frame, at_rest, elapsed, result.target_T_reference, explained, camera)
    watch = watch._replace(change=change)
    watch = watch._replace(found_wrong=watch.is_wrong)
    return with_finding(result, AlignmentStatus.DEPTH_MISMATCH) if watch.found_wrong else result, watch
