"""The motion between two frames, each taken by a moving camera.

A rolling shutter reads the rows of an image one after the other, and depth has another timestamp than grey. In a video
the motion between two frames gives the camera's velocity; between frames far apart it doesn't. But the distortion of
one frame by the camera's motion shows in the other frame. So both velocities are unknowns beside the motion, with a
prior. All three are fitted to the reprojection errors of each frame's corners in the other one.
"""

from typing import NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8

from gavo_jax.alignment.corners import track_corners
from gavo_jax.alignment.result import MAX_ROTATION_DEVIATION, MAX_TRANSLATION_DEVIATION, Alignment
from gavo_jax.camera import Camera, to_pixels, to_ray
from gavo_jax.image.motion_compensation import filled_inverse_depth, pixel_flow
from gavo_jax.image.shutter import row_time
from gavo_jax.number_types import Depth
from gavo_jax.se3 import log
from gavo_jax.status import AlignmentStatus, bit, gravest
from gavo_jax.trajectory import inverse

USUAL_SPEED = (0.5, 1.0)
"""m/s and rad/s: standard deviations of a hand-held camera's velocity."""
UNSHUTTERED = (0.04, 0.04)
"""Metres and radians: standard deviations of a motion that was found under the assumption of a global shutter."""
NOISE = 1.0
"""Lower bound on the reprojection error's scale, pixels."""
INDEPENDENT = 4.0
"""Largest effective number of independent corners per frame, as whole surfaces share their errors (depth, blur)."""
MIN_CORNERS = 20
"""Smallest number of corners for a result."""
ROUNDS = 8
LOOKS = 3
"""Number of first rounds in which depth is looked up anew."""

GreyAndDepth = tuple[UInt8[np.ndarray, "h w"], Depth]


class OwnMotion(NamedTuple):
    """The motion that corners give."""

    target_T_reference: Float64[np.ndarray, "4 4"]
    """The motion between the two frames' timestamps, those of their middle rows."""
    covariance: Float64[np.ndarray, "6 6"]
    """Covariance of δ in target_T_reference · exp(δ), metres and radians."""


def refine_moving(
    reference: GreyAndDepth,
    target: GreyAndDepth,
    camera: Camera,
    target_T_reference: Float[np.ndarray, "4 4"],
    delays: tuple[float, float] = (0.0, 0.0),
) -> OwnMotion | None:
    """Refine a motion that was found as if each frame were taken at one instant; None if there are too few corners.

    Args:
        reference: Grey and depth.
        target: The other frame's.
        camera: Camera of both, without distortion.
        target_T_reference: The motion that was found.
        delays: Seconds from each colour image's timestamp to its depth image's.
    """
    matches = track_corners(reference, target[0], target_T_reference, camera)
    if len(matches.reference) < MIN_CORNERS:
        return None
    frames = [
        _Side.of(pixels, images[1], camera, delay)
        for pixels, images, delay in zip(matches, (reference, target), delays, strict=True)
    ]
    start = np.asarray(target_T_reference, np.float64)
    prior = np.repeat([*UNSHUTTERED, *USUAL_SPEED, *USUAL_SPEED], 3) ** -2.0
    x, hessian = np.zeros(18), np.diag(prior)
    points: list[_Points] = []
    for number in range(ROUNDS):
        twists = x[6:].reshape(2, 6)
        if number < LOOKS:
            points = [frame.points(twist) for frame, twist in zip(frames, twists, strict=True)]
        residuals, slopes, known = _errors(frames, points, start @ _step(x[:6]), twists, camera)
        if known.sum() < MIN_CORNERS:
            return None
        weights = known * _weights(np.linalg.norm(residuals, axis=1), known)
        counted = weights * min(1.0, 2.0 * INDEPENDENT / max(float(weights.sum()), 1e-9))
        scale = max(NOISE, float(np.median(np.linalg.norm(residuals[known], axis=1))))
        weighted = slopes * (counted / scale**2)[:, None, None]
        hessian = np.einsum("nki,nkj->ij", weighted, slopes) + np.diag(prior)
        x = x - np.linalg.solve(hessian, np.einsum("nki,nk->i", weighted, residuals) + prior * x)
    # from the corners alone, without the prior on the motion
    told = hessian - np.diag([*prior[:6], *np.zeros(12)])
    covariance = np.linalg.inv(told + np.diag(1e-9 * np.diag(told)))[:6, :6]
    if not (np.isfinite(x).all() and np.isfinite(covariance).all()):
        return None
    return OwnMotion(start @ _step(x[:6]), covariance)


class _Points(NamedTuple):
    """Corners in space, each at the time its row was read."""

    place: Float64[np.ndarray, "n 3"]
    """Metres, in the frame's camera; arbitrary where the depth is not known."""
    known: Bool[np.ndarray, " n"]


