"""E(ξ), its derivatives and what is estimated from the data, against a float64 oracle written from (1) to (8)."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from gavo_jax.camera import Camera
from gavo_jax.image.levels import Levels, image_plane
from gavo_jax.image.pyramid import NO_PIXEL, PyramidLevel, make_atlas
from gavo_jax.image.sampling import INVERSE_DEPTH_STEP, Target, pack_target
from gavo_jax.objective import error as error_module
from gavo_jax.objective.error import Objective, Scales
from gavo_jax.objective.estimates import Brightness, depth_trust, estimate_brightness, estimate_scales, explained_share
from gavo_jax.objective.losses import LOSSES, Loss, huber, l2, student_t
from gavo_jax.objective.points import Reference, central_gradient, make_references, move_reference, undo_rolling_shutter
from gavo_jax.objective.preconditioning import preconditioner, reference_curvature, unconditioner
from gavo_jax.objective.problem import Problem
from gavo_jax.se3 import exp
from gavo_jax.solvers.base import Bounds, solve
from gavo_jax.solvers.genetic import GeneticAlgorithm
from gavo_jax.solvers.particle_swarm import ParticleSwarm

SMALL = Camera(24.0, 23.0, 11.3, 8.8, 24, 18)
CAMERA = Camera(60.0, 58.0, 31.2, 24.1, 64, 48)


@partial(jax.jit, static_argnames="cell")
def make_reference(level: PyramidLevel, camera: Camera, cell: int = 1) -> Reference:
    """The points of one level, one a cell x cell block."""
    points = (camera.width // cell) * (camera.height // cell)
    return jax.tree.map(lambda leaf: leaf[0], make_references((level,), camera, Levels.of(camera, (0,), points)))


@cache
def random_pair(seed: int) -> oracle.Pair:
    """White-noise images, depth of a few planes and steps, a fifth of the readings missing on either side."""
    rng = np.random.default_rng(seed)
    shape = (SMALL.height, SMALL.width)

    def inverse_depth() -> np.ndarray:
        v, u = np.mgrid[: shape[0], : shape[1]]
        q = 0.5 + rng.uniform(-0.01, 0.01) * u + rng.uniform(-0.01, 0.01) * v + 0.4 * (u > rng.integers(5, 20))
        q = np.rint(q / INVERSE_DEPTH_STEP) * INVERSE_DEPTH_STEP
        return np.where(rng.random(shape) < 0.2, 0.0, q)

    greys = [rng.integers(0, 256, shape).astype(float) for _ in range(2)]
    return oracle.Pair(SMALL, greys[0], inverse_depth(), greys[1], inverse_depth())


def build(
    pair: oracle.Pair,
    loss: Loss = l2,
    scales: tuple[float, float, float] | None = None,
    min_overlap: float = 0.0,
    gain: float = 1.0,
    bias: float = 0.0,
    outside_cost: float = 0.0,
) -> Objective:
    """The objective of a pair; scales are those of grey and depth, and the depth weight. Without them: (2)."""
    reference, target = prepare(pair.camera, *(image.astype(np.float32) for image in pair[1:]))
    reference = reference._replace(grey=gain * reference.grey + bias)
    use_depth = scales is not None and scales[2] > 0
    values = Scales.unit() if scales is None else Scales(*(jnp.float32(s) for s in scales))
    return Objective(
        reference,
        target,
        image_plane(pair.camera),
        values,
        jnp.float32(min_overlap),
        jnp.float32(outside_cost),
        loss=loss,
        use_depth=use_depth,
    )


@jax.jit
def prepare(
    camera: Camera, grey: jax.Array, inverse_depth: jax.Array, target_grey: jax.Array, target_inverse_depth: jax.Array
) -> tuple[Reference, Target]:
    """What the objective keeps of either frame."""
    reference = make_reference(PyramidLevel(grey, inverse_depth), camera)
    return reference, pack_target(make_atlas([PyramidLevel(target_grey, target_inverse_depth)]))


jit_error = jax.jit(lambda objective, motion: objective.error(motion))
jit_residuals = jax.jit(lambda objective, motion: objective.residuals(motion))
jit_score = jax.jit(lambda objective, motions: objective.score(motions))
jit_problem_score = jax.jit(lambda problem, x: problem.score(x))
jit_scales = jax.jit(lambda objective, motion, weight: estimate_scales(objective.residuals(motion), weight))
jit_trust = jax.jit(depth_trust)


@jax.jit
def jit_brightness(objective: Objective, motion: jax.Array) -> Brightness:
    """Of one view."""
    one = jax.tree.map(lambda leaf: leaf[None], objective.reference)
    found = estimate_brightness(one.grey, replace(objective, reference=one).residuals(motion))
    return jax.tree.map(lambda leaf: leaf[0], found)


jit_exp = jax.jit(exp)
jit_move = jax.jit(move_reference)
jit_undo = jax.jit(undo_rolling_shutter)
jit_counted = jax.jit(lambda objective, motions, counted: objective.score(motions, counted))
jit_explained = jax.jit(lambda objective, motion: explained_share(objective.residuals(motion)))
jit_linearize = jax.jit(lambda problem, x: problem.linearize(x))

# metres and radians that move a point of SMALL by a few pixels
twist = st.tuples(*[st.floats(-0.2, 0.2)] * 3, *[st.floats(-0.1, 0.1)] * 3).map(np.array)


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


@pytest.mark.parametrize("loss", LOSSES)
def test_a_loss_is_its_argument_near_zero_and_never_falls(loss: str) -> None:
    s = np.linspace(0, 400, 2001, dtype=np.float32)
    rho = jax.jit(LOSSES[loss])(s)
    assert float(rho[0]) == 0
    assert float(jax.jit(LOSSES[loss])(jnp.float32(1e-3))) == pytest.approx(1e-3, rel=2e-3)
    assert np.all(np.diff(rho) >= -1e-3)
    assert np.all(rho <= s * (1 + 1e-5))
    assert np.all(np.isfinite(jax.jit(jax.vmap(jax.grad(LOSSES[loss])))(s)))


def test_a_perfect_match_has_no_error() -> None:
    error, overlap = jit_error(build(smooth_pair(), student_t, (10.0, 0.01, 0.3)), jnp.eye(4))
    assert float(error) == pytest.approx(0, abs=1e-2)
    assert float(overlap) == 1.0


def test_too_little_overlap_is_worthless() -> None:
    pair = random_pair(2)
    motions = jit_exp(np.array([[0, 0, 0, 0, angle, 0] for angle in (0.0, 0.3, 0.6, 3.0)], np.float32))
    plain, overlap = jit_score(build(pair), motions)
    assert np.all(np.isfinite(plain)) and np.all(np.diff(overlap) < 0) and float(overlap[-1]) == 0
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


def random_motions(count: int, scale: float = 0.05) -> jax.Array:
    return jit_exp(np.random.default_rng(0).normal(0, scale, (count, 6)).astype(np.float32))


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


@pytest.mark.parametrize("cell", [2, 3])
def test_a_cell_gives_its_steepest_point_with_a_reading(cell: int) -> None:
    pair = random_pair(6)
    grey, inverse_depth = (jnp.asarray(image, jnp.float32) for image in pair[1:3])
    inverse_depth = inverse_depth.at[:6, :6].set(0.0)
    every = make_reference(PyramidLevel(grey, inverse_depth), SMALL)
    chosen = make_reference(PyramidLevel(grey, inverse_depth), SMALL, cell)
    assert chosen.grey.shape == ((18 // cell) * (24 // cell),)
    rows = np.rint(np.asarray(chosen.points.y) * SMALL.fy + SMALL.cy).astype(int)
    columns = np.rint(np.asarray(chosen.points.x) * SMALL.fx + SMALL.cx).astype(int)
    pixel = rows * SMALL.width + columns
    for own, of_all in zip(jax.tree.leaves(chosen), jax.tree.leaves(every), strict=True):
        np.testing.assert_array_equal(own, np.asarray(of_all)[pixel])
    blocks = rows // cell * (24 // cell) + columns // cell
    np.testing.assert_array_equal(blocks, np.arange(chosen.grey.size))
    steepness = np.asarray(every.grey_u**2 + every.grey_v**2).reshape(18, 24)
    seen = np.asarray(inverse_depth) > 0
    for i in range(chosen.grey.size):
        block = np.s_[rows[i] // cell * cell :, columns[i] // cell * cell :]
        inside = np.where(seen, steepness, -1)[block][:cell, :cell]
        assert np.where(seen, steepness, -1)[rows[i], columns[i]] == inside.max()


def test_several_levels_give_the_points_of_each_alone() -> None:
    levels = [PyramidLevel(*(jnp.asarray(i, jnp.float32) for i in random_pair(6)[1:3]))]
    rng = np.random.default_rng(2)
    for size in ((9, 12), (4, 6)):
        levels.append(PyramidLevel(*(jnp.asarray(rng.uniform(0.1, 200.0, size), jnp.float32) for _ in range(2))))
    points = (48, 30, 48)
    together = jax.jit(lambda levels: make_references(levels, SMALL, Levels.of(SMALL, (2, 1, 0), points)))(
        tuple(levels)
    )
    for row, level, cell in ((0, 2, 1), (1, 1, 2), (2, 0, 3)):
        alone = make_reference(levels[level], SMALL.level(level), cell)
        count = alone.grey.shape[0]
        for seen, expected in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(seen[row, :count], expected, rtol=1e-6)
        assert not np.any(together.points.q[row, count:])


def test_gradients_at_the_border_take_the_pixel_for_what_is_missing() -> None:
    grey = np.random.default_rng(3).uniform(0, 255, (6, 7)).astype(np.float32)
    wide = np.pad(grey, 1, mode="edge")
    expected = [0.5 * (wide[1:-1, 2:] - wide[1:-1, :-2]), 0.5 * (wide[2:, 1:-1] - wide[:-2, 1:-1])]
    np.testing.assert_allclose(central_gradient(jnp.pad(grey, 1, constant_values=NO_PIXEL)), expected, rtol=1e-5)


def test_moved_points_are_seen_as_from_their_own_camera() -> None:
    pair = random_pair(7)
    reference = make_reference(PyramidLevel(*(jnp.asarray(i, jnp.float32) for i in pair[1:3])), SMALL)
    anchor_T_view, target_T_anchor = random_motions(2, 0.1)
    objective = build(pair, student_t, (20.0, 0.02, 0.0))
    moved = replace(objective, reference=jit_move(reference, anchor_T_view))
    error, overlap = jit_error(moved, target_T_anchor)
    expected, expected_overlap = jit_error(objective, target_T_anchor @ anchor_T_view)
    assert float(error) == pytest.approx(float(expected), rel=1e-3)
    assert float(overlap) == pytest.approx(float(expected_overlap))


def test_points_moved_behind_the_camera_lose_their_reading() -> None:
    pair = random_pair(7)
    reference = make_reference(PyramidLevel(*(jnp.asarray(i, jnp.float32) for i in pair[1:3])), SMALL)
    back = jnp.eye(4).at[2, 3].set(-10.0)
    moved = jit_move(reference, back)
    assert not np.any(moved.points.q > 0)
    assert all(np.all(np.isfinite(leaf)) for leaf in moved.points)


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


def test_settled_points_are_where_they_were_in_the_middle_of_the_readout() -> None:
    pair = smooth_pair(rim=1)
    reference = make_reference(PyramidLevel(*(jnp.asarray(i, jnp.float32) for i in pair[1:3])), CAMERA)
    twist = np.array([0.02, -0.01, 0.015, 0.01, -0.02, 0.015])
    settled = jit_undo(reference, twist.astype(np.float32))
    assert not np.any(settled.row_time)
    before, after = (np.stack(points, dtype=float) for points in (reference.points, settled.points))
    for i in (70, 1000, 2900):
        row = i // CAMERA.width
        x, y, q = before[:, i]
        moment = (row + 0.5) / CAMERA.height - 0.5
        expected = oracle.expm(-moment * twist) @ [x / q, y / q, 1 / q, 1.0]
        found = np.array([*after[:2, i], 1.0]) / after[2, i]
        assert np.abs(found - expected[:3]).max() < 3e-4 < np.abs(np.array([x, y, 1.0]) / q - expected[:3]).max() / 10


# --- derivatives -----------------------------------------------------------------------------------------------------


def smooth_image(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A smooth texture of full contrast."""
    waves = np.sin(0.31 * u + 0.1 * v) + np.sin(0.23 * v - 0.13 * u + 1) + np.sin(0.17 * u + 0.29 * v + 2)
    return 128 + 40 * waves


