"""The equations of the compiled kernels in float64 NumPy: the reference that `selfcheck` compares the kernels with.

Nothing here uses JAX. Each function is written from the equations for many rows at once, and shares no code with the
kernel that it checks.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import erfinv

from gavo_jax.camera import Camera

Rows = np.ndarray
"""Float64 with a leading axis of n rows."""


def cross_matrix(a: np.ndarray) -> np.ndarray:
    """[a]× of vectors [..., 3], with [a]× b = a × b."""
    x, y, z = np.moveaxis(np.asarray(a, np.float64), -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)


def exp(twists: Rows) -> Rows:
    """`se3.exp` of twists [n, 6], by Rodrigues' formula: [n, 4, 4]."""
    twists = np.asarray(twists, np.float64)
    angle = np.linalg.norm(twists[:, 3:], axis=1)[:, None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 1.0 - angle**2 / 6, np.sin(safe) / safe)
    second = np.where(small, 0.5 - angle**2 / 24, (1.0 - np.cos(safe)) / safe**2)
    third = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    turn = cross_matrix(twists[:, 3:])
    result = np.tile(np.eye(4), (len(twists), 1, 1))
    result[:, :3, :3] += first * turn + second * turn @ turn
    result[:, :3, 3] = ((np.eye(3) + second * turn + third * turn @ turn) @ twists[:, :3, None])[..., 0]
    return result


def adjoint(motion: np.ndarray) -> np.ndarray:
    """A [6, 6] with motion · exp(δ) = exp(A δ) · motion."""
    rotation, shift = motion[:3, :3], motion[:3, 3]
    return np.block([[rotation, cross_matrix(shift) @ rotation], [np.zeros((3, 3)), rotation]])


class Scene(NamedTuple):
    """Two views of a plane by one camera: the target as an image, the reference as N points anywhere in its image."""

    camera: Camera
    target_grey: np.ndarray
    """[h, w], whole grey levels."""
    plane: tuple[float, float, float]
    """Coefficients a, b, c of the target's inverse depth a + b u + c v, 1/m and 1/m per pixel."""
    x: np.ndarray
    """[n] coordinate of the points' rays (x, y, 1), as y; float32 like all inputs of the kernels."""
    y: np.ndarray
    q: np.ndarray
    """[n] inverse depth, 1/m; 0 = no reading."""
    grey: np.ndarray
    """[n] grey levels of the reference."""
    facing: np.ndarray
    """[n] cosine of the surface's inclination."""


PLANE = (0.5, 1 / 4096, -1 / 4096)
"""Plane of a target; it packs without loss, so that its inverse depth is continuous from block to block."""


