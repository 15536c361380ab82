"""Errors against TUM's definitions, written out literally, and against evo."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.tools import file_interface
from paths import CLIPS, perturbed, real_pair, smooth_truth, transform
from scipy.spatial.transform import Rotation

from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.evaluation import (
    ErrorSeries,
    absolute_trajectory_error,
    distance_error,
    relative_pose_error,
    rotation_angle,
)
from gavo_jax.trajectory import Trajectory, inverse


def bisect_nearest(stamps: list, wanted: float) -> int:
    low, high, best = 0, len(stamps), 0
    while low < high:
        middle = (low + high) // 2
        if abs(stamps[middle] - wanted) < abs(stamps[best] - wanted):
            best = middle
        if stamps[middle] == wanted:
            return middle
        if stamps[middle] > wanted:
            high = middle
        else:
            low = middle + 1
    return best


def tum_tool(estimate: Trajectory, truth: Trajectory, delta: float) -> tuple[np.ndarray, np.ndarray]:
    """`evaluate_rpe.py --fixed_delta --delta_unit s`, pair by pair: translations (m) and angles (deg)."""
    est, true = list(estimate.timestamps), list(truth.timestamps)
    limit = 2 * np.median([b - a for a, b in zip(true[:-1], true[1:], strict=True)])
    translations, angles = [], []
    for i in range(len(est)):
        j = bisect_nearest(est, est[i] + delta)
        if j == len(est) - 1:
            continue
        m, n = bisect_nearest(true, est[i]), bisect_nearest(true, est[j])
        if abs(true[m] - est[i]) > limit or abs(true[n] - est[j]) > limit:
            continue
        moved = np.linalg.inv(estimate.world_T_camera[j]) @ estimate.world_T_camera[i]
        truly = np.linalg.inv(truth.world_T_camera[n]) @ truth.world_T_camera[m]
        error = np.linalg.inv(moved) @ truly
        translations.append(np.linalg.norm(error[:3, 3]))
        angles.append(np.degrees(np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1))))
    return np.array(translations), np.array(angles)


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.asarray(values) ** 2)))


@pytest.mark.parametrize("clip", CLIPS)
@pytest.mark.parametrize("delta", [1.0, 0.5])
def test_drift_equals_tums_tool_on_real_truth(data_dir, clip, delta):
    estimate, truth = real_pair(data_dir / clip)
    translations, angles = tum_tool(estimate, truth, delta)
    error = relative_pose_error(estimate, truth, delta, "s")
    np.testing.assert_allclose(error.translation.values, translations, atol=1e-12)
    np.testing.assert_allclose(error.rotation.values, angles, atol=1e-5)
    assert error.translation.rmse == pytest.approx(rms(translations), abs=1e-12)
    assert error.translation.rmse > 0.005


@pytest.mark.parametrize("rate", [100.0, 30.0])
def test_drift_equals_tums_tool_with_gaps_and_ties(rate):
    truth = smooth_truth(rate=rate)
    keep = (truth.timestamps < 1001.5) | (truth.timestamps > 1001.9)
    truth = Trajectory(np.round(truth.timestamps[keep], 2), truth.world_T_camera[keep])
    just_after = truth.timestamps[truth.timestamps < 1001.6][-1] + 1.5 / rate
    estimate = perturbed(truth, np.arange(1000.125, 1001.4, 0.0625), 3)
    late = perturbed(truth, np.arange(1002.0, 1003.8, 0.0625), 4)
    estimate = Trajectory(
        np.concatenate([estimate.timestamps, [just_after, 1001.7], late.timestamps]),
        np.concatenate([estimate.world_T_camera, np.tile(np.eye(4), (2, 1, 1)), late.world_T_camera]),
    )
    translations, angles = tum_tool(estimate, truth, 1.0)
    error = relative_pose_error(estimate, truth)
    np.testing.assert_allclose(error.translation.values, translations, atol=1e-12)
    np.testing.assert_allclose(error.rotation.values, angles, atol=1e-5)


@pytest.mark.parametrize("rate", [1.0, 3.0, 10.0])
def test_sparse_truth_is_compared_only_where_it_is(rate):
    """The nearest true pose was half a second away, and most of the drift was the way there."""
    dense = smooth_truth(rate=120.0)
    error = relative_pose_error(dense[::4], dense[:: round(120 / rate)])
    assert error.translation.rmse < 1e-9 and error.translation.values.size >= 2
    with pytest.raises(GavoError, match=r"no poses 1 s apart that the ground truth covers"):
        relative_pose_error(dense[6::12], dense[::120])


@pytest.mark.parametrize("start", [0.0, 1000.0, 1e6])
def test_the_clock_does_not_decide_whether_a_truth_is_sparse(start):
    """One of 25 Hz lay on the limit, to which its stamps' rounding added: other pairs, and another drift."""
    truth = smooth_truth(rate=25.0)
    moved = Trajectory(truth.timestamps - truth.timestamps[0] + start, truth.world_T_camera)
    without = np.arange(len(truth)) != 40
    found = relative_pose_error(moved, moved[without]).translation
    assert found.values.size == relative_pose_error(truth, truth[without]).translation.values.size
    assert found.rmse > 0, "within two intervals, as by TUM's script"