def smooth_pair(shift: tuple[float, float] = (0.0, 0.0), rim: int = 6) -> oracle.Pair:
    """A tilted, textured plane; the target's image is shifted by some pixels. No readings near the reference's rim,
    so that small motions move no point out of view: what leaves is no part of the derivative."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    q = 0.6 + 0.002 * u - 0.003 * v
    q = np.rint(q / INVERSE_DEPTH_STEP) * INVERSE_DEPTH_STEP
    inner = np.zeros(q.shape, bool)
    inner[rim:-rim, rim:-rim] = True
    reference = np.rint(smooth_image(u, v))
    return oracle.Pair(CAMERA, reference, np.where(inner, q, 0), np.rint(smooth_image(u - shift[0], v - shift[1])), q)


def central_differences(f: Callable[[np.ndarray], float], x: np.ndarray, h: float) -> np.ndarray:
    return np.array([(f(x + h * e) - f(x - h * e)) / (2 * h) for e in np.eye(len(x))])


class Place(NamedTuple):
    """Where derivatives are taken: coordinates x about an origin."""

    pair: oracle.Pair
    origin: np.ndarray
    basis: np.ndarray
    x: np.ndarray


@cache
def some_place() -> Place:
    """Of a pair that is nearly aligned; the coordinates are neither metres nor radians."""
    rng = np.random.default_rng(5)
    origin = oracle.expm(rng.normal(0, 0.01, 6))
    basis = np.linalg.qr(rng.normal(size=(6, 6)))[0] * rng.uniform(0.5, 2, 6)
    return Place(smooth_pair(shift=(0.4, -0.3)), origin, basis, rng.normal(0, 0.005, 6))


@cache
def terms_at(*x: float) -> oracle.Terms:
    """The oracle's residuals near `some_place`: every loss is one of the same residuals."""
    pair, origin, basis, _ = some_place()
    return oracle.residuals(pair, origin @ oracle.expm(basis @ np.array(x)))


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("depth_weight", [0.0, 0.3])
def test_gradient_against_central_differences(loss: str, depth_weight: float) -> None:
    pair, origin, basis, x = some_place()
    scales = (6.0, 0.01, depth_weight)

    def reference_error(x: np.ndarray) -> float:
        return oracle.error(terms_at(*x), loss, *scales)

    expected = central_differences(reference_error, x, 1e-7)
    problem = Problem(
        build(pair, LOSSES[loss], scales), jnp.asarray(origin, jnp.float32), jnp.asarray(basis, jnp.float32)
    )
    model = jit_linearize(problem, x.astype(np.float32))
    assert float(model.error) == pytest.approx(reference_error(x), rel=1e-4)
    np.testing.assert_allclose(model.gradient, expected, atol=2e-3 * np.abs(expected).max())


