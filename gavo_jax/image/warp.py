"""The warp ω(ξ, p) = P(g(ξ) P⁻¹(p)), equations (4) to (8).

Points are kept as separate flat arrays of ray coordinates and inverse depth, which suits a CPU's vector units.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gavo_jax.camera import Camera, to_pixels
from gavo_jax.image.levels import ImagePlane


class Points(NamedTuple):
    """Points of the reference frame as inverse-depth rays: P⁻¹(p) = (x, y, 1)/q. Arrays of any shape."""

    x: Float[Array, "*n"]
    y: Float[Array, "*n"]
    q: Float[Array, "*n"]
    """Inverse depth, 1/m; 0 marks a point without a reading."""


class Warped(NamedTuple):
    """Reference points seen by the target camera, all at one instant."""

    u: Float[Array, "*n"]
    v: Float[Array, "*n"]
    inverse_depth: Float[Array, "*n"]
    """1/z in the target camera, 1/m."""
    inside: Float[Array, "*n"]
    """1 where the point has a reading, lies in front of the camera and inside the image, else 0."""


class Slopes(NamedTuple):
    """Derivatives of a sampled quantity with respect to the coordinates of warped points; see `Warped`."""

    along_u: Float[Array, "*n"]
    along_v: Float[Array, "*n"]
    along_inverse_depth: Float[Array, "*n"]


def has_neighbours(u: Float[Array, "*n"], v: Float[Array, "*n"], camera: Camera | ImagePlane) -> Bool[Array, "*n"]:
    """Whether the four pixels around a position lie in the image."""
    return (u >= 0) & (u < camera.width - 1) & (v >= 0) & (v < camera.height - 1)


def moved(points: Points, camera_T_reference: Float[Array, "4 4"]) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return points in another camera's frame, scaled by their old inverse depth: R (x, y, 1) + t q."""
    r, t = camera_T_reference[:3, :3], camera_T_reference[:3, 3]
    x, y, q = points
    along = [r[i, 0] * x + r[i, 1] * y + (r[i, 2] + t[i] * q) for i in range(3)]
    return along[0], along[1], along[2]


def warp(points: Points, target_T_reference: Float[Array, "4 4"], camera: Camera | ImagePlane) -> Warped:
    """ω(ξ, p) = P(g(ξ) P⁻¹(p)) of every reference point for one motion. Equations (4), (7) and (8)."""
    x, y, depth = moved(points, target_T_reference)
    before = depth > 1e-3
    per_depth = 1.0 / jnp.where(before, depth, 1.0)
    u, v = to_pixels(camera, x, y, per_depth)
    inside = before & (points.q > 0) & has_neighbours(u, v, camera)
    return Warped(u, v, points.q * per_depth, inside.astype(jnp.float32))
