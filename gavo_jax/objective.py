"""The photometric error E(ξ) of a whole population of motions in one call, equations (1) and (2).

r_i(ξ) = I_{t+1}(ω(ξ, p_i)) − I_t(p_i) over the reference's points; E(ξ) = mean of a loss of r_i over the points that
land inside the target. With the L2 loss and nothing else switched on this is the paper's objective to the letter.
Beyond it: robust losses whose scale comes from the data, an affine brightness change between the frames, and a depth
residual 1/z_{t+1}(ω(ξ, p_i)) − 1/z_i(ξ). Inverse depth is the right quantity: σ_z ∝ z² for a structured-light sensor,
so the noise of 1/z is the same at every range and one scale serves all pixels.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gavo_jax.camera import Camera
from gavo_jax.pyramid import PyramidLevel
from gavo_jax.warp import (
    GENERATORS,
    DepthSample,
    GreySample,
    Points,
    Target,
    Warped,
    exp,
    inverse_depth_slopes,
    log,
    right_jacobian,
    sample_depth,
    sample_grey,
    warp,
)

Loss = Callable[[jax.Array], jax.Array]
"""A cost of the squared normalised residual s = (r/σ)²; ρ(s) ≈ s near 0. Any callable of arrays will do."""


def l2(s: jax.Array) -> jax.Array:
    """ρ(s) = s: plain least squares, the paper's (2)."""
    return s


def huber(s: jax.Array) -> jax.Array:
    """Quadratic up to 1.345 σ, linear beyond (95 % efficient under Gaussian noise)."""
    k = 1.345
    return jnp.where(s <= k * k, s, 2.0 * k * jnp.sqrt(jnp.maximum(s, k * k)) - k * k)


def cauchy(s: jax.Array) -> jax.Array:
    """c² log(1 + s/c²), c = 2.385."""
    c2 = 2.385**2
    return c2 * jnp.log1p(s / c2)


def student_t(s: jax.Array) -> jax.Array:
    """Negative log-likelihood of a t distribution of 5 degrees of freedom (Kerl et al. 2013), scaled to ρ'(0) = 1."""
    return 5.0 * jnp.log1p(s / 5.0)


def geman_mcclure(s: jax.Array) -> jax.Array:
    """s/(1 + s/c²), c = 3: redescending and free of transcendental functions."""
    return s / (1.0 + s / 9.0)


def truncated(s: jax.Array) -> jax.Array:
    """min(s, 2.795²): squares up to 2.8 σ, constant beyond. A population needs no derivative there."""
    return jnp.minimum(s, 2.795**2)


LOSSES: dict[str, Loss] = {
    "l2": l2,
    "huber": huber,
    "cauchy": cauchy,
    "student-t": student_t,
    "geman-mcclure": geman_mcclure,
    "truncated": truncated,
}


class Reference(NamedTuple):
    """What the objective keeps of a level of the reference frame: flat arrays of N points."""

    points: Points
    grey: Float[Array, " n"]
    grey_u: Float[Array, " n"]
    """Intensity gradient along u (grey levels a pixel), and `grey_v` along v."""
    grey_v: Float[Array, " n"]
    slope_u: Float[Array, " n"]
    """Inverse-depth slope along u (1/m a pixel), and `slope_v` along v."""
    slope_v: Float[Array, " n"]
    facing: Float[Array, " n"]
    """Cosine of the surface's inclination: turns a residual along the ray into a point-to-plane distance."""


def central_gradient(image: Float[Array, "h w"]) -> tuple[jax.Array, jax.Array]:
    """∂/∂u and ∂/∂v by central differences; borders replicate."""
    wide = jnp.pad(image, 1, mode="edge")
    return 0.5 * (wide[1:-1, 2:] - wide[1:-1, :-2]), 0.5 * (wide[2:, 1:-1] - wide[:-2, 1:-1])


