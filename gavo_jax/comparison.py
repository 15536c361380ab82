"""Odometries of other libraries behind this project's driver, so that all are timed, chained and judged alike."""

from typing import Any

from gavo_jax.alignment import Alignment, AlignmentStatus
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.odometry import Odometry, Progress, no_alignment
from gavo_jax.peers import make_peer
from gavo_jax.presets import OdometryOptions


class PeerOdometry(Odometry):
    """The driver with its alignment handed to a peer: frame to frame, from a zero guess, no second try.

    A pair that the peer calls failed is lost, as a pair is whose status is not `OK`. Of its alignments only
    `target_T_reference` and `status` mean something.
    """

    def __init__(self, name: str, camera: Camera) -> None:
        """Set up the peer of that name (`peers.PEERS`) for frames of a rectified camera.

        Raises:
            GavoError: no such peer, or its library cannot be imported.
        """
        super().__init__(camera, options=OdometryOptions(reference="previous", prior=False, recover=False))
        self.peer = make_peer(name, camera)

    def warm_up(self) -> float:
        """Return 0: nothing is compiled."""
        return 0.0

    def _start(self, frame: Frame) -> Any:
        return self.peer.prepare(frame)

    def _align(self, before: Progress, frame: Frame) -> tuple[Any, Alignment, bool]:
        prepared = self.peer.prepare(frame)
        found = self.peer.align(before.tracker, prepared)
        status = AlignmentStatus.OK if found.success else AlignmentStatus.NOT_FINITE
        return prepared, no_alignment(status)._replace(target_T_reference=found.target_T_reference), found.success
