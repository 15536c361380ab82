"""Relocalisation of a frame that nothing ties to earlier ones: keyframes that look alike, features, an alignment.

Small images tell which keyframes are worth a look, and matched keypoints give a motion without any guess. The alignment
there and back decides, as it does for loops.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32

from gavo_jax.camera import Camera
from gavo_jax.features import Features, detect, solve_motion
from gavo_jax.image.motion_compensation import CompensatedImages
from gavo_jax.mapping.candidates import LoopCandidate
from gavo_jax.mapping.keyframes import Keyframe, Thumbnail
from gavo_jax.mapping.verification import Edge, Verifier

MATCHED_KEYFRAMES = 8
"""Number of keyframes whose features are matched: those that look most like the frame."""
ALIGNED = 4
"""Number of matched keyframes that are aligned: those with most matches."""
MARGIN = 0.2
"""Share of a small image's width and height by which two images may be shifted and still look alike."""
MIN_MATCHES = 15
"""Fewest matched keypoints that have to agree with a motion."""
MIN_LIKENESS = 0.7
"""Smallest correlation of what both see under the motion found."""


class Place(NamedTuple):
    """The place of a frame in the map."""

    keyframe: Keyframe
    edge: Edge
    """Edge from that keyframe to the frame."""


class Recogniser:
    """Finds frames among keyframes.

    Args:
        camera: Camera of the keyframes' images.
        verifier: Decides whether a motion is right.
    """

    def __init__(self, camera: Camera, verifier: Verifier):
        self.camera, self.verifier = camera, verifier

    def find(self, frame: Keyframe, keyframes: list[Keyframe]) -> Place | None:
        """Return the place of a frame among keyframes; None where none of them shows it.

        Args:
            frame: The frame, made a keyframe; its poses are not used.
            keyframes: The keyframes to search, with their images.
        """
        alike = sorted(keyframes, key=lambda other: -likeness(frame.thumbnail, other.thumbnail))[:MATCHED_KEYFRAMES]
        seen = self._detect(frame)
        guesses: list[tuple[int, LoopCandidate]] = []
        for other in alike:
            motion = solve_motion(self._known(other), seen, self.camera)
            if motion is None or motion.inliers < MIN_MATCHES:
                continue
            _, agreement = other.thumbnail.agreement(frame.thumbnail, motion.target_T_reference, self.camera)
            if agreement >= MIN_LIKENESS:
                candidate = LoopCandidate(other, frame, motion.target_T_reference, 1.0, agreement)
                guesses.append((motion.inliers, candidate))
        guesses.sort(key=lambda guess: -guess[0])
        candidates = [candidate for _, candidate in guesses[:ALIGNED]]
        edges = self.verifier.verify(candidates)
        for candidate, edge in zip(candidates, edges, strict=True):
            if edge is not None:
                return Place(candidate.earlier, edge)
        return None

    def _known(self, keyframe: Keyframe) -> Features:
        """Keypoints of a keyframe, detected when first needed.

        SIFT's descriptors are whole numbers below 256, and are kept as bytes.
        """
        if keyframe.features is None:
            found = self._detect(keyframe)
            keyframe.features = found._replace(descriptors=found.descriptors.astype(np.uint8))
        return keyframe.features._replace(descriptors=keyframe.features.descriptors.astype(np.float32))

    def _detect(self, keyframe: Keyframe) -> Features:
        images: CompensatedImages | None = keyframe.images
        assert images is not None
        return detect(images.grey, images.depth, self.camera)


def likeness(a: Thumbnail, b: Thumbnail) -> float:
    """Correlation of two small images at the shift that fits best."""
    height, width = a.small.shape
    rows, columns = int(MARGIN * height), int(MARGIN * width)
    middle: Float32[np.ndarray, "h w"] = a.small[rows : height - rows, columns : width - columns]
    return float(cv2.matchTemplate(b.small, middle, cv2.TM_CCOEFF_NORMED).max())
