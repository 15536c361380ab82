"""Feature matching and PnP as a peer: the usual OpenCV pipeline for frames that are far apart."""

import cv2

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.features import FeatureKind, Features, detect, solve_motion
from gavo_jax.peers.base import PeerResult, check_size, failure, result_of


class FeaturePeer:
    """Keypoints, ratio test, `cv2.solvePnPRansac` and `cv2.solvePnPRefineLM`, with the settings of `features`.

    `success` is false if a motion has fewer than `features.MIN_INLIERS` inliers. Repeated structure or a few chance
    matches can agree on a wrong motion.
    """

    def __init__(self, name: str, camera: Camera, kind: FeatureKind) -> None:
        """Set up the peer; kind selects the keypoint detector and descriptor."""
        self.name = name
        self.versions = {"opencv": cv2.__version__}
        self._camera = camera
        self._kind: FeatureKind = kind

    def prepare(self, frame: Frame) -> Features:
        """Detect and describe the keypoints of a frame.

        Raises:
            GavoError: The frame's size differs from the camera's.
        """
        check_size(frame, self._camera)
        return detect(frame.grey, frame.depth, self._camera, self._kind)

    def align(self, reference: Features, target: Features) -> PeerResult:
        """Align two prepared frames."""
        found = solve_motion(reference, target, self._camera)
        return failure() if found is None else result_of(found.target_T_reference, True)
