"""Adapters to the RGB-D odometries of other libraries, to set beside this one in the same tables.

Every peer answers in this project's terms: `target_T_reference`, which maps points of the reference camera into the
target camera, in metres. Each aligns two single frames from a zero guess, at its library's default settings; where one
differs, the docstring of the class names it with the reason. A library beside OpenCV is imported only when one of its
peers is made.
"""

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.errors import GavoError
from gavo_jax.features import FeatureKind
from gavo_jax.image.numbers import grey_bytes
from gavo_jax.libusb import import_with_libusb
from gavo_jax.peers.base import Peer, PeerResult, check_size, failure, result_of
from gavo_jax.peers.clouds import KissIcpPeer, SmallGicpPeer
from gavo_jax.peers.features import FeaturePeer


class OpenCVPeer:
    """`cv2.Odometry`: iteratively reweighted Gauss-Newton on four levels, the library's algorithm `COMMON`.

    Settings that differ from the defaults:
    - camera matrix: the camera's (default: a generic one for 640×480);
    - largest translation and rotation of a result: open (defaults 0.15 m and 15 degrees). They only turn a finished
      result into a failure;
    - largest depth (default 4 m): open for the two photometric kinds, whose rotation far readings hold best; point to
      plane alone keeps the default, because the sensor's noise grows with z²;
    - readings of `DEPTH_LIMIT` and beyond are dropped: OpenCV takes a depth image with any value above 10 for one in
      1/5000 m and divides all of it, so that one far reading would spoil the frame without a word.

    `success` is false only where too few pixels match to solve for a motion at all: a diverged result counts as one.
    """

    DEPTH_LIMIT = 10.0  # metres

    def __init__(self, name: str, camera: Camera, kind: int) -> None:
        """Set up the odometry; kind is one of `cv2.ODOMETRY_TYPE_…`."""
        self.name = name
        self.versions = {"opencv": cv2.__version__}
        self._camera = camera
        settings = cv2.OdometrySettings()
        settings.setCameraMatrix(camera.matrix.astype(np.float32))
        settings.setMaxTranslation(1e6)
        settings.setMaxRotation(360.0)
        if kind != cv2.ODOMETRY_TYPE_DEPTH:
            settings.setMaxDepth(self.DEPTH_LIMIT)
        self._odometry = cv2.Odometry(kind, settings, cv2.ODOMETRY_ALGO_TYPE_COMMON)

    def prepare(self, frame: Frame) -> cv2.OdometryFrame:
        """Build pyramids, gradients and normals of one frame.

        Raises:
            GavoError: the frame is not of the camera's size.
        """
        check_size(frame, self._camera)
        metres = frame.depth.astype(np.float32) / np.float32(self._camera.depth_scale)
        metres[metres >= self.DEPTH_LIMIT] = 0.0
        prepared = cv2.OdometryFrame(depth=metres, image=grey_bytes(frame.grey))
        self._odometry.prepareFrame(prepared)
        return prepared

    def align(self, reference: cv2.OdometryFrame, target: cv2.OdometryFrame) -> PeerResult:
        """Align two prepared frames from a zero guess."""
        success, target_T_reference = self._odometry.compute(reference, target)
        return result_of(target_T_reference, success)


class Open3DLegacyPeer:
    """`open3d.pipelines.odometry.compute_rgbd_odometry`: Gauss-Newton on three levels.

    The colour term is that of Steinbrücker et al. 2011, the hybrid one that of Park et al. 2017.

    Settings that differ from the defaults:
    - depth scale: the camera's (default 1000);
    - the cut-off of the image constructor (default 3 m): the odometry's own default of 4 m for the hybrid term; for
      the colour term both are open at 10 m, as for OpenCV's photometric kinds.

    `success` is Open3D's flag, which is true even for frames without any depth.
    """

    def __init__(self, name: str, camera: Camera, term: str, max_depth: float) -> None:
        """Set up the odometry.

        Args:
            name: the peer's name.
            camera: of the frames, rectified.
            term: class of `open3d.pipelines.odometry` that gives the Jacobian.
            max_depth: metres; readings beyond are not used.
        """
        self.name = name
        self._open3d = _import_open3d()
        self.versions = {"open3d": self._open3d.__version__}
        self._camera = camera
        self._max_depth = max_depth
        odometry = self._open3d.pipelines.odometry
        self._jacobian = getattr(odometry, term)()
        self._option = odometry.OdometryOption(depth_max=max_depth)
        self._intrinsic = self._open3d.camera.PinholeCameraIntrinsic(
            camera.width, camera.height, float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy)
        )

    def prepare(self, frame: Frame) -> Any:
        """Convert one frame to Open3D's float intensity and depth.

        Raises:
            GavoError: the frame is not of the camera's size.
        """
        check_size(frame, self._camera)
        image = self._open3d.geometry.Image
        return self._open3d.geometry.RGBDImage.create_from_color_and_depth(
            image(grey_bytes(frame.grey)),
            image(np.ascontiguousarray(frame.depth)),
            depth_scale=float(self._camera.depth_scale),
            depth_trunc=self._max_depth,
            convert_rgb_to_intensity=True,
        )

    def align(self, reference: Any, target: Any) -> PeerResult:
        """Align two prepared frames from a zero guess."""
        success, target_T_reference, _ = self._open3d.pipelines.odometry.compute_rgbd_odometry(
            reference, target, self._intrinsic, np.eye(4), self._jacobian, self._option
        )
        return result_of(target_T_reference, success)


