"""Surfaces that tell little are told apart from those that tell enough, whatever the noise."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from small import CAMERA

from gavo_jax.alignment.pairs import align
from gavo_jax.alignment.result import Alignment
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.status import AlignmentStatus

DISTANCE = 1.5
"""Metres to the wall."""
SLIDE = np.array([0.01, 0.004])
"""Metres that the camera slides along the wall, right and down."""

Texture = Callable[[np.ndarray, np.ndarray], np.ndarray]


def waves(t: np.ndarray) -> np.ndarray:
    """Grey without a period along one coordinate in metres."""
    return 128 + 25 * (np.sin(23 * t) + np.sin(37 * t + 1) + np.sin(61 * t + 2))


WALLS: dict[str, tuple[Texture, set[str]]] = {
    "upright bands": (lambda x, y: waves(x), {"translation along y"}),
    "level bands": (lambda x, y: waves(y), {"translation along x"}),
    "oblique bands": (lambda x, y: waves(0.6 * x + 0.8 * y), {"translation along x", "translation along y"}),
    "one edge": (lambda x, y: 128 + 50 * np.tanh((x - 0.1) / 0.003), {"translation along y"}),
    "plain wall": (lambda x, y: np.full_like(x, 128.0), {"translation along x", "translation along y"}),
}


def photograph(
    texture: Texture, slide: np.ndarray, noise: float, kinect: bool, seed: int, slope: float = 0.0
) -> tuple[Any, Any]:
    """Grey and depth of a wall before the camera, further off to the right by a slope, with a sensor's noise."""
    generator = np.random.default_rng(seed)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    z = (DISTANCE + slope * slide[0]) / (1 - slope * x)
    x, y = x * z + slide[0], y * z + slide[1]
    grey = np.clip(np.round(texture(x, y) + noise * generator.normal(size=x.shape)), 0, 255).astype(np.uint8)
    inverse_depth = 1 / z
    if kinect:  # steps of an eighth of a pixel of disparity, and a noise of half of one
        inverse_depth = 0.00287 * np.round(inverse_depth / 0.00287 + 0.5 * generator.normal(size=x.shape))
    return grey, np.round(CAMERA.depth_scale / inverse_depth).astype(np.uint16)


def slid(texture: Texture, noise: float, kinect: bool) -> Alignment:
    """What is said of a wall that the camera slides along."""
    before, after = (photograph(texture, step * SLIDE, noise, kinect, step) for step in (0, 1))
    return align(before, after, CAMERA, GaussNewton())


@pytest.mark.parametrize("kinect", [False, True])
@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0, 3.0])
@pytest.mark.parametrize("name", WALLS)
def test_what_a_wall_leaves_open_is_named(name: str, noise: float, kinect: bool) -> None:
    texture, left_open = WALLS[name]
    result = slid(texture, noise, kinect)
    assert result.status is AlignmentStatus.LOW_TEXTURE
    assert all(direction in result.undetermined for direction in left_open)
    variances = np.linalg.eigvalsh(np.asarray(result.covariance, float))
    assert variances[-1] > 0.2 and variances[0] > -1e-6 * variances[-1]  # half a metre; single precision


def test_a_direction_is_named_by_every_axis_that_it_is_open_along() -> None:
    """The bands of a slanted wall run away from the camera as well, by a fifth of their way."""
    texture = WALLS["oblique bands"][0]
    before, after = (photograph(texture, step * SLIDE, 1.0, False, step, slope=0.3) for step in (0, 1))
    named = align(before, after, CAMERA, GaussNewton()).undetermined
    assert {part.removeprefix("translation along ") for part in named.split(" with ")} == {"x", "y", "z"}


@pytest.mark.parametrize("kinect", [False, True])
@pytest.mark.parametrize("noise", [0.0, 1.0, 3.0])
def test_a_texture_in_both_directions_is_enough(noise: float, kinect: bool) -> None:
    result = slid(lambda x, y: (waves(x) + waves(y)) / 2, noise, kinect)
    assert result.status is AlignmentStatus.OK and result.statuses == (AlignmentStatus.OK,)
    np.testing.assert_allclose(result.target_T_reference[:2, 3], -SLIDE, atol=1e-3)


def test_few_steep_points_do_not_hide_what_all_others_tell() -> None:
    """The outline of a bright picture holds most of the information; a weak texture is everywhere."""

    def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.where((np.abs(x - 0.05) < 0.04) & (np.abs(y) < 0.04), 250.0, 110 + 0.06 * (waves(x) + waves(y) - 256))

    result = slid(texture, 2.0, True)
    assert result.status is AlignmentStatus.OK
    np.testing.assert_allclose(result.target_T_reference[:2, 3], -SLIDE, atol=2e-3)


@pytest.mark.parametrize("name", WALLS)
def test_the_same_image_twice_tells_no_more(name: str) -> None:
    view = photograph(WALLS[name][0], 0 * SLIDE, 0.0, False, 0)
    assert align(view, view, CAMERA, GaussNewton()).status is AlignmentStatus.LOW_TEXTURE


def test_nothing_is_known_without_depth() -> None:
    grey, depth = photograph(lambda x, y: waves(x) + waves(y) - 128, 0 * SLIDE, 1.0, False, 0)
    result = align((grey, np.zeros_like(depth)), (grey, depth), CAMERA, GaussNewton())
    assert result.status is AlignmentStatus.NO_DEPTH
    assert np.isnan(result.covariance).all()