def exchanged(pair: oracle.Pair) -> oracle.Pair:
    return oracle.Pair(pair.camera, *pair[3:], *pair[1:3])


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


def test_symmetric_gradient_against_central_differences() -> None:
    rng = np.random.default_rng(5)
    forward = smooth_pair(shift=(0.4, -0.3))
    inner = np.pad(np.ones((CAMERA.height - 12, CAMERA.width - 12)), 6)
    forward = forward._replace(target_inverse_depth=forward.target_inverse_depth * inner)
    backward = exchanged(forward)
    scales = (6.0, 0.01, 0.0)
    origin, basis = oracle.expm(rng.normal(0, 0.01, 6)), np.diag(rng.uniform(0.5, 2, 6))
    x = rng.normal(0, 0.005, 6)

    def reference_error(x: np.ndarray) -> float:
        motion = origin @ oracle.expm(basis @ x)
        errors = [
            oracle.error(oracle.residuals(pair, m), "cauchy", *scales)
            for pair, m in ((forward, motion), (backward, np.linalg.inv(motion)))
        ]
        return sum(errors) / 2

    objective = replace(build(forward, LOSSES["cauchy"], scales), backward=build(backward, LOSSES["cauchy"], scales))
    problem = Problem(objective, jnp.asarray(origin, jnp.float32), jnp.asarray(basis, jnp.float32))
    model = jit_linearize(problem, x.astype(np.float32))
    expected = central_differences(reference_error, x, 1e-7)
    assert float(model.error) == pytest.approx(reference_error(x), rel=1e-4)
    np.testing.assert_allclose(model.gradient, expected, atol=2e-3 * np.abs(expected).max())
    assert np.linalg.eigvalsh(np.asarray(model.hessian, float)).min() > 0


