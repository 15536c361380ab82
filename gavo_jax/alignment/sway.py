"""The camera's velocity at a frame's timestamp, estimated from its rolling shutter distortion.

The motion between two frames gives the mean velocity since the last one. But a hand trembles several times a second.
At a frame's timestamp the camera turns faster or slower than that, by up to 0.5 rad/s, which stretches and shears the
image. A search that knows only the mean explains the stretch by a sideways translation and a compensating rotation, a
centimetre and more. So the difference of the frame's velocity from the mean, its sway, is an unknown beside the motion.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Integer

from gavo_jax.image.shutter import row_time
from gavo_jax.objective.derivatives import weighted_terms
from gavo_jax.objective.error import Residuals
from gavo_jax.objective.problem import Problem
from gavo_jax.se3 import adjoint, exp, rigid_inverse

SHARE = 1.5
"""Ratio of a sway's standard deviation to that of the mean velocity's changes from pair to pair. From the ground truth
of the TUM clips it is 0.5 to 0.9 at any rate (`benchmarks/acceleration.py`); single frames have much more."""
FORGETTING = 0.97
"""Factor from frame to frame on the sum of the sways. The sum is expected to be no larger than one of them, as the mean
velocity follows them and they cancel. What doesn't cancel is a model error (depth, lens), which would cause drift."""
FIRST_CHANGES, LEAST_CHANGES = (0.03, 0.3), (0.002, 0.01)
"""m/s and rad/s: initial value of the mean velocity's changes, and a lower bound on them."""
REMEMBERED = 15.0
"""Approximate number of last pairs that the mean velocity's changes are estimated from."""
UNSWAYED = (0.03, 0.03)
"""Metres and radians: standard deviations of a motion that was found with the mean velocity."""
DEPENDENT = 10.0
"""Number of points that carry as much information as one, as neighbours have similar errors. It is divided by the
squared share of points with depth and at rest: the less of the image they fill, the more a turn looks like a step."""
FRAMES = 2.0
"""Factor on the covariance due to the target's sway, as the reference's is known no better."""
ROUNDS = 2
"""Number of Gauss-Newton steps; a single one covers less than half the distance."""
LARGEST_RISE = 0.003
"""Share by which refinement of a search's result may raise E: between pixels E is rough by about that much, and the aim
is the centre of its basin. If E rises more, the motion stays as it was, without sway."""


class VelocityChange(NamedTuple):
    """How a run's velocity changes from frame to frame."""

    summed: Float[Array, " 6"]
    """Sum of the last frames' sways, m/s and rad/s."""
    changes: Float[Array, " 2"]
    """Mean square of the mean velocity's change from pair to pair, per axis: (m/s)² and (rad/s)²."""

    @classmethod
    def unknown(cls) -> "VelocityChange":
        """Return the state before the first pair."""
        still: Any = np.zeros(6, np.float32)
        changes: Any = np.square(np.asarray(FIRST_CHANGES, np.float32))
        return cls(still, changes)

    def after(self, sway: Float[Array, " 6"], change: Float[Array, " 6"]) -> "VelocityChange":
        """Return the state after one more pair, given its sway and its mean velocity's change, m/s and rad/s."""
        squares = jnp.mean(jnp.square(change.reshape(2, 3)), axis=1)
        return VelocityChange(FORGETTING * (self.summed + sway), self.changes + (squares - self.changes) / REMEMBERED)

    @property
    def deviation(self) -> Float[Array, " 6"]:
        """Standard deviation of a sway, m/s and rad/s."""
        least = jnp.square(jnp.array(LEAST_CHANGES))
        return jnp.repeat(SHARE * jnp.sqrt(jnp.maximum(self.changes, least)), 3)


class Swaying(NamedTuple):
    """Prior knowledge of a frame's sway."""

    elapsed: Float[Array, ""]
    """Seconds since the last frame."""
    velocity_change: VelocityChange
    """How the run's velocity has changed so far."""


