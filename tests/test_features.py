"""Features find target_T_reference from matches, many of them wrong, and say nothing where too few agree."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from gavo_jax.features import FeatureKind, Features, detect, feature_motion, solve_motion
from tests.small import CAMERA

TRUTH = np.eye(4)
TRUTH[:3, :3] = cv2.Rodrigues(np.array([0.1, -0.5, 0.3]))[0]
TRUTH[:3, 3] = (0.3, -0.1, 0.2)


def matched(wrong: float, count: int = 200) -> tuple[Features, Features]:
    """Points before the camera and where they land after `TRUTH`, with a share of the matches shuffled."""
    generator = np.random.default_rng(0)
    points = generator.uniform((-0.8, -0.8, 1.5), (0.8, 0.8, 3.0), (count, 3))
    landed = np.asarray(CAMERA.project(points @ TRUTH[:3, :3].T + TRUTH[:3, 3]))
    before = np.asarray(CAMERA.project(points))
    descriptors = generator.normal(size=(count, 32)).astype(np.float32)
    shuffled = int(wrong * count)
    landed[:shuffled] = generator.permutation(landed[:shuffled])
    return Features(before, descriptors, points), Features(landed, descriptors, np.full((count, 3), np.nan))


@pytest.mark.parametrize("wrong", [0.0, 0.6])
def test_the_motion_comes_back_in_our_direction(wrong: float) -> None:
    """It maps the reference's points into the target camera, whatever many of the matches say."""
    found = solve_motion(*matched(wrong), CAMERA)
    assert found is not None
    np.testing.assert_allclose(found.target_T_reference, TRUTH, atol=1e-5)
    assert found.share == pytest.approx(1.0 - wrong, abs=0.03)
    assert found.inliers == round(found.share * 200)


def test_chance_is_no_motion() -> None:
    """Nor are matches that all disagree, or none."""
    before, after = matched(0.0)
    assert solve_motion(before._replace(points=np.full_like(before.points, np.nan)), after, CAMERA) is None
    assert (
        solve_motion(before, after._replace(pixels=after.pixels[:1], descriptors=after.descriptors[:1]), CAMERA) is None
    )


@pytest.mark.parametrize("kind", ["sift", "orb"])
def test_images_that_turn_about_the_axis(kind: FeatureKind) -> None:
    """A picture before the camera, turned by a right angle: roll is what comes out, and depth is the camera's."""
    size = 120
    camera = replace(CAMERA, width=size, height=size, cx=(size - 1) / 2, cy=(size - 1) / 2)
    coarse = np.random.default_rng(1).integers(40, 220, (24, 24)).astype(np.uint8)
    image = cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC)
    depth = np.full((size, size), 7500, np.uint16)
    found = feature_motion((image, depth), (np.rot90(image, -1), depth), camera, kind)
    assert found is not None
    expected = cv2.Rodrigues(np.array([0.0, 0.0, np.pi / 2]))[0]
    np.testing.assert_allclose(found.target_T_reference[:3, :3], expected, atol=0.06)
    np.testing.assert_allclose(found.target_T_reference[:3, 3], 0.0, atol=0.1)


def test_a_plain_frame_has_no_keypoints() -> None:
    """And a keypoint without a reading has no point."""
    plain = np.full((120, 160), 128, np.uint8)
    assert len(detect(plain, np.full((120, 160), 5000, np.uint16), CAMERA).pixels) == 0
    dots = plain.copy()
    dots[40:46, 30:36] = 255
    features = detect(dots, np.zeros((120, 160), np.uint16), CAMERA)
    assert len(features.pixels) and np.isnan(features.points).all()


@pytest.mark.parametrize("kind", ["sift", "orb"])
def test_grey_of_any_numbers_has_the_keypoints_of_bytes(kind: FeatureKind) -> None:
    """OpenCV ended the program."""
    coarse = np.random.default_rng(1).integers(40, 220, (15, 20)).astype(np.uint8)
    grey = cv2.resize(coarse, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_CUBIC)
    depth = np.full(grey.shape, 7500, np.uint16)
    expected = detect(grey, depth, CAMERA, kind)
    assert len(expected.pixels) > 20
    for other in (grey.astype(np.float32) + np.float32(0.2), grey.astype(np.int64)):
        np.testing.assert_array_equal(detect(other, depth, CAMERA, kind).descriptors, expected.descriptors)
    blank = np.full(grey.shape, np.nan, np.float32)
    assert len(detect(blank, depth, CAMERA, kind).pixels) == 0
