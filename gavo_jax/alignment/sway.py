"""The camera's velocity at a frame's own moment, as the rolling shutter shows it.

The motion between two frames tells the mean velocity since the last one. A hand trembles several times a second: when a
frame is taken the camera turns faster or slower than that, by up to half a radian a second, which stretches and shears
the image. A search that knows the mean alone explains the stretch by a step to the side that a turn makes up for, a
centimetre and more. So how far the frame's own velocity is from the mean, its sway, is an unknown beside the motion.
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
"""Standard deviation of a sway, over that of the mean velocity's changes from pair to pair. By the truth of the TUM
clips it is 0.5 to 0.9, whatever the rate (`benchmarks/acceleration.py`); single frames have much more."""
FORGETTING = 0.97
"""Factor from frame to frame on the sum of the sways, which is expected to be no larger than one of them: the mean
velocity follows them, so that they make up for each other. What does not is an error of the model (depth, lens), which
would add up to drift."""
FIRST_CHANGES, LEAST_CHANGES = (0.03, 0.3), (0.002, 0.01)
"""m/s and rad/s: changes of the mean velocity before any is known, and at least."""
REMEMBERED = 15.0
"""Pairs that tell how much it changes, about."""
UNSWAYED = (0.03, 0.03)
"""Metres and radians: standard deviations of a motion that was found with the mean velocity."""
DEPENDENT = 10.0
"""Points that tell as much as one: errors of neighbours are alike. Over the square of the share of the points that have
depth and are at rest: the less of the image these fill, the more alike are a turn and a step."""
FRAMES = 2.0
"""Factor on the covariance that comes from the target's sway: the reference's is known no better."""
ROUNDS = 2
"""Gauss-Newton steps; one falls short of half the way."""
LARGEST_RISE = 0.003
"""Share by which what refines a search's result may raise E: between pixels E is rough, by about that much, and the aim
is the middle of its basin. Beyond, the motion stays, without sway."""


class VelocityChange(NamedTuple):
    """How a run's velocity changes from frame to frame."""

    summed: Float[Array, " 6"]
    """Sum of the last frames' sways, m/s and rad/s."""
    changes: Float[Array, " 2"]
    """Mean square of the mean velocity's change from pair to pair, of one axis: (m/s)² and (rad/s)²."""

    @classmethod
    def unknown(cls) -> "VelocityChange":
        """Before the first pair."""
        still: Any = np.zeros(6, np.float32)
        changes: Any = np.square(np.asarray(FIRST_CHANGES, np.float32))
        return cls(still, changes)

    def after(self, sway: Float[Array, " 6"], change: Float[Array, " 6"]) -> "VelocityChange":
        """Add one more pair: its sway and its mean velocity's change, m/s and rad/s."""
        squares = jnp.mean(jnp.square(change.reshape(2, 3)), axis=1)
        return VelocityChange(FORGETTING * (self.summed + sway), self.changes + (squares - self.changes) / REMEMBERED)

    @property
    def deviation(self) -> Float[Array, " 6"]:
        """Standard deviation of a sway, m/s and rad/s."""
        least = jnp.square(jnp.array(LEAST_CHANGES))
        return jnp.repeat(SHARE * jnp.sqrt(jnp.maximum(self.changes, least)), 3)


class Swaying(NamedTuple):
    """What is known of the sway before a frame is looked at."""

    elapsed: Float[Array, ""]
    """Seconds since the last frame."""
    velocity_change: VelocityChange
    """How the run's velocity has changed so far."""


class Swayed(NamedTuple):
    """A motion with the target's sway."""

    motion: Float[Array, "4 4"]
    twist: Float[Array, " 6"]
    """Velocity of the points in the target camera at its moment less the mean since the last frame, as a twist: metres
    and radians over the time between the two."""
    covariance: Float[Array, "6 6"]
    """What not knowing the sway adds to that of δ in motion · exp(δ)."""
    residuals: Residuals


def unswayed(motion: Float[Array, "4 4"], residuals: Residuals) -> Swayed:
    """A motion without sway."""
    return Swayed(motion, jnp.zeros(6), jnp.zeros((6, 6)), residuals)


class Iterate(NamedTuple):
    """Where the refinement stands after some of its steps."""

    motion: Float[Array, "4 4"]
    x: Float[Array, " 12"]
    """Twists of the motion's change and of the sway."""
    residuals: Residuals
    hessian: Float[Array, "12 12"]


def refine_swaying(problem: Problem, residuals: Residuals, swaying: Swaying, points: Integer[Array, ""]) -> Swayed:
    """The motion and the sway about the problem's origin, of which these are the residuals, that explain the images
    best; the origin without sway where E would rise.

    Minimises Σ w r² / (σ² DEPENDENT) plus the squared deviations from what is known of both beforehand. A twist of the
    target's own moves a point in row v as a step on the target's side would, times the row's time.
    """
    readout = problem.objective.readout
    assert readout is not None, "only a rolling shutter shows a sway"
    known = (swaying.elapsed * swaying.velocity_change.deviation) ** -2.0
    prior = jnp.concatenate([jnp.repeat(jnp.array(UNSWAYED), 3) ** -2.0, 2.0 * known])  # of the sway, and of the sum
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
    # a loop, as steps written out one by one take XLA a second longer
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
    """Covariance of the motion that comes from the sway's: what is left of it where that is known is taken off."""
    follows = jnp.linalg.solve(hessian[:6, :6], hessian[:6, 6:])
    return follows @ jnp.linalg.inv(hessian[6:, 6:] - hessian[6:, :6] @ follows) @ follows.T
