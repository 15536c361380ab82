"""Every batched kernel at the sizes that are used, compiled, against float64: what a new JAX has to pass."""

import jax
import numpy as np
import oracle
import pytest

from gavo_jax.camera import Camera
from gavo_jax.objective.problem import TILES
from gavo_jax.selfcheck import checks, equations
from gavo_jax.selfcheck.checks import CHECKS, WEIGHING, largest_deviation, spread_rows

SMALL = Camera(24.0, 23.0, 11.3, 8.8, 24, 18)
TWIST = np.array([0.03, -0.05, 0.04, 0.02, -0.03, 0.05])
BASIS = np.diag([0.01, 0.01, 0.02, 0.005, 0.005, 0.01]) + 0.002

AT_SIZES = [
    pytest.param(name, size, id=f"{name}-{size}")
    for name, check in CHECKS.items()
    for size in sorted({*check.sizes, *check.borders})
]


@pytest.mark.parametrize(("name", "size"), AT_SIZES)
def test_kernel_is_right(name: str, size: int) -> None:
    outcome = CHECKS[name].run(size)
    assert outcome.is_right, f"{outcome.name}: off by {outcome.deviation:.1e}, at most {outcome.tolerance:.0e}"


def test_sizes_are_those_of_the_presets() -> None:
    assert {64, 96 * 24, 8192} <= set(CHECKS["exp"].sizes)
    assert CHECKS["points"].sizes == (4800, 19200, 640 * 480)
    assert 2 * 4800 in CHECKS["covariance"].sizes
    assert CHECKS["generation"].sizes == (1, 96)
    for name in ("exp", "inverse", "transform", "warp"):
        assert {2**11 - 1, 2**11, 2**11 + 1, 2**14 + 1} <= set(CHECKS[name].borders)


ROW_KERNELS = {
    "exp": "exp",
    "log": "log",
    "inverse": "rigid_inverse",
    "transform": "transform",
    "warp": "warp_points",
    "candidates": "score",
}
KERNELS = {"points": "score", "derivatives": "linearize", "covariance": "examine"}


