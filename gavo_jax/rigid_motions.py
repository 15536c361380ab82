"""Rigid motions in double precision on the host, for long chains and pose graphs; `se3` is for the device."""

import numpy as np
from jaxtyping import Float64

from gavo_jax.evaluation import rotation_angle
from gavo_jax.trajectory import inverse, quaternion_from_rotation


def log(a_T_b: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, " 6"]:
    """Twist ξ = (v, w) of a rigid motion, metres and radians."""
    *axis, cosine = quaternion_from_rotation(a_T_b[:3, :3])
    sine = float(np.linalg.norm(axis))
    w = np.array(axis) * (2.0 * np.arctan2(sine, cosine) / sine if sine > 0 else 2.0)
    return np.concatenate([np.linalg.solve(_left_jacobian(w), a_T_b[:3, 3]), w])


def exp(xi: Float64[np.ndarray, " 6"]) -> Float64[np.ndarray, "4 4"]:
    """The rigid motion of a twist (v, w)."""
    result = np.eye(4)
    angle, hat = float(np.linalg.norm(xi[3:])), cross(xi[3:])
    result[:3, :3] += np.sinc(angle / np.pi) * hat + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (hat @ hat)
    result[:3, 3] = _left_jacobian(xi[3:]) @ xi[:3]
    return result


def interpolate(
    start: Float64[np.ndarray, "4 4"], end: Float64[np.ndarray, "4 4"], share: float
) -> Float64[np.ndarray, "4 4"]:
    """Return the pose at a share of the way between two poses, along the screw that joins them."""
    return start @ exp(share * log(inverse(start) @ end))


def adjoint(a_T_b: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "6 6"]:
    """The adjoint A of a rigid motion: a_T_b · exp(δ) = exp(A δ) · a_T_b."""
    result = np.zeros((6, 6))
    rotation = a_T_b[:3, :3]
    result[:3, :3] = result[3:, 3:] = rotation
    result[:3, 3:] = cross(a_T_b[:3, 3]) @ rotation
    return result


def transport_covariance(
    a_T_b: Float64[np.ndarray, "4 4"], covariance: Float64[np.ndarray, "6 6"]
) -> Float64[np.ndarray, "6 6"]:
    """Transport the covariance Σ of a step δ from frame b to frame a: A Σ Aᵀ, where A is the adjoint of a_T_b."""
    step = adjoint(a_T_b)
    return step @ covariance @ step.T


def cross(a: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Matrix of the cross product with a vector."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def length_and_angle(
    a_T_b: Float64[np.ndarray, "*n 4 4"],
) -> tuple[Float64[np.ndarray, "*n"], Float64[np.ndarray, "*n"]]:
    """Length of the translation (m) and angle of the rotation (rad) of rigid motions."""
    return np.linalg.norm(a_T_b[..., :3, 3], axis=-1), rotation_angle(a_T_b[..., :3, :3])


def _left_jacobian(w: np.ndarray) -> np.ndarray:
    """Left Jacobian V of SO(3): the translation of exp(v, w) is V v."""
    angle, hat = float(np.linalg.norm(w)), cross(w)
    if angle < 1e-4:
        return np.eye(3) + 0.5 * hat + hat @ hat / 6.0
    return np.eye(3) + (1 - np.cos(angle)) / angle**2 * hat + (angle - np.sin(angle)) / angle**3 * (hat @ hat)