class _Side(NamedTuple):
    """One frame's view of the corners."""

    pixels: Float64[np.ndarray, "n 2"]
    seconds: Float64[np.ndarray, " n"]
    """Time of each corner's row after the frame's timestamp."""
    depth: Depth
    usual: Float[np.ndarray, " n"]
    """1/z [1/m] about each corner."""
    camera: Camera
    delay: float

    @classmethod
    def of(cls, pixels: np.ndarray, depth: np.ndarray, camera: Camera, delay: float) -> "_Side":
        column, row = _nearest(pixels, camera)
        seconds = float(camera.readout) * row_time(pixels[:, 1], camera)
        return cls(pixels, seconds, depth, filled_inverse_depth(depth, camera)[row, column], camera, delay)

    def points(self, twist: Float64[np.ndarray, " 6"]) -> _Points:
        """Return the corners in space, looking up depth where they were when it was read, given their velocity."""
        u, v = self.pixels.T
        along_u, along_v, away = pixel_flow(self.camera, u, v, self.usual, twist)
        column, row = _nearest(self.pixels + self.delay * np.stack([along_u, along_v], axis=-1), self.camera)
        read = self.depth[row, column] / float(self.camera.depth_scale)
        z = read - self.delay * (read * away + twist[2])
        x, y = to_ray(self.camera, u, v)
        return _Points(np.stack([x * z, y * z, z], axis=-1), (read > 0) & (z > 0))


def _nearest(pixels: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    column, row = np.round(pixels).astype(int).T
    return column.clip(0, camera.width - 1), row.clip(0, camera.height - 1)


def _errors(
    frames: list[_Side], points: list[_Points], motion: np.ndarray, twists: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the corners' reprojection errors in the other frame, for both frames.

    Returns:
        Pixels [2n, 2]; derivatives by (δ, both twists) [2n, 2, 18]; and which ones are known.
    """
    residuals, slopes, known = [], [], []
    for here in (0, 1):
        there = 1 - here
        a_T_b = inverse(motion) if here else motion
        seconds, later = frames[here].seconds[:, None], frames[there].seconds[:, None]
        place = points[here].place
        still = place - seconds * _velocity(twists[here], place)
        moved = still @ a_T_b[:3, :3].T + a_T_b[:3, 3]
        landed = moved + later * _velocity(twists[there], moved)
        ahead = landed[:, 2] > 0.0
        x, y, z = landed[:, 0], landed[:, 1], np.where(ahead, landed[:, 2], 1.0)
        residuals.append(np.stack(to_pixels(camera, x, y, 1.0 / z), axis=-1) - frames[there].pixels)
        nothing = np.zeros_like(z)
        projection = np.stack(
            [
                np.stack([camera.fx / z, nothing, -camera.fx * x / z**2], axis=-1),
                np.stack([nothing, camera.fy / z, -camera.fy * y / z**2], axis=-1),
            ],
            axis=1,
        )
        turned = projection @ a_T_b[:3, :3]
        by_step = -projection @ _by_twist(moved) if here else turned @ _by_twist(still)
        by_twists = [-seconds[:, None] * turned @ _by_twist(place), later[:, None] * projection @ _by_twist(moved)]
        slopes.append(np.concatenate([by_step, by_twists[here], by_twists[there]], axis=-1))
        known.append(points[here].known & ahead)
    return np.concatenate(residuals), np.concatenate(slopes), np.concatenate(known)


def _velocity(twist: np.ndarray, points: np.ndarray) -> np.ndarray:
    return twist[:3] + np.cross(twist[3:], points)


def _by_twist(points: np.ndarray) -> np.ndarray:
    """Derivative of a point's velocity with respect to the twist, [n, 3, 6]."""
    x, y, z = points.T
    o = np.zeros_like(x)
    i = o + 1.0
    rows = [[i, o, o, o, z, -y], [o, i, o, -z, o, x], [o, o, i, y, -x, o]]
    return np.moveaxis(np.array(rows), 2, 0)


def _weights(distances: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Weights of corners under Geman and McClure's loss of their reprojection errors, pixels."""
    scale = 2.0 * max(NOISE, float(np.median(distances[known])))
    return 1.0 / (1.0 + (distances / scale) ** 2) ** 2


def _step(xi: np.ndarray) -> np.ndarray:
    """The rigid motion of a small twist."""
    motion = np.eye(4)
    motion[:3, :3] = cv2.Rodrigues(xi[3:])[0]
    motion[:3, 3] = xi[:3]
    return motion


def with_own_motion(result: Alignment, found: OwnMotion) -> Alignment:
    """Return a pair's result, on the host, with the motion that corners give.

    Its covariance decides whether the pair counts as `LOW_TEXTURE`.
    """
    motion = found.target_T_reference
    variance = np.diag(found.covariance)
    most = np.repeat(np.square([MAX_TRANSLATION_DEVIATION, MAX_ROTATION_DEVIATION]), 3)
    findings = int(result.findings) & ~bit(AlignmentStatus.LOW_TEXTURE)
    if not np.all((variance >= 0) & (variance <= most)):
        findings |= bit(AlignmentStatus.LOW_TEXTURE)
    return result._replace(
        target_T_reference=motion,
        xi=np.asarray(log(jnp.asarray(motion, jnp.float32))),
        covariance=found.covariance.astype(np.float32),
        findings=np.int32(findings),
        status=np.int32(gravest(findings)),
    )
