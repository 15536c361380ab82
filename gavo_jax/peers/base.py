"""Interface of peers, the odometries of other libraries, and their results."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, Float64

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.errors import GavoError


@dataclass(frozen=True, eq=False)
class PeerResult:
    """A peer's result for a pair of frames.

    Attributes:
        target_T_reference: Maps points of the reference camera into the target camera, metres; the identity if the
            peer failed.
        success: The peer's own verdict, which is weak for all peers: each class says which failures it misses.
    """

    target_T_reference: Float64[np.ndarray, "4 4"]
    success: bool


class Peer(Protocol):
    """An odometry of another library, ready for frames of one camera.

    Attributes:
        name: Key in `peers.registry.PEERS`.
        versions: Versions of the underlying libraries, for the records of a run.
    """

    name: str
    versions: dict[str, str]

    def prepare(self, frame: Frame) -> Any:
        """Prepare a frame, once for all the pairs it is in.

        Raises:
            GavoError: The frame's size differs from the camera's.
        """
        ...

    def align(self, reference: Any, target: Any) -> PeerResult:
        """Align two prepared frames, from a zero guess except for kiss-icp."""
        ...


def check_size(frame: Frame, camera: Camera) -> None:
    """Raise GavoError if a frame's size differs from the camera's."""
    expected = (camera.height, camera.width)
    if frame.grey.shape != expected or frame.depth.shape != expected:
        raise GavoError(f"grey {frame.grey.shape} and depth {frame.depth.shape} for a camera of {expected}")


def failure() -> PeerResult:
    """The result of a peer that found no motion."""
    return PeerResult(np.eye(4), False)


def result_of(target_T_reference: Float[np.ndarray, "4 4"], success: bool) -> PeerResult:
    """Return the motion as float64, or a failure if the peer failed or the matrix is not finite."""
    if not success or not np.isfinite(target_T_reference).all():
        return failure()
    return PeerResult(np.array(target_T_reference, dtype=np.float64), True)