def make_reference(level: PyramidLevel, camera: Camera, cell: int = 1) -> Reference:
    """Points of a reference level; with cell > 1, one a cell x cell block: that of the steepest grey with a reading.

    Args:
        level: Reference image and inverse depth, [h, w].
        camera: Camera of that level.
        cell: Side of the blocks, pixels. The choice is stratified, so its cost in accuracy is small, and N is static.
    """
    height, width = level.grey.shape
    grey_u, grey_v = central_gradient(level.grey)
    slope_u, slope_v = inverse_depth_slopes(level.inverse_depth)
    x = jnp.broadcast_to((jnp.arange(width) - camera.cx) / camera.fx, (height, width))
    y = jnp.broadcast_to(((jnp.arange(height) - camera.cy) / camera.fy)[:, None], (height, width))
    near = jnp.maximum(level.inverse_depth, 1e-3)
    facing = jax.lax.rsqrt(1.0 + (camera.fx * slope_u / near) ** 2 + (camera.fy * slope_v / near) ** 2)
    images = [x, y, level.inverse_depth, level.grey, grey_u, grey_v, slope_u, slope_v, facing]
    if cell == 1:
        flat = [image.reshape(-1) for image in images]
    else:
        rows, columns = height // cell, width // cell

        def blocks(image: jax.Array) -> jax.Array:
            cut = image[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell)
            return cut.transpose(0, 2, 1, 3).reshape(rows * columns, cell * cell)

        steepness = jnp.where(level.inverse_depth > 0, grey_u**2 + grey_v**2, -1.0)
        chosen = jnp.argmax(blocks(steepness), axis=1)[:, None]
        flat = [jnp.take_along_axis(blocks(image), chosen, axis=1)[:, 0] for image in images]
    x, y, q, grey, grey_u, grey_v, slope_u, slope_v, facing = flat
    return Reference(Points(x, y, q), grey, grey_u, grey_v, slope_u, slope_v, facing)


def move_reference(reference: Reference, anchor_T_view: Float[Array, "4 4"]) -> Reference:
    """The same points as rays of another camera; what falls behind it loses its reading."""
    r, t = anchor_T_view[:3, :3], anchor_T_view[:3, 3]
    x, y, q = reference.points
    moved = [r[i, 0] * x + r[i, 1] * y + (r[i, 2] + t[i] * q) for i in range(3)]
    before = (q > 0) & (moved[2] > 1e-3)
    depth = jnp.where(before, moved[2], 1.0)
    points = Points(moved[0] / depth, moved[1] / depth, jnp.where(before, q / depth, 0.0))
    return reference._replace(points=points)


def share_in_view(reference: Reference, target_T_reference: Float[Array, "4 4"], camera: Camera) -> Float[Array, ""]:
    """Share of the reference's points that land inside the target; nothing is sampled."""
    inside = warp(reference.points, target_T_reference, camera).inside
    return jnp.sum(inside) / jnp.maximum(jnp.sum(reference.points.q > 0), 1.0)


def concatenate_references(references: list[Reference]) -> Reference:
    """One set of points out of several, all in one camera's frame."""
    return jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *references)


class Scales(NamedTuple):
    """What is estimated from the data before a level is searched, and held while its candidates are compared."""

    grey: Float[Array, ""]
    """Scale σ of the grey residuals, grey levels."""
    depth: Float[Array, ""]
    """Scale of the inverse-depth residuals, 1/m."""
    depth_weight: Float[Array, ""]
    """Weight of the depth cost against the grey one (both normalised by their scales)."""

    @classmethod
    def unit(cls) -> "Scales":
        """Scales that leave residuals as they are, without depth: the paper's (2)."""
        one = jnp.float32(1.0)
        return cls(one, one, jnp.float32(0.0))


class Residuals(NamedTuple):
    """Residuals of one motion at every reference point, with what a derivative needs."""

    grey: Float[Array, " n"]
    """Grey levels; equation (1) after the brightness model."""
    depth: Float[Array, " n"]
    """Inverse depth, 1/m, along the surface normal; 0 where `depth_valid` is 0."""
    inside: Float[Array, " n"]
    depth_valid: Float[Array, " n"]
    warped: Warped
    grey_sample: GreySample
    depth_sample: DepthSample


