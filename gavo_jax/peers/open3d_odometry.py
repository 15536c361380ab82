"""Open3D's RGB-D odometries as peers: the legacy and the tensor pipeline."""

from typing import Any

import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.libusb import import_open3d
from gavo_jax.number_types import grey_bytes
from gavo_jax.peers.base import PeerResult, check_size, failure, result_of


class Open3DLegacyPeer:
    """`open3d.pipelines.odometry.compute_rgbd_odometry`: Gauss-Newton on three levels.

    The colour term is from Steinbrücker et al. 2011, the hybrid term from Park et al. 2017.

    Settings that differ from the defaults:
    - depth scale: the camera's (default 1000);
    - largest depth: 4 m for the hybrid term and 10 m for the colour term, as for OpenCV's photometric kinds (defaults
      3 m in the image's constructor, 4 m in the odometry).

    `success` is Open3D's own flag, which is true even for frames without any depth.
    """

    def __init__(self, name: str, camera: Camera, term: str, max_depth: float) -> None:
        """Set up the odometry.

        Args:
            name: Name of the peer.
            camera: Rectified camera of the frames.
            term: Class in `open3d.pipelines.odometry` that computes the Jacobian.
            max_depth: Largest depth used, metres.
        """
        self.name = name
        self._open3d = import_open3d("peers")
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
        """Convert a frame to Open3D's float intensity and depth.

        Raises:
            GavoError: The frame's size differs from the camera's.
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

    The largest depth is the default, 3 m: with as much as other peers use, these drift more on most clips.

    Open3D returns no flag here: `success` is false if it raises an error for a singular system.
    """

    ITERATIONS = (20, 20, 20, 20)  # coarse to fine

    def __init__(self, name: str, camera: Camera, method: str) -> None:
        """Set up the odometry; method is a member of `open3d.t.pipelines.odometry.Method`."""
        self.name = name
        self._open3d = import_open3d("peers")
        self.versions = {"open3d": self._open3d.__version__}
        self._camera = camera
        odometry = self._open3d.t.pipelines.odometry
        self._method = getattr(odometry.Method, method)
        self._criteria = [odometry.OdometryConvergenceCriteria(count) for count in self.ITERATIONS]
        self._intrinsics = self._open3d.core.Tensor(camera.matrix)

    def prepare(self, frame: Frame) -> Any:
        """Copy a frame to Open3D tensors, with the grey image repeated as the three channels that Open3D expects.

        Raises:
            GavoError: The frame's size differs from the camera's.
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
