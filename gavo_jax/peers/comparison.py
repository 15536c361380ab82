"""Odometries of other libraries behind this project's driver, so that all are timed, chained and judged alike."""

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
    """A peer as an aligner: frame to frame, from a zero guess, no second try.

    A pair that the peer calls failed is unusable, as one is whose status is not `OK`. Of its alignments only
    `target_T_reference` and `status` mean something.
    """

    peer: Peer

    def warm_up(self) -> float:
        """Nothing is compiled."""
        return 0.0

    def start(self, frame: Frame) -> Any:
        """What the peer makes of a frame before it is aligned."""
        return self.peer.prepare(frame)

    def align(self, state: Any, frame: Frame, clock: Clock) -> Attempt:
        """Align as the peer does it."""
        del clock
        prepared = self.peer.prepare(frame)
        found = self.peer.align(state, prepared)
        status = AlignmentStatus.OK if found.success else AlignmentStatus.NOT_FINITE
        result = no_alignment(status)._replace(target_T_reference=found.target_T_reference)
        return Attempt(prepared, result, found.success)

    def predict(self, state: Any, elapsed: float) -> Float64[np.ndarray, "4 4"]:
        """No motion: a peer keeps none."""
        del state, elapsed
        return np.eye(4)


def peer_odometry(name: str, camera: Camera) -> Odometry:
    """The driver with the peer of that name (`peers.registry.PEERS`), for frames of a rectified camera.

    Raises:
        GavoError: no such peer, or its library cannot be imported.
    """
    settings = Settings(odometry=OdometryOptions(reference="previous", prior=False, recover=False))
    return Odometry(camera, settings, aligner=PeerAligner(make_peer(name, camera)))
