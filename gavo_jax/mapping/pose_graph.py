"""Pose graph optimisation: least squares over the odometry's motions and the loops, robust to false loops.

The graph is GTSAM's. Graduated non-convexity (Yang, Antonante, Tzoumas and Carlone, RA-L 2020) starts with all loops
and ends with those that agree with each other and with the odometry. So neither a large drift nor a false loop decides
where it ends.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int

from gavo_jax.errors import GavoError
from gavo_jax.mapping.verification import Edge
from gavo_jax.rigid_motions import log, transport_covariance
from gavo_jax.trajectory import inverse

ROTATION_FIRST = [3, 4, 5, 0, 1, 2]
"""Indices of our twists in GTSAM's order: rotation first."""
PROBABILITY = 0.99
"""Probability that the residual of a correct loop stays below the limit from which a loop counts as false."""
REWEIGHTED = 2
"""Number of times that the odometry's weight is estimated anew and the graph optimised with it."""
SECOND_CHANCES = 4
"""Maximum number of times that the set of loops which fit is updated."""
IMPOSSIBLE = 1.0 - 1e-6
"""Probability that a correct loop's residual against the odometry alone stays below the limit from which it looks
false.
"""
MISTRUST = 4.0
"""Factor on the odometry's covariances while false loops are sought: odometry drifts to one side, which they don't
model.
"""
SCALES = (0.1, MISTRUST)
"""Smallest and largest factor on the odometry's covariances that loops can lead to."""
BELIEF = 20.0
"""Weight of the odometry's own covariances against the evidence of the loops, as a number of residuals."""
COUNTED = 0.5
"""Weight above which a loop counts as correct."""
MOST_ROWS, PROBES = 512, 128
"""Rows whose leverages are summed exactly, and number of random sums that are used for more rows."""
FIXED = 1e-6
"""Standard deviation of the prior that fixes the first keyframe, metres and radians."""


class Solution(NamedTuple):
    """An optimised graph."""

    world_T_camera: Float64[np.ndarray, "n 4 4"]
    weights: Float64[np.ndarray, " loops"]
    """Weight of each loop, from 1 (counted) to 0 (refused)."""
    residuals: Float64[np.ndarray, "loops 6"]
    """δ of each loop in earlier_T_later · exp(δ) = the motion by the poses, metres and radians."""
    scale: float
    """Factor on the odometry's covariances, as the loops ask for."""


