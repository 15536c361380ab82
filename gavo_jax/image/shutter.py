"""The rolling shutter: rows are exposed one after the other while the camera moves."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gavo_jax.camera import Camera, to_pixels, to_ray
from gavo_jax.image.levels import ImagePlane
from gavo_jax.image.warp import Points, Slopes, Warped, has_neighbours


class Shutter(NamedTuple):
    """A rolling shutter's readout, the row times of points, and the target's sway."""

    readout: Float[Array, ""]
    """Share of the motion between the two frames that passes between the target's first and last row; negative if the
    target was taken before the reference."""
    row_time: Float[Array, "*n"]
    """Time at which each reference point was seen, in readouts after its frame's timestamp (the middle row's); 0 where
    the rolling shutter was undone."""
    sway: Float[Array, " 6"] | None = None
    """Additional twist, over the same time, of the points in the target camera at the target's timestamp; see
    `alignment.sway`."""


def row_time(v: Float[Array | np.ndarray, "*n"] | float, camera: Camera | ImagePlane) -> Any:
    """Return the exposure times of rows, in readouts after that of the image's middle."""
    return (v + 0.5) / camera.height - 0.5


def delay(points: Points, warped: Warped, shutter: Shutter, camera: Camera | ImagePlane) -> Warped:
    """Return where warped points really are when the row that they land on is read.

    Meanwhile the camera moves on along ξ. So each point continues along its path from the reference by the share of the
    motion that falls into its delay, plus its sway. This is to first order in that share, which is a few hundredths
    between frames of a video.
    """
    share, way = _passed(points, warped, shutter, camera)
    u, v, inverse_depth = (start + share * step for start, step in zip(warped[:3], way, strict=True))
    if shutter.sway is not None:
        late = shutter.readout * row_time(warped.v, camera)
        flow = twist_flow(shutter.sway, warped, camera)
        u, v, inverse_depth = (start + late * step for start, step in zip((u, v, inverse_depth), flow, strict=True))
    inside = (warped.inside > 0) & has_neighbours(u, v, camera)
    return Warped(u, v, inverse_depth, inside.astype(jnp.float32))


def twist_flow(
    twist: Float[Array, " 6"], warped: Warped, camera: Camera | ImagePlane
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the motion of points seen at pixels by a small twist: along u, v and 1/z."""
    (x, y), q, (v, w) = to_ray(camera, warped.u, warped.v), warped.inverse_depth, (twist[:3], twist[3:])
    away = w[0] * y - w[1] * x + v[2] * q
    along_u = camera.fx * (w[1] - w[2] * y + v[0] * q - x * away)
    along_v = camera.fy * (w[2] * x - w[0] + v[1] * q - y * away)
    return along_u, along_v, -q * away


def delayed_slopes(
    slopes: Slopes, points: Points, warped: Warped, shutter: Shutter, camera: Camera | ImagePlane
) -> Slopes:
    """Return slopes with respect to `warped`'s (u, v, 1/z), from those with respect to its `delay`ed values."""
    share, way = _passed(points, warped, shutter, camera)
    later = shutter.readout / camera.height * sum(slope * step for slope, step in zip(slopes, way, strict=True))
    along_u, along_v, along_inverse_depth = ((1.0 + share) * slope for slope in slopes)
    return Slopes(along_u, along_v + later, along_inverse_depth)


def _passed(
    points: Points, warped: Warped, shutter: Shutter, camera: Camera | ImagePlane
) -> tuple[jax.Array, tuple[jax.Array, jax.Array, jax.Array]]:
    """Return the share of the motion in each point's delay, and the points' paths (u, v, 1/z) from the reference."""
    share = shutter.readout * (row_time(warped.v, camera) - shutter.row_time)
    u, v = to_pixels(camera, points.x, points.y)
    return share, (warped.u - u, warped.v - v, warped.inverse_depth - points.q)
