"""The motion between two frames from features: keypoints matched by their descriptors, and the pose that explains them.

The usual OpenCV pipeline: SIFT or ORB keypoints of both frames, depth at the reference's, matches that pass the ratio
test, `solvePnPRansac`, and Levenberg-Marquardt on the inliers. It needs no guess, only features that both frames show.
It is a baseline for the wide search (`peers`), and a source of guesses for it.
"""

from functools import cache
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float64, UInt8

from gavo_jax.camera import Camera
from gavo_jax.number_types import Depth, grey_bytes

FeatureKind = Literal["sift", "orb"]

KEYPOINTS = 2000
"""Largest number of keypoints of an image."""
CONTRAST = 0.01
"""SIFT's contrast threshold (at OpenCV's default, 0.04, a blurred image has a few hundred keypoints)."""
RATIO = 0.8
"""Largest ratio of a match's distance to that of the second-best one (Lowe 2004)."""
REPROJECTION = 2.0
"""Reprojection error below which a match is an inlier, pixels."""
ROUNDS = 2000
"""Largest number of RANSAC samples; it ends sooner once one is free of outliers with probability `CONFIDENCE`."""
CONFIDENCE = 0.9999
MIN_INLIERS = 6
"""Smallest number of inliers: two more than the four points that a motion is computed from."""
REFINEMENTS = 3
"""Rounds of refining the motion on the inliers and choosing these anew."""


class Features(NamedTuple):
    """Keypoints of one frame."""

    pixels: Float[np.ndarray, "n 2"]
    """Column and row."""
    descriptors: np.ndarray
    """[N, D]: float32 of SIFT, bytes of ORB."""
    points: Float64[np.ndarray, "n 3"]
    """In the frame's camera, metres; NaN where there is no reading."""


class FeatureMotion(NamedTuple):
    """The motion with the most inliers among the matches."""

    target_T_reference: Float64[np.ndarray, "4 4"]
    """Maps points of the reference camera into the target camera, metres."""
    inliers: int
    """Number of matches that agree with the motion."""
    share: float
    """Share of inliers among the matches, all of which have a reading in the reference."""


@cache
def _detector(kind: FeatureKind) -> Any:
    if kind == "sift":
        return cv2.SIFT.create(nfeatures=KEYPOINTS, contrastThreshold=CONTRAST)
    return cv2.ORB.create(nfeatures=KEYPOINTS)


def detect(grey: UInt8[np.ndarray, "h w"], depth: Depth, camera: Camera, kind: FeatureKind = "sift") -> Features:
    """Find the keypoints of a frame without lens distortion.

    Args:
        grey: Grey image.
        depth: Depth registered to it, in units of `camera.depth_scale` per metre, 0 = no reading.
        camera: Camera of the image.
        kind: Detector and descriptor.
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
    """Return the indices, in the reference and in the target, of matches with a reading in the reference."""
    known = np.flatnonzero(np.isfinite(reference.points[:, 2]))
    if len(known) == 0 or len(target.pixels) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    norm = cv2.NORM_L2 if reference.descriptors.dtype == np.float32 else cv2.NORM_HAMMING
    found = cv2.BFMatcher(norm).knnMatch(reference.descriptors[known], target.descriptors, k=2)
    good = [best for best, second in found if best.distance < RATIO * second.distance]
    return known[[m.queryIdx for m in good]], np.array([m.trainIdx for m in good], int)


def solve_motion(reference: Features, target: Features, camera: Camera) -> FeatureMotion | None:
    """Return the motion between two frames from their keypoints; None if it has too few inliers."""
    before, after = match(reference, target)
    if len(before) < MIN_INLIERS:
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
    except cv2.error:  # collinear points
        return None
    if not found or inliers is None:
        return None
    chosen: np.ndarray = np.asarray(inliers)[:, 0]
    for _ in range(REFINEMENTS):
        if len(chosen) < MIN_INLIERS:
            return None
        rotation, translation = cv2.solvePnPRefineLM(
            points[chosen], pixels[chosen], matrix, None, rotation, translation
        )
        projected, _ = cv2.projectPoints(points, rotation, translation, matrix, None)
        ahead = (points @ cv2.Rodrigues(rotation)[0].T + translation.T)[:, 2] > 0
        near = np.linalg.norm(projected[:, 0] - pixels, axis=1) < REPROJECTION
        chosen = np.flatnonzero(near & ahead)
    if len(chosen) < MIN_INLIERS or not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
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
    """Return the motion between two frames from their features.

    Args:
        reference: Grey and depth, uint8 and uint16 of [H, W], without lens distortion; depth in units of
            `camera.depth_scale` per metre, 0 = no reading.
        target: The other frame, likewise.
        camera: Their camera.
        kind: Detector and descriptor.

    Returns:
        The motion with its inliers; None if these are too few.
    """
    return solve_motion(detect(*reference, camera, kind), detect(*target, camera, kind), camera)
