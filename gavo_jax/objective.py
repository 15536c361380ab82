"""The photometric error E(ξ) of a whole population of motions in one call, equations (1) and (2).

r_i(ξ) = I_{t+1}(ω(ξ, p_i)) − I_t(p_i) over the reference's points; E(ξ) = mean of a loss of r_i over the points that
land inside the target. With the L2 loss and nothing else switched on this is the paper's objective to the letter.
Beyond it: robust losses whose scale comes from the data, an affine brightness change between the frames, and a depth
residual 1/z_{t+1}(ω(ξ, p_i)) − 1/z_i(ξ). Inverse depth is the right quantity: σ_z ∝ z² for a structured-light sensor,
so the noise of 1/z is the same at every range and one scale serves all pixels.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Integer

from gavo_jax.camera import Camera
from gavo_jax.levels import ImagePlane, Levels
from gavo_jax.pyramid import NO_PIXEL, Pyramid, make_atlas
from gavo_jax.se3 import adjoint, exp, log, right_jacobian, rigid_inverse
from gavo_jax.warp import (
    DepthSample,
    GreySample,
    Points,
    Shutter,
    Slopes,
    Target,
    Warped,
    delay,
    delayed_slopes,
    inverse_depth_slopes,
    look_up,
    row_time,
    sample_depth,
    sample_grey,
    warp,
)

Loss = Callable[[jax.Array], jax.Array]
"""A cost of the squared normalised residual s = (r/σ)², never negative. Any callable of arrays will do."""


def l2(s: jax.Array) -> jax.Array:
    """ρ(s) = s: plain least squares, as in the paper's error."""
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
    """What the objective keeps of a level of the reference frame: arrays of N points, with an axis of views before it
    where several frames serve together.
    """

    points: Points
    grey: Float[Array, "*views n"]
    grey_u: Float[Array, "*views n"]
    """Intensity gradient along u (grey levels a pixel), and `grey_v` along v."""
    grey_v: Float[Array, "*views n"]
    slope_u: Float[Array, "*views n"]
    """Inverse-depth slope along u (1/m a pixel), and `slope_v` along v."""
    slope_v: Float[Array, "*views n"]
    facing: Float[Array, "*views n"]
    """Cosine of the surface's inclination: turns a residual along the ray into a point-to-plane distance."""
    row_time: Float[Array, "*views n"]
    """When the point's row was exposed; see `Shutter`."""


def central_gradient(grey: Float[Array, "h+2 w+2"]) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """∂/∂u and ∂/∂v by central differences of an image with a margin of one pixel; a neighbour that is `NO_PIXEL`
    counts as the pixel itself.
    """
    middle = grey[1:-1, 1:-1]

    def along(before: jax.Array, after: jax.Array) -> jax.Array:
        return 0.5 * (jnp.where(after == NO_PIXEL, middle, after) - jnp.where(before == NO_PIXEL, middle, before))

    return along(grey[1:-1, :-2], grey[1:-1, 2:]), along(grey[:-2, 1:-1], grey[2:, 1:-1])


