"""The pose graph: right loops correct it, wrong ones don't, and the trajectory between keyframes follows."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csc_array
from scipy.stats import chi2

from gavo_jax.mapping.correction import Doubts, _placed, bridged, correct, joined, loop_figures
from gavo_jax.mapping.keyframes import Keyframe, Thumbnail
from gavo_jax.mapping.mapper import Loops
from gavo_jax.mapping.pose_graph import Solution, _chi_squared_below, _leverage, _plausible, optimise
from gavo_jax.mapping.verification import Edge
from gavo_jax.rigid_motions import exp, interpolate
from gavo_jax.trajectory import Trajectory, inverse

pytest.importorskip("gtsam")
RNG = np.random.default_rng(3)
SIGMA = 0.003
COUNT = 40


def circle() -> np.ndarray:
    """Twice round a circle, looking ahead."""
    step = exp(np.array([0.0, 0.0, 0.1, 0.0, 4 * np.pi / COUNT, 0.0]))
    poses = [np.eye(4)]
    for _ in range(COUNT - 1):
        poses.append(poses[-1] @ step)
    return np.stack(poses)


TRUTH = circle()


def edge(a: int, b: int, sigma: float, motion: np.ndarray | None = None) -> Edge:
    motion = inverse(TRUTH[a]) @ TRUTH[b] if motion is None else motion
    return Edge(a, b, motion @ exp(sigma * RNG.normal(size=6)), sigma**2 * np.eye(6))


ODOMETRY = [edge(i, i + 1, SIGMA) for i in range(COUNT - 1)]
LOOPS = [edge(i, i + COUNT // 2, 0.001) for i in range(0, COUNT // 2, 3)]
FALSE = [edge(int(a), int(b), 0.001, exp(0.3 * RNG.normal(size=6))) for a, b in ((1, 30), (4, 22), (5, 38), (0, 17))]


def dead_reckoned() -> np.ndarray:
    poses = [np.eye(4)]
    for motion in ODOMETRY:
        poses.append(poses[-1] @ motion.earlier_T_later)
    return np.stack(poses)


def error(poses: np.ndarray) -> float:
    return float(np.linalg.norm(poses[:, :3, 3] - TRUTH[:, :3, 3], axis=1).mean())


def test_loops_take_most_of_the_drift_away():
    start = dead_reckoned()
    solution = optimise(start, ODOMETRY, LOOPS)
    assert error(solution.world_T_camera) < 0.7 * error(start)
    assert (solution.weights > 0.5).all()
    assert np.abs(solution.residuals).max() < 0.01
    np.testing.assert_allclose(solution.world_T_camera[0], np.eye(4), atol=1e-5)


def test_planted_false_loops_change_nothing():
    start = dead_reckoned()
    clean, spoilt = optimise(start, ODOMETRY, LOOPS), optimise(start, ODOMETRY, LOOPS + FALSE)
    assert (spoilt.weights[len(LOOPS) :] < 0.5).all()
    np.testing.assert_allclose(spoilt.world_T_camera, clean.world_T_camera, atol=2e-3)


def test_false_loops_alone_leave_the_odometry_as_it_was():
    start = dead_reckoned()
    np.testing.assert_allclose(optimise(start, ODOMETRY, FALSE).world_T_camera, start, atol=1e-6)
    np.testing.assert_array_equal(optimise(start, ODOMETRY, []).world_T_camera, start)


def test_a_loop_is_as_plausible_from_either_end():
    """A segment that was found again ties keyframes to later ones: their odometry's variance was negative."""
    off = np.eye(4)
    off[0, 3] = 0.5
    chain = [Edge(i, i + 1, np.eye(4), 1e-4 * np.eye(6)) for i in range(9)]
    loops = [Edge(a, b, by, 1e-6 * np.eye(6)) for a, b, by in ((6, 9, off), (9, 6, inverse(off)), (9, 6, np.eye(4)))]
    assert _plausible(np.stack([np.eye(4)] * 10), chain, loops).tolist() == [False, False, True]


def test_right_loops_are_plausible_and_false_ones_are_not():
    """Along a path that turns: catches motions that are chained or compared in the wrong order."""
    start = dead_reckoned()
    assert _plausible(start, ODOMETRY, LOOPS).all() and not _plausible(start, ODOMETRY, FALSE).any()
    far = exp(np.array([5.0, -3.0, 2.0, 0.4, -1.0, 0.8]))
    assert _plausible(far @ start, ODOMETRY, LOOPS).all(), "wherever the first pose is"


