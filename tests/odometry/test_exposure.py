"""Brightness, contrast and sharpness of images."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from gavo_jax.image.pyramid import LEVELS, build_pyramid
from gavo_jax.odometry.exposure import SHARPNESS_LEVEL, Exposure
from gavo_jax.odometry.plausibility import MAX_ERROR_RATIO, MIN_USUAL_ERROR


def exposure_of(grey: np.ndarray) -> Exposure:
    return Exposure.of(build_pyramid(jnp.asarray(grey), jnp.ones(grey.shape), 1.0, LEVELS))


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    noise = np.random.default_rng(0).normal(0.0, 1.0, (128, 160)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 4.0)
    return 120.0 + 20.0 * smooth / smooth.std()


def test_error_per_pixel_is_that_of_a_shift(image: np.ndarray) -> None:
    """The mean over shifts along x and along y is half of the sum over both directions."""
    step = 2**SHARPNESS_LEVEL
    shifted = [np.mean((np.roll(image, step, axis)[step:, step:] - image[step:, step:]) ** 2) for axis in (0, 1)]
    exposure = exposure_of(image)
    assert float(exposure.error_per_pixel(exposure)) == pytest.approx(sum(shifted), rel=0.1)


def test_fine_texture_cannot_hide_that_images_differ() -> None:
    """Their E, twice the variance, has to exceed what is a high error after a camera at rest."""
    one, other = np.random.default_rng(0).normal(120.0, 20.0, (2, 64, 80)).repeat(2, axis=1).repeat(2, axis=2)
    exposure = exposure_of(one)
    assert np.mean((one - other) ** 2) > 1.5 * MAX_ERROR_RATIO * MIN_USUAL_ERROR * exposure.error_per_pixel(exposure)


def test_the_sharper_image_counts(image: np.ndarray) -> None:
    sharp, soft = exposure_of(image), exposure_of(cv2.GaussianBlur(image, (0, 0), 4.0))
    assert sharp.sharpness > 1.5 * soft.sharpness
    assert sharp.error_per_pixel(soft) == pytest.approx(float(sharp.error_per_pixel(sharp)))
    assert soft.error_per_pixel(sharp) == pytest.approx(float(soft.spread**2 * sharp.sharpness))


def test_gain_and_bias_leave_sharpness(image: np.ndarray) -> None:
    exposure, darker = exposure_of(image), exposure_of(0.5 * image + 10.0)
    assert darker.sharpness == pytest.approx(float(exposure.sharpness), rel=1e-3)
    assert darker.error_per_pixel(darker) == pytest.approx(0.25 * float(exposure.error_per_pixel(exposure)), rel=1e-3)
