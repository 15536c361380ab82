"""Rigid motions, SE(3), and their twists ξ = (v, w) ∈ se(3), equation (3); translation first, as in jaxlie."""

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Float64


def exp(xi: Float[Array, "*batch 6"]) -> Float[Array, "*batch 4 4"]:
    """g(ξ) = exp(ξ̂) of a twist ξ = (v, w), translation (m) first, rotation in radians. Equation (3).

    With θ = |w| it has the closed form I + ξ̂ + (1 − cos θ)/θ² ξ̂² + (θ − sin θ)/θ³ ξ̂³ (Murray, Li and Sastry 1994). The
    compiled program uses it in many places, so it is written in few operations: each is a kernel to compile.
    """
    hat = jnp.sum(GENERATORS * xi[..., None, None, :], axis=-1)
    angle = jnp.sqrt(jnp.maximum(jnp.sum(xi[..., 3:] ** 2, axis=-1), SMALL_ANGLE**2))[..., None, None]
    second = 2.0 * (jnp.sin(0.5 * angle) / angle) ** 2
    third = (angle - jnp.sin(angle)) / angle**3
    return jnp.eye(4) + hat + _product(second * jnp.eye(4) + third * hat, _product(hat, hat))


def _product(a: Float[Array, "*batch i j"], b: Float[Array, "*batch j k"]) -> Float[Array, "*batch i k"]:
    """Product of small matrices; a fused sum is quicker than a batch of matrix products."""
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


SMALL_ANGLE = 0.01
"""Angle below which the coefficients of `exp` are treated as constant, radians."""


def log(transform: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 6"]:
    """ξ of a rigid motion, the inverse of `exp`."""
    return jaxlie.SE3.from_matrix(transform).log()


def rigid_inverse(transform: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 4 4"]:
    """The inverse of a rigid motion, [Rᵀ, −Rᵀt]."""
    turned = jnp.swapaxes(transform[..., :3, :3], -1, -2)
    moved = -jnp.einsum("...ij,...j->...i", turned, transform[..., :3, 3])
    top = jnp.concatenate([turned, moved[..., None]], axis=-1)
    return jnp.concatenate([top, transform[..., 3:, :]], axis=-2)


def _generators() -> np.ndarray:
    basis = np.zeros((4, 4, 6), np.float32)
    for i in range(3):
        basis[i, 3, i] = 1.0
        j, k = (i + 1) % 3, (i + 2) % 3
        basis[k, j, 3 + i], basis[j, k, 3 + i] = 1.0, -1.0
    return basis


GENERATORS = _generators()
"""[4, 4, 6]: ξ̂ = GENERATORS · ξ, and the derivative of `exp` at 0."""


def right_jacobian(xi: Float[Array, " 6"]) -> Float[Array, "6 6"]:
    """J with exp(ξ + δ) ≈ exp(ξ) exp(J δ), to second order in ξ: I − ad/2 + ad²/6."""
    v, w = _cross(xi[:3]), _cross(xi[3:])
    ad = jnp.block([[w, v], [jnp.zeros((3, 3)), w]])
    return jnp.eye(6) - 0.5 * ad + ad @ ad / 6.0


def adjoint(transform: Float[Array, "4 4"]) -> Float[Array, "6 6"]:
    """A with transform · exp(δ) = exp(A δ) · transform."""
    rotation, translation = transform[:3, :3], transform[:3, 3]
    return jnp.block([[rotation, _cross(translation) @ rotation], [jnp.zeros((3, 3)), rotation]])


def _cross(a: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Matrix of the cross product with a vector."""
    return jnp.asarray(GENERATORS[:3, :3, 3:]) @ a


def rigid(transform: Float[Array | np.ndarray, "*batch 4 4"]) -> Float64[np.ndarray, "*batch 4 4"]:
    """Convert a motion from float32 to double precision, with its rotation made orthonormal.

    The nearest rotation is taken (Kabsch 1976), so that chains of motions stay rigid. Motions that are not finite stay
    as they are.
    """
    result = np.array(transform, np.float64)
    finite = np.isfinite(result).all(axis=(-2, -1), keepdims=True)
    u, _, v = np.linalg.svd(np.where(finite, result, np.eye(4))[..., :3, :3])
    result[..., :3, :3] = np.where(finite, u @ v, result[..., :3, :3])
    return result


ROUNDED = 0.01
"""Largest entry of RᵀR − I that is attributed to rounding."""


def is_rigid(
    matrices: Float[np.ndarray, "*batch 4 4"], tolerance: float = ROUNDED
) -> Bool[np.ndarray, " *batch"] | np.bool_:
    """Whether matrices are finite and, up to rounding, a rotation and a translation above 0 0 0 1."""
    matrices = np.asarray(matrices, np.float64)
    rotations, last = matrices[..., :3, :3], matrices[..., 3, :]
    with np.errstate(over="ignore", invalid="ignore"):
        departures = np.abs(np.swapaxes(rotations, -1, -2) @ rotations - np.eye(3)).max(axis=(-2, -1))
        turns = (departures <= tolerance) & (np.linalg.det(rotations) > 0)
    return turns & np.isclose(last, [0, 0, 0, 1]).all(axis=-1) & np.isfinite(matrices).all(axis=(-2, -1))


def departure_from_rigid(transform: Float[Array, "*batch 4 4"]) -> Float[Array, " *batch"]:
    """Largest entry of RᵀR − I: rounding leaves some 1e-6."""
    rotation = transform[..., :3, :3]
    return jnp.max(jnp.abs(_product(jnp.swapaxes(rotation, -1, -2), rotation) - jnp.eye(3)), axis=(-2, -1))