class Open3DTensorPeer:
    """`open3d.t.pipelines.odometry.rgbd_odometry_multi_scale` on the CPU: Gauss-Newton with Huber losses.

    Settings that differ from the defaults:
    - depth scale: the camera's (default 1000);
    - four levels of at most 20 iterations; the default three levels of 10, 5 and 3, coarse to fine, stop well short of
      convergence with the intensity and hybrid methods.

    The library has no flag: `success` is false where it raises its error of a singular system.
    """

    ITERATIONS = (20, 20, 20, 20)  # coarse to fine

    def __init__(self, name: str, camera: Camera, method: str) -> None:
        """Set up the odometry; method is a member of `open3d.t.pipelines.odometry.Method`."""
        self.name = name
        self._open3d = _import_open3d()
        self.versions = {"open3d": self._open3d.__version__}
        self._camera = camera
        odometry = self._open3d.t.pipelines.odometry
        self._method = getattr(odometry.Method, method)
        self._criteria = [odometry.OdometryConvergenceCriteria(count) for count in self.ITERATIONS]
        self._intrinsics = self._open3d.core.Tensor(camera.matrix)

    def prepare(self, frame: Frame) -> Any:
        """Copy one frame into Open3D's tensors; the grey becomes three equal channels, which Open3D expects.

        Raises:
            GavoError: the frame is not of the camera's size.
        """
        check_size(frame, self._camera)
        image, tensor = self._open3d.t.geometry.Image, self._open3d.core.Tensor
        color = np.repeat(grey_bytes(frame.grey)[..., None], 3, axis=-1)
        depth = np.ascontiguousarray(frame.depth[..., None])
        return self._open3d.t.geometry.RGBDImage(image(tensor(color)), image(tensor(depth)))

    def align(self, reference: Any, target: Any) -> PeerResult:
        """Align two prepared frames from a zero guess."""
        try:
            result = self._open3d.t.pipelines.odometry.rgbd_odometry_multi_scale(
                reference,
                target,
                self._intrinsics,
                depth_scale=float(self._camera.depth_scale),
                criteria_list=self._criteria,
                method=self._method,
            )
        except RuntimeError as error:
            if "Singular" not in str(error):
                raise
            return failure()
        return result_of(result.transformation.numpy(), True)


@dataclass(frozen=True)
class PeerInfo:
    """A peer that can be asked for by name.

    Attributes:
        name: key in `PEERS`.
        module: what must be importable.
        make: builds the peer for a camera.
    """

    name: str
    module: str
    make: Callable[[Camera], Peer]

    @property
    def installed(self) -> bool:
        """Whether its library is installed."""
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
"""Every peer by the name that the command line knows."""


def make_peer(name: str, camera: Camera) -> Peer:
    """Return the peer of that name, ready for rectified frames of that camera: no peer models lens distortion.

    Raises:
        GavoError: the name is not in `PEERS`, or its library cannot be imported.
    """
    if name not in PEERS:
        raise GavoError(f"unknown method {name!r}: the peers are {', '.join(PEERS)}")
    return PEERS[name].make(camera)


def _import_open3d() -> Any:
    try:
        return import_with_libusb("open3d")
    except (ImportError, OSError) as error:
        raise GavoError(f"Open3D cannot be imported ({error}): install 'gavo-jax[peers]'") from error
