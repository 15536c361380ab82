"""Runs peers by this project's driver, so that all methods are timed, chained and evaluated alike."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from gavo_jax.alignment.result import no_alignment
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.odometry.aligners import Attempt
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.tracking import Clock
from gavo_jax.peers.registry import Peer, make_peer
from gavo_jax.settings import OdometryOptions, Settings
from gavo_jax.status import AlignmentStatus


@dataclass(frozen=True)
class PeerAligner:
    """Adapts a peer to an aligner: from frame to frame, without a prior or a second attempt.

    A pair on which the peer fails is unusable, and its status is `HIGH_ERROR`, as peers don't say why. Only
    `target_T_reference` and `status` of the alignments are meaningful.
    """

    peer: Peer

    def warm_up(self) -> float:
        """Return 0: nothing is compiled."""
        return 0.0

    def start(self, frame: Frame) -> Any:
        """Return the first frame, prepared by the peer."""
        return self.peer.prepare(frame)

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        """Prepare a frame and align it to the previous one with the peer."""
        del clock
        prepared = self.peer.prepare(frame)
        found = self.peer.align(state, prepared)
        status = AlignmentStatus.OK if found.success else AlignmentStatus.HIGH_ERROR
        result = no_alignment(status)._replace(target_T_reference=found.target_T_reference)
        return Attempt(prepared, result, found.success)

    def predict(self, state: Any, elapsed: float) -> Float64[np.ndarray, "4 4"]:
        """Return the identity: a peer offers no prediction."""
        del state, elapsed
        return np.eye(4)


def peer_odometry(name: str, camera: Camera) -> Odometry:
    """Return a driver of the named peer (`peers.registry.PEERS`) for frames of a rectified camera.

    Raises:
        GavoError: There is no such peer, or its library cannot be imported.
    """
    settings = Settings(odometry=OdometryOptions(reference="previous", prior=False, recover=False))
    return Odometry(camera, settings, aligner=PeerAligner(make_peer(name, camera)))