@pytest.mark.parametrize(("name", "kernel"), ROW_KERNELS.items())
def test_a_kernel_that_is_wrong_from_row_2048_on_is_caught(
    name: str, kernel: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = getattr(checks, kernel)

    def wrong(*arguments):
        def off(leaf):
            values = np.array(leaf)
            values[2048:] *= 1.001
            return values

        return jax.tree.map(off, right(*arguments))

    monkeypatch.setattr(checks, kernel, wrong)
    assert not CHECKS[name].run(2049).is_right
    assert CHECKS[name].run(2047).is_right


@pytest.mark.parametrize(("name", "kernel"), KERNELS.items())
def test_a_kernel_that_is_a_little_off_is_caught(name: str, kernel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    right, check = getattr(checks, kernel), CHECKS[name]
    factor = np.float32(1.002)
    monkeypatch.setattr(checks, kernel, lambda *given: jax.tree.map(lambda a: np.asarray(a) * factor, right(*given)))
    assert not check.run(check.borders[0]).is_right


def test_a_generation_that_is_a_little_off_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    right, check = checks.breed, CHECKS["generation"]

    def wrong(*given):
        state, chance = right(*given)
        return state._replace(offspring=np.asarray(state.offspring) * np.float32(1.002)), chance

    monkeypatch.setattr(checks, "breed", wrong)
    assert not check.run(check.borders[0]).is_right


def test_one_wrong_choice_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    right, check = checks.best_distinct, CHECKS["distinct"]
    monkeypatch.setattr(checks, "best_distinct", lambda *given, count: right(*given, count=count).at[-1].set(0))
    assert not check.run(check.borders[0]).is_right


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_a_missing_number_is_never_right(number: float) -> None:
    assert largest_deviation([0.0, number], [0.0, 1.0]) == np.inf
    assert largest_deviation([np.nan], [np.nan]) == np.inf
    assert largest_deviation([np.inf, 1.0], [np.inf, 1.5]) == 0.5


def test_rows_that_are_compared_lie_about_powers_of_two() -> None:
    rows = spread_rows(8192, 60)
    assert {0, 2047, 2048, 4095, 4096, 8191} <= set(rows) and len(rows) <= 60 and rows.max() == 8191
    assert list(spread_rows(5, 60)) == [0, 1, 2, 3, 4]


def small_scene() -> equations.Scene:
    """A point on every pixel."""
    v, u = np.mgrid[: SMALL.height, : SMALL.width]
    return equations.plane_scene(SMALL, u.ravel().astype(float), v.ravel().astype(float))


def as_pair(scene: equations.Scene) -> oracle.Pair:
    rows, columns = np.mgrid[: SMALL.height, : SMALL.width]
    a, b, c = scene.plane
    shape = (SMALL.height, SMALL.width)
    images = (scene.grey.reshape(shape), scene.q.reshape(shape), scene.target_grey, a + b * columns + c * rows)
    return oracle.Pair(SMALL, *(image.astype(float) for image in images))


def test_reference_exp_is_the_matrix_exponential() -> None:
    twists = np.concatenate([np.random.default_rng(0).normal(size=(20, 6)), np.zeros((1, 6)), 1e-6 * np.ones((1, 6))])
    np.testing.assert_allclose(equations.exp(twists), [oracle.expm(xi) for xi in twists], atol=1e-12)


def test_reference_adjoint() -> None:
    motion, step = oracle.expm(TWIST), 0.1 * TWIST[::-1]
    expected = motion @ oracle.expm(step) @ np.linalg.inv(motion)
    np.testing.assert_allclose(oracle.expm(equations.adjoint(motion) @ step), expected, atol=1e-12)


@pytest.mark.parametrize("scale", [0.3, 1.0, 3.0])
def test_reference_error_is_the_oracles(scale: float) -> None:
    scene, motion = small_scene(), oracle.expm(scale * TWIST)
    r = equations.residuals(scene, motion)
    terms = oracle.residuals(as_pair(scene), motion)
    by = WEIGHING._replace(outside_cost=0.0)
    error, overlap = equations.error(scene, r, by)
    assert overlap == pytest.approx(terms.overlap)
    np.testing.assert_allclose(r.grey, terms.grey, atol=1e-4)  # the scene's rays are float32
    expected = oracle.error(terms, "geman-mcclure", by.grey, by.depth, 0.0)
    assert equations.error(scene, r, by._replace(depth_weight=0.0))[0] == pytest.approx(expected, rel=1e-6)
    # the oracle's inclination comes from neighbours, of which every eleventh is missing here
    np.testing.assert_allclose(r.depth, terms.depth, atol=2e-5)
    assert error == pytest.approx(oracle.error(terms, "geman-mcclure", by.grey, by.depth, by.depth_weight), rel=1e-3)


def test_reference_gradient_is_the_errors() -> None:
    scene, motion, step = small_scene(), oracle.expm(TWIST), 1e-6
    found = equations.slope(scene, motion, BASIS, WEIGHING, TILES)

    def error(x: np.ndarray) -> float:
        moved = motion @ oracle.expm(BASIS @ x)
        return equations.error(scene, equations.residuals(scene, moved), WEIGHING)[0]

    numerical = [(error(step * axis) - error(-step * axis)) / (2 * step) for axis in np.eye(6)]
    np.testing.assert_allclose(found.gradient, numerical, rtol=1e-5, atol=1e-6)
    assert np.allclose(found.hessian, found.hessian.T) and np.all(np.linalg.eigvalsh(found.hessian) > 0)
    assert np.allclose(found.scatter, found.scatter.T) and np.all(np.linalg.eigvalsh(found.scatter) > 0)


def test_reference_generation_selects_by_the_wheel() -> None:
    rng = np.random.default_rng(1)
    x, chance = rng.normal(size=(1, 16, 6)), rng.uniform(size=(1, 8, 8))
    errors = 1.0 + rng.permutation(16)[None] / 8
    by = equations.Breeding(8.0, 2, 0.25, 1.0, 4.0)
    found = equations.generation(x, errors, chance, by)
    best = np.argsort(errors[0])[:8]
    np.testing.assert_array_equal(found.population[0], x[0, best])
    fitness = np.exp(-8.0 * (found.error[0] / found.error[0, 0] - 1.0))
    drawn = [np.searchsorted(np.cumsum(fitness) / fitness.sum(), chance[0, 0, 6 + i]) for i in (0, 1)]
    first, second = found.population[0, drawn]
    alpha = 1.5 * chance[0, 0, :6] - 0.25
    np.testing.assert_allclose(found.offspring[0, 0], np.clip(first + alpha * (second - first), -4, 4))


def test_reference_surrogate_finds_the_minimum_of_a_round_bowl() -> None:
    rng, minimum = np.random.default_rng(2), np.array([0.5, -0.3, 0.2, 0.1, -0.6, 0.4])
    x = rng.normal(size=(1, 64, 6))
    error = 1.0 + np.sum((x - minimum) ** 2, axis=2)
    order = np.argsort(error, axis=1)
    found = equations.surrogate_minimum(np.take_along_axis(x, order[..., None], 1), np.take_along_axis(error, order, 1))
    np.testing.assert_allclose(found[0], minimum, atol=1e-4)


def test_reference_clears_modes() -> None:
    places = np.zeros((5, 6))
    places[:, 0] = [0.0, 0.9, 1.1, 3.0, 3.5]
    found = equations.best_distinct(places, np.array([2.0, 1.0, 3.0, 5.0, 4.0]), 2)
    np.testing.assert_array_equal(found, [1, 4])


def test_every_check_runs_at_full_size_and_a_fault_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def crash(_: int) -> float:
        raise jax.errors.JaxRuntimeError("no such\ninstruction")

    fine = checks.Check("fine of {} rows", lambda rows: rows * 1e-9, 1e-6, (3, 70), ())
    known = {"fine": fine, "broken": fine._replace(words="broken of {} rows", deviation=crash), "log": fine}
    monkeypatch.setattr(checks, "CHECKS", known)
    first, second = checks.full_size()
    assert first == ("fine of 70 rows", 7e-8, 1e-6) and first.is_right
    assert second.name == "broken of 70 rows (no such instruction)" and not second.is_right


def test_the_speed_is_a_time() -> None:
    assert 0.01 < checks.scoring_nanoseconds() < 10_000
