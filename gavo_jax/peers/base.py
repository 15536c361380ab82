"""What every odometry of another library is asked for, and answers with."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, Float64

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.errors import GavoError


@dataclass(frozen=True, eq=False)
class PeerResult:
    """What a peer says of a pair of frames.

    Attributes:
        target_T_reference: maps points of the reference camera into the target camera, metres; the identity where the
            peer failed.
        success: the peer's own verdict, a weak one with all of them: each class says what it does not notice.
    """

    target_T_reference: Float64[np.ndarray, "4 4"]
    success: bool


class Peer(Protocol):
    """An odometry of another library, ready for frames of one camera.

    Attributes:
        name: key in `peers.registry.PEERS`.
        versions: of the libraries behind it, for the records of a run.
    """

    name: str
    versions: dict[str, str]

    def prepare(self, frame: Frame) -> Any:
        """Do the work on one frame that is kept between its pairs.

        Raises:
            GavoError: the frame is not of the camera's size.
        """
        ...

    def align(self, reference: Any, target: Any) -> PeerResult:
        """Align two prepared frames, but for kiss-icp from a zero guess."""
        ...


def check_size(frame: Frame, camera: Camera) -> None:
    """Refuse a frame that is not of the camera's size."""
    expected = (camera.height, camera.width)
    if frame.grey.shape != expected or frame.depth.shape != expected:
        raise GavoError(f"grey {frame.grey.shape} and depth {frame.depth.shape} for a camera of {expected}")


def failure() -> PeerResult:
    """What a peer answers that found nothing."""
    return PeerResult(np.eye(4), False)


def result_of(target_T_reference: Float[np.ndarray, "4 4"], success: bool) -> PeerResult:
    """Return the motion as float64; a failure where the peer says so or where the matrix is not finite."""
    if not success or not np.isfinite(target_T_reference).all():
        return failure()
    return PeerResult(np.array(target_T_reference, dtype=np.float64), True)
