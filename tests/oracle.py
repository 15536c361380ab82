"""The objective in float64 NumPy, written plainly from the paper's equations (1) to (8): slow, and easy to check."""

from typing import NamedTuple

import numpy as np
import scipy.linalg

from gavo_jax.camera import Camera
from gavo_jax.image.sampling import INVERSE_DEPTH_STEP, SLOPE_STEP

LOSSES = {
    "l2": lambda s: s,
    "huber": lambda s: np.where(np.sqrt(s) <= 1.345, s, 2 * 1.345 * np.sqrt(s) - 1.345**2),
    "cauchy": lambda s: 2.385**2 * np.log(1 + s / 2.385**2),
    "student-t": lambda s: 5 * np.log(1 + s / 5),
    "geman-mcclure": lambda s: s / (1 + s / 9),
    "truncated": lambda s: np.where(np.sqrt(s) <= 2.795, s, 2.795**2),
}
"""ρ of the squared normalised residual, by the names of `gavo_jax.objective.losses.LOSSES`."""


def hat(xi: np.ndarray) -> np.ndarray:
    """ξ̂ of ξ = (v, w), equation (3): the rotation's cross-product matrix, the translation in the last column."""
    x, y, z = xi[3:]
    return np.array([[0, -z, y, xi[0]], [z, 0, -x, xi[1]], [-y, x, 0, xi[2]], [0, 0, 0, 0]], np.float64)


def expm(xi: np.ndarray) -> np.ndarray:
    """g(ξ) = exp(ξ̂), [4, 4]."""
    return scipy.linalg.expm(hat(np.asarray(xi, np.float64)))


def slopes_of(inverse_depth: np.ndarray) -> list[np.ndarray]:
    """∂(1/z)/∂u and ∂(1/z)/∂v: the mean step to those neighbours with a reading that differ by less than a tenth."""
    result = []
    for axis in (1, 0):
        total, count = np.zeros(inverse_depth.shape), np.zeros(inverse_depth.shape)
        here = np.moveaxis(inverse_depth, axis, 0)
        step = here[1:] - here[:-1]
        both = (here[1:] > 0) & (here[:-1] > 0)
        # the step between a pixel and the next counts for either, each by its own measure
        for side, own in ((slice(None, -1), here[:-1]), (slice(1, None), here[1:])):
            same = both & (np.abs(step) < 0.1 * own)
            np.moveaxis(total, axis, 0)[side] += np.where(same, step, 0)
            np.moveaxis(count, axis, 0)[side] += same
        result.append(total / np.maximum(count, 1))
    return result


class Pair(NamedTuple):
    """One level of two frames: grey in grey levels, inverse depth in 1/m (0 = no reading), all [h, w]."""

    camera: Camera
    reference_grey: np.ndarray
    reference_inverse_depth: np.ndarray
    target_grey: np.ndarray
    target_inverse_depth: np.ndarray


class Terms(NamedTuple):
    """Residuals of the points that count, and how far the nearest point is from changing its pixel or leaving."""

    grey: np.ndarray
    depth: np.ndarray
    overlap: float
    margin: float


def block_plane(
    inverse_depth: np.ndarray, slopes: list[np.ndarray], row: int, column: int
) -> tuple[float, float, float] | None:
    """Inverse depth in the middle of a 2x2 block and its slopes, over the readings on its nearest surface."""
    block = [(v, u) for v in (row, row + 1) for u in (column, column + 1)]
    nearest = max(inverse_depth[tap] for tap in block)
    kept = [tap for tap in block if inverse_depth[tap] > 0.9 * nearest]
    if nearest <= 0:
        return None
    along_u, along_v = (float(np.mean([slope[tap] for tap in kept])) for slope in slopes)
    said = [
        inverse_depth[v, u] + slopes[0][v, u] * (column + 0.5 - u) + slopes[1][v, u] * (row + 0.5 - v) for v, u in kept
    ]
    middle = np.rint(np.mean(said) / INVERSE_DEPTH_STEP) * INVERSE_DEPTH_STEP
    return middle, *(np.clip(np.rint(s / SLOPE_STEP), -127, 127) * SLOPE_STEP for s in (along_u, along_v))


def residuals(pair: Pair, target_T_reference: np.ndarray, gain: float = 1.0, bias: float = 0.0) -> Terms:
    """Equation (1) point by point, and the depth residual as `gavo_jax.objective` defines it.

    The depth residual is the difference in inverse depth between the target's surface (the plane of the 2x2 block
    about the point) and the point, times the cosine of the reference surface's inclination.
    """
    camera = pair.camera
    target_slopes = slopes_of(pair.target_inverse_depth)
    own_slopes = slopes_of(pair.reference_inverse_depth)
    grey, depth, margins, readings = [], [], [np.inf], 0
    for v, u in np.ndindex(camera.height, camera.width):
        q = pair.reference_inverse_depth[v, u]
        if q <= 0:
            continue
        readings += 1
        point = np.array([(u - camera.cx) / camera.fx / q, (v - camera.cy) / camera.fy / q, 1 / q])
        x, y, z = target_T_reference[:3, :3] @ point + target_T_reference[:3, 3]
        if z * q < 1e-3:
            continue
        u_t, v_t = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        margins += [abs(u_t), abs(u_t - camera.width + 1), abs(v_t), abs(v_t - camera.height + 1)]
        if not (0 <= u_t < camera.width - 1 and 0 <= v_t < camera.height - 1):
            continue
        column, row = int(u_t), int(v_t)
        a, b = u_t - column, v_t - row
        (top_left, top_right), (low_left, low_right) = pair.target_grey[row : row + 2, column : column + 2]
        top, low = (1 - a) * top_left + a * top_right, (1 - a) * low_left + a * low_right
        grey.append((1 - b) * top + b * low - (gain * pair.reference_grey[v, u] + bias))
        margins += [abs(u_t - round(u_t)), abs(v_t - round(v_t))]
        plane = block_plane(pair.target_inverse_depth, target_slopes, row, column)
        if plane is not None:
            surface = plane[0] + plane[1] * (a - 0.5) + plane[2] * (b - 0.5)
            tilt = (camera.fx * own_slopes[0][v, u] / q) ** 2 + (camera.fy * own_slopes[1][v, u] / q) ** 2
            depth.append((surface - 1 / z) / np.sqrt(1 + tilt))
    return Terms(np.array(grey), np.array(depth), len(grey) / max(readings, 1), min(margins))


def error(terms: Terms, loss: str, grey_scale: float, depth_scale: float, depth_weight: float) -> float:
    """E: σ² times the mean cost of the points inside (2): ρ of the grey residual plus the weighted ρ of the depth
    residual, which is ρ(1) where the target has no reading."""
    rho = LOSSES[loss]
    if not len(terms.grey):
        return 0.0
    total = np.sum(rho((terms.grey / grey_scale) ** 2))
    if depth_weight:
        missing = len(terms.grey) - len(terms.depth)
        total += depth_weight * (np.sum(rho((terms.depth / depth_scale) ** 2)) + missing * rho(np.array(1.0)))
    return float(grey_scale**2 * total / len(terms.grey))