def texture(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return a smooth image: 128 ± 90 grey levels, waves of some 20 to 40 pixels."""
    return 128.0 + 60.0 * np.sin(u / 5.9) * np.cos(v / 4.6) + 30.0 * np.sin((u + 2.0 * v) / 8.3)


def plane_scene(camera: Camera, u: np.ndarray, v: np.ndarray) -> Scene:
    """Make a scene with reference points at pixels (u, v), every eleventh without a reading."""
    rows, columns = np.mgrid[: camera.height, : camera.width]
    a, b, c = PLANE
    inverse_depth = a + b * u + c * v
    facing = 1.0 / np.sqrt(1.0 + (camera.fx * b / inverse_depth) ** 2 + (camera.fy * c / inverse_depth) ** 2)
    q = np.where(np.arange(len(u)) % 11 == 5, 0.0, inverse_depth)
    arrays = ((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, q, texture(u + 1.3, v - 0.8), facing)
    return Scene(camera, np.rint(texture(columns, rows)), PLANE, *(array.astype(np.float32) for array in arrays))


class Warped(NamedTuple):
    """Points in the target camera, [n] each."""

    u: np.ndarray
    v: np.ndarray
    depth: np.ndarray
    """Metres."""
    inside: np.ndarray
    """Whether the point has a reading, lies in front of the camera and has four pixels around it."""
    on_border: np.ndarray
    """Whether it lies so near to the image's border that float32 may put it on the other side."""


BORDER = 1e-4
"""Distance from the image's border within which a point is `on_border`, pixels."""


def points_of(scene: Scene) -> np.ndarray:
    """P⁻¹(p) of the points, as `Camera.back_project`, metres: [n, 3]; at 1 m depth where there is no reading."""
    x, y, q = (np.asarray(array, np.float64) for array in (scene.x, scene.y, scene.q))
    depth = 1.0 / np.where(q > 0, q, 1.0)
    return np.stack([x * depth, y * depth, depth], axis=-1)


def warp(scene: Scene, target_T_reference: np.ndarray) -> Warped:
    """ω(ξ, p) of all points for one motion [4, 4], as `warp.warp`."""
    camera = scene.camera
    moved = points_of(scene) @ target_T_reference[:3, :3].T + target_T_reference[:3, 3]
    seen = (scene.q > 0) & (moved[:, 2] * scene.q > 1e-3)
    depth = np.where(seen, moved[:, 2], 1.0)
    u = camera.fx * moved[:, 0] / depth + camera.cx
    v = camera.fy * moved[:, 1] / depth + camera.cy
    beyond = np.max([-u, u - camera.width + 1, -v, v - camera.height + 1], axis=0)
    return Warped(u, v, depth, seen & (beyond <= 0), seen & (np.abs(beyond) < BORDER))


class Weighing(NamedTuple):
    """Parameters of E: scales σ and τ, depth's weight λ, the cost of points out of view, the smallest overlap."""

    grey: float
    depth: float
    depth_weight: float
    outside_cost: float
    min_overlap: float


class Residuals(NamedTuple):
    """`Objective.residuals` of the points inside, [m] each, with all warped points."""

    grey: np.ndarray
    """Grey levels."""
    depth: np.ndarray
    """1/m, along the normal of the reference's surface."""
    grey_u: np.ndarray
    """Slope of the target along u, grey levels per pixel; `grey_v` along v."""
    grey_v: np.ndarray
    warped: Warped
    """All points, warped."""


def residuals(scene: Scene, target_T_reference: np.ndarray) -> Residuals:
    """Bilinear intensity minus the reference's, and the plane's inverse depth minus the point's own."""
    warped = warp(scene, target_T_reference)
    u, v, depth = (array[warped.inside] for array in warped[:3])
    column, row = np.floor(u).astype(int), np.floor(v).astype(int)
    a, b = u - column, v - row
    taps = [scene.target_grey[row + i, column + j] for i in (0, 1) for j in (0, 1)]
    value = (1 - b) * ((1 - a) * taps[0] + a * taps[1]) + b * ((1 - a) * taps[2] + a * taps[3])
    surface = scene.plane[0] + scene.plane[1] * u + scene.plane[2] * v
    return Residuals(
        value - scene.grey[warped.inside],
        scene.facing[warped.inside] * (surface - 1.0 / depth),
        (1 - b) * (taps[1] - taps[0]) + b * (taps[3] - taps[2]),
        (1 - a) * (taps[2] - taps[0]) + a * (taps[3] - taps[1]),
        warped,
    )


def geman_mcclure(s: np.ndarray | float) -> np.ndarray | float:
    """ρ of the squared normalised residual, c = 3."""
    return 9.0 * s / (9.0 + s)


def error(scene: Scene, r: Residuals, by: Weighing) -> tuple[float, float]:
    """`Objective.error` with the robust loss and the depth term, and the overlap."""
    cost = geman_mcclure((r.grey / by.grey) ** 2) + by.depth_weight * geman_mcclure((r.depth / by.depth) ** 2)
    readings, inside = np.count_nonzero(scene.q > 0), len(r.grey)
    typical = geman_mcclure(1.0) * (1.0 + by.depth_weight)
    total = np.sum(cost) + (readings - inside) * by.outside_cost * typical
    overlap = inside / max(readings, 1)
    if overlap < by.min_overlap:
        return np.inf, overlap
    return float(by.grey**2 * total / max(divisor(scene, r, by), 1)), overlap


def divisor(scene: Scene, r: Residuals, by: Weighing) -> int:
    """Number of points that E is the mean over."""
    return int(np.count_nonzero(scene.q > 0)) if by.outside_cost > 0 else len(r.grey)


class Slope(NamedTuple):
    """E's gradient [6] and Gauss-Newton Hessian [6, 6] in search coordinates, and the gradient's scatter over tiles."""

    gradient: np.ndarray
    hessian: np.ndarray
    scatter: np.ndarray


def slope(scene: Scene, motion: np.ndarray, basis: np.ndarray, by: Weighing, tiles: tuple[int, int]) -> Slope:
    """Derivatives of E(motion · exp(basis · x)) with respect to x at x = 0, through the point: ∂r/∂P [I, −[P]×]."""
    r, camera = residuals(scene, motion), scene.camera
    inside = r.warped.inside
    u, v, depth = (array[inside] for array in r.warped[:3])
    x, y, zero = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.zeros_like(u)
    u_by_point = camera.fx / depth[:, None] * np.stack([zero + 1, zero, -x], axis=-1)
    v_by_point = camera.fy / depth[:, None] * np.stack([zero, zero + 1, -y], axis=-1)
    inverse_by_point = np.stack([zero, zero, -1.0 / depth**2], axis=-1)
    point = np.stack([x, y, zero + 1], axis=-1) * depth[:, None]
    grey = r.grey_u[:, None] * u_by_point + r.grey_v[:, None] * v_by_point
    surface = scene.plane[1] * u_by_point + scene.plane[2] * v_by_point - inverse_by_point
    coordinates, pull, hessian = adjoint(motion) @ basis, np.zeros((len(u), 6)), np.zeros((6, 6))
    for residual, scale, weight, row in (
        (r.grey, by.grey, 1.0, grey),
        (r.depth, by.depth, by.depth_weight * (by.grey / by.depth) ** 2, scene.facing[inside, None] * surface),
    ):
        jacobian = np.concatenate([row, np.cross(point, row)], axis=1) @ coordinates
        weight = weight * 81.0 / (9.0 + (residual / scale) ** 2) ** 2
        pull += jacobian * (weight * residual)[:, None]
        hessian += jacobian.T @ (jacobian * weight[:, None])
    factor = 2.0 / divisor(scene, r, by)
    tile = np.floor(v * tiles[1] / camera.height) * tiles[0] + np.floor(u * tiles[0] / camera.width)
    by_tile = np.stack([np.bincount(tile.astype(int), column, tiles[0] * tiles[1]) for column in pull.T]) * factor
    used = np.count_nonzero(np.any(by_tile != 0, axis=0))
    return Slope(factor * pull.sum(axis=0), factor * hessian, by_tile @ by_tile.T * used / max(used - 1, 1))


class Generation(NamedTuple):
    """I populations of P chromosomes after a generation of the genetic algorithm."""

    population: np.ndarray
    """[I, P, 6], sorted by `error`."""
    error: np.ndarray
    """[I, P]"""
    offspring: np.ndarray
    """[I, P, 6]"""
    certain: np.ndarray
    """[I, P, 6], whether float32 must compute the same gene: no parent was drawn at the edge of its share of the wheel,
    and no random number lies in a tail where float32 is coarse."""


class Breeding(NamedTuple):
    """Parameters of the operators."""

    pressure: float
    mutants: int
    """Number of mutants among the offspring."""
    crossover_range: float
    mutation_step: float
    half_width: float
    """Half-width of the search box, search units."""


EDGE, TAIL = 1e-5, 1e-3
"""Shares of the wheel and of the random numbers within which a gene is not `certain`."""


def generation(x: np.ndarray, errors: np.ndarray, chance: np.ndarray, by: Breeding) -> Generation:
    """`GeneticAlgorithm.step`: the operators and the offspring that the quadratic fit breeds.

    Args:
        x: [I, 2P, 6] parents and newcomers.
        errors: [I, 2P] their errors, all different.
        chance: [I, P, 8] uniform random numbers: six for the genes, two for the parents.
        by: Parameters.
    """
    places = chance.shape[1]
    order = np.argsort(errors, axis=1)[:, :places]
    population, error = np.take_along_axis(x, order[..., None], 1), np.take_along_axis(errors, order, 1)
    wheel = np.cumsum(np.exp(-by.pressure * (error / error[:, :1] - 1.0)), axis=1)
    wheel /= wheel[:, -1:]
    drawn = np.minimum(np.sum(wheel[:, None, None, :] < chance[:, :, 6:, None], axis=-1), places - 1)
    edge = np.min(np.abs(wheel[:, None, None, :-1] - chance[:, :, 6:, None]), axis=(2, 3)) < EDGE
    first, second = (np.take_along_axis(population, drawn[:, :, i, None], 1) for i in (0, 1))
    alpha = -by.crossover_range + (1.0 + 2.0 * by.crossover_range) * chance[:, :, :6]
    mutated = first + by.mutation_step * np.sqrt(2.0) * erfinv(2.0 * chance[:, :, :6] - 1.0)
    own = np.arange(places)[:, None]
    is_mutant = own >= places - 1 - by.mutants
    offspring = np.where(is_mutant, mutated, first + alpha * (second - first))
    offspring[:, -1] = surrogate_minimum(population, error)
    tail = is_mutant & (np.abs(chance[:, :, :6] - 0.5) > 0.5 - TAIL)
    certain = ~(edge[..., None] | tail) | (own == places - 1)
    return Generation(population, error, np.clip(offspring, -by.half_width, by.half_width), certain)


def surrogate_minimum(x: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Minimum [I, 6] of a quadratic fitted by ridge regression to each of I populations [I, P, 6], best first."""
    offset = x - x[:, :1]
    radius = np.sqrt(np.mean(offset**2, axis=(1, 2), keepdims=True)) + 1e-6
    z = offset / radius
    height = error - error[:, :1]
    height /= np.mean(height, axis=1, keepdims=True) + 1e-12
    weight = (1.0 + height) ** -2
    first, second = np.triu_indices(6, 1)
    square = np.sum(z**2, axis=2, keepdims=True)
    features = np.concatenate(
        [np.ones_like(square), z, square, z**2 - square / 6, z[..., first] * z[..., second]], axis=2
    )
    penalty = np.repeat([1e-6, 0.1], [8, 21]) * np.sum(weight, axis=1)[:, None]
    normal = np.einsum("ipf,ip,ipg->ifg", features, weight, features) + penalty[:, None] * np.eye(29)
    fit = np.linalg.solve(normal, np.einsum("ipf,ip->if", features, weight * height)[..., None])[..., 0]
    uneven = fit[:, 8:14] - np.mean(fit[:, 8:14], axis=1, keepdims=True)
    curvature = np.zeros((len(x), 6, 6))
    curvature[:, first, second] = curvature[:, second, first] = fit[:, 14:]
    curvature[:, range(6), range(6)] = 2.0 * (fit[:, 7:8] + uneven)
    values, vectors = np.linalg.eigh(curvature)
    values = np.maximum(values, 0.2 * np.maximum(fit[:, 7:8], 1e-3))
    step = -np.einsum("ijk,ik,ilk,il->ij", vectors, 1.0 / values, vectors, fit[:, 1:7])
    step *= np.minimum(1.0, 4.0 / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9))
    return x[:, 0] + radius[:, 0] * step


def best_distinct(places: np.ndarray, errors: np.ndarray, count: int) -> np.ndarray:
    """Indices of the `count` smallest errors [n] with no two less than 1 apart in places [n, 6], best first.

    There must be that many.
    """
    left, chosen = errors.astype(np.float64), []
    for _ in range(count):
        chosen.append(int(np.argmin(left)))
        left[np.sum((places - places[chosen[-1]]) ** 2, axis=1) < 1.0] = np.inf
    return np.array(chosen)