def test_a_loop_may_be_off_by_the_drift_between_its_ends_and_by_its_own_error():
    """Catches the drift since the start instead; and an error of the loop that counts against it."""

    def off(metres: float) -> np.ndarray:
        return exp(np.array([metres, 0.0, 0.0, 0.0, 0.0, 0.0]))

    chain = [Edge(i, i + 1, np.eye(4), 1e-4 * np.eye(6)) for i in range(9)]
    loops = [
        Edge(8, 9, off(0.1), 1e-6 * np.eye(6)),
        Edge(8, 9, off(0.15), 1e-6 * np.eye(6)),
        Edge(6, 9, off(0.2), 6e-4 * np.eye(6)),
        Edge(6, 9, off(0.3), 6e-4 * np.eye(6)),
    ]
    assert _plausible(np.stack([np.eye(4)] * 10), chain, loops).tolist() == [True, False, True, False]


@pytest.mark.parametrize("probability", [0.99, 1.0 - 1e-6])
def test_limits_are_those_of_six_numbers(probability: float) -> None:
    assert _chi_squared_below(probability) == pytest.approx(chi2(6).ppf(probability), rel=1e-6)


@pytest.mark.parametrize(("said", "least", "most"), [(0.5, 2.0, 4.0), (1.0, 0.6, 1.5), (3.0, 0.1, 0.4)])
def test_loops_tell_how_far_off_the_odometrys_covariances_are(said: float, least: float, most: float) -> None:
    """The factor is in metrics.json, and decides how much a loop moves the poses."""
    odometry = [motion._replace(covariance=said**2 * motion.covariance) for motion in ODOMETRY]
    ends = ((i, i + COUNT // 2) for i in range(COUNT // 2))
    loops = [Edge(a, b, inverse(TRUTH[a]) @ TRUTH[b], 0.0005**2 * np.eye(6)) for a, b in ends]
    solution = optimise(dead_reckoned(), odometry, loops)
    assert least < solution.scale <= most and solution.weights.mean() > 0.9
    assert optimise(dead_reckoned(), odometry, loops, scale=0.7, reweighted=0).scale == 0.7


def keyframe(number: int, timestamp: float, odometry: np.ndarray, corrected: np.ndarray, segment: int = 0) -> Keyframe:
    thumbnail = Thumbnail(np.zeros((3, 4), np.float32), np.zeros((3, 0)), np.zeros(0, np.float32))
    return Keyframe(number, number, timestamp, segment, odometry, corrected, None, None, thumbnail)


def solved(keyframes: list[Keyframe], edges: list[Edge]) -> Loops:
    nothing = np.zeros((len(edges), 6))
    return Loops(keyframes, edges, Solution(np.zeros((0, 4, 4)), np.ones(len(edges)), nothing, 1.0))


def test_corrections_change_over_between_keyframes():
    poses = np.stack([exp(np.array([0.1 * i, 0, 0, 0, 0, 0])) for i in range(5)])
    raised = exp(np.array([0.0, 0.04, 0.0, 0.0, 0.0, 0.0])) @ poses[4]
    loops = solved([keyframe(0, 0.0, poses[0], poses[0]), keyframe(1, 4.0, poses[4], raised)], [])
    corrected = correct(Trajectory(np.arange(5.0), poses), loops)
    np.testing.assert_allclose(corrected.world_T_camera[:, 1, 3], [0.0, 0.01, 0.02, 0.03, 0.04], atol=1e-9)
    np.testing.assert_allclose(corrected.world_T_camera[:, 0, 3], poses[:, 0, 3], atol=1e-9)


def test_corrections_change_over_between_later_keyframes_too():
    """Catches a share of the way that is counted from the first pose instead of the keyframe before."""
    poses = np.stack([exp(np.array([0.1 * i, 0, 0, 0, 0, 0])) for i in range(9)])
    frames = []
    for number, (place, up) in enumerate(((1, 0.0), (3, 0.02), (7, 0.06))):
        raised = exp(np.array([0.0, up, 0.0, 0.0, 0.0, 0.0])) @ poses[place]
        frames.append(keyframe(number, 0.5 * place, poses[place], raised))
    corrected = correct(Trajectory(0.5 * np.arange(9), poses), solved(frames, []))
    heights = [0.0, 0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.06]
    np.testing.assert_allclose(corrected.world_T_camera[:, 1, 3], heights, atol=1e-9)


def test_keyframes_are_corrected_to_where_the_map_has_them():
    """With turns: catches corrections that are taken or applied on the wrong side."""
    rng = np.random.default_rng(5)
    poses = np.stack([exp(0.5 * rng.normal(size=6)) for _ in range(7)])
    places, moved = (1, 3, 5), [exp(0.3 * rng.normal(size=6)) for _ in range(3)]
    frames = [keyframe(k, float(i), poses[i], moved[k] @ poses[i]) for k, i in enumerate(places)]
    odometry = Trajectory(np.arange(7.0), poses)
    corrected = correct(odometry, solved(frames, [])).world_T_camera
    np.testing.assert_allclose(corrected[list(places)], [frame.world_T_camera for frame in frames], atol=1e-9)
    np.testing.assert_allclose(corrected[[0, 6]], [moved[0] @ poses[0], moved[2] @ poses[6]], atol=1e-9)
    halfway = [interpolate(moved[k] @ poses[i], moved[k + 1] @ poses[i], 0.5) for k, i in ((0, 2), (1, 4))]
    np.testing.assert_allclose(corrected[[2, 4]], halfway, atol=1e-9)
    assert correct(odometry, solved([], [])) is odometry


def test_lost_poses_are_on_the_way_between_the_known_ones_around_them():
    """By their stamps, far from the first pose; not between two segments, and not where there is only one side."""
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, 0, 3] = [0.0, 1.0, 2.0, 9.0, 9.0, 5.0, 6.0, 9.0, 8.0]
    lost = np.array([False, False, False, True, True, False, False, True, False])
    stamps, segments = np.array([0.0, 1, 2, 2.5, 4, 5, 6, 7, 8]), np.array([0] * 7 + [1] * 2)
    found = bridged(Trajectory(stamps, poses, segments), lost)
    np.testing.assert_allclose(found.world_T_camera[:, 0, 3], [0, 1, 2, 2.5, 4, 5, 6, 9, 8], atol=1e-9)


def test_figures_of_the_map_count_what_was_refused():
    loops = solved([keyframe(i, float(i), np.eye(4), np.eye(4)) for i in range(4)], LOOPS[:3])
    loops = loops._replace(solution=loops.solution._replace(weights=np.array([1.0, 0.0, 1.0]), scale=1.7))
    figures = {"keyframes": 4, "loops": 2, "loops_refused": 1, "odometry_covariance_scale": 1.7}
    assert loop_figures(loops) == figures


def test_two_keyframes_of_one_stamp_have_a_place_each() -> None:
    poses = np.tile(np.eye(4), (4, 1, 1))
    twice = [keyframe(0, 1.0, poses[1], poses[1]), keyframe(1, 1.0, poses[2], poses[2])]
    placed = _placed(twice, Trajectory(np.array([0.0, 1.0, 1.0, 2.0]), poses))
    assert [place for _, place in placed] == [1, 2]


def test_a_map_that_is_ahead_of_an_interrupted_run_corrects_what_there_is() -> None:
    """The last pose was not-a-number: its keyframe is the last one in the trajectory, and the next one has no pose."""
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.arange(5.0)
    raised = np.eye(4)
    raised[1, 3] = 0.5
    loops = solved([keyframe(i, float(k), poses[k], raised @ poses[k]) for i, k in enumerate((0, 2, 3))], [])
    corrected = correct(Trajectory(np.arange(3.0), poses[:3]), loops)
    np.testing.assert_allclose(corrected.world_T_camera, raised @ poses[:3], atol=1e-9)


def test_guesses_are_put_on_the_way_between_what_is_known():
    poses = np.stack([np.eye(4)] * 5)
    poses[4, 0, 3] = 0.4
    loops = solved([keyframe(0, 0.0, poses[0], poses[0]), keyframe(1, 4.0, poses[4], poses[4])], [])
    lost = np.array([False, True, True, True, False])
    corrected = correct(Trajectory(np.arange(5.0), poses), loops, Doubts(lost, lost))
    np.testing.assert_allclose(corrected.world_T_camera[:, 0, 3], [0.0, 0.1, 0.2, 0.3, 0.4], atol=1e-9)


def test_a_motion_gone_on_with_stays_as_it_is_but_takes_the_correction():
    """Behind a body the path bends as the camera moved: it was cut straight from one known place to the next."""
    poses = np.stack([exp(np.array([0.1 * i, 0, 0, 0, 0.2 * (i == 2), 0])) for i in range(5)])
    frames = [keyframe(0, 0.0, poses[0], poses[0]), keyframe(1, 4.0, poses[4], poses[4])]
    doubts = Doubts(np.array([False, False, True, False, False]), np.zeros(5, bool))
    odometry = Trajectory(np.arange(5.0), poses)
    np.testing.assert_allclose(correct(odometry, solved(frames, []), doubts).world_T_camera, poses, atol=1e-9)
    raised = exp(np.array([0.0, 0.04, 0.0, 0.0, 0.0, 0.0])) @ poses[4]
    corrected = correct(odometry, solved([frames[0], keyframe(1, 4.0, poses[4], raised)], []), doubts)
    np.testing.assert_allclose(corrected.world_T_camera[:, 1, 3], [0.0, 0.0, 0.04, 0.04, 0.04], atol=2e-3)


def test_a_clock_that_was_set_back_does_not_matter():
    """Keyframes were sought by their stamps, as if these grew: poses became not-a-number."""
    poses = np.stack([exp(np.array([0.1 * i, 0, 0, 0, 0, 0])) for i in range(9)])
    raised = exp(np.array([0.0, 0.04, 0.0, 0.0, 0.0, 0.0])) @ poses[8]
    lost = np.array([False] * 5 + [True] + [False] * 3)
    corrected = []
    for back, after in ((0.0, 3), (1000.0, 3), (1000.0, 6)):
        stamps = 0.5 * np.arange(9) - back * (np.arange(9) > after)
        frames = [keyframe(k, stamps[i], poses[i], poses[i]) for k, i in enumerate((0, 4))]
        loops = solved([*frames, keyframe(2, stamps[8], poses[8], raised)], [])
        corrected.append(correct(Trajectory(stamps, poses), loops, Doubts(lost, lost)).world_T_camera)
    np.testing.assert_allclose(corrected[1], corrected[0], atol=1e-9)
    np.testing.assert_allclose(corrected[2], corrected[0], atol=1e-9)


def test_stamps_that_come_again_are_those_of_another_segment() -> None:
    """A recording that is played twice: the second pass corrected the first one."""
    poses = np.tile(np.eye(4), (9, 1, 1))
    raised = np.eye(4)
    raised[1, 3] = 0.04
    stamps, segments = np.r_[np.arange(4.0), np.arange(5.0)], np.r_[np.zeros(4, int), np.ones(5, int)]
    frames = [keyframe(0, 0.0, poses[0], poses[0]), replace(keyframe(1, 1.0, poses[5], raised), segment=1)]
    corrected = correct(Trajectory(stamps, poses, segments), solved(frames, []))
    np.testing.assert_allclose(corrected.world_T_camera[:, 1, 3], [0.0] * 4 + [0.04] * 5, atol=1e-9)


def test_a_loop_joins_segments():
    frames = [keyframe(i, float(i), np.eye(4), np.eye(4), segment=i) for i in range(3)]
    loops = solved(frames, [edge(0, 2, 0.001)])
    np.testing.assert_array_equal(joined(np.array([0, 0, 1, 1, 2]), loops), [0, 0, 1, 1, 0])


@pytest.mark.parametrize(("count", "within"), [(40, 1e-9), (120, 0.02)])
def test_leverages_are_those_of_the_dense_jacobian(count, within):
    jacobian = np.random.default_rng(1).normal(size=(6 * count, 60)) * np.geomspace(1.0, 100.0, 60)
    rows = np.arange(6, 6 * count)
    dense = np.einsum("ij,jk,ik->i", jacobian, np.linalg.inv(jacobian.T @ jacobian), jacobian)
    np.testing.assert_allclose(_leverage(csc_array(jacobian), rows), dense[rows].sum(), rtol=within)
