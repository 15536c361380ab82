"""The warp ω(ξ, p) = P(g(ξ) P⁻¹(p)), equations (4) to (8), and depth at another moment.

Points are kept as separate flat arrays of ray coordinates and inverse depth, which suits a CPU's vector units.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gavo_jax.camera import Camera, to_pixels, to_ray
from gavo_jax.image.levels import ImagePlane
from gavo_jax.se3 import rigid_inverse


class Points(NamedTuple):
    """Points of the reference frame as inverse-depth rays: P⁻¹(p) = (x, y, 1)/q. Flat arrays of N."""

    x: Float[Array, " n"]
    y: Float[Array, " n"]
    q: Float[Array, " n"]
    """Inverse depth, 1/m; 0 marks a point without a reading."""


class Warped(NamedTuple):
    """Reference points seen by the target camera, all at one moment."""

    u: Float[Array, " n"]
    v: Float[Array, " n"]
    inverse_depth: Float[Array, " n"]
    """1/z in the target camera, 1/m."""
    inside: Float[Array, " n"]
    """1 where the point has a reading, lies before the camera and inside the image, else 0."""


def synchronise_depth(
    inverse_depth: Float[Array, "h w"], camera: Camera, depth_T_colour: Float[Array, "4 4"]
) -> Float[Array, "h w"]:
    """Inverse depth as the camera would have read it at the colour image's moment.

    A structured-light camera's depth and colour images are not exposed together: TUM's pairs lie up to 20 ms apart,
    at handheld speed several pixels. Each pixel looks up, in the depth image, where its point was when that was taken.

    Args:
        inverse_depth: [h, w] 1/m, 0 = no reading, seen by the camera where it stood when depth was read.
        camera: Camera of the image.
        depth_T_colour: Maps points of the camera at the colour image's moment into the camera at the depth image's.
    """
    height, width = inverse_depth.shape
    x, y = to_ray(camera, jnp.arange(width), jnp.arange(height)[:, None])
    x, y, depth = moved(Points(x, y, inverse_depth), depth_T_colour)
    u, v = to_pixels(camera, x, y, 1.0 / depth)
    inside = (depth > 1e-3) & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
    column = jnp.clip((u + 0.5).astype(jnp.int32), 0, width - 1)
    row = jnp.clip((v + 0.5).astype(jnp.int32), 0, height - 1)
    pixel = jnp.where(inside, row * width + column, 0)
    read = jnp.where(inside, inverse_depth.reshape(-1).at[pixel].get(mode="promise_in_bounds"), 0.0)
    rays = to_ray(camera, column.astype(jnp.float32), row.astype(jnp.float32))
    _, _, depth_back = moved(Points(*rays, read), rigid_inverse(depth_T_colour))
    return jnp.where(depth_back > 1e-3, read / depth_back, 0.0)


def moved(points: Points, camera_T_reference: Float[Array, "4 4"]) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Points seen from another camera, their coordinates times their old inverse depth: R (x, y, 1) + t q."""
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
    inside = before & (points.q > 0) & (u >= 0) & (u < camera.width - 1) & (v >= 0) & (v < camera.height - 1)
    return Warped(u, v, points.q * per_depth, inside.astype(jnp.float32))
