"""The photometric error E(ξ) of a whole population of motions in one call, equations (1) and (2).

r_i(ξ) = I_{t+1}(ω(ξ, p_i)) − I_t(p_i) over the reference's points; E(ξ) = mean of a loss of r_i over the points that
land inside the target. With the L2 loss and everything else switched off this is exactly the paper's objective.
Extensions are robust losses whose scale comes from the data, an affine brightness change between the frames, and a
depth residual 1/z_{t+1}(ω(ξ, p_i)) − 1/z_i(ξ). It is taken in inverse depth: σ_z ∝ z² for a structured-light sensor, so
the noise of 1/z is the same at every range and one scale serves all pixels.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Integer

from gavo_jax.image.levels import ImagePlane
from gavo_jax.image.sampling import DepthSample, GreySample, Target, look_up, sample_depth, sample_grey
from gavo_jax.image.shutter import Shutter, delay
from gavo_jax.image.warp import Warped, warp
from gavo_jax.objective.losses import Loss, l2
from gavo_jax.objective.points import Reference
from gavo_jax.se3 import rigid_inverse


class Scales(NamedTuple):
    """Scales estimated from the data before a level is searched, and fixed while its candidates are compared."""

    grey: Float[Array, ""]
    """Scale σ of the grey residuals, grey levels."""
    depth: Float[Array, ""]
    """Scale of the inverse-depth residuals, 1/m."""
    depth_weight: Float[Array, ""]
    """Weight of the depth cost against the grey one (both normalised by their scales)."""

    @property
    def depth_factor(self) -> Float[Array, ""]:
        """Weight of a squared depth residual relative to that of a grey one."""
        return self.depth_weight * (self.grey / self.depth) ** 2

    @classmethod
    def unit(cls) -> "Scales":
        """Return unit scales without depth: the paper's error."""
        one = jnp.float32(1.0)
        return cls(one, one, jnp.float32(0.0))


class Residuals(NamedTuple):
    """Residuals of one motion at every reference point, with the samples that derivatives need."""

    grey: Float[Array, "*n"]
    """Grey levels; the paper's residual after the brightness model, about its mean where the objective is `centred`."""
    depth: Float[Array, "*n"]
    """Inverse depth, 1/m, along the surface normal; 0 where `depth_valid` is 0."""
    inside: Float[Array, "*n"]
    lit: Float[Array, "*n"]
    """From the reference; see `Reference`."""
    depth_valid: Float[Array, "*n"]
    warped: Warped
    """Warped points before any delay by the rolling shutter."""
    grey_sample: GreySample
    depth_sample: DepthSample