@pytest.mark.parametrize("apart", [2.1, 2.5, 30.0])
def test_poses_that_lie_far_apart_have_no_drift_a_second(apart):
    """The pose nearest to one second later was the same one: the drift was 0."""
    truth = smooth_truth(seconds=100)
    estimate = perturbed(truth, np.arange(1000.2, 1090.0, apart), 3, degree=10)
    with pytest.raises(GavoError, match=f"no two poses about 1 s apart: those of the estimate are {apart:g} s"):
        relative_pose_error(estimate, truth)
    joined = np.concatenate([estimate.timestamps, estimate.timestamps[-1] + 0.1 * np.arange(1, 30)])
    some = relative_pose_error(perturbed(truth, joined, 3, degree=10), truth).translation
    assert np.all(some.values > 0) and some.timestamps[0] >= estimate.timestamps[-1]


def evo_pair(tmp_path, estimate, truth):
    estimate.write_tum(tmp_path / "estimate.txt")
    truth.write_tum(tmp_path / "truth.txt")
    reference = file_interface.read_tum_trajectory_file(str(tmp_path / "truth.txt"))
    theirs = file_interface.read_tum_trajectory_file(str(tmp_path / "estimate.txt"))
    return sync.associate_trajectories(reference, theirs, max_diff=0.02)


@pytest.mark.parametrize("clip", CLIPS)
@pytest.mark.parametrize("delta", [1, 7])
def test_relative_error_per_frame_equals_evo(data_dir, tmp_path, clip, delta):
    estimate, truth = real_pair(data_dir / clip, seed=1)
    error = relative_pose_error(estimate, truth, delta, "frames")
    for series, relation in (
        (error.translation, metrics.PoseRelation.translation_part),
        (error.rotation, metrics.PoseRelation.rotation_angle_deg),
    ):
        rpe = metrics.RPE(relation, delta=delta, delta_unit=metrics.Unit.frames, all_pairs=True)
        rpe.process_data(evo_pair(tmp_path, estimate, truth))
        np.testing.assert_allclose(series.values, rpe.error, atol=1e-6)
        assert series.rmse == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), abs=1e-6)
        assert series.median == pytest.approx(rpe.get_statistic(metrics.StatisticsType.median), abs=1e-6)


@pytest.mark.parametrize("clip", CLIPS)
def test_absolute_error_equals_evo(data_dir, tmp_path, clip):
    estimate, truth = real_pair(data_dir / clip, seed=2)
    reference, theirs = evo_pair(tmp_path, estimate, truth)
    aligned = copy.deepcopy(theirs)
    aligned.align(reference, correct_scale=False)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, aligned))
    error = absolute_trajectory_error(estimate, truth)
    np.testing.assert_allclose(error.values, ape.error, atol=1e-6)
    assert error.rmse == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), abs=1e-6)