def test_gradient_under_a_rolling_shutter() -> None:
    """Against differences of E itself, which rounding and the image's kinks allow to a few per cent."""
    objective = replace(
        build(smooth_pair(shift=(0.4, -0.3)), LOSSES["cauchy"], (6.0, 0.01, 0.3)), readout=jnp.float32(3.0)
    )
    problem = Problem(objective, exp(jnp.full(6, 0.02)), jnp.eye(6))
    x = np.zeros(6, np.float32)

    def error(x: np.ndarray) -> float:
        return float(jit_problem_score(problem, jnp.asarray(x[None], jnp.float32))[0][0])

    model = jit_linearize(problem, x)
    at_once = jit_linearize(replace(problem, objective=replace(objective, readout=None)), x)
    expected = central_differences(error, x.astype(float), 1e-3)
    assert float(model.error) == pytest.approx(error(x), rel=1e-5)
    np.testing.assert_allclose(model.gradient, expected, atol=0.03 * np.abs(expected).max())
    assert np.abs(at_once.gradient - expected).max() > 0.1 * np.abs(expected).max()


@pytest.mark.parametrize("loss", LOSSES)
def test_hessian_is_symmetric_and_positive(loss: str) -> None:
    problem = Problem(build(smooth_pair((1.3, 0.7)), LOSSES[loss], (6.0, 0.01, 0.3)), jnp.eye(4), jnp.eye(6))
    model = jit_linearize(problem, jnp.full(6, 0.003))
    hessian = np.asarray(model.hessian, float)
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-4, atol=1e-4 * np.abs(hessian).max())
    assert np.linalg.eigvalsh(hessian).min() > 0