class Swayed(NamedTuple):
    """A motion with the target's sway."""

    motion: Float[Array, "4 4"]
    twist: Float[Array, " 6"]
    """Velocity of the points in the target camera at its timestamp, less the mean since the last frame, as a twist:
    metres and radians over the time between the two."""
    covariance: Float[Array, "6 6"]
    """Contribution of the sway's uncertainty to the covariance of δ in motion · exp(δ)."""
    residuals: Residuals


def unswayed(motion: Float[Array, "4 4"], residuals: Residuals) -> Swayed:
    """Return a motion without sway."""
    return Swayed(motion, jnp.zeros(6), jnp.zeros((6, 6)), residuals)


class Iterate(NamedTuple):
    """State of the refinement after some of its steps."""

    motion: Float[Array, "4 4"]
    x: Float[Array, " 12"]
    """Twists of the motion's change and of the sway."""
    residuals: Residuals
    hessian: Float[Array, "12 12"]


def refine_swaying(problem: Problem, residuals: Residuals, swaying: Swaying, points: Integer[Array, ""]) -> Swayed:
    """Estimate the motion and sway that explain the images best, starting at the problem's origin and its residuals.

    Minimises Σ w r² / (σ² DEPENDENT) plus the squared deviations from the priors of both. The target's sway moves a
    point in row v as a step on the target's side does, times the row's time. If E would rise, the result is the origin
    without sway.
    """
    readout = problem.objective.readout
    assert readout is not None, "only a rolling shutter shows a sway"
    known = (swaying.elapsed * swaying.velocity_change.deviation) ** -2.0
    prior = jnp.concatenate([jnp.repeat(jnp.array(UNSWAYED), 3) ** -2.0, 2.0 * known])  # on the sway and on the sum
    share = problem.objective.readings() / points
    factor = share**2 / (problem.objective.scales.grey**2 * DEPENDENT)

    def step_on(_: int, now: Iterate) -> Iterate:
        objective = problem.with_sway(now.x[6:]).objective
        late = (readout * row_time(now.residuals.warped.v, objective.plane)).reshape(-1)
        gradient, hessian = prior * now.x, jnp.diag(prior)
        gradient = gradient.at[6:].add(known * swaying.elapsed * swaying.velocity_change.summed)
        for jacobian, residual, weight in weighted_terms(objective, objective.reference, now.residuals):
            both = jnp.concatenate([jacobian, late * jacobian])
            gradient += factor * both @ (weight * residual)
            hessian += factor * (both * weight) @ both.T
        step = -jnp.linalg.solve(hessian, gradient)
        motion, x = exp(step[:6]) @ now.motion, now.x + step
        return Iterate(motion, x, problem.with_sway(x[6:]).objective.residuals(motion), hessian)

    start = Iterate(problem.origin, jnp.zeros(12), residuals, jnp.diag(prior))
    # a loop, as XLA takes a second longer to compile unrolled steps
    motion, x, r, hessian = jax.lax.fori_loop(0, ROUNDS, step_on, start)
    objective = problem.with_sway(x[6:]).objective
    error, _ = objective.error_of(r)
    before, _ = problem.objective.error_of(residuals)
    better = (error < before * (1.0 + LARGEST_RISE)) & jnp.all(jnp.isfinite(x)) & ~problem.is_out_of_reach(motion)
    to_reference = adjoint(rigid_inverse(motion))
    added = FRAMES * to_reference @ _from_sway(hessian) @ to_reference.T
    found = Swayed(motion, x[6:], jnp.where(jnp.all(jnp.isfinite(added)), added, 0.0), r)
    return jax.lax.cond(better, lambda: found, lambda: unswayed(problem.origin, residuals))


def _from_sway(hessian: Float[Array, "12 12"]) -> Float[Array, "6 6"]:
    """Contribution of the sway's uncertainty to the motion's covariance: marginal minus conditional covariance."""
    follows = jnp.linalg.solve(hessian[:6, :6], hessian[:6, 6:])
    return follows @ jnp.linalg.inv(hessian[6:, 6:] - hessian[6:, :6] @ follows) @ follows.T