def test_a_perfect_estimate_in_another_world_has_no_error():
    """Catches poses the wrong way round: the inverse trajectory is not without error."""
    truth = smooth_truth()
    other_T_world = transform([0.3, -1.0, 2.0], [4, 5, 6])
    moved = Trajectory(truth.timestamps, other_T_world @ truth.world_T_camera)
    for unit in ("s", "frames"):
        error = relative_pose_error(moved, truth, 1, unit)
        assert error.translation.max < 1e-12 and error.rotation.max < 1e-6
    assert absolute_trajectory_error(moved, truth).max < 1e-12
    assert distance_error(moved, truth).max < 1e-12
    backwards = Trajectory(truth.timestamps, inverse(truth.world_T_camera))
    assert relative_pose_error(backwards, truth).translation.rmse > 0.05
    assert absolute_trajectory_error(backwards, truth).rmse > 0.05
    assert distance_error(backwards, truth).rmse > 0.05


def test_absolute_error_never_mirrors():
    truth = smooth_truth()
    mirrored = truth.world_T_camera.copy()
    mirrored[:, 0, 3] *= -1
    assert absolute_trajectory_error(Trajectory(truth.timestamps, mirrored), truth).rmse > 0.01


def test_absolute_error_does_not_scale():
    truth = smooth_truth()
    larger = truth.world_T_camera.copy()
    larger[:, :3, 3] *= 2
    assert absolute_trajectory_error(Trajectory(truth.timestamps, larger), truth).rmse > 0.1


def test_absolute_error_of_a_camera_that_never_moved_is_finite():
    truth = smooth_truth()
    still = Trajectory(truth.timestamps, np.tile(np.eye(4), (len(truth), 1, 1)))
    spread = truth.world_T_camera[:, :3, 3] - truth.world_T_camera[:, :3, 3].mean(axis=0)
    assert absolute_trajectory_error(still, truth).rmse == pytest.approx(rms(np.linalg.norm(spread, axis=1)))


def test_distance_error_starts_at_zero_and_follows_the_offset():
    truth = smooth_truth()
    from_first = inverse(truth.world_T_camera[0]) @ truth.world_T_camera
    from_first[:, 0, 3] += np.linspace(0, 0.3, len(truth))
    error = distance_error(Trajectory(truth.timestamps, from_first), truth)
    np.testing.assert_allclose(error.values, np.linspace(0, 0.3, len(truth)), atol=1e-9)
    assert error.final == pytest.approx(0.3)
    assert error.unit == "m" and "first pose" in error.definition


def test_distance_error_leaves_out_what_the_truth_does_not_cover():
    truth = smooth_truth()
    estimate = perturbed(truth, truth.timestamps[::3], 0)
    error = distance_error(estimate, Trajectory(truth.timestamps[60:], truth.world_T_camera[60:]))
    assert len(error.values) == len(estimate) - 20 and error.values[0] == 0


def test_distance_error_follows_the_stamps_whatever_the_order_of_the_poses():
    truth = smooth_truth()
    estimate = perturbed(truth, truth.timestamps[50:350:10], 3)
    expected, found = distance_error(estimate, truth), distance_error(estimate[::-1], truth)
    np.testing.assert_allclose(found.values, expected.values)
    assert found.final == pytest.approx(expected.final)