def test_hessian_predicts_the_gradient_of_a_good_match() -> None:
    problem = Problem(build(smooth_pair(), l2, (1.0, 0.01, 0.0)), jnp.eye(4), jnp.eye(6))
    still = jit_linearize(problem, jnp.zeros(6))
    size = np.sqrt(np.diag(still.hessian))
    for i in range(6):
        # 1 mm or 1 mrad: a fraction of a pixel
        step = jnp.zeros(6).at[i].set(1e-3)
        ahead, behind = jit_linearize(problem, step).gradient, jit_linearize(problem, -step).gradient
        found = np.asarray(ahead - behind) / 2e-3
        assert np.all(np.abs(found - still.hessian[i]) < 0.1 * size[i] * size)


def test_transform_goes_from_the_origin_along_the_basis() -> None:
    rng = np.random.default_rng(0)
    origin = oracle.expm(rng.normal(0, 0.3, 6)).astype(np.float32)
    basis = rng.normal(0, 0.1, (6, 6)).astype(np.float32)
    problem = Problem(build(random_pair(0)), jnp.asarray(origin), jnp.asarray(basis))
    x = rng.normal(0, 1, 6).astype(np.float32)
    motion = problem.transform(jnp.asarray(x))
    np.testing.assert_allclose(motion, origin @ oracle.expm(basis @ x), atol=1e-5)
    np.testing.assert_allclose(problem.transform(jnp.stack([jnp.asarray(x)] * 2))[1], motion, atol=1e-6)


# --- search coordinates ----------------------------------------------------------------------------------------------


def preconditioned(depth_weight: float) -> tuple[Problem, np.ndarray]:
    """The problem of a perfect match in the coordinates of its preconditioner, and the curvature A."""
    pair = smooth_pair(rim=2)
    objective = build(pair, l2, (1.0, 0.01, depth_weight))
    curvature = reference_curvature(objective)
    return Problem(objective, jnp.eye(4), preconditioner(curvature)), np.asarray(curvature, float)