MAP_FROM_POINTS = 6_000
"""On a CPU, levels of at least this many points score candidate after candidate in one fused loop each; smaller ones,
and every level on a GPU, score all candidates side by side (`benchmarks/kernel.py`)."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Objective:
    """E of one level of one pair of frames: prepared arrays, scales and a loss."""

    reference: Reference
    target: Target
    camera: Camera
    scales: Scales
    min_overlap: Float[Array, ""]
    loss: Loss = field(default=l2, metadata={"static": True})
    use_depth: bool = field(default=False, metadata={"static": True})
    columns: int = field(default=1, metadata={"static": True})
    """Reference points a row: they come from a grid, row after row."""
    outside_cost: Float[Array, ""] | None = None
    """Cost of a reference point that leaves the view, in units of that of a residual of one scale; None averages over
    the points in view alone, as (2) does. With a cost, a motion cannot win by pushing pixels out of view."""

    def residuals(self, target_T_reference: Float[Array, "4 4"]) -> Residuals:
        """r_i(ξ) of one motion, equation (1)."""
        reference = self.reference
        warped = warp(reference.points, target_T_reference, self.camera)
        grey_sample = sample_grey(self.target.grey, warped)
        grey = grey_sample.value - reference.grey
        depth_sample = sample_depth(self.target.depth, warped)
        depth_valid = depth_sample.valid * warped.inside
        depth = reference.facing * (depth_sample.value - warped.inverse_depth)
        return Residuals(
            jnp.where(warped.inside > 0, grey, 0.0),
            jnp.where(depth_valid > 0, depth, 0.0),
            warped.inside,
            depth_valid,
            warped,
            grey_sample,
            depth_sample,
        )

    def error(self, target_T_reference: Float[Array, "4 4"]) -> tuple[jax.Array, jax.Array]:
        """E of one motion (squared grey levels), equation (2), and the share of reference points inside the target."""
        r, scales = self.residuals(target_T_reference), self.scales
        count = jnp.sum(r.inside)
        variance = scales.grey**2
        total = jnp.sum(r.inside * self.loss(r.grey**2 / variance))
        valid = jnp.maximum(jnp.sum(self.reference.points.q > 0), 1.0)
        if self.outside_cost is None:
            error = variance * total / jnp.maximum(count, 1.0)
        else:
            error = variance * (total + (valid - count) * self.outside_cost * self.loss(jnp.float32(1.0))) / valid
        if self.use_depth:
            cost = jnp.sum(r.depth_valid * self.loss((r.depth / scales.depth) ** 2))
            error += variance * scales.depth_weight * cost / jnp.maximum(jnp.sum(r.depth_valid), 1.0)
        overlap = count / valid
        return jnp.where(overlap < self.min_overlap, jnp.inf, error), overlap

    def score(self, target_T_reference: Float[Array, "p 4 4"]) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        """Errors and overlaps of P motions in one call."""
        if self.reference.grey.shape[0] >= MAP_FROM_POINTS and jax.default_backend() == "cpu":
            return jax.lax.map(self.error, target_T_reference)
        return jax.vmap(self.error)(target_T_reference)


class Linearization(NamedTuple):
    """E, its gradient and its Gauss-Newton Hessian (with the loss's weights) at one motion, in search coordinates."""

    error: Float[Array, ""]
    overlap: Float[Array, ""]
    gradient: Float[Array, " 6"]
    hessian: Float[Array, "6 6"]


def _jacobian(
    along_u: jax.Array,
    along_v: jax.Array,
    along_inverse_depth: jax.Array,
    warped: Warped,
    points: Points,
    camera: Camera,
    tangent: Float[Array, "4 4 6"],
) -> Float[Array, "6 n"]:
    """Chain rule from (u, v, 1/z) of the warped points to six coordinates; `tangent` is ∂(4x4 motion)/∂x."""
    per_depth = warped.inverse_depth / jnp.maximum(points.q, 1e-6)
    from_x = along_u * camera.fx * per_depth
    from_y = along_v * camera.fy * per_depth
    from_z = -(
        along_u * (warped.u - camera.cx) + along_v * (warped.v - camera.cy) + along_inverse_depth * warped.inverse_depth
    )
    from_z *= per_depth
    x, y, q = points

    def column(t: jax.Array) -> jax.Array:
        moved = [t[i, 0] * x + t[i, 1] * y + (t[i, 2] + t[i, 3] * q) for i in range(3)]
        return from_x * moved[0] + from_y * moved[1] + from_z * moved[2]

    return jnp.stack([column(tangent[:, :, k]) for k in range(6)])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Problem:
    """An objective in search coordinates x: target_T_reference = origin · exp(basis · x).

    With origin = basis = identity x is ξ itself, the paper's chromosome. With `precondition` a unit step in any
    direction of x changes the image by one grey level.
    """

    objective: Objective
    origin: Float[Array, "4 4"]
    basis: Float[Array, "6 6"]
    centre: Float[Array, "4 4"] | None = None
    """Motion that the search is held about, and `reach`, the largest translation (m) and rotation (rad) from it; a
    candidate further off is worthless. None: the solver's bounds alone hold it."""
    reach: Float[Array, " 2"] | None = None

    def transform(self, x: Float[Array, "*batch 6"]) -> Float[Array, "*batch 4 4"]:
        """target_T_reference of search coordinates."""
        return self.origin @ exp(x @ self.basis.T)

    def coordinates(self, target_T_reference: Float[Array, "4 4"]) -> Float[Array, " 6"]:
        """Search coordinates of a motion, the inverse of `transform`."""
        return jnp.linalg.solve(self.basis, log(jnp.linalg.inv(self.origin) @ target_T_reference))

    def score(self, x: Float[Array, "p 6"]) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        """Errors and overlaps of P candidates; not-a-number becomes +inf here, once for every solver."""
        motions = self.transform(x)
        error, overlap = self.objective.score(motions)
        if self.centre is not None and self.reach is not None:
            offset = jnp.linalg.inv(self.centre) @ motions
            cosine = 0.5 * (jnp.trace(offset, axis1=-2, axis2=-1) - 1.0)
            far = (jnp.linalg.norm(offset[:, :3, 3], axis=-1) > self.reach[0]) | (cosine < jnp.cos(self.reach[1]))
            error = jnp.where(far, jnp.inf, error)
        return jnp.where(jnp.isnan(error), jnp.inf, error), overlap

    def _weighted_terms(self, x: Float[Array, " 6"]) -> tuple[Residuals, list[tuple[jax.Array, jax.Array, jax.Array]]]:
        """For each channel J of [6, N], r and w of [N]: E's gradient is Σ J w r, its Gauss-Newton Hessian Σ w J Jᵀ."""
        objective = self.objective
        twist = self.basis @ x
        tangent = jnp.einsum("ij,jkm->ikm", self.transform(x), GENERATORS @ (right_jacobian(twist) @ self.basis))
        r, scales, facing = objective.residuals(self.transform(x)), objective.scales, objective.reference.facing
        grey, depth = r.grey_sample, r.depth_sample
        one = jnp.float32(1.0)
        channels = [(r.grey, scales.grey, r.inside, one, grey.along_u, grey.along_v, jnp.zeros_like(r.grey))]
        if objective.use_depth:
            factor = scales.depth_weight * (scales.grey / scales.depth) ** 2
            slopes = (facing * depth.along_u, facing * depth.along_v, -facing)
            channels.append((r.depth, scales.depth, r.depth_valid, factor, *slopes))
        terms = []
        for residual, scale, mask, factor, along_u, along_v, along_q in channels:
            jacobian = _jacobian(
                along_u, along_v, along_q, r.warped, objective.reference.points, objective.camera, tangent
            )
            jacobian = jnp.where(mask > 0, jacobian, 0.0)
            s = (residual / scale) ** 2
            _, slope = jax.jvp(objective.loss, (s,), (jnp.ones_like(s),))
            weight = factor * jnp.where(mask > 0, slope, 0.0) * 2.0 / jnp.maximum(jnp.sum(mask), 1.0)
            terms.append((jacobian, residual, weight))
        return r, terms

    def linearize(self, x: Float[Array, " 6"]) -> Linearization:
        """E and its first two derivatives; image gradients are sampled, nothing is differentiated in reverse."""
        error, overlap = self.objective.error(self.transform(x))
        _, terms = self._weighted_terms(x)
        gradient = jnp.asarray(sum(jacobian @ (weight * residual) for jacobian, residual, weight in terms))
        hessian = jnp.asarray(sum((jacobian * weight) @ jacobian.T for jacobian, _, weight in terms))
        return Linearization(error, overlap, gradient, hessian)

    def gradient_scatter(self, x: Float[Array, " 6"]) -> Float[Array, "6 6"]:
        """Covariance of E's gradient from its spread over the tiles of the target image.

        Residuals of neighbouring pixels are correlated, so pixels are no independent witnesses; tiles nearly are.
        With the Hessian on both sides this is the cluster-robust ("sandwich") covariance of an M-estimate.
        """
        r, terms = self._weighted_terms(x)
        camera = self.objective.camera
        column = jnp.clip(r.warped.u * (TILES[0] / camera.width), 0, TILES[0] - 1).astype(jnp.int32)
        row = jnp.clip(r.warped.v * (TILES[1] / camera.height), 0, TILES[1] - 1).astype(jnp.int32)
        tile = jax.nn.one_hot(row * TILES[0] + column, TILES[0] * TILES[1])
        sums = jnp.asarray(sum((jacobian * (weight * residual)) @ tile for jacobian, residual, weight in terms))
        used = jnp.sum(jnp.any(sums != 0, axis=0))
        return (sums @ sums.T) * used / jnp.maximum(used - 1, 1)


TILES = (8, 6)
"""Tiles across and down the image, for `Problem.gradient_scatter`."""


def reference_curvature(objective: Objective) -> Float[Array, "6 6"]:
    """A = mean of JᵀJ at zero motion from the reference frame alone: half the Hessian of E for a perfect match.

    J is taken in a step on the reference's side, target_T_reference = origin · exp(ξ), where it does not depend on
    the origin. No target is needed, so A is known before the search.
    """
    reference, camera, scales = objective.reference, objective.camera, objective.scales
    points = reference.points
    valid = (points.q > 0).astype(jnp.float32)
    count = jnp.maximum(jnp.sum(valid), 1.0)
    warped = Warped(points.x * camera.fx + camera.cx, points.y * camera.fy + camera.cy, points.q, valid)
    tangent = jnp.asarray(GENERATORS)
    zero = jnp.zeros_like(reference.grey)
    grey = _jacobian(reference.grey_u, reference.grey_v, zero, warped, points, camera, tangent) * valid
    curvature = grey @ grey.T / count
    if objective.use_depth:
        depth = (
            _jacobian(
                reference.facing * reference.slope_u,
                reference.facing * reference.slope_v,
                -reference.facing,
                warped,
                points,
                camera,
                tangent,
            )
            * valid
        )
        curvature += scales.depth_weight * (scales.grey / scales.depth) ** 2 * (depth @ depth.T) / count
    return curvature


LARGEST_UNIT_STEP = 0.05
"""Metres or radians: a direction that the image hardly constrains is not searched further than this a unit."""


def preconditioner(curvature: Float[Array, "6 6"]) -> Float[Array, "6 6"]:
    """B with BᵀAB = identity, B = V Λ^(−1/2) of A = V Λ Vᵀ, limited where A is nearly singular."""
    ridge = jnp.eye(6) / LARGEST_UNIT_STEP**2
    values, vectors = jnp.linalg.eigh(curvature + ridge)
    return vectors * jax.lax.rsqrt(jnp.maximum(values, 1e-9))


ROUNDS = 6
"""Rounds of the re-weighted estimates below; each contracts the remaining error several times."""


def _t_variance(square: jax.Array, mask: jax.Array, variance: jax.Array) -> jax.Array:
    """One fixed-point round for the squared scale of a t distribution, 5 degrees of freedom (Kerl et al. 2013)."""
    weighted = mask * square * 6.0 / (5.0 + square / jnp.maximum(variance, 1e-20))
    return jnp.sum(weighted) / jnp.maximum(jnp.sum(mask), 1.0)


def _t_scale(residual: jax.Array, mask: jax.Array) -> jax.Array:
    """Scale of a t distribution fitted to the masked residuals."""
    square = residual**2
    start = jnp.sum(mask * square) / jnp.maximum(jnp.sum(mask), 1.0)
    return jnp.sqrt(jax.lax.fori_loop(0, ROUNDS, lambda _, variance: _t_variance(square, mask, variance), start))


SMALLEST_GREY_SCALE = 0.5
"""Grey levels: rounding alone leaves 0.3."""
SMALLEST_DEPTH_SCALE = 5e-4
"""1/m: a tenth of the quantisation of a structured-light sensor."""


def _independent_share(residual: jax.Array, mask: jax.Array, scale: jax.Array, columns: int) -> jax.Array:
    """Share of a channel's residuals that are independent witnesses, from their correlation between neighbours.

    n_eff/n = ∏ (1 − ρ)/(1 + ρ) over the two image directions, ρ the correlation at lag one of the residuals as the
    loss weighs them (an autoregressive model along either direction). Where depth and colour are out of step, whole
    surfaces err together: ρ is near 1 and the share falls to a few per cent.
    """
    weighted = mask * residual * 6.0 / (5.0 + (residual / scale) ** 2)
    weighted, mask = weighted.reshape(-1, columns), mask.reshape(-1, columns)
    share = jnp.float32(1.0)
    for first, second, both in (
        (weighted[:, :-1], weighted[:, 1:], mask[:, :-1] * mask[:, 1:]),
        (weighted[:-1], weighted[1:], mask[:-1] * mask[1:]),
    ):
        product = jnp.sum(first * second)
        power = 0.5 * jnp.sum(both * (first**2 + second**2))
        rho = jnp.clip(product / jnp.maximum(power, 1e-20), 0.0, 0.98)
        share *= (1.0 - rho) / (1.0 + rho)
    return share


def estimate_scales(
    objective: Objective, target_T_reference: Float[Array, "4 4"], depth_weight: jax.Array | float
) -> Scales:
    """Scales of the grey and the depth residuals at one motion, and the weight of depth that follows from them.

    Each channel counts as its independent residuals do; `depth_weight` multiplies the ratio.
    """
    r = objective.residuals(target_T_reference)
    grey = jnp.maximum(_t_scale(r.grey, r.inside), SMALLEST_GREY_SCALE)
    depth = jnp.maximum(_t_scale(r.depth, r.depth_valid), SMALLEST_DEPTH_SCALE)
    ratio = _independent_share(r.depth, r.depth_valid, depth, objective.columns) / _independent_share(
        r.grey, r.inside, grey, objective.columns
    )
    return Scales(grey, depth, depth_weight * jnp.clip(ratio, *DEPTH_WEIGHT_RANGE))


DEPTH_WEIGHT_RANGE = (0.1, 0.3)
"""The estimated weight of depth is held within these: depth errs by whole surfaces (calibration, timing) in ways that
its scatter about them does not show, so it never counts as much as grey does."""


def estimate_brightness(objective: Objective, target_T_reference: Float[Array, "4 4"]) -> tuple[jax.Array, jax.Array]:
    """Gain and bias with I_{t+1}(ω(ξ, p)) ≈ gain · I_t(p) + bias at one motion, by re-weighted regression.

    The gain leans to 1 where the image has little contrast.
    """
    r = objective.residuals(target_T_reference)
    source, mask = objective.reference.grey, r.inside
    sample = jnp.where(mask > 0, r.grey_sample.value, 0.0)

    def refine(_: int, estimate: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        gain, bias, variance = estimate
        square = (sample - (gain * source + bias)) ** 2
        variance = jnp.maximum(_t_variance(square, mask, variance), SMALLEST_GREY_SCALE**2)
        weight = mask * 6.0 / (5.0 + square / variance)
        total = jnp.maximum(jnp.sum(weight), 1e-6)
        mean_source, mean_sample = jnp.sum(weight * source) / total, jnp.sum(weight * sample) / total
        covariance = jnp.sum(weight * (source - mean_source) * (sample - mean_sample)) / total
        spread = jnp.sum(weight * (source - mean_source) ** 2) / total
        gain = jnp.clip((covariance + GAIN_PRIOR) / (spread + GAIN_PRIOR), 0.7, 1.4)
        return gain, mean_sample - gain * mean_source, variance

    start = (jnp.float32(1.0), jnp.float32(0.0), jnp.float32(1e4))
    gain, bias, _ = jax.lax.fori_loop(0, ROUNDS, refine, start)
    return gain, bias


GAIN_PRIOR = 100.0
"""Squared grey levels: the image contrast at which the estimated gain is half-way between 1 and the regression's."""


def explained_variance(objective: Objective, target_T_reference: Float[Array, "4 4"]) -> Float[Array, ""]:
    """Share of the reference's grey variance that the target explains, 1 at best; points in view only."""
    r = objective.residuals(target_T_reference)
    count = jnp.maximum(jnp.sum(r.inside), 1.0)
    grey = objective.reference.grey
    mean = jnp.sum(r.inside * grey) / count
    variance = jnp.sum(r.inside * (grey - mean) ** 2) / count
    return 1.0 - (jnp.sum(r.inside * r.grey**2) / count) / jnp.maximum(variance, 1e-6)