@pytest.mark.parametrize("error", [distance_error, absolute_trajectory_error, relative_pose_error])
def test_segments_of_the_truth_count_as_the_estimates(error):
    """Of two runs that are compared, the one that stands for the truth may be in segments: its jump was an error."""
    whole = smooth_truth()
    segments = (np.arange(len(whole)) >= 150).astype(int)
    jumped = whole.world_T_camera.copy()
    jumped[150:, 0, 3] += 5.0
    pieces = replace(whole, world_T_camera=jumped, segments=segments)
    for estimate, truth in ((pieces, whole), (whole, pieces)):
        found = error(estimate[::3], truth)
        values = found.values if hasattr(found, "values") else found.translation.values
        assert np.max(values) < 1e-6


def test_a_segment_of_one_pose_says_nothing_of_the_absolute_error():
    """Aligned by itself it had no error: a trajectory in pieces looked perfect."""
    truth = smooth_truth()
    estimate = perturbed(truth, truth.timestamps[50:350:10], 3)
    whole = absolute_trajectory_error(estimate[:20], truth)
    pieces = replace(estimate, segments=np.r_[np.zeros(20, int), np.arange(1, 11)])
    found = absolute_trajectory_error(pieces, truth)
    assert found.rmse == pytest.approx(whole.rmse) and len(found.values) == 20
    with pytest.raises(GavoError, match="no two poses of one segment"):
        absolute_trajectory_error(replace(estimate, segments=np.arange(30)), truth)


def test_results_say_what_they_are():
    truth = smooth_truth()
    error = relative_pose_error(perturbed(truth, truth.timestamps[::3], 0), truth)
    assert (error.translation.unit, error.rotation.unit) == ("m", "deg")
    summary = error.translation.summary()
    assert summary["count"] == len(error.translation.values) == len(error.translation.timestamps)
    assert "translation" in error.translation.definition and "rotation" in error.rotation.definition
    assert summary["max"] == error.translation.max >= error.translation.rmse >= error.translation.mean > 0


def test_definitions_name_the_span_and_how_near_the_truth_has_to_be():
    """Catches a figure over seven frames that says it is over one, or one whose limit is TUM's but says otherwise."""
    truth = smooth_truth(rate=120.0)
    for delta, span in ((1, "over 1 frame,"), (7, "over 7 frames,")):
        assert span in relative_pose_error(truth, truth, delta, "frames").translation.definition
    dense, sparse = (relative_pose_error(truth, truth[::step]).rotation.definition for step in (1, 12))
    assert "over 1 s" in dense and "within" not in dense and sparse.endswith("nearest true stamps within 0.02 s")


@pytest.mark.parametrize("which", ["estimate", "truth"])
def test_poses_that_are_not_known_are_left_out(which):
    """They ended in a traceback or in a drift that is not-a-number; unknown stamps alone in no drift at all."""
    truth = smooth_truth()
    both = {"estimate": perturbed(truth, truth.timestamps[::3], 0), "truth": truth}
    whole = both[which]
    lost = np.arange(len(whole)) % 7 == 3
    stamps, poses = whole.timestamps.copy(), whole.world_T_camera.copy()
    poses[lost], stamps[5] = np.nan, np.nan
    lost[5] = True
    holed, cut, unknown = (
        both | {which: Trajectory(*of)}
        for of in ((stamps, poses), (stamps[~lost], poses[~lost]), (stamps, np.full_like(poses, np.nan)))
    )

    def drift(estimate: Trajectory, truth: Trajectory) -> ErrorSeries:
        return relative_pose_error(estimate, truth).translation

    for error in (drift, absolute_trajectory_error, distance_error):
        series, expected = (error(pair["estimate"], pair["truth"]) for pair in (holed, cut))
        assert np.isfinite(series.rmse) and series.rmse == expected.rmse
        with pytest.raises(GavoError):
            error(unknown["estimate"], unknown["truth"])