@pytest.mark.parametrize("depth_weight", [0.0, 0.3])
def test_preconditioner_makes_the_curvature_round(depth_weight: float) -> None:
    problem, curvature = preconditioned(depth_weight)
    basis = np.asarray(problem.basis, float)
    round_curvature = basis.T @ curvature @ basis
    np.testing.assert_allclose(round_curvature, np.diag(np.diag(round_curvature)), atol=2e-3)
    diagonal = np.sort(np.diag(round_curvature))
    assert np.all(diagonal < 1.001) and diagonal[0] > 0.3 and np.all(diagonal[2:] > 0.9)


def test_preconditioner_of_a_blank_image_is_finite_and_small() -> None:
    basis = np.asarray(preconditioner(jnp.zeros((6, 6))))
    assert np.isfinite(basis).all() and np.abs(basis).max() <= 0.1


def test_unconditioner_is_the_preconditioners_inverse() -> None:
    problem, _ = preconditioned(0.3)
    np.testing.assert_allclose(unconditioner(problem.basis) @ problem.basis, np.eye(6), atol=1e-5)


@pytest.mark.parametrize("depth_weight", [0.0, 0.3])
def test_curvature_is_half_the_hessian_of_a_perfect_match(depth_weight: float) -> None:
    problem, curvature = preconditioned(depth_weight)
    hessian = jit_linearize(replace(problem, basis=jnp.eye(6)), jnp.zeros(6)).hessian
    np.testing.assert_allclose(0.5 * hessian, curvature, atol=0.1 * np.abs(curvature).max())


def test_a_unit_step_in_any_direction_costs_about_one_squared_grey_level() -> None:
    problem, _ = preconditioned(0.0)
    rng = np.random.default_rng(0)
    directions = np.concatenate([np.eye(6), -np.eye(6), rng.normal(size=(20, 6))])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    error, _ = jit_problem_score(problem, directions.astype(np.float32))
    assert np.all(error > 0.5) and np.all(error < 1.5)
    assert np.mean(error) == pytest.approx(1, abs=0.25)


# --- what the data say -----------------------------------------------------------------------------------------------


def noisy_pair(noise: np.ndarray, gain: float = 1.0, bias: float = 0.0) -> oracle.Pair:
    pair = smooth_pair(rim=1)
    return pair._replace(target_grey=np.clip(gain * pair.reference_grey + bias + noise, 0, 255))


def test_scale_of_a_t_distribution() -> None:
    noise = 4.0 * np.random.default_rng(0).standard_t(5, (48, 64))
    assert float(jit_scales(build(noisy_pair(noise)), jnp.eye(4), 1.0).grey) == pytest.approx(4.0, rel=0.1)


def test_depth_counts_as_its_own_scale_says() -> None:
    rng = np.random.default_rng(0)
    pair = noisy_pair(rng.normal(0, 3, (48, 64)))
    found = []
    for sigma in (0.01, 0.02):
        noise = sigma * rng.standard_t(5, (48, 64))
        noisy = pair._replace(target_inverse_depth=pair.target_inverse_depth + noise)
        found.append(jit_scales(build(noisy), jnp.eye(4), 0.3))
    assert float(found[1].depth / found[0].depth) == pytest.approx(2.0, rel=0.1)
    assert [float(scales.depth_weight) for scales in found] == pytest.approx([0.3, 0.3])


def test_depth_that_errs_by_whole_surfaces_is_trusted_less() -> None:
    rng = np.random.default_rng(0)
    pair = noisy_pair(rng.normal(0, 3, (48, 64)))
    patches = np.kron(rng.normal(0, 0.004, (6, 8)), np.ones((8, 8)))
    trust = []
    for noise in (rng.permuted(patches), patches):
        noisy = pair._replace(target_inverse_depth=pair.target_inverse_depth + noise)
        objective = replace(build(noisy), columns=noisy.camera.width)
        trust.append(float(jit_trust(objective, jnp.eye(4), jit_scales(objective, jnp.eye(4), 1.0))))
    assert trust[1] == pytest.approx(1 / 3, rel=1e-6) and trust[0] > 0.8


def test_scale_survives_outliers() -> None:
    rng = np.random.default_rng(1)
    noise = np.where(rng.random((48, 64)) < 0.15, rng.uniform(-100, 100, (48, 64)), rng.normal(0, 3, (48, 64)))
    assert 2.0 < float(jit_scales(build(noisy_pair(noise)), jnp.eye(4), 1.0).grey) < 8.0