GROUP = 8
"""Number of candidates scored side by side on a CPU; a population's size is best a multiple of it."""
CHUNK = 1200
"""Number of points of a view on which a group of candidates is scored at a time on a CPU, so that intermediate arrays
stay in the cache (`benchmarks/kernel.py`). Twice as many suit images of more than `FEW_POINTS`. On smaller ones, whose
levels share arrays of one length, larger chunks would score more padding."""
FEW_POINTS = 9600
LINEARIZED_CHUNK = 4800
"""Number of points of a view that are linearised at a time; there is only one candidate then."""
CENTRING_POINTS = 480
"""Number of points of a view that a motion's mean residual is taken over."""
MOST_SAMPLED = 46340
"""Largest number of points of a view in any sample: the product of two indices fits into 32 bits."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Objective:
    """E of one level of one pair of frames: prepared arrays, scales and a loss.

    A point that lands inside costs ρ(r²/σ²) + λ ρ(q²/τ²). Where the target has no depth reading the second term is
    λ ρ(1), the cost of a typical one, so that gaps are neither rewarded nor punished. E is σ² times the mean cost.
    """

    reference: Reference
    target: Target
    plane: ImagePlane
    scales: Scales
    min_overlap: Float[Array, ""]
    outside_cost: Float[Array, ""] = field(default_factory=lambda: jnp.float32(0.0))
    """Cost of a reference point that leaves the view, in units of a typical point's. If positive, a motion cannot win
    by pushing pixels out of view; 0 averages over only the points in view, as the paper's error does."""
    count: Integer[Array, ""] | None = None
    """Number of points of a view that are used, the first ones; None: all."""
    views: Integer[Array, ""] | None = None
    """Number of views that are used, the first ones; None: all."""
    columns: Integer[Array, ""] | int = 1
    """Number of reference points in a row: they come from a grid, row by row."""
    centred: Bool[Array, ""] | None = None
    """Whether each motion's grey residuals are taken about their own mean, so that a change of exposure, which may
    exceed any contrast, does not penalise the true motion. None: never, at no cost."""
    readout: Float[Array, ""] | None = None
    """Share of the motion that passes during the readout of a rolling shutter; see `Shutter`. None: global shutter."""
    sway: Float[Array, " 6"] | None = None
    """Sway of the target under a rolling shutter; see `Shutter`. None: it moved at the mean velocity since the
    reference."""
    backward: "Objective | None" = None
    """The error with the frames' roles exchanged: the target's points seen from the reference, by the inverse motion.
    With it E is the mean of both directions, as neither frame is nearer to the truth than the other."""
    loss: Loss = field(default=l2, metadata={"static": True})
    use_depth: bool = field(default=False, metadata={"static": True})

    def sum_over_points(self, part: Callable[[Reference], Any], chunk_size: int) -> Any:
        """Sum `part` over chunks of the reference's points that are used, view by view."""
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
        """Return the same error on at most `points` evenly spread points of a view; None: on all."""
        if points is None:
            return self
        available = self.reference.grey.shape[-1]
        size = min(points, available, MOST_SAMPLED)
        apart, rest = divmod(available if self.count is None else self.count, size)
        places = jnp.arange(size)
        places = places * apart + places * rest // size  # an index times all points would overflow 32 bits
        some = jax.tree.map(lambda a: a.at[..., places].get(mode="promise_in_bounds"), self.reference)
        return replace(self, reference=some, count=None)

    def merged(self) -> "Objective":
        """Return the same error with the points of all views in one flat array, which is simpler to sum over."""
        return replace(self, reference=jax.tree.map(jnp.ravel, self.reference), count=None, views=None)

    def residuals(
        self,
        target_T_reference: Float[Array, "4 4"],
        reference: Reference | None = None,
        mean: Float[Array, ""] | None = None,
    ) -> Residuals:
        """Residuals r_i(ξ) = I_{t+1}(ω(ξ, p_i)) − I_t(p_i) of one motion. Equation (1).

        `reference` selects some of the points, and `mean` gives their mean residual if it is already known.
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
            grey=jnp.where(seen.inside > 0, grey, 0.0),
            depth=jnp.where(depth_valid > 0, depth, 0.0),
            inside=seen.inside,
            lit=reference.lit,
            depth_valid=depth_valid,
            warped=warped,
            grey_sample=grey_sample,
            depth_sample=depth_sample,
        )

    def shutter(self, reference: Reference) -> Shutter | None:
        """Return the rolling shutter of some points; None for a global shutter."""
        return None if self.readout is None else Shutter(self.readout, reference.row_time, self.sway)

    def cost(self, r: Residuals) -> Float[Array, "*n"]:
        """Cost of every point; −1 marks those outside, so that one pass over the points is enough."""
        scales = self.scales
        cost = self.loss(r.grey**2 * (1.0 / scales.grey**2))
        if self.use_depth:
            depth_cost = self.loss(r.depth**2 * (1.0 / scales.depth**2))
            cost += scales.depth_weight * jnp.where(r.depth_valid > 0, depth_cost, self.loss(jnp.float32(1.0)))
        return jnp.where(r.inside > 0, cost, -1.0)

    def sums(self, cost: Float[Array, "*n"]) -> Float[Array, " 2"]:
        """Sum of the costs of points inside, and the number of these points."""
        inside = lane_sum((cost >= 0).astype(jnp.float32))
        return jnp.stack([lane_sum(cost) + (cost.size - inside), inside])

    def error_and_overlap(self, sums: Float[Array, "2 ..."]) -> tuple[Float[Array, "*p"], Float[Array, "*p"]]:
        """Errors and overlaps from the sums over all points."""
        total, inside = sums
        valid = jnp.maximum(self.readings(), 1.0)
        typical = self.loss(jnp.float32(1.0))
        if self.use_depth:
            typical += self.scales.depth_weight * typical
        outside = (valid - inside) * self.outside_cost * typical
        overlap = inside / valid
        error = self.scales.grey**2 * (total + outside) / self.divisor(inside)
        return jnp.where(self.is_out_of_view(overlap), jnp.inf, error), overlap

    def is_out_of_view(self, overlap: Float[Array, "*p"]) -> Bool[Array, "*p"]:
        """Whether too few points are in view for a motion to count; without any, even where none is required."""
        return (overlap < self.min_overlap) | (overlap <= 0)

    def divisor(self, inside: Float[Array, "*p"]) -> Float[Array, "*p"]:
        """Number of points that E is the mean over."""
        return jnp.maximum(jnp.where(self.outside_cost > 0, self.readings(), inside), 1.0)

    def readings(self) -> Float[Array, ""]:
        """Number of reference points with a reading."""
        return lane_sum((self.reference.points.q > 0).astype(jnp.float32))

    def error(self, target_T_reference: Float[Array, "4 4"]) -> tuple[jax.Array, jax.Array]:
        """E(ξ) = (1/N) Σ r_i² of one motion (squared grey levels), N points being inside the target. Equation (2).

        A loss, a depth term and a cost of points outside go beyond the paper. The second number is the overlap, the
        share of reference points inside.
        """
        found = self.error_of(self.residuals(target_T_reference))
        return (
            found
            if self.backward is None
            else both_directions(found, self.backward.error(rigid_inverse(target_T_reference)))
        )

    def error_of(self, r: Residuals) -> tuple[jax.Array, jax.Array]:
        """E and overlap of a motion from its residuals, in this direction only."""
        return self.error_and_overlap(self.sums(self.cost(r)))

    def score(
        self, target_T_reference: Float[Array, "p 4 4"], counted: Bool[Array, " p"] | None = None
    ) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        """Errors and overlaps of P motions in one call.

        Those that are not `counted` have an error of +inf, and cost nothing on a CPU.
        """
        if counted is None:
            counted = jnp.ones(target_T_reference.shape[0], bool)
        found = _score(replace(self, backward=None), target_T_reference, counted)
        if self.backward is None:
            return found
        return both_directions(found, self.backward.score(rigid_inverse(target_T_reference), counted))


def both_directions(
    forward: tuple[jax.Array, jax.Array], backward: tuple[jax.Array, jax.Array]
) -> tuple[jax.Array, jax.Array]:
    """Combine error and overlap of both directions: mean error, smaller overlap."""
    return 0.5 * (forward[0] + backward[0]), jnp.minimum(forward[1], backward[1])


def lane_sum(values: Float[Array, "*n"]) -> Float[Array, ""]:
    """Sum over all points in lanes: a plain sum is a single chain of additions, which a compiler must not reorder."""
    flat = values.reshape(-1)
    lanes = next(size for size in (480, 240, 120, 60, 32, 1) if flat.shape[0] % size == 0)
    return jnp.sum(jnp.sum(flat.reshape(-1, lanes), axis=0))


def _score_side_by_side(objective: Objective, motions: jax.Array, counted: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Score all candidates on all points at once, which suits a GPU."""
    sums = jax.vmap(lambda motion: objective.sums(objective.cost(objective.residuals(motion))), out_axes=1)(motions)
    error, overlap = objective.error_and_overlap(sums)
    return jnp.where(counted, error, jnp.inf), overlap


