"""The motion between two frames by features: keypoints matched by their descriptors, and the pose that explains them.

What one does with OpenCV in twenty lines: SIFT or ORB keypoints of both frames, the reference's depth at its own,
matches that pass the ratio test, `solvePnPRansac`, Levenberg-Marquardt on what agrees. It needs no guess,
only corners that both frames show. It is a rival of the wide search (`peers`), and a source of guesses for it.
"""

from functools import cache
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float64, UInt8

from gavo_jax.camera import Camera
from gavo_jax.image.numbers import Depth, grey_bytes

FeatureKind = Literal["sift", "orb"]

KEYPOINTS = 2000
"""Most keypoints of one image."""
CONTRAST = 0.01
"""SIFT's threshold (OpenCV's default: 0.04, at which a blurred image has a few hundred keypoints)."""
RATIO = 0.8
"""Largest distance of a match over that of the second-best one (Lowe 2004)."""
REPROJECTION = 2.0
"""Pixels within which a match agrees with a motion."""
ROUNDS = 2000
"""Largest number of RANSAC's samples; it ends sooner where it has, with `CONFIDENCE`, drawn one without outliers."""
CONFIDENCE = 0.9999
FEWEST = 6
"""Matches that must agree with a motion: what four points give has two to spare."""
REFINEMENTS = 3
"""Rounds of refining the motion by the matches that agree, and choosing these anew."""


class Features(NamedTuple):
    """Keypoints of one frame."""

    pixels: Float[np.ndarray, "n 2"]
    """Column and row."""
    descriptors: np.ndarray
    """[N, D]: float32 of SIFT, bytes of ORB."""
    points: Float64[np.ndarray, "n 3"]
    """In the frame's camera, metres; not-a-number where there is no reading."""


class FeatureMotion(NamedTuple):
    """The motion that most matches agree with."""

    target_T_reference: Float64[np.ndarray, "4 4"]
    """Maps points of the reference camera into the target camera, metres."""
    inliers: int
    """Number of matches that agree with the motion."""
    share: float
    """Share of the matches with a reading in the reference that agree."""


@cache
def _detector(kind: FeatureKind) -> Any:
    if kind == "sift":
        return cv2.SIFT.create(nfeatures=KEYPOINTS, contrastThreshold=CONTRAST)
    return cv2.ORB.create(nfeatures=KEYPOINTS)


def detect(grey: UInt8[np.ndarray, "h w"], depth: Depth, camera: Camera, kind: FeatureKind = "sift") -> Features:
    """Find the keypoints of a frame without lens distortion.

    Args:
        grey: Image.
        depth: Registered to it, in units of `camera.depth_scale` a metre, 0 = no reading.
        camera: Of the image.
        kind: What finds and describes them.
    """
    keypoints, descriptors = _detector(kind).detectAndCompute(grey_bytes(grey), None)
    if descriptors is None or not keypoints:
        return Features(np.zeros((0, 2)), np.zeros((0, 1), np.float32), np.zeros((0, 3)))
    pixels = np.array([keypoint.pt for keypoint in keypoints], np.float64)
    column, row = np.round(pixels).astype(int).T
    z = depth[row.clip(0, depth.shape[0] - 1), column.clip(0, depth.shape[1] - 1)] / float(camera.depth_scale)
    z = np.where(z > 0, z, np.nan)
    return Features(pixels, descriptors, np.asarray(camera.back_project(pixels, z)))


def match(reference: Features, target: Features) -> tuple[np.ndarray, np.ndarray]:
    """Places in the reference and in the target of the keypoints that match and have a reading in the reference."""
    known = np.flatnonzero(np.isfinite(reference.points[:, 2]))
    if len(known) == 0 or len(target.pixels) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    norm = cv2.NORM_L2 if reference.descriptors.dtype == np.float32 else cv2.NORM_HAMMING
    found = cv2.BFMatcher(norm).knnMatch(reference.descriptors[known], target.descriptors, k=2)
    good = [best for best, second in found if best.distance < RATIO * second.distance]
    return known[[m.queryIdx for m in good]], np.array([m.trainIdx for m in good], int)


def solve_motion(reference: Features, target: Features, camera: Camera) -> FeatureMotion | None:
    """The motion between two frames of which these are the keypoints; None where too few matches agree on one."""
    before, after = match(reference, target)
    if len(before) < FEWEST:
        return None
    points, pixels, matrix = reference.points[before], target.pixels[after], camera.rectified().matrix
    try:
        found, rotation, translation, inliers = cv2.solvePnPRansac(
            points,
            pixels,
            matrix,
            None,
            iterationsCount=ROUNDS,
            reprojectionError=REPROJECTION,
            confidence=CONFIDENCE,
            flags=cv2.SOLVEPNP_AP3P,
        )
    except cv2.error:  # of points that lie on a line
        return None
    if not found or inliers is None:
        return None
    chosen: np.ndarray = np.asarray(inliers)[:, 0]
    for _ in range(REFINEMENTS):
        if len(chosen) < FEWEST:
            return None
        rotation, translation = cv2.solvePnPRefineLM(
            points[chosen], pixels[chosen], matrix, None, rotation, translation
        )
        projected, _ = cv2.projectPoints(points, rotation, translation, matrix, None)
        ahead = (points @ cv2.Rodrigues(rotation)[0].T + translation.T)[:, 2] > 0
        near = np.linalg.norm(projected[:, 0] - pixels, axis=1) < REPROJECTION
        chosen = np.flatnonzero(near & ahead)
    if len(chosen) < FEWEST or not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        return None
    target_T_reference = np.eye(4)
    target_T_reference[:3, :3] = cv2.Rodrigues(rotation)[0]
    target_T_reference[:3, 3] = translation[:, 0]
    return FeatureMotion(target_T_reference, len(chosen), len(chosen) / len(before))


def feature_motion(
    reference: tuple[np.ndarray, np.ndarray],
    target: tuple[np.ndarray, np.ndarray],
    camera: Camera,
    kind: FeatureKind = "sift",
) -> FeatureMotion | None:
    """The motion between two frames by their features.

    Args:
        reference: Grey and depth, uint8 and uint16 of [H, W], without lens distortion; depth in units of
            `camera.depth_scale` a metre, 0 = no reading.
        target: The other frame, alike.
        camera: Their camera.
        kind: What finds and describes the keypoints.

    Returns:
        The motion with what speaks for it; None where too few matches agree on one.
    """
    return solve_motion(detect(*reference, camera, kind), detect(*target, camera, kind), camera)
