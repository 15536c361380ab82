"""Features and a pose from matches as a peer: what one writes with OpenCV where two frames lie far apart."""

import cv2

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.features import FeatureKind, Features, detect, solve_motion
from gavo_jax.peers.base import PeerResult, check_size, failure, result_of


class FeaturePeer:
    """Keypoints, ratio test, `cv2.solvePnPRansac` and `cv2.solvePnPRefineLM`, with the settings of `features`.

    `success` is false where fewer than `features.FEWEST` matches agree on a motion. Repeated structure and a handful of
    chance matches can agree on a wrong one.
    """

    def __init__(self, name: str, camera: Camera, kind: FeatureKind) -> None:
        """Set up; kind is what finds and describes the keypoints."""
        self.name = name
        self.versions = {"opencv": cv2.__version__}
        self._camera = camera
        self._kind: FeatureKind = kind

    def prepare(self, frame: Frame) -> Features:
        """Find the keypoints of one frame.

        Raises:
            GavoError: the frame is not of the camera's size.
        """
        check_size(frame, self._camera)
        return detect(frame.grey, frame.depth, self._camera, self._kind)

    def align(self, reference: Features, target: Features) -> PeerResult:
        """Align two prepared frames."""
        found = solve_motion(reference, target, self._camera)
        return failure() if found is None else result_of(found.target_T_reference, True)
