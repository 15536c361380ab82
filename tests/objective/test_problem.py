"""What a solver is handed: coordinates, and errors of populations."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from observed import CAMERA, build, jit_error, random_pair, smooth_image, smooth_pair, staircase

from gavo_jax.objective.points import Reference
from gavo_jax.objective.preconditioning import preconditioner, reference_curvature
from gavo_jax.objective.problem import Problem
from gavo_jax.solvers.base import Bounds, solve
from gavo_jax.solvers.genetic import GeneticAlgorithm
from gavo_jax.solvers.particle_swarm import ParticleSwarm


def test_transform_goes_from_the_origin_along_the_basis() -> None:
    rng = np.random.default_rng(0)
    origin = oracle.expm(rng.normal(0, 0.3, 6)).astype(np.float32)
    basis = rng.normal(0, 0.1, (6, 6)).astype(np.float32)
    problem = Problem(build(random_pair(0)), jnp.asarray(origin), jnp.asarray(basis))
    x = rng.normal(0, 1, 6).astype(np.float32)
    motion = problem.transform(jnp.asarray(x))
    np.testing.assert_allclose(motion, origin @ oracle.expm(basis @ x), atol=1e-5)
    np.testing.assert_allclose(problem.transform(jnp.stack([jnp.asarray(x)] * 2))[1], motion, atol=1e-6)


@pytest.mark.parametrize("reach", [1e-3, 0.2, 0.8, 1.7, 4.0])
def test_a_search_is_held_within_its_angle(reach: float) -> None:
    """The angle came from the trace of all four rows: 0.2 rad let motions of 1.07 rad through."""
    centre = jnp.asarray(oracle.expm(np.array([0.1, 0.2, 0.3, 0.1, -0.2, 0.3])), jnp.float32)
    problem = Problem(build(random_pair(0)), jnp.eye(4), jnp.eye(6), centre=centre, reach=jnp.array([1.0, reach]))
    for angle in (0.97 * min(reach, 3.1), 1.03 * reach):
        offset = oracle.expm(np.array([0.0, 0.0, 0.0, 0.6 * angle, 0.8 * angle, 0.0]))
        is_out = bool(problem.is_out_of_reach(centre @ jnp.asarray(offset, jnp.float32)))
        assert is_out == (reach < angle < np.pi)


@pytest.mark.parametrize(
    "solver",
    [
        GeneticAlgorithm(population=(32,), iterations=(20,), spread=(4.0,), mutation_step=(3.0,)),
        ParticleSwarm(population=(32,), iterations=(30,), spread=(4.0,)),
    ],
    ids=["ga", "pso"],
)
def test_a_population_needs_no_derivative(solver: GeneticAlgorithm | ParticleSwarm) -> None:
    exact = oracle.expm(np.array([0.02, -0.015, 0.01, 0.01, -0.008, 0.012]))
    pair = smooth_pair()
    # the target is what the exact motion makes of the reference: each of its pixels looks its own grey up
    u, v = warped_back(exact)
    pair = pair._replace(target_grey=np.clip(smooth_image(u, v), 0, 255))
    objective = build(pair, staircase, (4.0, 0.01, 0.0))
    problem = Problem(objective, jnp.eye(4), preconditioner(reference_curvature(objective)))
    bounds = Bounds(jnp.full(6, -40.0), jnp.full(6, 40.0))
    solution = jax.jit(solve)(jax.random.key(0), solver.at_level(0), problem, jnp.zeros((1, 6)), bounds)
    still, there = jit_error(objective, jnp.eye(4))[0], jit_error(objective, exact.astype(np.float32))[0]
    assert there < 0.5 * still
    assert float(solution.error) < 1.3 * there


def warped_back(target_T_reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where each target pixel lies in the reference image, for the plane of `smooth_pair`."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], -1)
    # inverse depth 0.6 + 0.002 u - 0.003 v of the reference is the plane normal . P = 1
    a, b = 0.002 * CAMERA.fx, -0.003 * CAMERA.fy
    normal = np.array([a, b, 0.6 + 0.002 * CAMERA.cx - 0.003 * CAMERA.cy])
    reference_T_target = np.linalg.inv(target_T_reference)
    directions = rays @ reference_T_target[:3, :3].T
    start = reference_T_target[:3, 3]
    points = start + directions * ((1 - start @ normal) / (directions @ normal))[..., None]
    pixels = np.asarray(CAMERA.project(points))
    return pixels[..., 0], pixels[..., 1]


def test_objective_is_a_value() -> None:
    objective = build(random_pair(0), partial(jnp.minimum, 4.0))
    leaves, structure = jax.tree.flatten(objective)
    assert all(isinstance(leaf, jax.Array | float | int) for leaf in leaves)
    again = jax.tree.unflatten(structure, leaves)
    assert isinstance(again.reference, Reference) and again.loss is objective.loss