def test_scales_never_vanish() -> None:
    scales = jit_scales(build(noisy_pair(np.zeros((48, 64)))), jnp.eye(4), 1.0)
    assert float(scales.grey) > 0.1 and float(scales.depth) > 1e-5
    nothing = build(random_pair(0)._replace(reference_inverse_depth=np.zeros((18, 24))))
    assert all(np.isfinite(s) and s > 0 for s in jit_scales(nothing, jnp.eye(4), 1.0))


@pytest.mark.parametrize("gain, bias", [(1.0, 0.0), (1.1, -12.0), (0.85, 20.0)])
def test_brightness_is_recovered_in_spite_of_outliers(gain: float, bias: float) -> None:
    rng = np.random.default_rng(2)
    noise = rng.normal(0, 1.5, (48, 64)) + 80 * (rng.random((48, 64)) < 0.05)
    found_gain, found_bias = jit_brightness(build(noisy_pair(noise, gain, bias)), jnp.eye(4))
    mean = smooth_pair().reference_grey.mean()
    assert float(found_gain) == pytest.approx(gain, abs=0.02)
    assert float(found_gain) * mean + float(found_bias) == pytest.approx(gain * mean + bias, abs=1.5)


def test_brightness_of_a_blank_image_is_a_bias_alone() -> None:
    pair = smooth_pair()
    blank = np.full((48, 64), 100.0)
    gain, bias = jit_brightness(build(pair._replace(reference_grey=blank, target_grey=blank + 10)), jnp.eye(4))
    assert float(gain) == pytest.approx(1, abs=1e-3) and float(bias) == pytest.approx(10, abs=0.2)


def test_explained_share() -> None:
    rng = np.random.default_rng(3)
    matched = jit_explained(build(smooth_pair(rim=1), scales=(1.0, 0.01, 0.3)), jnp.eye(4))
    assert float(matched.grey) == pytest.approx(1, abs=1e-3) and float(matched.depth) == pytest.approx(1, abs=1e-3)
    noise = noisy_pair(rng.normal(0, 12, (48, 64)))
    one_sigma = float(jit_explained(build(noise), jnp.eye(4)).grey)
    assert one_sigma == pytest.approx(0.683, abs=0.04)
    unrelated = noise._replace(target_grey=rng.permuted(noise.reference_grey))
    assert float(jit_explained(build(unrelated), jnp.eye(4)).grey) < 0.4
    half = smooth_pair(rim=1)
    half.target_inverse_depth[:, :32] += 0.1
    assert 0.4 < float(jit_explained(build(half, scales=(1.0, 0.01, 0.3)), jnp.eye(4)).depth) < 0.6


def test_gradient_scatter_is_a_covariance() -> None:
    noise = np.random.default_rng(4).normal(0, 3, (48, 64))
    problem = Problem(build(noisy_pair(noise), student_t, (3.0, 0.01, 0.3)), jnp.eye(4), jnp.eye(6))
    residuals = jit_residuals(problem.objective, problem.origin)
    scatter = np.asarray(jax.jit(lambda problem, residuals: problem.examine(residuals)[1])(problem, residuals), float)
    np.testing.assert_allclose(scatter, scatter.T, rtol=1e-4, atol=1e-4 * np.abs(scatter).max())
    assert np.linalg.eigvalsh(scatter).min() > -1e-5 * np.linalg.eigvalsh(scatter).max()
    assert np.linalg.eigvalsh(scatter).max() > 0


def staircase(s: jax.Array) -> jax.Array:
    """Flat nearly everywhere: its derivative tells nothing."""
    return jnp.ceil(jnp.minimum(s, 9.0))


def test_any_callable_is_a_loss() -> None:
    pair = random_pair(11)
    motion = random_motions(1)[0]
    terms = oracle.residuals(pair, np.asarray(motion, float))
    expected = 400 * np.ceil(np.minimum((terms.grey / 20) ** 2, 9)).mean()
    objective = build(pair, staircase, (20.0, 0.01, 0.0))
    assert float(jit_error(objective, motion)[0]) == pytest.approx(expected, rel=1e-3)


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
