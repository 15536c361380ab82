"""Odometries of other libraries by name, for comparison with this project's own.

Every peer returns `target_T_reference`, which maps points of the reference camera into the target camera, in metres.
Each aligns two single frames from a zero guess, except kiss-icp, which keeps a map of earlier frames. Each uses its
library's default settings, apart from those listed in its class's docstring. Libraries other than OpenCV are imported
only when one of their peers is made.
"""

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass

import cv2

from gavo_jax.camera import Camera
from gavo_jax.errors import GavoError
from gavo_jax.features import FeatureKind
from gavo_jax.peers.base import Peer
from gavo_jax.peers.clouds import KissIcpPeer, SmallGicpPeer
from gavo_jax.peers.features import FeaturePeer
from gavo_jax.peers.open3d_odometry import Open3DLegacyPeer, Open3DTensorPeer
from gavo_jax.peers.opencv_odometry import OpenCVPeer


@dataclass(frozen=True)
class PeerInfo:
    """A peer that can be asked for by name.

    Attributes:
        name: Key in `PEERS`.
        module: Module that must be importable.
        make: Builds the peer for a camera.
    """

    name: str
    module: str
    make: Callable[[Camera], Peer]

    @property
    def installed(self) -> bool:
        """Whether the peer's library is installed."""
        return importlib.util.find_spec(self.module) is not None


def _opencv(name: str, kind: int) -> PeerInfo:
    return PeerInfo(name, "cv2", lambda camera: OpenCVPeer(name, camera, kind))


def _legacy(name: str, term: str, max_depth: float) -> PeerInfo:
    return PeerInfo(name, "open3d", lambda camera: Open3DLegacyPeer(name, camera, term, max_depth))


def _tensor(name: str, method: str) -> PeerInfo:
    return PeerInfo(name, "open3d", lambda camera: Open3DTensorPeer(name, camera, method))


def _features(name: str, kind: FeatureKind) -> PeerInfo:
    return PeerInfo(name, "cv2", lambda camera: FeaturePeer(name, camera, kind))


PEERS: dict[str, PeerInfo] = {
    info.name: info
    for info in (
        _opencv("opencv-rgb", cv2.ODOMETRY_TYPE_RGB),
        _opencv("opencv-rgbd", cv2.ODOMETRY_TYPE_RGB_DEPTH),
        _opencv("opencv-depth", cv2.ODOMETRY_TYPE_DEPTH),
        _features("sift-pnp", "sift"),
        _features("orb-pnp", "orb"),
        _legacy("open3d-color", "RGBDOdometryJacobianFromColorTerm", 10.0),
        _legacy("open3d-hybrid", "RGBDOdometryJacobianFromHybridTerm", 4.0),
        _tensor("open3d-tensor-intensity", "Intensity"),
        _tensor("open3d-tensor-hybrid", "Hybrid"),
        _tensor("open3d-tensor-point-to-plane", "PointToPlane"),
        PeerInfo(
            "small-gicp",
            "small_gicp",
            lambda camera: SmallGicpPeer("small-gicp", camera),
        ),
        PeerInfo("kiss-icp", "kiss_icp", lambda camera: KissIcpPeer("kiss-icp", camera)),
    )
}
"""All peers by their names on the command line."""


def make_peer(name: str, camera: Camera) -> Peer:
    """Return the named peer, ready for rectified frames of the camera: no peer models lens distortion.

    Raises:
        GavoError: The name is not in `PEERS`, or its library cannot be imported.
    """
    if name not in PEERS:
        raise GavoError(f"unknown method {name!r}: the peers are {', '.join(PEERS)}")
    return PEERS[name].make(camera)
