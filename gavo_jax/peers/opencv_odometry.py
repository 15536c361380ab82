"""OpenCV's RGB-D odometries as peers."""

import cv2
import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.number_types import grey_bytes
from gavo_jax.peers.base import PeerResult, check_size, result_of


class OpenCVPeer:
    """`cv2.Odometry`: iteratively reweighted Gauss-Newton on four levels, OpenCV's algorithm `COMMON`.

    Settings that differ from the defaults:
    - camera matrix: the camera's (default: a generic one for 640×480);
    - largest translation and rotation: unlimited (defaults 0.15 m and 15 degrees). They only turn a finished result
      into a failure;
    - largest depth (default 4 m): `DEPTH_LIMIT` for the two photometric kinds, where far readings constrain rotation
      best. Point-to-plane keeps the default, because the sensor's noise grows with z²;
    - readings of `DEPTH_LIMIT` or more are dropped. If any value is above 10, OpenCV assumes units of 1/5000 m and
      divides the whole image: a single far reading would silently spoil the frame.

    `success` is false only if too few pixels match to solve for a motion: a diverged result counts as a success.
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
        """Build the pyramids, gradients and normals of a frame.

        Raises:
            GavoError: The frame's size differs from the camera's.
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
