"""Warping of depth to the colour image's timestamp, if the two were not exposed together."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from gavo_jax.camera import Camera, to_pixels, to_ray
from gavo_jax.image.warp import Points, moved
from gavo_jax.se3 import rigid_inverse


def synchronise_depth(
    inverse_depth: Float[Array, "h w"], camera: Camera, depth_T_colour: Float[Array, "4 4"]
) -> Float[Array, "h w"]:
    """Warp inverse depth to what the camera would have read at the colour image's timestamp.

    A structured-light camera's depth and colour images are not exposed together: TUM's pairs are up to 20 ms apart,
    several pixels at handheld speed. Each pixel looks up the depth image where its point was when that was taken.

    Args:
        inverse_depth: [h, w] 1/m, 0 = no reading, seen from the camera's pose when depth was read.
        camera: Camera of the image.
        depth_T_colour: Maps points of the camera at the colour image's timestamp into that at the depth image's.
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
