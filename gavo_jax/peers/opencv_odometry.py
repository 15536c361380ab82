"""OpenCV's RGB-D odometries as peers."""

import cv2
import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.image.numbers import grey_bytes
from gavo_jax.peers.base import PeerResult, check_size, result_of


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
