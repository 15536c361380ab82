"""Where all keyframes stand: least squares over the odometry's motions and the loops, deaf to loops that are wrong.

The graph is GTSAM's. Graduated non-convexity (Yang, Antonante, Tzoumas and Carlone, RA-L 2020) starts with all
loops and ends with those that agree with each other and with the odometry, so that neither a large drift nor a false
loop decides where it ends.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from gavo_jax.errors import GavoError
from gavo_jax.mapping.verification import Edge

ROTATION_FIRST = [3, 4, 5, 0, 1, 2]
"""GTSAM's order of a twist."""
PROBABILITY = 0.99
"""That the residual of a right loop stays below what makes a loop count as wrong."""
REWEIGHTED = 2
"""Times that the odometry's weight is told anew and the graph optimised with it."""
MISTRUST = 4.0
"""On the odometry's covariances while false loops are sought: it drifts to one side, which they don't say."""
SCALES = (0.1, MISTRUST)
"""Smallest and largest factor on the odometry's covariances that the loops may tell,"""
BELIEF = 20.0
"""and how many residuals' worth its covariances are believed beforehand."""
COUNTED = 0.5
"""Weight from which on a loop counts as right."""
FIXED = 1e-6
"""Metres and radians within which the first keyframe stays."""


class Solution(NamedTuple):
    """An optimised graph."""

    world_T_camera: Float64[np.ndarray, "n 4 4"]
    weights: Float64[np.ndarray, " loops"]
    """Of each loop, 1 counted, 0 refused."""
    residuals: Float64[np.ndarray, "loops 6"]
    """δ of each loop in earlier_T_later · exp(δ) = what the poses say, metres and radians."""
    scale: float
    """Of the odometry's covariances, as the loops tell."""


def require_gtsam() -> Any:
    """GTSAM.

    Raises:
        GavoError: it is not installed.
    """
    try:
        import gtsam
    except ImportError:
        raise GavoError("loops need GTSAM: pip install 'gavo-jax[loops]'") from None
    return gtsam


def optimise(
    poses: Float64[np.ndarray, "n 4 4"],
    odometry: list[Edge],
    loops: list[Edge],
    scale: float = 1.0,
    reweighted: int = REWEIGHTED,
) -> Solution:
    """Optimise a pose graph.

    Args:
        poses: world_T_camera to start from; the first one stays.
        odometry: Motions between neighbours, which count whatever they say.
        loops: Motions between others, each right or wrong.
        scale: Of the odometry's covariances, to start from.
        reweighted: Times that the scale is told anew.

    Raises:
        GavoError: GTSAM is not installed.
    """
    gtsam = require_gtsam()
    if not loops:
        return Solution(np.array(poses), np.ones(0), np.zeros((0, 6)), scale)
    start = gtsam.Values()
    for number, pose in enumerate(poses):
        start.insert(number, _pose(gtsam, pose))
    trusted = len(odometry) + 1
    doubting = _graph(gtsam, poses[0], odometry, loops, MISTRUST)
    values, weights = _without_false_loops(gtsam, doubting, start, trusted)
    kept = [edge for edge, weight in zip(loops, weights, strict=True) if weight > COUNTED]
    for attempt in range(reweighted + 1):
        # what the search for false loops ends with may still lean to those that it gave up last
        graph = _graph(gtsam, poses[0], odometry, kept, scale)
        values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        if kept and attempt < reweighted:
            scale = float(np.clip(scale * _surprise(graph, values, trusted), *SCALES))
    solved = np.stack([values.atPose3(number).matrix() for number in range(len(poses))])
    residuals = np.stack([_residual(gtsam, values, edge) for edge in loops])
    return Solution(solved, weights, residuals, scale)


def _graph(gtsam: Any, first: np.ndarray, odometry: list[Edge], loops: list[Edge], scale: float) -> Any:
    graph = gtsam.NonlinearFactorGraph()
    fixed = gtsam.noiseModel.Isotropic.Sigma(6, FIXED)
    graph.add(gtsam.PriorFactorPose3(0, _pose(gtsam, first), fixed))
    for edges, factor in ((odometry, scale), (loops, 1.0)):
        for edge in edges:
            covariance = factor * edge.covariance[np.ix_(ROTATION_FIRST, ROTATION_FIRST)]
            noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
            motion = _pose(gtsam, edge.earlier_T_later)
            graph.add(gtsam.BetweenFactorPose3(edge.earlier, edge.later, motion, noise))
    return graph


def _without_false_loops(gtsam: Any, graph: Any, start: Any, trusted: int) -> tuple[Any, np.ndarray]:
    """The optimum, and the weight of each factor after the trusted ones."""
    params = gtsam.GncLMParams()
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers(list(range(trusted)))
    optimizer = gtsam.GncLMOptimizer(graph, start, params)
    optimizer.setInlierCostThresholdsAtProbability(PROBABILITY)
    values = optimizer.optimize()
    return values, np.asarray(optimizer.getWeights())[trusted:]


def _surprise(graph: Any, values: Any, trusted: int) -> float:
    """Variance of the odometry's residuals over what their covariances say, by their redundancy (Förstner 1979); near 1
    where the loops say little of it.
    """
    jacobian, residual = graph.linearize(values).jacobian()
    rows = slice(6, 6 * trusted)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    own = jacobian[rows]
    redundancy = own.shape[0] - np.einsum("ij,jk,ik->", own, covariance, own, optimize=True)
    return float(((residual[rows] ** 2).sum() + BELIEF) / (redundancy + BELIEF))


def _residual(gtsam: Any, values: Any, edge: Edge) -> np.ndarray:
    said = values.atPose3(edge.earlier).between(values.atPose3(edge.later))
    return gtsam.Pose3.Logmap(_pose(gtsam, edge.earlier_T_later).between(said))[ROTATION_FIRST]


def _pose(gtsam: Any, transform: np.ndarray) -> Any:
    return gtsam.Pose3(gtsam.Rot3(transform[:3, :3]), transform[:3, 3])
