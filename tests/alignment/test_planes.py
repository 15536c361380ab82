"""Planes in a frame's depth, and views from straight before them."""

import numpy as np
import pytest
from small import CAMERA

from gavo_jax.alignment.planes import Plane, planes, seen_straight, smaller

V, U = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
X, Y = (U - CAMERA.cx) / CAMERA.fx, (V - CAMERA.cy) / CAMERA.fy


def depth_of(*shown: Plane) -> np.ndarray:
    """The nearest of some planes."""
    q = np.max(
        [(plane.normal[0] * X + plane.normal[1] * Y + plane.normal[2]) / plane.distance for plane in shown], axis=0
    )
    return np.where(q > 0.1, CAMERA.depth_scale / np.maximum(q, 0.1), 0).astype(np.uint16)


def plane(x: float, y: float, z: float, distance: float) -> Plane:
    normal = np.array([x, y, z])
    return Plane(normal / np.linalg.norm(normal), distance)


WALL, SLANTED, FLOOR = plane(0, 0, 1, 2.0), plane(-0.6, 0.2, 1, 1.5), plane(0, 1, 0, 0.8)


def looked_at(depth: np.ndarray, grey: np.ndarray | None = None):
    return smaller(np.zeros(depth.shape, np.uint8) if grey is None else grey, depth, CAMERA, 2)


@pytest.mark.parametrize("shown", [WALL, SLANTED])
def test_a_wall_is_a_plane(shown: Plane) -> None:
    (found,) = planes(looked_at(depth_of(shown)))
    np.testing.assert_allclose(found.normal, shown.normal, atol=0.01)
    assert found.distance == pytest.approx(shown.distance, rel=0.01)


def test_a_floor_before_a_wall_makes_two() -> None:
    far = plane(0, 0, 1, 4.0)
    found = planes(looked_at(depth_of(far, FLOOR)))
    for shown in (far, FLOOR):
        assert min(np.linalg.norm(plane.foot - shown.foot) for plane in found) < 0.02


@pytest.mark.parametrize(
    "depth", [np.zeros_like(U), 2000 + 6000 * np.hypot(np.sin(9 * X), np.cos(7 * Y))], ids=["none", "waves"]
)
def test_what_is_no_plane_is_none(depth: np.ndarray) -> None:
    assert planes(looked_at(depth.astype(np.uint16))) == []


def test_a_view_from_straight_before_a_wall_shows_it_to_scale() -> None:
    """A square on a slanted wall is a square, and what stands before the wall is left out."""
    right = np.array([1.0, 0.0, 0.0]) - SLANTED.normal[0] * SLANTED.normal
    right /= np.linalg.norm(right)
    down = np.cross(SLANTED.normal, right)
    depth = depth_of(SLANTED)
    points = np.stack([X, Y, np.ones_like(X)], axis=-1) * (depth / CAMERA.depth_scale)[..., None]
    s, t = points @ right - 0.5, points @ down
    square = (np.abs(s) < 0.2) & (np.abs(t) < 0.2)
    depth[:20, :20] = 0.5 * CAMERA.depth_scale
    view = seen_straight(looked_at(depth, np.where(square, 200, 50).astype(np.uint8)), SLANTED)
    assert view is not None
    np.testing.assert_allclose(view.axes / np.linalg.norm(view.axes, axis=1, keepdims=True), [right, down], atol=1e-6)
    rows, columns = np.nonzero(view.grey > 125)
    pixel = np.linalg.norm(view.axes[0])
    assert (np.ptp(columns) + 1) * pixel == pytest.approx(0.4, abs=0.04)
    assert (np.ptp(rows) + 1) * pixel == pytest.approx(0.4, abs=0.04)
    assert 0.5 < view.inside.mean() < 0.95


def test_a_plane_out_of_sight_is_seen_from_nowhere() -> None:
    assert seen_straight(looked_at(depth_of(WALL)), plane(0, 0, 1, 5.0)) is None