@pytest.mark.parametrize("which", ["estimate", "truth"])
@pytest.mark.parametrize(
    "change", [np.transpose, lambda pose: 1.1 * pose, lambda pose: pose @ np.diag([1.0, 1.0, -1.0, 1.0])]
)
def test_poses_that_are_no_rigid_transforms_are_refused(change, which):
    """Transposed ones have no translation: what drifted was told to stand still."""
    truth = smooth_truth()
    both = {"estimate": perturbed(truth, truth.timestamps[::3], 0), "truth": truth}
    poses = both[which].world_T_camera.copy()
    poses[1] = change(poses[1])
    both[which] = broken = Trajectory(both[which].timestamps, poses)
    for error in (relative_pose_error, absolute_trajectory_error, distance_error):
        with pytest.raises(GavoError, match=f"pose 1 of {len(poses)} is not a rigid transform"):
            error(both["estimate"], both["truth"])
    with pytest.raises(GavoError, match="pose 1 of .* is not a rigid transform"):
        SyntheticSequence(trajectory=broken)


def test_too_little_to_compare_is_refused():
    truth = smooth_truth()
    short = perturbed(truth, truth.timestamps[:20:3], 0)
    elsewhere = Trajectory(truth.timestamps + 1e6, truth.world_T_camera)
    single = Trajectory(truth.timestamps[:1], truth.world_T_camera[:1])
    empty = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    for estimate in (short, elsewhere, single, empty):
        with pytest.raises(GavoError):
            relative_pose_error(estimate, truth)
    for estimate in (elsewhere, single, empty):
        with pytest.raises(GavoError):
            relative_pose_error(estimate, truth, 1, "frames")
        with pytest.raises(GavoError):
            absolute_trajectory_error(estimate, truth)
    for estimate in (elsewhere, empty):
        with pytest.raises(GavoError):
            distance_error(estimate, truth)
    with pytest.raises(GavoError, match=r"no associated poses 7 frames apart \(7 associate\)"):
        relative_pose_error(short, truth, 7, "frames")
    with pytest.raises(GavoError, match=r"only 0 poses of estimate and ground truth are within 0\.02 s of each other"):
        relative_pose_error(elsewhere, truth, 1, "frames")


@pytest.mark.parametrize(
    "arguments", [(0, "s"), (-1, "s"), (np.nan, "s"), (0.5, "frames"), (np.inf, "frames"), (1, "m")]
)
def test_bad_deltas_and_units_are_refused(arguments):
    truth = smooth_truth()
    with pytest.raises(GavoError):
        relative_pose_error(truth, truth, *arguments)


@pytest.mark.parametrize("value", ["1", None, [1], np.ones(1), 1j, True])
def test_spans_that_are_no_numbers_are_refused_by_name(value):
    truth = smooth_truth()
    for unit in ("s", "frames"):
        with pytest.raises(GavoError, match="relative pose error: delta: expected a number, got"):
            relative_pose_error(truth, truth, value, unit)
    with pytest.raises(GavoError, match="absolute trajectory error: max_difference: expected a number, got"):
        absolute_trajectory_error(truth, truth, value)
    with pytest.raises(GavoError, match="distance error: max_gap: expected a number, got"):
        distance_error(truth, truth, value)


@pytest.mark.parametrize("other", [None, "truth.txt", np.eye(4), [1.0]])
def test_what_is_no_trajectory_is_refused(other):
    truth = smooth_truth()
    for error in (relative_pose_error, absolute_trajectory_error, distance_error):
        for pair in ((other, truth), (truth, other)):
            with pytest.raises(GavoError, match=f"expected a Trajectory, got {type(other).__name__}: .*read_tum"):
                error(*pair)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, 3.0, np.pi])
def test_rotation_angles_are_exact_at_both_ends(angle):
    rotation = Rotation.from_rotvec(np.array([0.6, 0.0, 0.8]) * angle).as_matrix()
    assert rotation_angle(rotation[None])[0] == pytest.approx(angle, abs=1e-12)


def test_poses_of_one_moment_have_no_drift_over_a_second():
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, 0, 3] = np.arange(40)
    still = Trajectory(np.ones(40), poses)
    with pytest.raises(GavoError, match="no poses 1 s apart"):
        relative_pose_error(still, still)
