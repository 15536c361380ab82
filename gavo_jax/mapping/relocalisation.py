"""Where a frame is that nothing ties to the frames before: keyframes that look like it, features, an alignment.

Small images tell which keyframes are worth a look, matched keypoints give a motion without any guess, and the alignment
there and back decides: it is the same that verifies loops.
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

LOOKED_AT = 8
"""Keyframes whose features are matched, those most like the frame."""
ALIGNED = 4
"""Of these, the keyframes that are aligned, the best ones by matches."""
MARGIN = 0.2
"""Share of a small image's width and height by which two may be shifted against each other and still look alike."""
MIN_MATCHES = 15
"""Matched keypoints that agree with a motion."""
MIN_LIKENESS = 0.7
"""Correlation of what both see, by the motion that was found."""


class Place(NamedTuple):
    """Where a frame is."""

    keyframe: Keyframe
    edge: Edge
    """From that keyframe to the frame."""


class Recogniser:
    """Finds frames among keyframes.

    Args:
        camera: Of the keyframes' images.
        verifier: What decides.
    """

    def __init__(self, camera: Camera, verifier: Verifier):
        self.camera, self.verifier = camera, verifier

    def find(self, frame: Keyframe, keyframes: list[Keyframe]) -> Place | None:
        """Return where a frame is, as a keyframe of its own; None where none of the others shows that.

        Args:
            frame: Its poses say nothing.
            keyframes: The others, with their images.
        """
        alike = sorted(keyframes, key=lambda other: -likeness(frame.thumbnail, other.thumbnail))[:LOOKED_AT]
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
        """Keypoints of a keyframe, found when they are first needed. SIFT's descriptors are whole numbers below 256,
        and kept as bytes.
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
    """Correlation of two small images at the shift that suits them best."""
    height, width = a.small.shape
    rows, columns = int(MARGIN * height), int(MARGIN * width)
    middle: Float32[np.ndarray, "h w"] = a.small[rows : height - rows, columns : width - columns]
    return float(cv2.matchTemplate(b.small, middle, cv2.TM_CCOEFF_NORMED).max())
