"""E(ξ) and how it is computed, against a float64 oracle written from (1) to (8)."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from observed import (
    build,
    exchanged,
    jit_error,
    jit_exp,
    jit_problem_score,
    jit_residuals,
    random_motions,
    random_pair,
    smooth_pair,
    twist,
)

from gavo_jax.objective import error as error_module
from gavo_jax.objective.error import Objective
from gavo_jax.objective.losses import LOSSES, huber, student_t
from gavo_jax.objective.problem import Problem

jit_score = jax.jit(lambda objective, motions: objective.score(motions))
jit_counted = jax.jit(lambda objective, motions, counted: objective.score(motions, counted))


def check_against_oracle(
    objective: Objective, pair: oracle.Pair, xi: np.ndarray, loss: str, gain: float = 1.0, bias: float = 0.0
) -> None:
    """E and the overlap agree to 1e-4; motions with a point about to change its pixel or to leave are not judged."""
    target_T_reference = oracle.expm(xi)
    terms = oracle.residuals(pair, target_T_reference, gain, bias)
    assume(terms.margin > 2e-5)
    expected = oracle.error(terms, loss, *(float(s) for s in objective.scales))
    error, overlap = jit_error(objective, target_T_reference.astype(np.float32))
    assert float(overlap) == pytest.approx(terms.overlap, rel=1e-6)
    assert float(error) == pytest.approx(expected, rel=1e-4)


@given(twist, st.integers(0, 50))
@settings(max_examples=40)
def test_the_papers_error(xi: np.ndarray, seed: int) -> None:
    pair = random_pair(seed)
    check_against_oracle(build(pair), pair, xi, "l2")


@pytest.mark.parametrize("loss", LOSSES)
@given(twist, st.integers(0, 50), st.floats(5, 80), st.floats(0.003, 0.3), st.sampled_from([0.0, 0.3, 1.0]))
@settings(max_examples=8)
def test_every_loss_with_and_without_depth(
    loss: str, xi: np.ndarray, seed: int, grey_scale: float, depth_scale: float, depth_weight: float
) -> None:
    pair = random_pair(seed)
    objective = build(pair, LOSSES[loss], (grey_scale, depth_scale, depth_weight))
    check_against_oracle(objective, pair, xi, loss)


@given(twist, st.floats(0.7, 1.4), st.floats(-20, 20))
@settings(max_examples=8)
def test_a_given_brightness_change(xi: np.ndarray, gain: float, bias: float) -> None:
    pair = random_pair(3)
    check_against_oracle(build(pair, gain=gain, bias=bias), pair, xi, "l2", gain, bias)


def test_a_perfect_match_has_no_error() -> None:
    error, overlap = jit_error(build(smooth_pair(), student_t, (10.0, 0.01, 0.3)), jnp.eye(4))
    assert float(error) == pytest.approx(0, abs=1e-2)
    assert float(overlap) == 1.0


def test_too_little_overlap_is_worthless() -> None:
    pair = random_pair(2)
    motions = jit_exp(np.array([[0, 0, 0, 0, angle, 0] for angle in (0.0, 0.3, 0.6, 3.0)], np.float32))
    plain, overlap = jit_score(build(pair), motions)
    assert np.all(np.isfinite(plain[:-1])) and np.all(np.diff(overlap) < 0)
    assert float(overlap[-1]) == 0 and np.isposinf(plain[-1]), "nothing in view is no perfect match"
    floored, same = jit_score(build(pair, min_overlap=0.5), motions)
    np.testing.assert_array_equal(same, overlap)
    np.testing.assert_array_equal(floored, np.where(overlap < 0.5, np.inf, plain))


@pytest.mark.parametrize("loss", ["l2", "student-t"])
def test_a_point_out_of_view_can_be_charged(loss: str) -> None:
    pair, scale, cost = random_pair(2), 30.0, 0.5
    objective = build(pair, LOSSES[loss], (scale, 0.01, 0.0), outside_cost=cost)
    for angle in (0.017, 0.2, 0.4):
        terms = oracle.residuals(pair, oracle.expm(np.array([0, 0, 0, 0, angle, 0])))
        inside = oracle.error(terms, loss, scale, 0.01, 0.0)
        outside = cost * scale**2 * oracle.LOSSES[loss](np.array(1.0))
        expected = terms.overlap * inside + (1 - terms.overlap) * outside
        error, _ = jit_error(objective, oracle.expm(np.array([0, 0, 0, 0, angle, 0])).astype(np.float32))
        assert float(error) == pytest.approx(expected, rel=1e-3)


def test_not_a_number_becomes_infinite() -> None:
    objective = build(random_pair(2))
    problem = Problem(objective, jnp.eye(4), jnp.eye(6))
    x = jnp.zeros((3, 6)).at[1, 2].set(jnp.nan)
    error, _ = jit_problem_score(problem, x)
    assert np.isfinite(error[0]) and not np.isnan(error[1]) and float(error[0]) == float(error[2])
    spoilt = replace(
        objective, reference=objective.reference._replace(grey=objective.reference.grey.at[30].set(jnp.nan))
    )
    error, _ = jit_problem_score(replace(problem, objective=spoilt), jnp.zeros((3, 6)))
    np.testing.assert_array_equal(error, np.inf)


def test_a_population_scores_as_its_members() -> None:
    objective = build(random_pair(4), student_t, (20.0, 0.02, 0.3), min_overlap=0.6)
    motions = random_motions(16, 0.1)
    error, overlap = jit_score(objective, motions)
    assert 0 < np.isinf(error).sum() < 16
    members = [jit_error(objective, motion) for motion in motions]
    np.testing.assert_allclose(error, [e for e, _ in members], rtol=1e-5)
    np.testing.assert_allclose(overlap, [o for _, o in members], rtol=1e-6)


def test_every_way_to_score_agrees(monkeypatch: pytest.MonkeyPatch) -> None:
    objective = build(random_pair(5), student_t, (20.0, 0.02, 0.3))
    motions = random_motions(21)
    expected = jax.jit(error_module._score_side_by_side)(objective, motions, np.ones(21, bool))
    # 432 points: all at once, in chunks that fit, and in chunks with a rest
    for group, chunk in ((8, 432), (4, 108), (32, 100)):
        monkeypatch.setattr(error_module, "GROUP", group)
        monkeypatch.setattr(error_module, "CHUNK", chunk)
        for result, value in zip(jax.jit(lambda o, m: o.score(m))(objective, motions), expected, strict=True):
            np.testing.assert_allclose(result, value, rtol=1e-5)


def test_only_what_counts_is_scored() -> None:
    objective = build(random_pair(5), student_t, (20.0, 0.02, 0.3))
    motions = random_motions(19)
    counted = np.random.default_rng(0).random(19) < 0.4
    every, _ = jit_score(objective, motions)
    some, _ = jit_counted(objective, motions, counted)
    np.testing.assert_allclose(some, np.where(counted, every, np.inf), rtol=1e-6)
    none, _ = jit_counted(objective, motions, np.zeros(19, bool))
    np.testing.assert_array_equal(none, np.inf)


def test_points_beyond_the_count_are_left_out() -> None:
    pair = random_pair(5)
    objective = build(pair, student_t, (20.0, 0.02, 0.3))
    shorter = jax.tree.map(lambda leaf: leaf[:240], objective.reference)
    longer = jax.tree.map(lambda leaf: jnp.pad(leaf, (0, 200)), shorter)
    motions = random_motions(9)
    expected, _ = jit_score(replace(objective, reference=shorter), motions)
    found, _ = jit_score(replace(objective, reference=longer, count=jnp.int32(240)), motions)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_populations_side_by_side_are_one() -> None:
    objective = build(random_pair(5), student_t, (20.0, 0.02, 0.3))
    motions = random_motions(24).reshape(4, 6, 4, 4)
    expected = [jit_score(objective, population)[0] for population in motions]
    together = jax.jit(jax.vmap(lambda o, m: o.score(m)[0], in_axes=(None, 0)))(objective, motions)
    np.testing.assert_allclose(together, np.stack(expected), rtol=1e-5)
    gains = np.array([0.9, 1.0, 1.1, 1.2], np.float32)

    def brighter(gain: jax.Array, motions: jax.Array) -> jax.Array:
        reference = objective.reference._replace(grey=gain * objective.reference.grey)
        return replace(objective, reference=reference).score(motions)[0]

    several = jax.jit(jax.vmap(brighter))(gains, motions)
    alone = jax.jit(brighter)
    np.testing.assert_allclose(several, [alone(g, m) for g, m in zip(gains, motions, strict=True)], rtol=1e-5)


def test_two_references_score_as_the_mean_over_both_their_points() -> None:
    pairs = [random_pair(seed) for seed in (8, 9)]
    pairs[1] = pairs[1]._replace(target_grey=pairs[0].target_grey)
    objectives = [build(pair) for pair in pairs]
    motion = random_motions(1)[0]
    views = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(o.reference for o in objectives))
    together = replace(objectives[0], reference=views)
    counts = [np.sum(jit_residuals(o, motion).inside) for o in objectives]
    expected = np.average([float(jit_error(o, motion)[0]) for o in objectives], weights=counts)
    assert float(jit_error(together, motion)[0]) == pytest.approx(expected, rel=1e-5)


def two_views(pair: oracle.Pair, other: oracle.Pair) -> tuple[Objective, Objective]:
    """The first pair's objective, and the same with the other's reference as a second view."""
    one = build(pair, student_t, (20.0, 0.02, 0.3))
    second = build(other, student_t, (20.0, 0.02, 0.3)).reference
    return one, replace(one, reference=jax.tree.map(lambda *leaves: jnp.stack(leaves), one.reference, second))


@pytest.mark.parametrize("chunk", [432, 100])
def test_views_are_scored_chunk_after_chunk(monkeypatch: pytest.MonkeyPatch, chunk: int) -> None:
    _, both = two_views(random_pair(8), random_pair(9))
    motions = random_motions(11)
    expected = jax.jit(error_module._score_side_by_side)(both, motions, np.ones(11, bool))
    monkeypatch.setattr(error_module, "CHUNK", chunk)
    for found, value in zip(jax.jit(lambda o, m: o.score(m))(both, motions), expected, strict=True):
        np.testing.assert_allclose(found, value, rtol=1e-5)


def test_a_view_without_readings_changes_nothing_and_is_not_visited() -> None:
    one, both = two_views(random_pair(8), random_pair(9))
    motions = random_motions(11)
    expected = jit_score(one, motions)
    points = both.reference.points
    emptied = replace(both, reference=both.reference._replace(points=points._replace(q=points.q.at[1].set(0.0))))
    visited = replace(both, reference=both.reference._replace(grey=both.reference.grey.at[1].set(jnp.nan)))
    for objective in (emptied, replace(emptied, views=jnp.int32(1))):
        np.testing.assert_allclose(jit_score(objective, motions), expected, rtol=1e-5)
    assert not np.any(np.isnan(jit_score(replace(visited, views=jnp.int32(1)), motions)))


def test_a_sample_is_spread_over_the_points_that_count() -> None:
    objective = build(random_pair(5), student_t, (20.0, 0.02, 0.3))
    few = replace(objective, count=jnp.int32(240)).sample(60)
    np.testing.assert_array_equal(few.reference.grey, objective.reference.grey[:240:4])
    everything = objective.sample(10_000)
    np.testing.assert_array_equal(everything.reference.grey, objective.reference.grey)


@pytest.mark.parametrize("is_counted", [False, True])
@pytest.mark.parametrize("available", [1920 * 1080, 4096 * 3072, 10_007, 1200])
def test_a_sample_of_a_large_image_is_spread_over_all_of_it(available: int, is_counted: bool) -> None:
    objective = build(random_pair(5))
    numbered = jax.tree.map(lambda leaf: jnp.arange(available, dtype=jnp.int32), objective.reference)
    count = jnp.int32(available) if is_counted else None
    for points in (1200, 9600, 100_000):
        drawn = replace(objective, reference=numbered, count=count).sample(points).reference.grey
        size = drawn.size  # which is capped where the products would not fit any more
        assert min(points, available, 40_000) <= size <= points
        np.testing.assert_array_equal(drawn, np.arange(size, dtype=np.int64) * available // size)


def test_symmetric_error_is_the_mean_of_both_directions() -> None:
    scales = (20.0, 0.05, 0.3)
    forward, backward = random_pair(3), exchanged(random_pair(3))
    objective = replace(build(forward, huber, scales), backward=build(backward, huber, scales))
    motions = [oracle.expm(np.random.default_rng(i).normal(0, 0.05, 6)) for i in range(5)]
    expected = [
        (
            oracle.error(oracle.residuals(forward, motion), "huber", *scales)
            + oracle.error(oracle.residuals(backward, np.linalg.inv(motion)), "huber", *scales)
        )
        / 2
        for motion in motions
    ]
    stacked = jnp.asarray(np.stack(motions), jnp.float32)
    np.testing.assert_allclose(jit_score(objective, stacked)[0], expected, rtol=2e-3)
    np.testing.assert_allclose(jit_error(objective, stacked[0])[0], expected[0], rtol=2e-3)
    one_way = [jit_score(build(pair), stacked[:1])[1] for pair in (forward, backward)]
    assert abs(float(one_way[0][0]) - float(one_way[1][0])) > 0.01