def make_references(pyramid: Pyramid, camera: Camera, levels: Levels) -> Reference:
    """Points of some levels, [L, N]: one a square block of pixels, that of the steepest grey with a reading.

    The choice is stratified, so its cost in accuracy is small, and N is static. Shorter levels are filled up with
    points without a reading.

    Args:
        pyramid: Of the reference frame.
        camera: Of level 0.
        levels: Which ones, in the order of the result.
    """
    layout = levels.layout
    grey, inverse_depth = (image[:-1, :-1] for image in make_atlas([pyramid[number] for number in levels.numbers]))
    gradient, slopes = central_gradient(grey), inverse_depth_slopes(inverse_depth)
    grey, inverse_depth = grey[1:-1, 1:-1], inverse_depth[1:-1, 1:-1]
    steepness = jnp.where(inverse_depth > 0, gradient[0] ** 2 + gradient[1] ** 2, -1.0)
    chosen = []
    for (height, width), (row, column), cell in zip(levels.sizes, layout.corners, levels.cells, strict=True):
        u, v = _steepest_of_blocks(steepness[row : row + height, column : column + width], cell)
        chosen.append(((v + row) * layout.width + u + column).reshape(-1))
    place = jnp.stack([jnp.pad(p, (0, levels.most_points - p.shape[0]), constant_values=layout.gap) for p in chosen])
    q, grey, grey_u, grey_v, slope_u, slope_v = (
        image.reshape(-1).at[place].get(mode="promise_in_bounds") for image in (inverse_depth, grey, *gradient, *slopes)
    )
    plane = jax.tree.map(lambda leaf: leaf[:, None], levels.planes(camera))
    row, column = np.array(layout.corners).T[..., None]
    u, v = (axis.astype(jnp.float32) for axis in (place % layout.width - column, place // layout.width - row))
    near = jnp.maximum(q, 1e-3)
    facing = jax.lax.rsqrt(1.0 + (plane.fx * slope_u / near) ** 2 + (plane.fy * slope_v / near) ** 2)
    rays = Points((u - plane.cx) / plane.fx, (v - plane.cy) / plane.fy, q)
    return Reference(rays, grey, grey_u, grey_v, slope_u, slope_v, facing, row_time(v, plane))


def _steepest_of_blocks(steepness: Float[Array, "h w"], cell: int) -> tuple[Integer[Array, "r c"], ...]:
    """Column and row of the largest pixel of each cell x cell block, the first of equal ones."""
    rows, columns = (size // cell for size in steepness.shape)
    blocks = steepness[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell).transpose(0, 2, 1, 3)
    within = jnp.argmax(blocks.reshape(rows, columns, cell * cell), axis=-1)
    return jnp.arange(columns) * cell + within % cell, jnp.arange(rows)[:, None] * cell + within // cell


def move_reference(reference: Reference, camera_T_reference: Float[Array, "4 4"]) -> Reference:
    """The same points as rays of another camera; what falls behind it loses its reading."""
    r, t = camera_T_reference[:3, :3], camera_T_reference[:3, 3]
    x, y, q = reference.points
    return reference._replace(points=_rays([r[i, 0] * x + r[i, 1] * y + (r[i, 2] + t[i] * q) for i in range(3)], q))


def settle_reference(reference: Reference, twist: Float[Array, " 6"]) -> Reference:
    """The points where they were at their frame's moment instead of when their rows were exposed.

    Args:
        reference: As the camera's rolling shutter saw it.
        twist: Motion of the points in the camera during one readout, small.
    """
    (v, w), (x, y, q), back = (twist[:3], twist[3:]), reference.points, -reference.row_time
    moved = [
        x + back * (w[1] - w[2] * y + v[0] * q),
        y + back * (w[2] * x - w[0] + v[1] * q),
        1.0 + back * (w[0] * y - w[1] * x + v[2] * q),
    ]
    return reference._replace(points=_rays(moved, q), row_time=jnp.zeros_like(reference.row_time))


def _rays(moved: list[jax.Array], q: jax.Array) -> Points:
    """Points from their coordinates times their old inverse depth; those behind the camera lose their reading."""
    before = (q > 0) & (moved[2] > 1e-3)
    depth = jnp.where(before, moved[2], 1.0)
    return Points(moved[0] / depth, moved[1] / depth, jnp.where(before, q / depth, 0.0))


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
        """Scales that leave residuals as they are, without depth: the paper's error."""
        one = jnp.float32(1.0)
        return cls(one, one, jnp.float32(0.0))


class Residuals(NamedTuple):
    """Residuals of one motion at every reference point, with what a derivative needs."""

    grey: Float[Array, "*n"]
    """Grey levels; the paper's residual after the brightness model, about its mean where the objective is `centred`."""
    depth: Float[Array, "*n"]
    """Inverse depth, 1/m, along the surface normal; 0 where `depth_valid` is 0."""
    inside: Float[Array, "*n"]
    depth_valid: Float[Array, "*n"]
    warped: Warped
    """Before any delay by the shutter."""
    grey_sample: GreySample
    depth_sample: DepthSample


GROUP = 8
"""Candidates that are scored side by side on a CPU; a population's size is best a multiple of it."""
CHUNK = 1200
"""Points of a view on which a group of candidates is scored at a time on a CPU; what lies between two loops stays in
the cache (`benchmarks/kernel.py`). Twice as many suit an image of more than `FEW_POINTS`, but of several levels in
arrays of one length the short ones would be scored with what fills them up."""
FEW_POINTS = 9600
LINEARIZED_CHUNK = 4800
"""Points of a view that are linearised at a time; there is only one candidate then."""
CENTRING_POINTS = 480
"""Points a view that tell a motion's mean residual."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Objective:
    """E of one level of one pair of frames: prepared arrays, scales and a loss.

    A point that lands inside costs ρ(r²/σ²) + λ ρ(q²/τ²), or λ ρ(1) for the second term where the target has no depth
    reading: as much as a typical one, so that neither seeking nor shunning gaps pays. E is σ² times the mean cost.
    """

    reference: Reference
    target: Target
    plane: ImagePlane
    scales: Scales
    min_overlap: Float[Array, ""]
    outside_cost: Float[Array, ""] = field(default_factory=lambda: jnp.float32(0.0))
    """Cost of a reference point that leaves the view, in units of a typical point's. Positive, and a motion cannot win
    by pushing pixels out of view; 0 averages over the points in view alone, as the paper's error does."""
    count: Integer[Array, ""] | None = None
    """Points a view that hold something, from the first on; None: all."""
    views: Integer[Array, ""] | None = None
    """Views that hold something, from the first on; None: all."""
    columns: Integer[Array, ""] | int = 1
    """Reference points a row: they come from a grid, row after row."""
    centred: Bool[Array, ""] | None = None
    """Whether each motion's grey residuals are taken about their own mean, so that a change of exposure, which may be
    larger than any contrast, says nothing against the true motion. None: never, at no cost."""
    readout: Float[Array, ""] | None = None
    """Of a camera with a rolling shutter the share of the motion that passes during a readout; see `Shutter`. None: all
    rows are exposed at once."""
    backward: "Objective | None" = None
    """The same error with the frames' parts exchanged: the target's points seen from the reference, by the inverse
    motion. With it E is the mean of both, as neither frame is nearer to the truth than the other."""
    loss: Loss = field(default=l2, metadata={"static": True})
    use_depth: bool = field(default=False, metadata={"static": True})

    def sum_over_points(self, part: Callable[[Reference], Any], chunk_size: int) -> Any:
        """Sum of `part` over chunks of the reference's points, view after view, as far as there are any."""
        views, points = self.reference.grey.reshape(-1, self.reference.grey.shape[-1]).shape
        size = min(chunk_size, points)
        chunks = -(-points // size)
        if chunks * views == 1:
            return part(self.reference)
        fill = chunks * size - points
        whole = jax.tree.map(lambda a: jnp.pad(a.reshape(views, points), [(0, 0), (0, fill)]), self.reference)
        used_chunks = jnp.int32(chunks) if self.count is None else -(-self.count // size)
        used_views = views if self.views is None else jnp.minimum(self.views, views)

        def chunk(k: jax.Array) -> Reference:
            start = (jax.lax.div(k, used_chunks), jax.lax.rem(k, used_chunks) * size)
            return jax.tree.map(lambda a: jax.lax.dynamic_slice(a, start, (1, size))[0], whole)

        zero = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(lambda: part(chunk(jnp.int32(0)))))
        add = partial(jax.tree.map, jnp.add)
        return jax.lax.fori_loop(0, used_views * used_chunks, lambda k, total: add(total, part(chunk(k))), zero)

    def mean_residual(self, target_T_reference: Float[Array, "4 4"]) -> Float[Array, ""]:
        """Mean grey residual of one motion over points inside; 0 unless `centred`."""
        if self.centred is None:
            return jnp.float32(0.0)
        r = replace(self.sample(CENTRING_POINTS), centred=None).residuals(target_T_reference)
        return jnp.where(self.centred, jnp.sum(r.grey) / jnp.maximum(jnp.sum(r.inside), 1.0), 0.0)

    def sample(self, points: int | None) -> "Objective":
        """The same error on at most so many points a view, spread evenly; None: on all."""
        if points is None:
            return self
        available = self.reference.grey.shape[-1]
        size = min(points, available)
        places = jnp.arange(size) * (available if self.count is None else self.count) // size
        some = jax.tree.map(lambda a: a.at[..., places].get(mode="promise_in_bounds"), self.reference)
        return replace(self, reference=some, count=None)

    def merged(self) -> "Objective":
        """The same error with the points of all views in one flat array: sums over them then need no arithmetic on
        indices.
        """
        return replace(self, reference=jax.tree.map(jnp.ravel, self.reference), count=None, views=None)

    def residuals(
        self,
        target_T_reference: Float[Array, "4 4"],
        reference: Reference | None = None,
        mean: Float[Array, ""] | None = None,
    ) -> Residuals:
        """Residuals r_i(ξ) = I_{t+1}(ω(ξ, p_i)) − I_t(p_i) of one motion. Equation (1).

        They are of all points or of some, and about a mean that may be known already.
        """
        reference = self.reference if reference is None else reference
        mean = self.mean_residual(target_T_reference) if mean is None else mean
        warped = warp(reference.points, target_T_reference, self.plane)
        shutter = self.shutter(reference)
        seen = warped if shutter is None else delay(reference.points, warped, shutter, self.plane)
        words = look_up(self.target, seen, self.plane)
        grey_sample, depth_sample = sample_grey(words, seen), sample_depth(words, seen)
        grey = grey_sample.value - reference.grey - mean
        depth = reference.facing * (depth_sample.value - seen.inverse_depth)
        depth_valid = depth_sample.valid * seen.inside
        return Residuals(
            jnp.where(seen.inside > 0, grey, 0.0),
            jnp.where(depth_valid > 0, depth, 0.0),
            seen.inside,
            depth_valid,
            warped,
            grey_sample,
            depth_sample,
        )

    def shutter(self, reference: Reference) -> Shutter | None:
        """How the rows of some points were exposed; None where all were at once."""
        return None if self.readout is None else Shutter(self.readout, reference.row_time)

    def _cost(self, r: Residuals) -> Float[Array, "*n"]:
        """Cost of every point; −1 marks those outside, so that one pass over the points does."""
        scales = self.scales
        cost = self.loss(r.grey**2 * (1.0 / scales.grey**2))
        if self.use_depth:
            depth_cost = self.loss(r.depth**2 * (1.0 / scales.depth**2))
            cost += scales.depth_weight * jnp.where(r.depth_valid > 0, depth_cost, self.loss(jnp.float32(1.0)))
        return jnp.where(r.inside > 0, cost, -1.0)

    def _sums(self, cost: Float[Array, "*n"]) -> Float[Array, " 2"]:
        """Sum of the costs inside, and the number of points there."""
        inside = _lane_sum((cost >= 0).astype(jnp.float32))
        return jnp.stack([_lane_sum(cost) + (cost.size - inside), inside])

    def _conclude(self, sums: Float[Array, "2 ..."]) -> tuple[Float[Array, "*p"], Float[Array, "*p"]]:
        """Errors and overlaps from the sums over all points."""
        total, inside = sums
        valid = jnp.maximum(self._readings(), 1.0)
        typical = self.loss(jnp.float32(1.0))
        if self.use_depth:
            typical += self.scales.depth_weight * typical
        outside = (valid - inside) * self.outside_cost * typical
        overlap = inside / valid
        error = self.scales.grey**2 * (total + outside) / self._divisor(inside)
        return jnp.where(overlap < self.min_overlap, jnp.inf, error), overlap

    def _divisor(self, inside: Float[Array, "*p"]) -> Float[Array, "*p"]:
        """Number of points that E is the mean over."""
        return jnp.maximum(jnp.where(self.outside_cost > 0, self._readings(), inside), 1.0)

    def _readings(self) -> Float[Array, ""]:
        """Number of reference points with a reading."""
        return _lane_sum((self.reference.points.q > 0).astype(jnp.float32))

    def error(self, target_T_reference: Float[Array, "4 4"]) -> tuple[jax.Array, jax.Array]:
        """E(ξ) = (1/N) Σ r_i² of one motion (squared grey levels), N points being inside the target. Equation (2).

        A loss, a depth term and a cost of points outside go beyond the paper. The second number is the overlap, the
        share of reference points inside.
        """
        found = self.error_of(self.residuals(target_T_reference))
        return found if self.backward is None else _mean(found, self.backward.error(rigid_inverse(target_T_reference)))

    def error_of(self, r: Residuals) -> tuple[jax.Array, jax.Array]:
        """E and overlap of the motion of which these are the residuals, in this direction alone."""
        return self._conclude(self._sums(self._cost(r)))

    def score(
        self, target_T_reference: Float[Array, "p 4 4"], counted: Bool[Array, " p"] | None = None
    ) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        """Errors and overlaps of P motions in one call; those not `counted` cost nothing and have an error of +inf."""
        if counted is None:
            counted = jnp.ones(target_T_reference.shape[0], bool)
        found = _score(replace(self, backward=None), target_T_reference, counted)
        if self.backward is None:
            return found
        return _mean(found, self.backward.score(rigid_inverse(target_T_reference), counted))


def _mean(forward: tuple[jax.Array, jax.Array], backward: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
    """Error and overlap of both directions together."""
    return 0.5 * (forward[0] + backward[0]), jnp.minimum(forward[1], backward[1])


def _lane_sum(values: Float[Array, "*n"]) -> Float[Array, ""]:
    """Sum over all points in lanes: a plain sum is one chain of additions, which no compiler may reorder."""
    flat = values.reshape(-1)
    lanes = next(size for size in (480, 240, 120, 60, 32, 1) if flat.shape[0] % size == 0)
    return jnp.sum(jnp.sum(flat.reshape(-1, lanes), axis=0))


def _score_side_by_side(objective: Objective, motions: jax.Array, counted: jax.Array) -> tuple[jax.Array, jax.Array]:
    """All candidates and points at once: what a GPU wants."""
    sums = jax.vmap(lambda motion: objective._sums(objective._cost(objective.residuals(motion))), out_axes=1)(motions)
    error, overlap = objective._conclude(sums)
    return jnp.where(counted, error, jnp.inf), overlap


def _score_in_groups(objective: Objective, motions: jax.Array, counted: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Groups of candidates on chunks of points: what a CPU wants. Both loops run only as far as there is something."""
    candidates, points = motions.shape[0], objective.reference.grey.shape[-1]
    size = CHUNK if points <= FEW_POINTS else 2 * CHUNK
    group = min(GROUP, candidates)
    groups = -(-candidates // group)
    order = jnp.argsort(~counted, stable=True)
    order = jnp.concatenate([order, jnp.full(groups * group - candidates, candidates)])

    def score_group(i: jax.Array, sums: jax.Array) -> jax.Array:
        members = jax.lax.dynamic_slice_in_dim(order, i * group, group)
        chosen = motions.at[members].get(mode="clip")
        means = jax.vmap(objective.mean_residual)(chosen)

        def chunk_sums(chunk: Reference) -> jax.Array:
            def sums(motion: jax.Array, mean: jax.Array) -> jax.Array:
                return objective._sums(objective._cost(objective.residuals(motion, chunk, mean)))

            return jax.vmap(sums, out_axes=1)(chosen, means)

        return sums.at[:, members].set(objective.sum_over_points(chunk_sums, size), mode="drop")

    busy = -(-jnp.sum(counted) // group)
    sums = jax.lax.fori_loop(0, busy, score_group, jnp.zeros((2, candidates)))
    error, overlap = objective._conclude(sums)
    return jnp.where(counted, error, jnp.inf), overlap


@jax.custom_batching.custom_vmap
def _score(objective: Objective, motions: jax.Array, counted: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The form that suits the backend."""
    if jax.default_backend() == "cpu":
        return _score_in_groups(objective, motions, counted)
    return _score_side_by_side(objective, motions, counted)


@_score.def_vmap
def _score_batch(
    size: int, batched: Any, objective: Objective, motions: jax.Array, counted: jax.Array
) -> tuple[Any, tuple[bool, bool]]:
    """Several populations on one objective are one large population; several objectives are side by side."""
    if any(jax.tree.leaves(batched[0])):
        axes = jax.tree.map(lambda flag: 0 if flag else None, batched)
        return jax.vmap(_score_side_by_side, in_axes=tuple(axes))(objective, motions, counted), (True, True)
    motions, counted = (
        array if flag else jnp.broadcast_to(array, (size, *array.shape))
        for array, flag in zip((motions, counted), batched[1:], strict=True)
    )
    error, overlap = _score(objective, motions.reshape(-1, 4, 4), counted.reshape(-1))
    return (error.reshape(size, -1), overlap.reshape(size, -1)), (True, True)


class Linearization(NamedTuple):
    """E, its gradient and its Gauss-Newton Hessian (with the loss's weights) at one motion, in search coordinates."""

    error: Float[Array, ""]
    overlap: Float[Array, ""]
    gradient: Float[Array, " 6"]
    hessian: Float[Array, "6 6"]


def _jacobian(slopes: Slopes, warped: Warped, camera: Camera | ImagePlane) -> Float[Array, "6 n"]:
    """Derivative by a step δ on the target's side, exp(δ) · target_T_reference, by way of u, v and 1/z."""
    x, y, q = (warped.u - camera.cx) / camera.fx, (warped.v - camera.cy) / camera.fy, warped.inverse_depth
    pull_x, pull_y = slopes.along_u * camera.fx, slopes.along_v * camera.fy
    pull_z = -(pull_x * x + pull_y * y + slopes.along_inverse_depth * q)
    # held back, or XLA would compute what is sampled once more for each of the six rows
    x, y, q, pull_x, pull_y, pull_z = jax.lax.optimization_barrier((x, y, q, pull_x, pull_y, pull_z))
    turns = (y * pull_z - pull_y, pull_x - x * pull_z, x * pull_y - y * pull_x)
    return jnp.stack([q * pull_x, q * pull_y, q * pull_z, *turns]).reshape(6, -1)


Term = tuple[Float[Array, "6 n"], Float[Array, " n"], Float[Array, " n"]]
"""A channel's Jacobian, residuals and weights."""


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
    searched: Bool[Array, ""] | bool = True
    """Whether anything is to be found here; if not, no candidate is worth anything and none costs anything."""

    def transform(self, x: Float[Array, "*batch 6"]) -> Float[Array, "*batch 4 4"]:
        """target_T_reference of search coordinates."""
        return self.origin @ exp(x @ self.basis.T)

    def coordinates(self, target_T_reference: Float[Array, "4 4"]) -> Float[Array, " 6"]:
        """Search coordinates of a motion, the inverse of `transform`."""
        return jnp.linalg.solve(self.basis, log(rigid_inverse(self.origin) @ target_T_reference))

    def score(
        self, x: Float[Array, "p 6"], counted: Bool[Array, " p"] | None = None
    ) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        """Errors and overlaps of P candidates; not-a-number becomes +inf here, once for every solver.

        Candidates that are not `counted` cost nothing and have an error of +inf: a population that is smaller on one
        level than on another leaves places empty.
        """
        # held back, or XLA would compute each motion anew for each of its 16 entries
        motions = jax.lax.optimization_barrier(self.transform(x))
        counted = jnp.ones(x.shape[0], bool) if counted is None else counted
        error, overlap = self.objective.score(motions, counted & self.searched)
        return jnp.where(jnp.isnan(error) | self.is_out_of_reach(motions), jnp.inf, error), overlap

    def is_out_of_reach(self, motions: Float[Array, "*p 4 4"]) -> Bool[Array, "*p"]:
        """Which motions lie further from the centre than the search is held."""
        if self.centre is None or self.reach is None:
            return jnp.zeros(motions.shape[:-2], bool)
        offset = rigid_inverse(self.centre) @ motions
        cosine = 0.5 * (jnp.trace(offset, axis1=-2, axis2=-1) - 1.0)
        return (jnp.linalg.norm(offset[..., :3, 3], axis=-1) > self.reach[0]) | (cosine < jnp.cos(self.reach[1]))

    def linearize(self, x: Float[Array, " 6"]) -> Linearization:
        """E and its first two derivatives; image gradients are sampled, nothing is differentiated in reverse."""
        motion, tangent = self._tangent(x)
        model = _linearize(self.objective, motion, tangent)
        backward = self.objective.backward
        if backward is None:
            return model
        inverse = rigid_inverse(motion)
        other = _linearize(backward, inverse, -adjoint(inverse) @ tangent)
        error, overlap = _mean(model[:2], other[:2])
        return Linearization(error, overlap, *(0.5 * (a + b) for a, b in zip(model[2:], other[2:], strict=True)))

    def linearize_residuals(self, r: Residuals) -> Linearization:
        """E and its derivatives at x = 0, of which these are the residuals; from the reference to the target alone."""
        objective = self.objective
        sums = objective._sums(objective._cost(r))
        tangent = adjoint(self.origin) @ self.basis
        return _linearization(
            objective, tangent, sums, *_normal_equations(_weighted_terms(objective, objective.reference, r))
        )

    def examine(self, r: Residuals) -> tuple[Linearization, Float[Array, "6 6"]]:
        """E's derivatives at x = 0, of which these are the residuals, and the covariance of its gradient; from the
        reference to the target alone.

        The covariance comes from the gradient's spread over tiles of the target image: residuals of neighbouring
        pixels are correlated, so pixels are no independent witnesses; tiles nearly are. With the Hessian on both
        sides this is the cluster-robust ("sandwich") covariance of an M-estimate.
        """
        objective, plane = self.objective, self.objective.plane
        tangent = adjoint(self.origin) @ self.basis
        terms = _weighted_terms(objective, objective.reference, r)
        sums = objective._sums(objective._cost(r))
        column = jnp.clip(r.warped.u * (TILES[0] / plane.width), 0, TILES[0] - 1).astype(jnp.int32)
        row = jnp.clip(r.warped.v * (TILES[1] / plane.height), 0, TILES[1] - 1).astype(jnp.int32)
        tile = (row * TILES[0] + column).reshape(-1)
        pull = jnp.asarray(sum(jacobian * (weight * residual) for jacobian, residual, weight in terms))
        sum_by_tile = partial(jax.ops.segment_sum, segment_ids=tile, num_segments=TILES[0] * TILES[1])
        by_tile = tangent.T @ jax.vmap(sum_by_tile)(pull)
        by_tile *= 2.0 / objective._divisor(sums[1])
        used = jnp.sum(jnp.any(by_tile != 0, axis=0))
        scatter = (by_tile @ by_tile.T) * used / jnp.maximum(used - 1, 1)
        return _linearization(objective, tangent, sums, *_normal_equations(terms)), scatter

    def _tangent(self, x: Float[Array, " 6"]) -> tuple[Float[Array, "4 4"], Float[Array, "6 6"]]:
        """The motion, and J with transform(x + dx) ≈ exp(J dx) · motion."""
        motion = self.transform(x)
        return motion, adjoint(motion) @ right_jacobian(self.basis @ x) @ self.basis


def _linearize(objective: Objective, motion: Float[Array, "4 4"], tangent: Float[Array, "6 6"]) -> Linearization:
    """E of one direction and its first two derivatives at a motion, by coordinates of which exp(tangent · dx) follows
    it.
    """
    mean = objective.mean_residual(motion)

    def part(reference: Reference) -> tuple[jax.Array, jax.Array, jax.Array]:
        r = objective.residuals(motion, reference, mean)
        gradient, hessian = _normal_equations(_weighted_terms(objective, reference, r))
        return objective._sums(objective._cost(r)), gradient, hessian

    return _linearization(objective, tangent, *objective.sum_over_points(part, LINEARIZED_CHUNK))


def _linearization(
    objective: Objective, tangent: Float[Array, "6 6"], sums: jax.Array, gradient: jax.Array, hessian: jax.Array
) -> Linearization:
    error, overlap = objective._conclude(sums)
    factor = 2.0 / objective._divisor(sums[1])
    return Linearization(error, overlap, factor * tangent.T @ gradient, factor * tangent.T @ hessian @ tangent)


def _weighted_terms(objective: Objective, reference: Reference, r: Residuals) -> list[Term]:
    """For each channel J of [6, N], r and w of [N]: half of E's gradient, by a step on the target's side, is Σ J w r
    over the number of points, half its Gauss-Newton Hessian Σ w J Jᵀ.
    """
    scales, facing, shutter = objective.scales, reference.facing, objective.shutter(reference)
    grey, depth = r.grey_sample, r.depth_sample
    one = jnp.float32(1.0)
    along = Slopes(grey.along_u, grey.along_v, jnp.zeros_like(r.grey))
    channels = [(r.grey, scales.grey, r.inside, one, along)]
    if objective.use_depth:
        factor = scales.depth_weight * (scales.grey / scales.depth) ** 2
        along = Slopes(facing * depth.along_u, facing * depth.along_v, -facing)
        channels.append((r.depth, scales.depth, r.depth_valid, factor, along))
    terms = []
    for residual, scale, mask, factor, slopes in channels:
        if shutter is not None:
            slopes = delayed_slopes(slopes, reference.points, r.warped, shutter, objective.plane)
        jacobian = jnp.where(mask.reshape(-1) > 0, _jacobian(slopes, r.warped, objective.plane), 0.0)
        s = (residual / scale) ** 2
        _, slope = jax.jvp(objective.loss, (s,), (jnp.ones_like(s),))
        weight = factor * jnp.where(mask > 0, slope, 0.0)
        terms.append((jacobian, residual.reshape(-1), weight.reshape(-1)))
    return terms


def _normal_equations(terms: list[Term]) -> tuple[Float[Array, " 6"], Float[Array, "6 6"]]:
    gradient = jnp.asarray(sum(jacobian @ (weight * residual) for jacobian, residual, weight in terms))
    return gradient, jnp.asarray(sum((jacobian * weight) @ jacobian.T for jacobian, _, weight in terms))


TILES = (8, 6)
"""Tiles across and down the image, for `Problem.examine`."""


def reference_curvature(objective: Objective) -> Float[Array, "6 6"]:
    """A = mean of JᵀJ at zero motion from the reference frame alone: half the Hessian of E for a perfect match.

    J is taken in a step on the reference's side, target_T_reference = origin · exp(ξ), where it does not depend on
    the origin. No target is needed, so A is known before the search.
    """
    reference, plane, scales = objective.reference, objective.plane, objective.scales
    points, facing = reference.points, reference.facing
    valid = (points.q > 0).astype(jnp.float32)
    warped = Warped(points.x * plane.fx + plane.cx, points.y * plane.fy + plane.cy, points.q, valid)

    def curvature(slopes: Slopes) -> jax.Array:
        jacobian = _jacobian(slopes, warped, plane) * valid.reshape(-1)
        return jacobian @ jacobian.T / jnp.maximum(jnp.sum(valid), 1.0)

    total = curvature(Slopes(reference.grey_u, reference.grey_v, jnp.zeros_like(valid)))
    if objective.use_depth:
        depth = curvature(Slopes(facing * reference.slope_u, facing * reference.slope_v, -facing))
        total += scales.depth_weight * (scales.grey / scales.depth) ** 2 * depth
    return total


LARGEST_UNIT_STEP = 0.05
"""Metres or radians: a direction that the image hardly constrains is not searched further than this a unit."""


def preconditioner(curvature: Float[Array, "6 6"]) -> Float[Array, "6 6"]:
    """B with BᵀAB = identity, B = V Λ^(−1/2) of A = V Λ Vᵀ, limited where A is nearly singular."""
    ridge = jnp.eye(6) / LARGEST_UNIT_STEP**2
    values, vectors = jnp.linalg.eigh(curvature + ridge)
    return vectors * jax.lax.rsqrt(jnp.maximum(values, 1e-9))


def unconditioner(basis: Float[Array, "6 6"]) -> Float[Array, "6 6"]:
    """The inverse of a `preconditioner`, whose columns are at right angles."""
    return (basis / jnp.sum(basis**2, axis=0)).T


ROUNDS = 6
"""Rounds of the re-weighted estimates below; each contracts the remaining error several times."""


def _t_weight(square: Float[Array, "*n"], variance: Float[Array, "*#n"]) -> Float[Array, "*n"]:
    """Weight of squared residuals under a t distribution, 5 degrees of freedom (Kerl et al. 2013)."""
    return 6.0 / (5.0 + square / jnp.maximum(variance, 1e-20))


def _t_scales(residual: Float[Array, "c n"], mask: Float[Array, "c n"]) -> Float[Array, " c"]:
    """Scales of t distributions fitted to the masked residuals of some channels, by fixed-point rounds."""
    square = mask * residual**2
    count = jnp.maximum(jnp.sum(mask, axis=1), 1.0)

    def refine(_: int, variance: jax.Array) -> jax.Array:
        return jnp.sum(square * _t_weight(square, variance[:, None]), axis=1) / count

    return jnp.sqrt(jax.lax.fori_loop(0, ROUNDS, refine, jnp.sum(square, axis=1) / count))


SMALLEST_GREY_SCALE = 0.5
"""Grey levels: rounding alone leaves 0.3."""
SMALLEST_DEPTH_SCALE = 5e-4
"""1/m: a tenth of the quantisation of a structured-light sensor."""


def _independent_share(
    residual: jax.Array, mask: jax.Array, scale: jax.Array, columns: jax.Array | int
) -> Float[Array, ""]:
    """Share of a channel's residuals that are independent witnesses, from their correlation between neighbours.

    n_eff/n = ∏ (1 − ρ)/(1 + ρ) over the two image directions, ρ the correlation at lag one of the residuals as the
    loss weighs them (an autoregressive model along either direction). Where depth and colour are out of step, whole
    surfaces err together: ρ is near 1 and the share falls to a few per cent.
    """
    weighted = mask * residual * 6.0 / (5.0 + (residual / scale) ** 2)
    place = jnp.arange(residual.shape[-1])
    share = jnp.float32(1.0)
    for step, has_next in ((1, place % columns < columns - 1), (columns, True)):
        following, following_mask = (
            jnp.take(a, place + step, axis=-1, mode="fill", fill_value=0.0) for a in (weighted, mask)
        )
        both = mask * following_mask * has_next
        product = jnp.sum(both * weighted * following)
        power = 0.5 * jnp.sum(both * (weighted**2 + following**2))
        rho = jnp.clip(product / jnp.maximum(power, 1e-20), 0.0, 0.98)
        share *= (1.0 - rho) / (1.0 + rho)
    return share


FULL_DEPTH_RATIO = 0.3
"""Independent share of the depth residuals, over that of the grey ones, from which on depth has its whole weight;"""
LEAST_DEPTH_TRUST = 1 / 3
"""of which this part always stays."""


def depth_trust(objective: Objective, target_T_reference: Float[Array, "4 4"], scales: Scales) -> Float[Array, ""]:
    """Factor on depth's weight, from 1 to a third where its residuals, more than grey's, err by whole surfaces."""
    r = objective.residuals(target_T_reference)
    depth = _independent_share(r.depth, r.depth_valid, scales.depth, objective.columns)
    grey = _independent_share(r.grey, r.inside, scales.grey, objective.columns)
    return jnp.clip(depth / grey / FULL_DEPTH_RATIO, LEAST_DEPTH_TRUST, 1.0)


def estimate_scales(r: Residuals, depth_weight: jax.Array | float) -> Scales:
    """Scales of the grey and the depth residuals of one motion, with the weight that depth is given."""
    residual = jnp.stack([r.grey, r.depth]).reshape(2, -1)
    mask = jnp.stack([r.inside, r.depth_valid]).reshape(2, -1)
    found = jnp.maximum(_t_scales(residual, mask), jnp.array([SMALLEST_GREY_SCALE, SMALLEST_DEPTH_SCALE]))
    return Scales(found[0], found[1], jnp.float32(depth_weight))


class Brightness(NamedTuple):
    """Gain and bias of every view, [V]: I_{t+1}(ω(ξ, p)) ≈ gain · I_t(p) + bias."""

    gain: Float[Array, "*v"]
    bias: Float[Array, "*v"]

    @classmethod
    def unchanged(cls, views: int) -> "Brightness":
        """Every view as bright as the target."""
        return cls(jnp.ones(views), jnp.zeros(views))

    def seen(self, grey: Float[Array, "v n"]) -> Float[Array, "v n"]:
        """Grey of the views' points as the target shows them."""
        return self.gain[:, None] * grey + self.bias[:, None]


def estimate_brightness(grey: Float[Array, "v n"], r: Residuals) -> Brightness:
    """Brightness of each view at one motion, by re-weighted regression of what was sampled on the reference's grey.

    The gain leans to 1 where the image has little contrast.
    """
    mask = r.inside
    sample = jnp.where(mask > 0, r.grey_sample.value, MIDDLE_GREY) - MIDDLE_GREY
    features = jnp.stack([jnp.ones_like(grey), grey - MIDDLE_GREY, sample], axis=1)

    def refine(_: int, estimate: tuple[Brightness, jax.Array]) -> tuple[Brightness, jax.Array]:
        brightness, variance = estimate
        square = (sample + MIDDLE_GREY - brightness.seen(grey)) ** 2
        mean = jnp.sum(mask * square * _t_weight(square, variance), axis=1) / jnp.maximum(jnp.sum(mask, axis=1), 1.0)
        variance = jnp.maximum(mean, SMALLEST_GREY_SCALE**2)[:, None]
        weight = mask * _t_weight(square, variance)
        moments = jnp.einsum("vin,vn,vjn->vij", features, weight, features)
        moments /= jnp.maximum(moments[:, :1, :1], 1e-6)
        mean_source, mean_sample = moments[:, 0, 1], moments[:, 0, 2]
        spread, covariance = moments[:, 1, 1] - mean_source**2, moments[:, 1, 2] - mean_source * mean_sample
        gain = jnp.clip((covariance + GAIN_PRIOR) / (spread + GAIN_PRIOR), 0.7, 1.4)
        bias = mean_sample + MIDDLE_GREY - gain * (mean_source + MIDDLE_GREY)
        return Brightness(gain, bias), variance

    start = (Brightness.unchanged(grey.shape[0]), jnp.full((grey.shape[0], 1), 1e4))
    return jax.lax.fori_loop(0, ROUNDS, refine, start)[0]


MIDDLE_GREY = 128.0
"""Grey levels that moments are taken about, so that they lose no digits."""


GAIN_PRIOR = 100.0
"""Squared grey levels: the image contrast at which the estimated gain is half-way between 1 and the regression's."""


LARGE_GREY_RESIDUAL = 12.0
"""Grey levels: what noise and interpolation leave of a true match stays below, on all but edges and occlusions."""
LARGE_DEPTH_RESIDUAL = 0.03
"""1/m: ten times the quantisation of a structured-light sensor."""


class ExplainedShare(NamedTuple):
    """Share of a motion's residuals that are not large."""

    grey: Float[Array, ""]
    depth: Float[Array, ""]


def explained_share(residuals: Residuals) -> ExplainedShare:
    """How much of what both frames see a motion explains, 1 at best; points in view, with a reading, only."""
    r = residuals

    def share(residual: jax.Array, mask: jax.Array, large: float) -> jax.Array:
        return jnp.sum(mask * (jnp.abs(residual) < large)) / jnp.maximum(jnp.sum(mask), 1.0)

    return ExplainedShare(
        share(r.grey, r.inside, LARGE_GREY_RESIDUAL), share(r.depth, r.depth_valid, LARGE_DEPTH_RESIDUAL)
    )