def _score_in_groups(objective: Objective, motions: jax.Array, counted: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Score groups of candidates on chunks of points, which suits a CPU; neither loop runs over empty places."""
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
                return objective.sums(objective.cost(objective.residuals(motion, chunk, mean)))

            return jax.vmap(sums, out_axes=1)(chosen, means)

        return sums.at[:, members].set(objective.sum_over_points(chunk_sums, size), mode="drop")

    busy = -(-jnp.sum(counted) // group)
    sums = jax.lax.fori_loop(0, busy, score_group, jnp.zeros((2, candidates)))
    error, overlap = objective.error_and_overlap(sums)
    return jnp.where(counted, error, jnp.inf), overlap


@jax.custom_batching.custom_vmap
def _score(objective: Objective, motions: jax.Array, counted: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Score in the form that suits the backend."""
    if jax.default_backend() == "cpu":
        return _score_in_groups(objective, motions, counted)
    return _score_side_by_side(objective, motions, counted)


@_score.def_vmap
def _score_batch(
    size: int, batched: Any, objective: Objective, motions: jax.Array, counted: jax.Array
) -> tuple[Any, tuple[bool, bool]]:
    """Score several populations on one objective as one large population; several objectives side by side."""
    if any(jax.tree.leaves(batched[0])):
        axes = jax.tree.map(lambda flag: 0 if flag else None, batched)
        return jax.vmap(_score_side_by_side, in_axes=tuple(axes))(objective, motions, counted), (True, True)
    motions, counted = (
        array if flag else jnp.broadcast_to(array, (size, *array.shape))
        for array, flag in zip((motions, counted), batched[1:], strict=True)
    )
    error, overlap = _score(objective, motions.reshape(-1, 4, 4), counted.reshape(-1))
    return (error.reshape(size, -1), overlap.reshape(size, -1)), (True, True)
