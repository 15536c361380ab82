"""Point-cloud odometries as peers, which use the depth alone: small_gicp and kiss-icp.

Their defaults suit a laser scanner with a range of a hundred metres. Each class lists the settings that differ.
"""

import importlib
import importlib.metadata
from typing import Any

import numpy as np
from jaxtyping import Float64

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.errors import GavoError
from gavo_jax.peers.base import PeerResult, check_size, failure, result_of
from gavo_jax.trajectory import inverse

NEAREST, FARTHEST = 0.4, 5.0
"""Range in which a structured-light depth camera measures well, metres."""
Cloud = Float64[np.ndarray, "n 3"]


def point_cloud(frame: Frame, camera: Camera) -> Cloud:
    """Back-project a frame's depth readings between `NEAREST` and `FARTHEST` to points in its camera, metres.

    Raises:
        GavoError: The frame's size differs from the camera's.
    """
    check_size(frame, camera)
    metres = frame.depth / float(camera.depth_scale)
    row, column = np.nonzero((metres > NEAREST) & (metres < FARTHEST))
    return np.asarray(camera.back_project(np.stack([column, row], axis=-1), metres[row, column]), np.float64)


class SmallGicpPeer:
    """`small_gicp.align`: generalised ICP of two point clouds.

    Settings that differ from the defaults, which suit a laser scanner:
    - downsampling to 2 cm (default 25 cm) and correspondences within 10 cm (default 1 m), to suit a desk;
    - 20 neighbours per point for its covariance (default 10), as in the library's own examples;
    - 50 iterations at most (default 20), two threads (default one).

    `success` means that the iteration converged, possibly to a wrong motion.
    """

    RESOLUTION, CORRESPONDENCE, NEIGHBOURS, ITERATIONS, THREADS = 0.02, 0.1, 20, 50, 2

    def __init__(self, name: str, camera: Camera) -> None:
        """Import the library."""
        self.name = name
        self._library = _import("small_gicp")
        self.versions = {"small_gicp": _version("small_gicp")}
        self._camera = camera

    def prepare(self, frame: Frame) -> Any:
        """Return the downsampled cloud with covariances and its k-d tree; None if it has too few points.

        Raises:
            GavoError: The frame's size differs from the camera's.
        """
        cloud = point_cloud(frame, self._camera)
        if len(cloud) < self.NEIGHBOURS:
            return None
        prepared = self._library.preprocess_points(cloud, self.RESOLUTION, self.NEIGHBOURS, self.THREADS)
        return None if prepared[0].size() < self.NEIGHBOURS else prepared

    def align(self, reference: Any, target: Any) -> PeerResult:
        """Align two prepared frames from a zero guess."""
        if reference is None or target is None:
            return failure()
        found = self._library.align(
            target[0],
            reference[0],
            target[1],
            registration_type="GICP",
            max_correspondence_distance=self.CORRESPONDENCE,
            num_threads=self.THREADS,
            max_iterations=self.ITERATIONS,
        )
        return result_of(found.T_target_source, bool(found.converged))


class KissIcpPeer:
    """`kiss_icp.kiss_icp.KissICP`: point-to-point ICP of a cloud against a map of earlier clouds.

    Successive frames are registered to the same map, as the method intends. A pair whose reference is not the last
    target starts a new map.

    Settings that differ from the defaults, which suit a laser scanner on a car:
    - range 0.4 to 5 m (default 0 to 100 m), and voxels of 3 cm (default a hundredth of the range);
    - initial threshold of 0.2 m and minimum motion of 0.02 m (defaults 2 m and 0.1 m), scaled down likewise;
    - no deskewing: a depth image has no timestamp per point.

    kiss-icp returns no flag: `success` means that both frames have points.
    """

    VOXEL, THRESHOLD, LEAST_MOTION = 0.03, 0.2, 0.02

    def __init__(self, name: str, camera: Camera) -> None:
        """Import the library."""
        self.name = name
        self._library = _import("kiss_icp.kiss_icp")
        self.versions = {"kiss-icp": _version("kiss-icp")}
        self._camera = camera
        self._odometry: Any = None
        self._last: Cloud | None = None

    def prepare(self, frame: Frame) -> Cloud:
        """Return the frame's point cloud.

        Raises:
            GavoError: The frame's size differs from the camera's.
        """
        return point_cloud(frame, self._camera)

    def align(self, reference: Cloud, target: Cloud) -> PeerResult:
        """Align the target to the map; a reference other than the last target first starts a new map."""
        if not len(reference) or not len(target):
            self._last = None
            return failure()
        if self._last is not reference:
            self._odometry = self._fresh()
            self._register(reference)
        before = self._odometry.last_pose
        self._register(target)
        return result_of(inverse(self._odometry.last_pose) @ before, True)

    def _fresh(self) -> Any:
        config = _import("kiss_icp.config").KISSConfig()
        config.data.min_range, config.data.max_range, config.data.deskew = NEAREST, FARTHEST, False
        config.mapping.voxel_size = self.VOXEL
        config.adaptive_threshold.initial_threshold = self.THRESHOLD
        config.adaptive_threshold.min_motion_th = self.LEAST_MOTION
        return self._library.KissICP(config)

    def _register(self, cloud: Cloud) -> None:
        self._odometry.register_frame(cloud, np.zeros(0))
        self._last = cloud


def _import(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise GavoError(f"{module} cannot be imported ({error}): install 'gavo-jax[peers]'") from error


def _version(package: str) -> str:
    return importlib.metadata.version(package)
