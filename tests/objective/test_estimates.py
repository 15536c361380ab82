"""What is estimated from the data: scales, brightness, the share explained, and how far depth is trusted."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from observed import build, noisy_pair, random_pair, smooth_pair

from gavo_jax.objective.error import Objective
from gavo_jax.objective.estimates import Brightness, depth_trust, estimate_brightness, estimate_scales, explained_share

GREYS = ("reference_grey", "target_grey")
jit_scales = jax.jit(lambda objective, motion, weight: estimate_scales(objective.residuals(motion), weight))
jit_trust = jax.jit(depth_trust)


@jax.jit
def jit_brightness(objective: Objective, motion: jax.Array) -> Brightness:
    """Of one view."""
    one = jax.tree.map(lambda leaf: leaf[None], objective.reference)
    found = estimate_brightness(one.grey, replace(objective, reference=one).residuals(motion))
    return jax.tree.map(lambda leaf: leaf[0], found)


jit_explained = jax.jit(lambda objective, motion: explained_share(objective.residuals(motion)))


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


def test_white_that_both_images_show_does_not_make_the_noise_smaller() -> None:
    pair = noisy_pair(np.random.default_rng(4).normal(0, 4, (48, 64)))
    scales = [float(jit_scales(build(one), jnp.eye(4), 1.0).grey) for one in (pair, _partly_white(pair))]
    assert scales[1] == pytest.approx(scales[0], rel=0.1)


def test_white_tells_nothing_of_a_gain() -> None:
    pair = noisy_pair(np.random.default_rng(5).normal(0, 1.0, (48, 64)), gain=0.8)
    gain, _ = jit_brightness(build(_partly_white(pair)), jnp.eye(4))
    assert float(gain) == pytest.approx(0.8, abs=0.02)


def test_nothing_is_brighter_than_white() -> None:
    brightness = Brightness(jnp.array([1.5]), jnp.array([-10.0]))
    np.testing.assert_allclose(brightness.seen(jnp.array([[100.0, 200.0]])), [[140.0, 255.0]])


def test_what_was_cut_off_may_have_been_brighter() -> None:
    pair = smooth_pair(rim=1)
    white = np.full((48, 64), 255.0)
    shares = []
    for target in (white - 40.0, white):
        objective = build(pair._replace(reference_grey=white, target_grey=target))
        seen = Brightness(jnp.array([0.9]), jnp.array([0.0])).seen(objective.reference.grey[None])[0]
        darker = objective.reference._replace(grey=seen)
        shares.append(float(jit_explained(replace(objective, reference=darker), jnp.eye(4)).grey))
    assert shares == [0.0, 1.0]


def _partly_white(pair: Any) -> Any:
    """A pair whose upper two thirds are white in both images."""
    white = (np.arange(48) < 32)[:, None]
    return pair._replace(**{name: np.where(white, 255.0, getattr(pair, name)) for name in GREYS})


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