def require_gtsam() -> Any:
    """Import GTSAM.

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
        poses: Initial world_T_camera; the first one stays.
        odometry: Motions between neighbours, which are always trusted.
        loops: Motions between other pairs, each of them correct or false.
        scale: Initial factor on the odometry's covariances.
        reweighted: Number of times that the scale is estimated anew.

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
    # the search for false loops may fail among many wild ones, and odometry may drift further than it says:
    # so try both starts, and take the one that more loops agree with
    plausible = _plausible(poses, odometry, loops)
    beginnings = [plausible] if plausible.all() else [plausible, np.ones(len(loops), bool)]
    found = []
    for beginning in beginnings:
        values, counted = start, np.zeros(len(loops), bool)
        if beginning.any():
            doubting = _graph(gtsam, poses[0], odometry, _chosen(loops, beginning), MISTRUST)
            values, weights = _without_false_loops(gtsam, doubting, start, trusted)
            counted[beginning] = weights > COUNTED
        found.append(_settled(gtsam, values, counted, poses[0], odometry, loops, scale))
    values, counted = max(found, key=lambda one: int(one[1].sum()))
    for _ in range(reweighted if counted.any() else 0):
        graph = _graph(gtsam, poses[0], odometry, _chosen(loops, counted), scale)
        scale = float(np.clip(scale * _surprise(graph, values, trusted), *SCALES))
        values, counted = _settled(gtsam, values, counted, poses[0], odometry, loops, scale)
    solved = np.stack([values.atPose3(number).matrix() for number in range(len(poses))])
    residuals = np.stack([_residual(gtsam, values, edge) for edge in loops])
    return Solution(solved, counted.astype(np.float64), residuals, scale)


def _chosen(loops: list[Edge], which: Bool[np.ndarray, " loops"]) -> list[Edge]:
    return [edge for edge, chosen in zip(loops, which, strict=True) if chosen]


def _settled(
    gtsam: Any,
    values: Any,
    counted: Bool[np.ndarray, " loops"],
    first: np.ndarray,
    odometry: list[Edge],
    loops: list[Edge],
    scale: float,
) -> tuple[Any, Bool[np.ndarray, " loops"]]:
    """The optimum with the loops that count; these are updated by whether they fit, until that changes nothing."""
    before = counted
    for _ in range(SECOND_CHANCES):
        graph = _graph(gtsam, first, odometry, _chosen(loops, counted), scale)
        values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        before, counted = counted, np.array([_fits(gtsam, values, edge) for edge in loops])
        if (counted == before).all():
            break
    return values, before


def _plausible(
    poses: Float64[np.ndarray, "n 4 4"], odometry: list[Edge], loops: list[Edge]
) -> Bool[np.ndarray, " loops"]:
    """Which loops are within the possible drift of the odometry."""
    chain, spread = [poses[0]], [np.zeros((6, 6))]
    for edge in odometry:
        chain.append(chain[-1] @ edge.earlier_T_later)
        spread.append(spread[-1] + transport_covariance(chain[-1], edge.covariance))
    result = []
    for edge in loops:
        said = inverse(chain[edge.earlier]) @ chain[edge.later]
        residual = log(inverse(edge.earlier_T_later) @ said)
        first, last = sorted((edge.earlier, edge.later))  # numbers may fall where a segment was found again
        drifted = transport_covariance(inverse(chain[edge.later]), spread[last] - spread[first])
        squared = residual @ np.linalg.solve(MISTRUST * drifted + edge.covariance, residual)
        result.append(squared < _chi_squared_below(IMPOSSIBLE))
    return np.array(result)


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
    """Variance factor of the odometry: its squared, whitened residuals over their redundancy (Förstner 1979).

    It is near 1 where the loops tell little of it.
    """
    from scipy.sparse import csc_array

    size = 6 * values.size()
    rows, columns, numbers = graph.linearize(values).sparseJacobian_()
    matrix = csc_array((numbers, (rows.astype(int) - 1, columns.astype(int) - 1)), shape=(6 * graph.size(), size + 1))
    jacobian, residual = matrix[:, :size], matrix[:, [size]].toarray()
    # all leverages sum to the number of unknowns: those of the few other rows give the odometry's
    own, others = np.arange(6, 6 * trusted), np.r_[0:6, 6 * trusted : 6 * graph.size()]
    redundancy = len(own) - (size - _leverage(jacobian, others))
    return float(((residual[own] ** 2).sum() + BELIEF) / (redundancy + BELIEF))


def _leverage(jacobian: Any, rows: Int[np.ndarray, " n"]) -> float:
    """Sum of some rows' leverages, the diagonal of J (JᵀJ)⁻¹ Jᵀ, for a sparse Jacobian J.

    For many rows it is estimated from their sums with random signs (Hutchinson 1989), to within a per cent: this bounds
    the work.
    """
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    factor, some = splu(csc_array(jacobian.T @ jacobian), permc_spec="MMD_AT_PLUS_A"), jacobian[rows].T
    if len(rows) <= MOST_ROWS:
        some = some.toarray()
        return float((some * factor.solve(some)).sum())
    summed = some @ np.random.default_rng(0).choice([-1.0, 1.0], (len(rows), PROBES))
    return float((summed * factor.solve(summed)).sum()) / PROBES


def _fits(gtsam: Any, values: Any, edge: Edge) -> bool:
    """Whether a loop's residual at the poses is within what its covariance allows."""
    residual = _residual(gtsam, values, edge)
    return bool(residual @ np.linalg.solve(edge.covariance, residual) < _chi_squared_below(PROBABILITY))


def _residual(gtsam: Any, values: Any, edge: Edge) -> np.ndarray:
    said = values.atPose3(edge.earlier).between(values.atPose3(edge.later))
    return gtsam.Pose3.Logmap(_pose(gtsam, edge.earlier_T_later).between(said))[ROTATION_FIRST]


def _pose(gtsam: Any, transform: np.ndarray) -> Any:
    return gtsam.Pose3(gtsam.Rot3(transform[:3, :3]), transform[:3, 3])


@cache
def _chi_squared_below(probability: float) -> float:
    """Value that chi-squared with six degrees of freedom stays below with a given probability."""
    from scipy.special import chdtri  # a sixth of the command's start, and most runs close no loops

    return float(chdtri(6, 1.0 - probability))
